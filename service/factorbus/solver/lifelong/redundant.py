"""Which poses a map has enough of: those that have others around them, but for what has to stay.

A pose stays that is fixed, is one of the newest of its letter, has a factor other than a relative pose or the position
of a landmark that is estimated, or sees a landmark that too few see.  Of the others the oldest stay: front ends know
them, and find them again.
"""

from itertools import islice, product
from typing import NamedTuple

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import are_of_many
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.lifelong.policy import KeepPolicy

_DIMENSIONS = {at.SE2: 2, at.SE3: 3}
_AROUND = tuple(product((-1, 0, 1), repeat=3))
_BETWEEN = [at.FACTOR_CODES[name] for name in ("between_se2", "between_se3")]
_SEEN = [at.FACTOR_CODES[name] for name in ("landmark_se2", "landmark_se3")]


class Redundant(NamedTuple):
    """poses (n,): variables, the newest first.

    rows (m,): of relative factors between what is estimated, or between such a pose and a fixed one; ends (m, 2): of
    each its variables.
    """

    poses: I64
    rows: I64
    ends: I64


def find_redundant(graph: FactorGraph, policy: KeepPolicy, staying: I64) -> Redundant:
    """Poses that may go, by where they are; staying: keys of such that may not."""
    n, m = int(graph.counts[at.VARIABLES]), int(graph.counts[at.FACTORS])
    var, fac = graph.var[:n], graph.fac[:m]
    ends, free = fac[:, at.F_I : at.F_J + 1], var[:, at.V_COLUMN] >= 0
    relative = np.isin(fac[:, at.F_KIND], _BETWEEN + _SEEN) & ~are_of_many(fac)
    held = ~free[ends[relative]]
    relative[relative] = ~held.any(axis=1) | (np.isin(fac[relative, at.F_KIND], _BETWEEN) & ~held.all(axis=1))
    may_go = free & np.isin(var[:, at.V_KIND], list(_DIMENSIONS)) & ~np.isin(graph.keys[:n], staying)
    others = ends[~relative].ravel()
    may_go[others[others >= 0]] = False
    seen = relative & np.isin(fac[:, at.F_KIND], _SEEN)
    seers = np.bincount(ends[seen, 1], minlength=n)
    may_go[ends[seen][seers[ends[seen, 1]] <= policy.landmarks, 0]] = False
    poses = np.flatnonzero(np.isin(var[:, at.V_KIND], list(_DIMENSIONS)))
    poses = poses[~_newest(graph.keys[poses] >> 56, policy.window)]
    found = _surplus(_places(graph, poses), may_go[poses], policy)
    rows = np.flatnonzero(relative)
    return Redundant(np.sort(poses[found])[::-1], rows, ends[rows])


def _newest(letters: I64, window: int) -> np.ndarray:
    """(n,) Whether a pose is among the newest `window` of its letter; of one left behind, the last alone.

    letters (n,): of poses in the order in which they came.  Left behind is a letter after whose last pose another one
    has that many: it is not driven on, as that of a drive of yesterday, or stands still for long.
    """
    order = np.argsort(letters, kind="stable")
    behind = np.empty(letters.size, np.int64)
    behind[order] = np.searchsorted(letters[order], letters[order], side="right") - np.arange(letters.size)
    last, begins = np.flatnonzero(behind == 1), np.flatnonzero(behind == window)
    left_behind = letters[last[last < begins.max(initial=-1)]]
    return np.where(np.isin(letters, left_behind), behind == 1, behind <= window)


def _surplus(places: F64, may_go: np.ndarray, policy: KeepPolicy) -> I64:
    """Indices of those that have enough others around; those that stay anyway count first, then the oldest."""
    kept: dict[tuple[int, int, int], list[tuple[float, float, float]]] = {}
    found, reach = list[int](), policy.spacing_m**2
    around = [step for step in _AROUND if places[:, 2].any() or not step[2]]
    for n in np.argsort(may_go, kind="stable").tolist():
        x, y, z = places[n].tolist()
        cell = int(x // policy.spacing_m), int(y // policy.spacing_m), int(z // policy.spacing_m)
        if may_go[n]:
            close = [kept[at_it] for a, b, c in around if (at_it := (cell[0] + a, cell[1] + b, cell[2] + c)) in kept]
            near = (1 for some in close for p, q, r in some if (p - x) ** 2 + (q - y) ** 2 + (r - z) ** 2 < reach)
            if sum(islice(near, policy.poses)) == policy.poses:  # no more are counted: a large area may have all poses
                found.append(n)
                continue
        kept.setdefault(cell, []).append((x, y, z))
    return np.array(found, np.int64)


def _places(graph: FactorGraph, poses: I64) -> F64:
    """(n, 3) Positions; z = 0 in the plane."""
    places, kinds = np.zeros((poses.size, 3)), graph.var[poses, at.V_KIND]
    for code, size in _DIMENSIONS.items():
        of = np.flatnonzero(kinds == code)
        places[of[:, None], np.arange(size)] = graph.values[graph.var[poses[of], at.V_AT, None] + np.arange(size)]
    return places
