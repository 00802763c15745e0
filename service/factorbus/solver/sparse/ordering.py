"""The elimination order of block variables."""

import numpy as np

from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.sparse.amd import amd
from factorbus.wording import counted


def order(dims: I64, rows: I64, cols: I64, group: I64 | None = None) -> I64:
    """Constrained approximate minimum degree on blocks: perm (n,), perm[k] = the variable eliminated k-th.

    dims (n,): scalars of each variable.  rows, cols (m,): the blocks of Λ, each pair once.
    group (n,) of small integers >= 0: all of group 0 are eliminated before group 1, and so on; None: no constraint.
    Raises ValueError when an index is outside its range; pairs given twice are not looked for.
    """
    dims, rows, cols = checked_pattern(dims, rows, cols)
    group = np.zeros(len(dims), np.int64) if group is None else integers(group)
    if group.shape != dims.shape or group.min(initial=0) < 0:
        raise ValueError(
            f"{counted(len(group), 'group')}, the least {group.min(initial=0)}: {len(dims)} of 0 or more are wanted"
        )
    return amd(dims, rows, cols, group)


def checked_pattern(dims: I64, rows: I64, cols: I64) -> tuple[I64, I64, I64]:
    """The pattern as the kernels want it.  They look at nothing again, so what is wrong must not get past here."""
    dims, rows, cols = integers(dims), integers(rows), integers(cols)
    if dims.min(initial=1) < 1:
        raise ValueError(f"a variable of {counted(dims.min(), 'scalar')}: each needs at least one")
    if rows.shape != cols.shape:
        raise ValueError(
            f"{counted(len(rows), 'row')} and {counted(len(cols), 'column')}: one of each per block is wanted"
        )
    least = min(rows.min(initial=0), cols.min(initial=0))
    largest = max(rows.max(initial=-1), cols.max(initial=-1))
    if least < 0 or largest >= len(dims):
        raise ValueError(f"blocks of the variables {least} to {largest}: there are only 0 to {len(dims) - 1}")
    return dims, rows, cols


def integers(values: I64) -> I64:
    """A one-dimensional int64 array that a kernel takes; a copy where it must be."""
    array = np.require(values, np.int64, ("C", "W"))
    if array.ndim != 1:
        raise ValueError(f"an array of shape {array.shape} where a one-dimensional one is wanted")
    return array
