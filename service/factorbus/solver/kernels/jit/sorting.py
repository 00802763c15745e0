"""Lists of indices in ascending order."""

import numpy as np

from factorbus.solver.kernels.jit.compile import I64, inline_kernel, part

SPARSE = 64  # one variable in this number at the most: each has pages of its own anyway


@part
def put_in_order(indices: I64, count: int) -> bool:
    """Sort different indices below `count`; where they are few among many they stay as they are, and it gives False.

    What is done with each of thousands of variables then finds its rows in the cache, for they are read ahead.
    """
    if indices.size * SPARSE < count:
        return False
    words = np.zeros(count // 8 + 1, np.int64)
    there, n = words.view(np.uint8), 0
    for k in range(indices.size):
        there[indices[k]] = 1
    for w in range(words.size):
        if words[w] != 0:
            for v in range(8 * w, 8 * w + 8):
                if there[v] != 0:
                    indices[n] = v
                    n += 1
    return True


@part
def sort(numbers: I64) -> None:
    """Sort by a heap, in place.  (To compile NumPy's way of it takes a second in each process.)"""
    for k in range(numbers.size // 2 - 1, -1, -1):
        _sink(numbers, k, numbers.size)
    for end in range(numbers.size - 1, 0, -1):
        numbers[0], numbers[end] = numbers[end], numbers[0]
        _sink(numbers, 0, end)


@inline_kernel
def _sink(numbers: I64, k: int, end: int) -> None:
    """Of a heap of `end` numbers only the one at k may be too small."""
    own = numbers[k]
    child = 2 * k + 1
    while child < end:
        if child + 1 < end and numbers[child + 1] > numbers[child]:
            child += 1
        if numbers[child] <= own:
            break
        numbers[k] = numbers[child]
        k, child = child, 2 * child + 1
    numbers[k] = own
