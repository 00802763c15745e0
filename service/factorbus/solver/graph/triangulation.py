"""Points that come without a value and that only bearings see: placed where the rays of their batch meet.  MATH §2.4.

A bearing alone places nothing, two from different places do.  With tₖ where the k-th ray starts and dₖ its direction,
both in the map, the point is that of the least sum of squared distances from the rays,

    p = (Σ Pₖ)⁻¹ Σ Pₖ tₖ,      Pₖ = I − dₖ dₖᵀ

unless that is behind a pose that sees it: rays that are nearly parallel meet anywhere.  Then it is put on the ray of
the last bearing, in front, as far off as `_BASELINES` times the poses are apart.
"""

from collections import defaultdict

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

_BASELINES = 10.0
_LEAST_BASELINE = 1e-9  # metres: poses closer than that are one place, which says nothing of the distance


def place_by_bearings(graph: FactorGraph, first: int, first_factor: int, reached: I64) -> bool:
    """Give a value to each new point that is not `reached` and that bearings of placed poses see from two places.

    in/out  reached: an entry for each variable from `first` on, 1: it has a value
    Gives whether there was one.
    """
    fac = graph.fac[first_factor : int(graph.counts[at.FACTORS])]
    rows = np.flatnonzero(np.isin(fac[:, at.F_KIND], (at.BEARING_SE2, at.BEARING_SE3)))
    rays: dict[int, list[tuple[F64, F64]]] = defaultdict(list)
    for pose, point, payload in fac[rows][:, [at.F_I, at.F_J, at.F_AT]].tolist():
        if point >= first and not reached[point - first] and (pose < first or reached[pose - first]):
            rays[point].append(_ray(graph, pose, payload))
    placed = False
    for point, seen in rays.items():
        value = _where_they_meet(np.array([start for start, _ in seen]), np.array([way for _, way in seen]))
        if value is not None:
            begin = int(graph.var[point, at.V_AT])
            graph.values[begin : begin + value.size] = value
            reached[point - first] = 1
            placed = True
    return placed


def _ray(graph: FactorGraph, pose: int, payload: int) -> tuple[F64, F64]:
    """(where it starts, its direction of unit length), in the map."""
    begin, kind = int(graph.var[pose, at.V_AT]), int(graph.var[pose, at.V_KIND])
    x = graph.values[begin : begin + 7]
    if kind == at.SE2:
        angle = x[2] + graph.payload[payload]
        return x[:2].copy(), np.array([np.cos(angle), np.sin(angle)])
    u, w, v = x[3:6], x[6], graph.payload[payload : payload + 3]
    t = 2.0 * np.cross(u, v)
    return x[:3].copy(), v + w * t + np.cross(u, t)


def _where_they_meet(starts: F64, ways: F64) -> F64 | None:
    """starts, ways (n, 2 or 3); None where all rays start at one place."""
    baseline = float(np.linalg.norm(starts - starts[0], axis=1).max())
    if baseline <= _LEAST_BASELINE:
        return None
    P = np.eye(starts.shape[1]) - np.einsum("ni,nj->nij", ways, ways)
    total, right = P.sum(axis=0), np.einsum("nij,nj->i", P, starts)
    if np.linalg.cond(total) < 1.0 / np.finfo(float).eps:
        point = np.linalg.solve(total, right)
        if (np.einsum("ni,ni->n", point - starts, ways) > 0.0).all():
            return point
    return starts[-1] + _BASELINES * baseline * ways[-1]
