"""Memory of the tree: blocks of two arenas, kept for reuse by size class when they are freed.

Sizes are rounded up to one of eight classes per doubling, so a block wastes an eighth at most, and a free block serves
any request of its class.  A free block holds the place of the next one of its class plus one in its first entry.

A drive asks for other sizes later on than at first: in `numbers`, which has nearly all of a map, a class that has none
takes from the next larger one that has, and when much is free in pieces those that are neighbours become one again.
(Without that two thirds of it were free at 20,000 poses.)  A free block there holds its size in its second entry.
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.sorting import sort

UNIT = 8  # doubles: a cache line
FOLLOWING, SIZE = 0, 1  # entries of a free block


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
def size_below(size: int) -> int:
    """The class whose blocks are as large as this one or smaller by less than an eighth; `size` is of whole units."""
    units, shift = size // UNIT, 0
    while units > 16:
        units >>= 1
        shift += 1
    return 8 * shift + units


@part
def take_numbers(size: int, numbers: F64, state: I64) -> tuple[int, int]:
    """(start, rounded size) of a block of `numbers`; there is room for it behind what is in use."""
    kind, size = size_class(size)
    found = find_free(kind, state)
    if found < 0 and is_worth_joining(state):
        join_free(numbers, state)
        found = find_free(kind, state)
    if found < 0:
        start = int(state[tl.S_NUMBERS])
        state[tl.S_NUMBERS] += size
        return start, size
    head = tl.S_FREE + found
    start = int(state[head] - 1)
    state[head] = int(numbers[start + FOLLOWING])
    whole = int(numbers[start + SIZE])
    state[tl.S_IDLE] -= whole
    if found == kind:
        return start, whole
    if whole > size:
        put_free(start + size, whole - size, numbers, state)
    return start, size


@inline_kernel
def give_numbers(start: int, size: int, numbers: F64, state: I64) -> None:
    """Give a block back."""
    put_free(start, size, numbers, state)
    state[tl.S_GIVEN] += size


@inline_kernel
def put_free(start: int, size: int, numbers: F64, state: I64) -> None:
    """A block is free."""
    kind = size_below(size)
    head = tl.S_FREE + kind
    numbers[start + FOLLOWING], numbers[start + SIZE] = float(state[head]), float(size)
    state[head] = start + 1
    state[tl.S_IDLE] += size
    state[tl.S_LARGEST] = max(state[tl.S_LARGEST], kind)


@inline_kernel
def find_free(kind: int, state: I64) -> int:
    """The smallest class from `kind` on that has a block; −1: none has."""
    found = kind
    while found <= state[tl.S_LARGEST]:
        if state[tl.S_FREE + found] != 0:
            return found
        found += 1
    state[tl.S_LARGEST] = min(state[tl.S_LARGEST], kind - 1)
    return -1


@inline_kernel
def is_worth_joining(state: I64) -> bool:
    """Whether enough is free, and was freed since the last time, to look through all of it."""
    return 4 * state[tl.S_IDLE] > state[tl.S_NUMBERS] and 8 * state[tl.S_GIVEN] > state[tl.S_NUMBERS]


@part
def join_free(numbers: F64, state: I64) -> None:
    """Free blocks that are neighbours become one; the last one is returned to what was never in use."""
    count = 0
    for kind in range(tl.CLASSES):
        block = state[tl.S_FREE + kind]
        while block != 0:
            count += 1
            block = int(numbers[block - 1 + FOLLOWING])
    starts, put = np.empty(count, np.int64), 0
    for kind in range(tl.CLASSES):
        block = state[tl.S_FREE + kind]
        state[tl.S_FREE + kind] = 0
        while block != 0:
            starts[put] = block - 1
            put += 1
            block = int(numbers[block - 1 + FOLLOWING])
    sort(starts)
    state[tl.S_IDLE] = state[tl.S_GIVEN] = state[tl.S_LARGEST] = 0
    k, behind = count - 1, state[tl.S_NUMBERS]
    while k >= 0:
        # From the end on, so that of a class the first blocks are taken first.
        start = starts[k]
        size = int(numbers[start + SIZE])
        while k > 0 and starts[k - 1] + int(numbers[starts[k - 1] + SIZE]) == start:
            k -= 1
            size += start - starts[k]
            start = starts[k]
        if start + size == behind:
            state[tl.S_NUMBERS] = start
        else:
            put_free(start, size, numbers, state)
        k -= 1


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
