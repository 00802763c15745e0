"""Loop closures in the plane that the map has, against the map without them, read from its columns in place."""

import math

import numpy as np

from factorbus.solver.kernels.closures.ahead import place_among, pose_of, residual_weighed
from factorbus.solver.kernels.closures.plane import (
    add_predicted,
    motion_at,
    motion_to,
    put_adjoint,
    put_weight_without,
)
from factorbus.solver.kernels.jit.compile import F64, I64, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at


@kernel(
    "int64(int64[::1], int64[:,::1], float64[:,:,::1], float64[:,:,::1], int64[::1], float64, int64[::1], float64[::1])"
)
def list_worst(
    rows: I64, ends: I64, z: F64, weights: F64, graph_table: I64, most: float, found: I64, distance: F64
) -> int:
    """Those with the largest rᵀ W r, of `weigh_residuals`, that are beyond `most`; gives how many there are.

    out  found, distance (k,): the worst first, of equal ones the first of `rows`; NaN is infinite
    """
    graph = graph_at(graph_table)
    var, values, count = graph.var, graph.values, 0
    for k in range(rows.size):
        d2 = residual_weighed(rows[k], ends, z, weights, var, values)
        if d2 <= most:
            continue
        if math.isnan(d2):
            d2 = math.inf
        place = min(count, found.size)
        while place > 0 and distance[place - 1] < d2:
            place -= 1
        if place == found.size:
            continue
        count = min(count + 1, found.size)
        for p in range(count - 1, place, -1):
            found[p], distance[p] = found[p - 1], distance[p - 1]
        found[place], distance[place] = rows[k], d2
    return count


@kernel("int64(int64[::1], int64[:,::1], int64[::1], int64[::1], int64[:,::1])")
def list_free_ends(rows: I64, ends: I64, graph_table: I64, free: I64, places: I64) -> int:
    """The free ones among the ends of closures; gives how many there are.

    in   rows (n,): of the columns of a ledger  ends: of all its closures
    out  free: variables, each once  places (n, 2): where each end is among them; −1: it is fixed
    """
    var, count = graph_at(graph_table).var, 0
    for k in range(rows.size):
        for e in range(2):
            v = ends[rows[k], e]
            place = -1
            if var[v, at.V_SCALAR] >= 0:
                place = place_among(free, count, v)
                count = max(count, place + 1)
            places[k, e] = place
    return count


@kernel("void(int64[::1], int64[:,::1], float64[:,:,::1], int64[:,::1], float64[:,::1], int64[::1], float64[:,:,::1])")
def bound_without(rows: I64, ends: I64, noise: F64, places: I64, known: F64, graph_table: I64, bound: F64) -> None:
    """The bounds of closures at the estimate, as `weights_without_plane` has them.

    in   places, known: of `list_free_ends`, and the joint covariance of its `free`
    out  bound: of all closures of the ledger; those in `rows` are written
    """
    graph = graph_at(graph_table)
    var, values = graph.var, graph.values
    J, P, B, L, K = np.zeros((3, 6)), np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(rows.size):
        n = rows[k]
        a, b = pose_of(values, var[ends[n, 0], at.V_AT]), pose_of(values, var[ends[n, 1], at.V_AT])
        put_adjoint(motion_to(b, a), -1.0, 0, J)
        J[0, 3] = J[1, 4] = J[2, 5] = 1.0
        P[:, :] = 0.0
        for m in range(4):
            row, column = places[k, m // 2], places[k, m % 2]
            if row >= 0 and column >= 0:
                add_predicted(J, 3 * (m // 2), 3 * row, 3 * (m % 2), 3 * column, known, P)
        put_weight_without(P, noise[n], L, K, B, bound[n])


@kernel("int64(int64[::1], int64[:,::1], float64[:,:,::1], int64[::1], float64, float64)")
def count_in_spread(rows: I64, ends: I64, z: F64, graph_table: I64, metres: float, radians: float) -> int:
    """How many of some closures are off by this at most, along each axis and about it, at the estimate."""
    graph = graph_at(graph_table)
    var, values, count = graph.var, graph.values, 0
    for n in rows:
        a, b = pose_of(values, var[ends[n, 0], at.V_AT]), pose_of(values, var[ends[n, 1], at.V_AT])
        x, y, c, s = motion_to(motion_at(z[n]), motion_to(a, b))
        count += abs(x) <= metres and abs(y) <= metres and abs(math.atan2(s, c)) <= radians
    return count
