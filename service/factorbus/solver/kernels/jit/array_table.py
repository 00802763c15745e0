"""Arrays that a kernel finds by their addresses: a table of them is one argument, which costs what one array costs.

A row of a table is the address of an array and its shape; of one with one dimension the second size is 1.  Who passes
a table keeps its arrays alive, and as C-contiguous, aligned rows of eight bytes an entry
(`factorbus.solver.graph.arenas`).
"""

import ctypes
from typing import Any

import numpy as np

from factorbus.solver.kernels.jit.compile import DISABLED, inline_kernel, intrinsic, ir, types

WIDTH = 3
_WORD = 8

ints: Any
floats: Any
int_rows: Any
float_rows: Any
address_of: Any


def array_in_python(table: Any, entry: int, kind: type, dimensions: int) -> Any:
    """The array at this entry of the table, with entries of `kind`; in Python."""
    address, *shape = table[WIDTH * entry : WIDTH * entry + 1 + dimensions].tolist()
    room: Any = (ctypes.c_char * (_WORD * int(np.prod(shape)))).from_address(address)
    return np.frombuffer(room, kind).reshape(shape)


if DISABLED:

    def _first_entry(array: Any) -> int:
        """Where it is."""
        return int(array.ctypes.data)

    def _plain(kind: type, dimensions: int) -> Any:
        return lambda table, entry: array_in_python(table, entry, kind, dimensions)

    address_of = _first_entry
    ints, int_rows = _plain(np.int64, 1), _plain(np.int64, 2)
    floats, float_rows = _plain(np.float64, 1), _plain(np.float64, 2)

else:

    @intrinsic
    def _entry(_typing: Any, array: Any) -> Any:
        """Where the first entry of the array is."""

        def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data = context.make_array(signature.args[0])(context, builder, args[0]).data
            return builder.ptrtoint(data, ir.IntType(64))

        return types.int64(array), emit

    def array_entry(context: Any, builder: Any, made: Any, words: Any, entry: Any, columns: int = 0) -> Any:
        """The array of type `made` at this entry of the table that begins at the pointer `words`.

        A table does not change while a kernel runs, so the compiler may look an array up once for a whole loop.
        columns: of a row, where they are always as many, so that an offset is a shift; 0: the table says.
        """
        first, row = builder.mul(entry, ir.IntType(64)(WIDTH)), []
        for k in range(1 + made.ndim):
            word = builder.load(builder.gep(words, [builder.add(first, ir.IntType(64)(k))]))
            word.set_metadata("invariant.load", builder.module.add_metadata([]))
            row.append(word)
        if columns > 0:
            row[2] = ir.IntType(64)(columns)
        return make_array(context, builder, made, row[0], row[1:])

    def _compiled(kind: Any, dimensions: int) -> Any:
        made = types.Array(kind, dimensions, "C")

        @intrinsic
        def found(_typing: Any, table: Any, _entry: Any) -> Any:
            """The array at this entry of the table."""

            def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
                words = context.make_array(signature.args[0])(context, builder, args[0]).data
                return array_entry(context, builder, made, words, args[1])

            return made(table, types.int64), emit

        return found

    def make_array(context: Any, builder: Any, made: Any, address: Any, shape: list[Any]) -> Any:
        """An array that nobody counts the references of."""
        size = context.get_constant(types.intp, _WORD)
        model = context.data_model_manager[made]
        fields = {
            "meminfo": context.get_constant_null(types.voidptr),
            "parent": context.get_constant_null(types.pyobject),
            "nitems": shape[0] if len(shape) == 1 else builder.mul(shape[0], shape[1]),
            "itemsize": size,
            "data": builder.inttoptr(address, context.get_value_type(types.CPointer(made.dtype))),
            "shape": _tuple(builder, shape),
            "strides": _tuple(builder, [size] if len(shape) == 1 else [builder.mul(shape[1], size), size]),
        }
        array = ir.Constant(context.get_value_type(made), ir.Undefined)
        for name, value in fields.items():
            array = model.set(builder, array, value, name)
        return array

    def _tuple(builder: Any, values: list[Any]) -> Any:
        made = ir.Constant(ir.ArrayType(values[0].type, len(values)), ir.Undefined)
        for k, value in enumerate(values):
            made = builder.insert_value(made, value, k)
        return made

    address_of = _entry
    ints, int_rows = _compiled(types.int64, 1), _compiled(types.int64, 2)
    floats, float_rows = _compiled(types.float64, 1), _compiled(types.float64, 2)


@inline_kernel
def put_entry(table: Any, entry: int, address: int, rows: int, columns: int) -> None:
    """Enter an array in the table, which is valid for as long as the array exists."""
    table[WIDTH * entry], table[WIDTH * entry + 1], table[WIDTH * entry + 2] = address, rows, columns
