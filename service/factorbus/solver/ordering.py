"""The elimination order of block variables."""

import numpy as np

from factorbus.solver.kernels._jit import I64
from factorbus.solver.kernels.amd import amd


def order(dims: I64, rows: I64, cols: I64, group: I64 | None = None) -> I64:
    """Constrained approximate minimum degree on blocks: perm (n,), perm[k] = the variable eliminated k-th.

    dims (n,): scalars of each variable.  rows, cols (m,): the blocks of Λ, each pair once.
    group (n,) of small integers >= 0: all of group 0 are eliminated before group 1, and so on; None: no constraint.
    """
    dims, rows, cols = (np.ascontiguousarray(a, np.int64) for a in (dims, rows, cols))
    group = np.zeros(len(dims), np.int64) if group is None else np.ascontiguousarray(group, np.int64)
    return amd(dims, rows, cols, group)
