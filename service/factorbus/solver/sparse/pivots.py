"""The pivots of R, wherever its rows are."""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64


def least_pivot(numbers: F64, rows: I64, pivots: I64, ld: I64) -> float:
    """The least R_kk² of blocks of rows, infinite without any.

    pivots: rows of each block   rows: where the first begins in `numbers`   ld: from one to the next, less a column
    """
    k = np.arange(int(pivots.sum())) - np.repeat(np.cumsum(pivots) - pivots, pivots)
    return float(numbers[np.repeat(rows, pivots) + k * (np.repeat(ld, pivots) + 1)].min(initial=np.inf)) ** 2
