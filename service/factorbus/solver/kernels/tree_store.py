"""Memory of the tree: blocks of two arenas, kept for reuse by size class when they are given back.

Sizes are rounded up to one of eight classes per doubling, so a block wastes an eighth at most, and a free block serves
any request of its class.  A free block holds the place of the next one in its first entry.
"""

from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels._jit import F64, I64, inline_kernel

UNIT = 8  # doubles: a cache line


@inline_kernel
def size_class(size: int) -> tuple:
    """(class, rounded size) of a block of `size` entries."""
    units = (size + UNIT - 1) // UNIT
    if units <= 16:
        return units, units * UNIT
    shift = 0
    top = units - 1
    while top >= 16:
        top >>= 1
        shift += 1
    step = 1 << shift
    units = (units + step - 1) // step * step
    return 8 * shift + (units >> shift), units * UNIT


@inline_kernel
def take_numbers(size: int, numbers: F64, state: I64) -> tuple:
    """(start, rounded size) of a block of `numbers`; there is room for it behind what is in use."""
    kind, size = size_class(size)
    head = tl.S_FREE + kind
    start = state[head] - 1
    if start >= 0:
        state[head] = int(numbers[start])
        return start, size
    start = state[tl.S_NUMBERS]
    state[tl.S_NUMBERS] += size
    return start, size


@inline_kernel
def give_numbers(start: int, size: int, numbers: F64, state: I64) -> None:
    """Give a block back."""
    head = tl.S_FREE + size_class(size)[0]
    numbers[start] = float(state[head])
    state[head] = start + 1


@inline_kernel
def take_list(size: int, lists: I64, state: I64) -> tuple:
    """The same in `lists`."""
    kind, size = size_class(size)
    head = tl.S_FREE + tl.CLASSES + kind
    start = state[head] - 1
    if start >= 0:
        state[head] = lists[start]
        return start, size
    start = state[tl.S_LISTS]
    state[tl.S_LISTS] += size
    return start, size


@inline_kernel
def give_list(start: int, size: int, lists: I64, state: I64) -> None:
    """Give a list back."""
    head = tl.S_FREE + tl.CLASSES + size_class(size)[0]
    lists[start] = state[head]
    state[head] = start + 1


@inline_kernel
def take_clique(clique: I64, state: I64) -> int:
    """A free record; there is room for it."""
    c = state[tl.S_FREE_CLIQUE]
    if c >= 0:
        state[tl.S_FREE_CLIQUE] = clique[c, tl.C_NEXT]
    else:
        c = state[tl.S_CLIQUES]
        state[tl.S_CLIQUES] += 1
    state[tl.S_ALIVE] += 1
    return c


@inline_kernel
def give_clique(c: int, clique: I64, state: I64) -> None:
    """Give a record back."""
    clique[c, tl.C_NEXT] = state[tl.S_FREE_CLIQUE]
    state[tl.S_FREE_CLIQUE] = c
    state[tl.S_ALIVE] -= 1
