"""Loop closures in the plane that a ledger has, against the map, read from its columns in place."""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

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

Bools: TypeAlias = NDArray[np.bool_]


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


@kernel(
    "UniTuple(int64, 2)(boolean[::1], UniTuple(int64, 2), int64[:,::1], float64[:,:,::1], int64[::1],"
    " UniTuple(float64, 2))"
)
def count_in_spread(
    chosen: Bools, among: tuple[int, int], ends: I64, z: F64, graph_table: I64, spread: tuple[float, float]
) -> tuple[int, int]:
    """How many of the newest chosen closures are off by this at most at the estimate, along each axis and about it; and
    how many these are.

    in   among: how many closures there are, and how many of the chosen ones are counted at most
         spread: metres and radians
    """
    graph = graph_at(graph_table)
    var, values, near, count, n = graph.var, graph.values, 0, 0, among[0]
    while n > 0 and count < among[1]:
        n -= 1
        if not chosen[n]:
            continue
        count += 1
        a, b = pose_of(values, var[ends[n, 0], at.V_AT]), pose_of(values, var[ends[n, 1], at.V_AT])
        x, y, c, s = motion_to(motion_at(z[n]), motion_to(a, b))
        near += abs(x) <= spread[0] and abs(y) <= spread[0] and abs(math.atan2(s, c)) <= spread[1]
    return near, count


@kernel(
    "boolean(UniTuple(boolean[::1], 3), int64[::1], UniTuple(int64, 2), int64[:,::1], UniTuple(float64[:,:,::1], 2),"
    " int64[::1], UniTuple(float64, 2))"
)
def is_any_due(
    marks: tuple[Bools, Bools, Bools],
    looked: I64,
    counts: tuple[int, int],
    ends: I64,
    columns: tuple[F64, F64],
    graph_table: I64,
    beyond: tuple[float, float],
) -> bool:
    """Whether any suspect has to be looked at: one that is new, or one that the map may not contradict any more, by its
    bound, since the look at which it moved last.

    in   marks: whether each closure of a ledger is a suspect, is new, and is improbable  looked, ends: of each
         counts: how many there are; the look at which any went in or out last  columns: what was measured, and bounds
         beyond: rᵀ W r beyond which an improbable suspect stays one, and beyond which any other does
    """
    graph = graph_at(graph_table)
    is_suspect, is_new, is_improbable = marks
    count, moved_at = counts
    for n in range(count):
        if not is_suspect[n]:
            continue
        if is_new[n]:
            return True
        if looked[n] < moved_at:
            most = beyond[0] if is_improbable[n] else beyond[1]
            if not residual_weighed(n, ends, columns[0], columns[1], graph.var, graph.values) > most:
                return True
    return False


@kernel("float64(int64[::1], int64)")
def longest_side(graph_table: I64, kind: int) -> float:
    """Of the rectangle, along x and y, around the positions of all poses of a kind."""
    graph = graph_at(graph_table)
    var, values = graph.var, graph.values
    low_x, low_y, high_x, high_y = math.inf, math.inf, -math.inf, -math.inf
    for v in range(graph.counts[at.VARIABLES]):
        if var[v, at.V_KIND] == kind:
            x, y = values[var[v, at.V_AT]], values[var[v, at.V_AT] + 1]
            low_x, low_y, high_x, high_y = min(low_x, x), min(low_y, y), max(high_x, x), max(high_y, y)
    return float(max(high_x - low_x, high_y - low_y))


@kernel("void(int64[::1], int64[:,::1], int64[::1], float64[:,::1])")
def put_poses(rows: I64, ends: I64, graph_table: I64, out: F64) -> None:
    """The poses that closures are between, x y θ, out (2 n, 3): of first and second end, one after the other."""
    graph = graph_at(graph_table)
    for k in range(rows.size):
        for e in range(2):
            v = graph.var[ends[rows[k], e], at.V_AT]
            for c in range(3):
                out[2 * k + e, c] = graph.values[v + c]


@kernel("void(int64[:,::1], float64[:,::1], float64[:,::1])")
def put_known(places: I64, known: F64, out: F64) -> None:
    """The joint covariance of ends, of which some may be the same, from that of different ones.

    in   places: of `list_free_ends`, none fixed
    """
    n = len(places)
    for k in range(2 * n):
        for m in range(2 * n):
            row, column = 3 * places[k // 2, k % 2], 3 * places[m // 2, m % 2]
            for r in range(3):
                for c in range(3):
                    out[3 * k + r, 3 * m + c] = known[row + r, column + c]
