"""The processor's cycle counter: what share of a call each of its phases took.  It is not a clock."""

from typing import Any

from factorbus.solver.kernels.jit.compile import DISABLED, cgutils, intrinsic, ir, types

cycles: Any

if DISABLED:

    def _nothing() -> int:
        """In plain Python nothing is counted."""
        return 0

    cycles = _nothing

else:

    @intrinsic
    def _counter(_typing: Any) -> Any:
        """Cycles since some moment."""

        def emit(_context: Any, builder: Any, _signature: Any, _args: Any) -> Any:
            kind = ir.FunctionType(ir.IntType(64), [])
            counter = cgutils.get_or_insert_function(builder.module, kind, "llvm.readcyclecounter")
            return builder.call(counter, [])

        return types.int64(), emit

    cycles = _counter
