"""Ask the processor for a cache line ahead of the code that reads it."""

from typing import Any

from factorbus.solver.kernels.jit.compile import DISABLED, cgutils, intrinsic, ir, types

prefetch: Any

if DISABLED:

    def _nothing(_array: Any, _i: int) -> None:
        """In plain Python nothing is fetched ahead."""

    prefetch = _nothing

else:

    @intrinsic
    def _fetch(_typing: Any, array: Any, _i: Any) -> Any:
        """The line of the number i, counted from the start of a contiguous array, comes into the nearest cache.

        No index is checked: an address that is none of the process's is ignored.
        """

        def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            number, byte = ir.IntType(32), ir.IntType(8).as_pointer()
            start = context.make_array(signature.args[0])(context, builder, args[0]).data
            address = builder.bitcast(builder.gep(start, [args[1]]), byte)
            kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
            fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
            builder.call(fetch, [address, number(0), number(3), number(1)])
            return context.get_dummy_value()

        return types.void(array, types.int64), emit

    prefetch = _fetch
