"""Rows of `fac` as Python looks at many of them: which belong together, their variables, their losses.

A factor of more than two variables has a row for each pair of them (`kernels/model/factor_rows.py`).
"""

import numpy as np

from factorbus.proto.inertial import MOMENTS
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import ASIDE_END

_LOSS = at.LOSS_MASK << at.LOSS_SHIFT


def losses_of(fac: I64) -> I64:
    """The code of the loss of each row."""
    return fac[..., at.F_FLAGS] >> at.LOSS_SHIFT & at.LOSS_MASK


def with_losses(flags: I64, losses: I64 | int) -> I64:
    """The same flags with other losses."""
    return flags & ~_LOSS | losses << at.LOSS_SHIFT


def rows_of_arities(ends: I64) -> I64:
    """How many rows factors of these numbers of variables have."""
    return np.where(ends > 2, ends * (ends - 1) // 2, 1)


def first_rows(fac: I64) -> I64:
    """For each row (n,) the first of its factor."""
    return np.arange(len(fac)) - (fac[:, at.F_FLAGS] >> at.OFFSET_SHIFT & at.OFFSET_MASK)


def is_first(fac: I64) -> np.ndarray:
    """Which rows (n,) are the first of a factor."""
    return fac[:, at.F_KIND] != at.MEMBER


def rows_of_factors(fac: I64, rows: I64) -> I64:
    """All rows of the factors that begin at these rows, in their order."""
    counts = rows_of_arities(fac[rows, at.F_FLAGS] >> at.ENDS_SHIFT & at.ENDS_MASK)
    if (counts == 1).all():
        return rows
    return np.repeat(rows, counts) + np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)


def of_whole_factors(fac: I64, marked: np.ndarray) -> np.ndarray:
    """`marked` (n,), where all rows of a factor are marked if any is."""
    first = first_rows(fac)
    of = np.zeros(len(fac), bool)
    of[first[marked]] = True
    return of[first]


def ends_of_rows(fac: I64, rows: I64, arity: int) -> I64:
    """(m, arity) variables of the factors that begin at these rows, which are of that arity."""
    if arity <= 2:
        return fac[rows, at.F_I : at.F_I + arity]
    return np.column_stack([fac[rows, at.F_I], *(fac[rows + n, at.F_J] for n in range(arity - 1))])


def arities_of(fac: I64) -> I64:
    """(n,) How many variables the factors have whose first rows these are."""
    own = fac[:, at.F_FLAGS] >> at.ENDS_SHIFT & at.ENDS_MASK
    return np.where(own > 0, own, np.where(fac[:, at.F_J] >= 0, 2, 1))


def are_of_many(fac: I64) -> np.ndarray:
    """Which rows (n,) are of factors that `many` evaluates: of more than two, linear, or own."""
    return fac[:, at.F_FLAGS] >> at.OFFSET_SHIFT != 0


def variables_aside(fac: I64) -> I64:
    """The poses that are no places in the map: mounts of sensors, and the map's poses in other frames."""
    end = np.where(fac[:, at.F_FLAGS] & at.MOUNTED != 0, MOMENTS, ASIDE_END[fac[:, at.F_KIND]])
    rows = np.flatnonzero(end >= 0)
    end = end[rows]
    return np.unique(np.where(end == 0, fac[rows, at.F_I], fac[rows + np.maximum(end - 1, 0), at.F_J]))
