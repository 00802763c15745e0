"""Records of arrays by name: one argument of a kernel instead of twenty.

A record is a named tuple whose fields are `Ints`, `Floats`, `IntRows` or `FloatRows`.  `opener` returns the function
that makes one of a table of addresses (`array_table`), whose rows are in the order of the fields:

    class Lists(NamedTuple):
        starts: Ints
        values: FloatRows
        places: Annotated[IntRows, RowWidth(4)]

    lists_at = opener(Lists)

    @part
    def total(lists: Lists) -> float:
        starts, values = lists.starts, lists.values
        ...

In compiled code a record is the address of its table: it costs one word to pass, and an array is looked up where its
name is used.  So a table must stay as it is while a kernel runs.
"""

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

import numpy as np

from factorbus.solver.kernels.jit.array_table import array_in_python
from factorbus.solver.kernels.jit.compile import DISABLED, F64, I64, intrinsic, ir, types

# What an array holds, and how many dimensions it has.
Ints = Annotated[I64, (np.int64, 1)]
Floats = Annotated[F64, (np.float64, 1)]
IntRows = Annotated[I64, (np.int64, 2)]
FloatRows = Annotated[F64, (np.float64, 2)]

Record = TypeVar("Record", bound=tuple[Any, ...])


class RowWidth(NamedTuple):
    """How many columns an array of rows always has: kernels then compute with the number instead of reading it."""

    count: int


class Field(NamedTuple):
    """What an array of a record holds, its dimensions, and how many columns it always has; 0: that varies."""

    kind: type
    dimensions: int
    columns: int


def fields_of(record: type) -> dict[str, Field]:
    """The fields of a record by name, in the order of its table."""
    fields = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        (kind, dimensions), *columns = hint.__metadata__
        fields[name] = Field(kind, dimensions, columns[0].count if columns else 0)
    return fields


def opener(record: type[Record]) -> Callable[[I64], Record]:
    """The function that makes a record of its table."""
    return _open(record)


table_of: Any
_open: Any


def _open_in_python(record: type) -> Any:
    """What makes records of tables in Python; tests call parts of kernels with them."""
    kinds = [(field.kind, field.dimensions) for field in fields_of(record).values()]
    with_table: Any = type(record.__name__, (record,), {})

    def record_at(table: I64) -> Any:
        """The record of this table."""
        made = with_table(*(array_in_python(table, entry, *kind) for entry, kind in enumerate(kinds)))
        made.table_ = table
        return made

    return record_at, with_table


if DISABLED:

    def _open_only_in_python(record: type) -> Any:
        return _open_in_python(record)[0]

    def _table_of(record: Any) -> I64:
        """The table that the record was made of."""
        return record.table_

    table_of, _open = _table_of, _open_only_in_python

else:
    from factorbus.solver.kernels.jit.array_table import WIDTH, array_entry, make_array
    from factorbus.solver.kernels.jit.compile import AttributeTemplate, extending

    _ENTRIES = {np.int64: types.int64, np.float64: types.float64}

    class RecordType(types.Type):
        """The type of a record: the names and the types of its arrays."""

        def __init__(self, record: type) -> None:
            self.entries = {
                name: (k, types.Array(_ENTRIES[field.kind], field.dimensions, "C"), field.columns)
                for k, (name, field) in enumerate(fields_of(record).items())
            }
            super().__init__(name=f"{record.__module__}.{record.__qualname__}")

    @extending.register_model(RecordType)
    class _Address(extending.models.PrimitiveModel):
        """A pointer to the table."""

        def __init__(self, manager: Any, type_: Any) -> None:
            super().__init__(manager, type_, ir.IntType(64).as_pointer())

    @extending.infer_getattr
    class _Fields(AttributeTemplate):
        key = RecordType

        def generic_resolve(self, typ: Any, attr: str) -> Any:
            """The type of an array by its name; None: there is no such name."""
            return typ.entries[attr][1] if attr in typ.entries else None

    @extending.lower_getattr_generic(RecordType)
    def _look_up(context: Any, builder: Any, typ: Any, table: Any, attr: str) -> Any:
        entry, made, columns = typ.entries[attr]
        return array_entry(context, builder, made, table, ir.IntType(64)(entry), columns)

    @intrinsic
    def _table(_typing: Any, record: Any) -> Any:
        """The table that the record was made of."""
        made = types.Array(types.int64, 1, "C")

        def emit(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            size = ir.IntType(64)(WIDTH * len(record.entries))
            return make_array(context, builder, made, builder.ptrtoint(args[0], ir.IntType(64)), [size])

        return made(record), emit

    @extending.unbox(RecordType)
    def _from_python(_typ: Any, record: Any, c: Any) -> Any:
        """The address of the table that a record in Python was made of, which keeps it alive."""
        kind = types.Array(types.int64, 1, "C")
        table = c.pyapi.object_getattr_string(record, "table_")
        words = c.unbox(kind, table)
        c.pyapi.decref(table)
        data = c.context.make_array(kind)(c.context, c.builder, words.value).data
        return extending.NativeValue(data, is_error=words.is_error)

    def _open_anywhere(record: type) -> Any:
        made = RecordType(record)
        record_at, with_table = _open_in_python(record)
        extending.typeof_impl.register(with_table)(lambda _value, _context: made)

        @intrinsic
        def address(_typing: Any, table: Any) -> Any:
            """The record of this table."""

            def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
                return context.make_array(signature.args[0])(context, builder, args[0]).data

            return made(table), emit

        @extending.overload(record_at, strict=False)
        def _in_kernels(table: Any) -> Any:
            return lambda table: address(table)

        return record_at

    table_of, _open = _table, _open_anywhere
