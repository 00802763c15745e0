"""Normal equations in blocks of one size, with our own Cholesky factor: Σ ‖B x_j − A x_i − v‖² over pairs of unknowns.

Analysed once, factorized as often as the weights change.
"""

import math

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.dissection import analyze_whole
from factorbus.solver.sparse.symbolic import analyze


class Normal:
    """n unknowns of d numbers each; pairs (i, j) (m,) of different ones, in any order and as often as they come.

    rank (n,): eliminated from the lowest on, as where these unknowns are some of a graph that is ordered already.
    """

    def __init__(self, count: int, dim: int, i: I64, j: I64, rank: I64 | None = None) -> None:
        low, high = np.minimum(i, j), np.maximum(i, j)
        key = low * count + high
        self._sorted = np.argsort(key, kind="stable")
        key = key[self._sorted]
        self._begin = np.flatnonzero(np.concatenate([np.ones(min(key.size, 1), bool), key[1:] != key[:-1]]))
        self._turned = (i > j)[self._sorted]
        pairs, all_of = key[self._begin], np.arange(count)
        rows, cols = np.concatenate([all_of, pairs // count]), np.concatenate([all_of, pairs % count])
        dims = np.full(count, dim, np.int64)
        if rank is None:
            self._symbolic = analyze_whole(dims, rows, cols)
        else:
            self._symbolic = analyze(dims, rows, cols, np.argsort(rank, kind="stable"))
        self._offsets = dim * dim * np.arange(rows.size)
        self._cholesky, self._count, self._dim = Cholesky(), count, dim

    def factorize(self, diagonal: F64, pairs: F64) -> bool:
        """Of diagonal blocks (n, d, d) and one block (m, d, d) for each pair, row i; False: it is singular."""
        off = pairs[self._sorted]
        off = np.where(self._turned[:, None, None], off.transpose(0, 2, 1), off)
        summed = np.add.reduceat(off, self._begin, axis=0) if self._begin.size else off
        data = np.concatenate([diagonal, summed]).reshape(-1)
        return self._cholesky.factorize(self._symbolic, data, self._offsets) < 0

    def solve(self, right: F64) -> F64:
        """The unknowns (n, d) of a right side (n, d)."""
        return self._cholesky.solve(right.reshape(-1)).reshape(self._count, self._dim)


def summed(into: I64, blocks: F64, count: int) -> F64:
    """Blocks (m, ...) summed to (count, ...) by their index; those of a negative one are left out."""
    kept = into >= 0
    into, flat = into[kept], blocks.reshape(len(blocks), math.prod(blocks.shape[1:]))[kept]
    made = np.stack([np.bincount(into, column, count) for column in flat.T], axis=1)
    return np.asarray(made, float).reshape(count, *blocks.shape[1:])
