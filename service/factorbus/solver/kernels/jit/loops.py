"""A loop over `range` is begun in a third of the instructions that Numba writes for it.

Numba writes what a range is made of to memory and reads it back, divides by a step of 1 or -1 as by any other, and
looks whether it is 0.  The types are Numba's, as is how a loop goes on: ranges of other kinds, and those with other
steps, are begun by it.  The code after optimization is the same.
"""

from typing import Any

from llvmlite import ir
from llvmlite.ir.instructions import InsertValue
from numba.core import cgutils, types

__all__ = ["LOOPS", "is_range", "lower_loop", "make_range"]

_WORD = ir.IntType(64)
_RANGE, _ITERATOR = types.range_state64_type, types.range_iter64_type
_START, _STOP, _STEP = range(3)
_AT, _, _BY, _LEFT = range(4)  # of an iterator: where it is; where it stops; its step; how many are left

_PAIR = types.Pair(types.int64, types.boolean)  # a number, and whether it is one


def is_range(function: Any, signature: Any) -> bool:
    """Whether a call makes a range of integers of a word."""
    return signature.return_type == _RANGE and getattr(function, "typing_key", None) is range


def make_range(builder: Any, context: Any, bounds: list[Any]) -> Any:
    """`range` of these one, two or three numbers."""
    start, stop, step = (_WORD(0), *bounds, _WORD(1)) if len(bounds) == 1 else (*bounds, _WORD(1))[:3]
    made = ir.Constant(context.get_value_type(_RANGE), ir.Undefined)
    for place, value in ((_START, start), (_STOP, stop), (_STEP, step)):
        made = builder.insert_value(made, value, place)
    return made


def lower_loop(lower: Any, expression: Any) -> Any:
    """What a part of a loop comes to; None: it is for Numba to write."""
    operation = _OPERATIONS.get((expression.op, lower.typeof(expression.value.name)))
    return operation and operation(lower.builder, lower.context, lower.loadvar(expression.value.name))


def _begin(builder: Any, context: Any, made: Any) -> Any:
    """The iterator over a range; None: its step is neither 1 nor -1 where it is written."""
    step = made.value if isinstance(made, InsertValue) else None
    if not isinstance(step, ir.Constant) or step.constant not in (1, -1):
        return None
    start, stop = made.aggregate.aggregate.value, made.aggregate.value
    length = builder.sub(stop, start) if step.constant == 1 else builder.sub(start, stop)
    some = builder.icmp_signed(">", length, _WORD(0))
    at, left = cgutils.alloca_once(builder, _WORD), cgutils.alloca_once(builder, _WORD)
    builder.store(start, at)
    with builder.if_else(builder.not_(some)) as (none, otherwise):
        with none:
            builder.store(_WORD(0), left)
        with otherwise:
            builder.store(length, left)
    iterator = ir.Constant(context.get_value_type(_ITERATOR), ir.Undefined)
    for place, value in ((_AT, at), (_BY, step), (_LEFT, left)):
        iterator = builder.insert_value(iterator, value, place)
    return iterator


_OPERATIONS = {
    ("getiter", _RANGE): _begin,
    ("pair_first", _PAIR): lambda builder, _, pair: builder.extract_value(pair, 0),
    ("pair_second", _PAIR): lambda builder, _, pair: builder.extract_value(pair, 1),
}
LOOPS = {operation for operation, _ in _OPERATIONS}
