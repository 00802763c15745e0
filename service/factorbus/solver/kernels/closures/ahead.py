"""Loop closures in the plane judged before the step of their batch.

A pose that is new is where odometry leads to from one that the map has, u:  x = u T.  With x = x̂ exp(δ) and what
odometry adds,

    δ_x = Ad(T⁻¹) δ_u + q,   Cov q = Q:   T ← T z,   Q ← Ad(z⁻¹) Q Ad(z⁻¹)ᵀ + Ω⁻¹

so that the covariance of both ends follows from that of poses which the last step left.
"""

import math

import numpy as np

from factorbus.solver.kernels.closures.plane import (
    Motion,
    add_predicted,
    inverse_of,
    motion_at,
    motion_product,
    motion_to,
    put_adjoint,
    weigh_motion,
)
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at

MOVED = 13  # numbers of an end: T as x, y, cosine, sine, and Q
# Columns of `ends`: u, and where it is among the free ones, −1 where it is fixed; and the end itself.
END_BASE, END_PLACE, END_ITSELF, END_COLUMNS = range(4)
J_ODDS, J_ALLOWED, J_NOISE, J_WEIGHT, J_BOUND, J_MEASURED, J_SIZE = 0, 1, 4, 7, 10, 13, 16  # rows of a judgement
J_DISTANCE, J_CHANCE, J_BELIEVED = range(3)  # of the first row


@kernel("int64(int64, int64, int64[::1], int64[::1], int64[::1], int64[:,::1], float64[:,::1])")
def list_closure_ends(v0: int, f0: int, closing: I64, graph_table: I64, free: I64, ends: I64, moved: F64) -> int:
    """Where the ends of closures lead back to; gives how many free poses those are, −1: it is not by odometry alone.

    in   v0, f0: variables and factors that the last step had  closing (n,): rows of factors, ascending
    out  free: poses, each once
         ends (2 n, END_COLUMNS), moved (2 n, MOVED): of first and second end, one after the other
    """
    graph = graph_at(graph_table)
    var, fac, payload, counts = graph.var, graph.fac, graph.payload, graph.counts
    new = counts[at.VARIABLES] - v0
    base, motion = np.full(new, -1), np.zeros((new + 1, MOVED))
    motion[new, 2] = 1.0  # of what is not new
    following, placed = 0, 0
    for f in range(f0, counts[at.FACTORS]):
        if following < closing.size and closing[following] == f:
            following += 1
            continue
        i, j = fac[f, at.F_I], fac[f, at.F_J]
        if fac[f, at.F_KIND] != at.BETWEEN_SE2 or j < v0 or base[j - v0] >= 0 or var[j, at.V_SCALAR] < 0:
            return -1
        if i >= v0 and base[i - v0] < 0:
            return -1
        base[j - v0] = i if i < v0 else base[i - v0]
        follow_odometry(motion[new if i < v0 else i - v0], payload, fac[f, at.F_AT], motion[j - v0])
        placed += 1
    if placed != new:
        return -1
    count = 0
    for e in range(2 * closing.size):
        v, own = fac[closing[e // 2], at.F_I + e % 2], new
        ends[e, END_ITSELF] = v
        if v >= v0:
            if e % 2 == 1 and fac[closing[e // 2], at.F_I] >= v0:
                return -1  # both are new: what odometry adds to them is not independent
            own, v = v - v0, base[v - v0]
        for k in range(MOVED):
            moved[e, k] = motion[own, k]
        place = -1
        if var[v, at.V_SCALAR] >= 0:
            place = place_among(free, count, v)
            count = max(count, place + 1)
        ends[e, END_BASE], ends[e, END_PLACE] = v, place
    return count


@inline_kernel
def place_among(free: I64, count: int, v: int) -> int:
    """Where v is among the first `count` of `free`; if it is not, it becomes the next."""
    place = 0
    while place < count and free[place] != v:
        place += 1
    free[place] = v
    return place


@inline_kernel
def follow_odometry(before: F64, payload: F64, p: int, after: F64) -> None:
    """after = before and the relative pose that is measured at p of the payload."""
    z = payload[p], payload[p + 1], math.cos(payload[p + 2]), math.sin(payload[p + 2])
    T = motion_product((before[0], before[1], before[2], before[3]), z)
    after[0], after[1], after[2], after[3] = T
    A, Q = np.empty((3, 3)), np.zeros((3, 3))
    put_adjoint(inverse_of(z), 1.0, 0, A)
    add_predicted(A, 0, 0, 0, 0, before[4:].reshape(3, 3), Q)
    N = np.empty((2, 3, 3))
    put_certainty(payload, p + 3, N[0], N[1])
    for r in range(3):
        for c in range(3):
            after[4 + 3 * r + c] = Q[r, c] + N[0, r, c]


@inline_kernel
def put_certainty(payload: F64, p: int, noise: F64, weight: F64) -> None:
    """Ω, of which the upper triangle is at p, and Ω⁻¹."""
    a, b, c, d, e, f = payload[p], payload[p + 1], payload[p + 2], payload[p + 3], payload[p + 4], payload[p + 5]
    weight[0, 0], weight[0, 1], weight[0, 2] = a, b, c
    weight[1, 0], weight[1, 1], weight[1, 2] = b, d, e
    weight[2, 0], weight[2, 1], weight[2, 2] = c, e, f
    over = 1.0 / (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d))
    noise[0, 0], noise[1, 1], noise[2, 2] = over * (d * f - e * e), over * (a * f - c * c), over * (a * d - b * b)
    noise[0, 1] = noise[1, 0] = over * (c * e - b * f)
    noise[0, 2] = noise[2, 0] = over * (b * e - c * d)
    noise[1, 2] = noise[2, 1] = over * (b * c - a * e)


@kernel("void(int64[::1], int64[::1], int64[:,::1], float64[:,::1], float64[:,::1], float64[:,:,::1])")
def judge_ahead(closing: I64, graph_table: I64, ends: I64, moved: F64, known: F64, out: F64) -> None:
    """Closures in the rows `closing` against what the map expects, as `judge_each_plane` does.

    in   ends, moved: of `list_closure_ends`  known: the joint covariance of its `free`
    out  (n, J_SIZE, 3): d² and v;  S;  Ω⁻¹;  Ω;  Ω S Ω = (Ω⁻¹ − J Σ₊ Jᵀ)⁻¹ with Σ₊ as it is when the closure is in;
         what was measured, as a matrix
    """
    graph = graph_at(graph_table)
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    J, P, B = np.empty((3, 6)), np.empty((3, 3)), np.empty((3, 6))
    for k in range(closing.size):
        own, p = out[k], fac[closing[k], at.F_AT]
        put_certainty(payload, p + 3, own[J_NOISE : J_NOISE + 3], own[J_WEIGHT : J_WEIGHT + 3])
        z = payload[p], payload[p + 1], math.cos(payload[p + 2]), math.sin(payload[p + 2])
        put_motion(z, own[J_MEASURED:])
        first, second = moved[2 * k], moved[2 * k + 1]
        T_a, T_b = (first[0], first[1], first[2], first[3]), (second[0], second[1], second[2], second[3])
        a = motion_product(pose_of(values, var[ends[2 * k, END_BASE], at.V_AT]), T_a)
        b = motion_product(pose_of(values, var[ends[2 * k + 1, END_BASE], at.V_AT]), T_b)
        there = motion_to(a, b)
        # By what odometry adds to both ends, then by the poses that they follow from.
        put_adjoint(inverse_of(there), -1.0, 0, J)
        P[:, :] = 0.0
        add_predicted(J, 0, 0, 0, 0, first[4:].reshape(3, 3), P)
        for r in range(3):
            for c in range(3):
                P[r, c] += second[4 + 3 * r + c]
        put_adjoint(motion_to(there, inverse_of(T_a)), -1.0, 0, B)
        put_adjoint(inverse_of(T_b), 1.0, 3, B)
        for m in range(4):
            row, column = ends[2 * k + m // 2, END_PLACE], ends[2 * k + m % 2, END_PLACE]
            if row >= 0 and column >= 0:
                add_predicted(B, 3 * (m // 2), 3 * row, 3 * (m % 2), 3 * column, known, P)
        weigh_motion(motion_to(z, there), P, own[J_NOISE : J_NOISE + 3], own)
        for r in range(3):
            for c in range(3):
                own[J_BOUND + r, c] = 0.0
        add_predicted(own[J_WEIGHT : J_WEIGHT + 3], 0, 0, 0, 0, own[J_ALLOWED : J_ALLOWED + 3], own[J_BOUND:])


@kernel("int64(float64[::1], float64[:,:,::1])")
def believe_ahead(limits: F64, judged: F64) -> int:
    """Which closures go in with the step of their batch; gives how many.

    Where one that is not believed may be right none is: it may speak against the others, and all are judged together.

    in   limits: d² of the gate, d² beyond which one is improbable whatever agrees, the most odds, and the volume where
         false ones are
         judged: `out` of `judge_ahead`
    out  its first rows: v becomes the odds of the residual, and 1 or 0 follows: believed or not
    """
    gate, beyond, most, volume, count, is_open = limits[0], limits[1], limits[2], limits[3], 0, False
    for k in range(len(judged)):
        own = judged[k, J_ODDS]
        own[J_CHANCE] = min(own[J_CHANCE] / volume, 1.0)
        is_in = own[J_DISTANCE] <= gate and own[J_CHANCE] <= most
        own[J_BELIEVED] = 1.0 if is_in else 0.0
        count += is_in
        is_open = is_open or (not is_in and own[J_DISTANCE] <= beyond)
    if is_open:
        for k in range(len(judged)):
            judged[k, J_ODDS, J_BELIEVED] = 0.0
        return 0
    return count


@kernel(
    "void(int64, float64[:,:,::1], int64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], int64[:,::1])"
)
def enter_judged(first: int, judged: F64, of: I64, z: F64, noise: F64, bound: F64, ends: I64) -> None:
    """Write closures into the columns of a ledger, from row `first` on.

    in   judged, of: `out` of `judge_ahead`, and its `ends`
    out  the columns: what was measured, Ω⁻¹, bounds, ends
    """
    for k in range(len(judged)):
        n = first + k
        for r in range(3):
            for c in range(3):
                z[n, r, c], noise[n, r, c] = judged[k, J_MEASURED + r, c], judged[k, J_NOISE + r, c]
                bound[n, r, c] = judged[k, J_BOUND + r, c]
        ends[n, 0], ends[n, 1] = of[2 * k, END_ITSELF], of[2 * k + 1, END_ITSELF]


@kernel("void(int64[::1], int64[:,::1], float64[:,:,::1], float64[:,:,::1], int64[::1], float64[::1])")
def weigh_residuals(rows: I64, ends: I64, z: F64, weights: F64, graph_table: I64, out: F64) -> None:
    """rᵀ W r of some closures at the estimate, of the columns of a ledger."""
    graph = graph_at(graph_table)
    var, values = graph.var, graph.values
    for k in range(rows.size):
        out[k] = residual_weighed(rows[k], ends, z, weights, var, values)


@inline_kernel
def residual_weighed(n: int, ends: I64, z: F64, weights: F64, var: I64, values: F64) -> float:
    """rᵀ W r of closure n."""
    a, b = pose_of(values, var[ends[n, 0], at.V_AT]), pose_of(values, var[ends[n, 1], at.V_AT])
    x, y, c, s = motion_to(motion_at(z[n]), motion_to(a, b))
    W, t = weights[n], math.atan2(s, c)
    squares = x * x * W[0, 0] + y * y * W[1, 1] + t * t * W[2, 2]
    return squares + 2.0 * (x * y * W[0, 1] + x * t * W[0, 2] + y * t * W[1, 2])


@kernel("int64(int64[::1], int64[::1], int64[:,::1], float64[:,:,::1], int64[::1], float64, float64, int64[::1])")
def list_companions(
    new: I64, others: I64, ends: I64, z: F64, graph_table: I64, metres: float, radians: float, found: I64
) -> int:
    """Those of `others` whose loop with one of `new` ends this near to where it began; gives how many there are."""
    graph = graph_at(graph_table)
    var, values, count = graph.var, graph.values, 0
    for q in others:
        second = motion_at(z[q])
        a_q, b_q = pose_of(values, var[ends[q, 0], at.V_AT]), pose_of(values, var[ends[q, 1], at.V_AT])
        for p in new:
            a, b = pose_of(values, var[ends[p, 0], at.V_AT]), pose_of(values, var[ends[p, 1], at.V_AT])
            to_a, back = motion_product(motion_to(a, a_q), second), motion_to(b_q, b)
            x, y, c, s = motion_to(motion_at(z[p]), motion_product(to_a, back))
            if abs(x) <= metres and abs(y) <= metres and abs(math.atan2(s, c)) <= radians:
                found[count] = q
                count += 1
                break
    return count


@inline_kernel
def pose_of(values: F64, v: int) -> Motion:
    """The pose whose value is at v."""
    return values[v], values[v + 1], math.cos(values[v + 2]), math.sin(values[v + 2])


@inline_kernel
def put_motion(T: Motion, out: F64) -> None:
    """T as a matrix (3, 3)."""
    x, y, c, s = T
    out[0, 0], out[0, 1], out[0, 2] = c, -s, x
    out[1, 0], out[1, 1], out[1, 2] = s, c, y
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0
