"""Estimates of two solvers beside each other, variable by variable."""

import numpy as np
from naive.dense_least_squares import distance

from factorbus.solver import Solver


def values(solver: Solver) -> dict[int, tuple[str, np.ndarray]]:
    """Kind and value of each variable, by its key."""
    return {
        key: (group.kind, row)
        for group in solver.estimate()
        for key, row in zip(group.keys.tolist(), group.values, strict=True)
    }


def apart(one: Solver, other: Solver) -> float:
    """How far two estimates of the same variables are from each other."""
    a, b = values(one), values(other)
    assert a.keys() == b.keys()
    return max((distance(kind, row, b[key][1]) for key, (kind, row) in a.items()), default=0.0)
