"""CHOLMOD on scalars, through scikit-sparse: the path of the 2013 paper, to compare with.  Its R comes back in blocks.

The order is ours (by blocks, constrained), so CHOLMOD gets the matrix as it is to be eliminated and permutes nothing.
"""

from importlib import import_module
from typing import Any

import numpy as np

from factorbus.solver.errors import NoBackend
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.sparse.fill_fronts import fill_fronts
from factorbus.solver.sparse.symbolic import Symbolic


def require_cholmod() -> Any:
    """The module sksparse.cholmod.  Raises NoBackend."""
    try:
        return import_module("sksparse.cholmod")
    except ImportError as missing:
        raise NoBackend("cholmod", "scikit-sparse", str(missing)) from missing


def factorize_by_cholmod(
    symbolic: Symbolic, rows: I64, cols: I64, data: F64, offsets: I64, damping: float, arena: F64
) -> int:
    """R of Λ with its diagonal times 1 + damping, into the fronts of `symbolic` in `arena`.

    Gives −1, or the variable whose pivot failed.  Raises NoBackend.
    """
    cholmod = require_cholmod()
    matrix = lower_triangle(symbolic, rows, cols, data, offsets)
    matrix.setdiag(matrix.diagonal() * (1.0 + damping))
    try:
        L = cholmod.cholesky(matrix, ordering_method="natural").L().tocsc()
    except cholmod.CholmodNotPositiveDefiniteError as failed:
        return symbolic.variable_at(min(int(failed.column), symbolic.size - 1))
    L.sort_indices()
    fill_fronts(
        symbolic.fronts, symbolic.separator, L.indptr.astype(np.int64), L.indices.astype(np.int64), L.data, arena
    )  # fmt: skip
    return -1


def lower_triangle(symbolic: Symbolic, rows: I64, cols: I64, data: F64, offsets: I64) -> Any:
    """PΛPᵀ on and below the diagonal, scalars in elimination order: a scipy CSC matrix."""
    from scipy.sparse import csc_matrix

    at_row, at_col, numbers = [], [], []
    heights, widths = symbolic.dims[rows], symbolic.dims[cols]
    for height, width in set(zip(heights.tolist(), widths.tolist(), strict=True)):
        some = np.flatnonzero((heights == height) & (widths == width))
        i, j = np.divmod(np.arange(height * width), width)
        r, c = symbolic.place[rows[some], None] + i, symbolic.place[cols[some], None] + j
        at_row.append(np.maximum(r, c).ravel())
        at_col.append(np.minimum(r, c).ravel())
        # of a diagonal block the lower half; of another all, wherever it lies
        keep = ((rows[some] != cols[some])[:, None] | (i >= j)[None, :]).ravel()
        numbers.append(np.where(keep, data[offsets[some, None] + np.arange(height * width)].ravel(), 0.0))
        at_row[-1], at_col[-1], numbers[-1] = at_row[-1][keep], at_col[-1][keep], numbers[-1][keep]
    entries = (np.concatenate(numbers), (np.concatenate(at_row), np.concatenate(at_col)))
    return csc_matrix(entries, shape=(symbolic.size, symbolic.size))
