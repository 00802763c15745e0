"""Indices of variables in the order in which their rows lie in memory."""

import numpy as np

from factorbus.solver.kernels._jit import I64, part

SPARSE = 64  # of so many variables one at the most: each has pages of its own anyway


@part
def put_in_order(indices: I64, count: int) -> None:
    """Sort different indices below `count`; where they are few among so many they stay as they are.

    What is done with each of thousands of variables then finds its rows in the cache, for they are read ahead.
    """
    if indices.size * SPARSE < count:
        return
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
