"""Short arrays for as long as an elimination takes, from one that stays: to ask the system for each takes longer than
to fill it, and a step needs fifty.

The first word of `scratch` says where its room begins.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part

WORDS = 8192  # what a step with few affected variables needs, several times


@inline_kernel
def clear_scratch(scratch: I64) -> None:
    """What was taken before is not needed any more."""
    scratch[0] = 1


@inline_kernel
def scratch_used(scratch: I64) -> int:
    """How much of the room is used, for `free_since`."""
    return int(scratch[0])


@inline_kernel
def free_since(before: int, scratch: I64) -> None:
    """What was taken since this much was used is not needed any more."""
    scratch[0] = before


@part
def take(count: int, scratch: I64) -> I64:
    """`count` integers, which hold anything; where the room is used up they are an array of their own."""
    start = scratch[0]
    if start + count > scratch.size:
        return np.empty(count, np.int64)
    scratch[0] = start + count
    return scratch[start : start + count]


@part
def take_filled(count: int, number: int, scratch: I64) -> I64:
    """`count` integers, all of them this number."""
    taken = take(count, scratch)
    for k in range(count):
        taken[k] = number
    return taken


@part
def take_floats(count: int, scratch: I64) -> F64:
    """`count` numbers, which hold anything."""
    return take(count, scratch).view(np.float64)


@part
def take_rows(count: int, columns: int, scratch: I64) -> I64:
    """`count` rows of integers, which hold anything."""
    return take(count * columns, scratch).reshape((count, columns))
