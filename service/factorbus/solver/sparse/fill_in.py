"""Nonzeros of R under different orderings: what Figures 1 and 2 of the 2013 paper compare."""

import numpy as np

from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import analyze


def fill_in(dims: I64, rows: I64, cols: I64, group: I64 | None = None, by_element: bool = False) -> tuple[int, I64]:
    """(nonzeros of R, the scalars in their elimination order) of a block pattern Λ.

    dims (n,), rows and cols (nb,): as `ordering.order` takes them.   group (n,): constraint, None: none
    by_element: order scalars instead of blocks
    """
    if by_element:
        dims, rows, cols, group = elements(dims, rows, cols, group)
    symbolic = analyze(dims, rows, cols, order(dims, rows, cols, group))
    return symbolic.nnz_r, symbolic.scalar_order()


def elements(dims: I64, rows: I64, cols: I64, group: I64 | None) -> tuple[I64, I64, I64, I64 | None]:
    """The same pattern with every scalar a block of its own."""
    starts = np.concatenate([[0], np.cumsum(dims)])
    r, c = [], []
    for height, width in set(zip(dims[rows].tolist(), dims[cols].tolist(), strict=True)):
        some = np.flatnonzero((dims[rows] == height) & (dims[cols] == width))
        i, j = np.divmod(np.arange(height * width), width)
        a, b = starts[rows[some], None] + i, starts[cols[some], None] + j
        keep = a <= b
        r.append(a[keep])
        c.append(b[keep])
    scalars = None if group is None else np.repeat(group, dims)
    return np.ones(starts[-1], np.int64), np.concatenate(r), np.concatenate(c), scalars
