"""The covariance of new features with what their structure leaves to multiply.  MATH §5.3, §5.4.

A feature moves with the camera's position r and its small rotation δ only, so of P_v six rows matter:

    U = [ P_r ; T P_q ]  (6 × m),   C = cov(δ, r) = U_δ[:, r],   S = cov(δ, δ) = U_δ[:, q] Tᵀ         (5.4)

and with G_i of (3.2), M_i of (3.4), every block is

    P(new i, before)  = ( U_r ; G_i U_δ ; 0 )                                                         (5.5)
    P(new i, new k)   = [ P_rr   W_kᵀ   0 ;  W_i   V_i G_kᵀ   0 ;  0 0 0 ],  W = G C, V = G S         (5.6)
    P(new i, new i)  += [ 0 ; σ_pixel² M_i M_iᵀ ; σ_ρ² ]                                              (5.7)

(θ, φ) takes two multiplications for a number each, for G has a 1 and a 0.  The rows of x, y, z are the same for all
new features and are copied; the row of ρ is zero but for its variance.
"""

from typing import NamedTuple

from factorbus.idp.kernels.compile import F64, inline_kernel, kernel, types
from factorbus.idp.kernels.layout import FEATURE, Q, R
from factorbus.idp.kernels.rays import turning


class RowFactors(NamedTuple):
    """Numbers that the rows of n new features are made of.

    turn (n, 4): of which G is made   U (6, m): what all share   V (n, 6): G S row by row   W (n, 6): G C row by row
    own (n, 3): σ² M Mᵀ: θθ, θφ, φφ
    """

    turn: F64
    U: F64
    V: F64
    W: F64
    own: F64


_MATRIX = types.float64[:, ::1]
_ROW_FACTORS = types.NamedUniTuple(_MATRIX, len(RowFactors._fields), RowFactors)


@kernel("int64(float64[::1], float64[:,::1], float64[:,::1], float64[:,::1])")
def share(x: F64, before: F64, U: F64, S: F64) -> int:
    """What all new features share; gives the number of multiplications.  MATH (5.4)

    in   x (13,)   before (13, m): the camera's rows of P
    out  U (6, m)   S (3, 3)
    """
    t00, t01, t02, t03, t10, t11, t12, t13, t20, t21, t22, t23 = turning(x)
    count = 0
    for c in range(before.shape[1]):
        U[0, c], U[1, c], U[2, c] = before[R, c], before[R + 1, c], before[R + 2, c]
        q0, q1, q2, q3 = before[Q, c], before[Q + 1, c], before[Q + 2, c], before[Q + 3, c]
        U[3, c] = t00 * q0 + t01 * q1 + t02 * q2 + t03 * q3
        U[4, c] = t10 * q0 + t11 * q1 + t12 * q2 + t13 * q3
        U[5, c] = t20 * q0 + t21 * q1 + t22 * q2 + t23 * q3
        count += 12
    for a in range(3):
        q0, q1, q2, q3 = U[3 + a, Q], U[3 + a, Q + 1], U[3 + a, Q + 2], U[3 + a, Q + 3]
        S[a, 2] = q0 * t20 + q1 * t21 + q2 * t22 + q3 * t23
        count += 4
        if a < 2:
            S[a, 1] = q0 * t10 + q1 * t11 + q2 * t12 + q3 * t13
            count += 4
        if a < 1:
            S[a, 0] = q0 * t00 + q1 * t01 + q2 * t02 + q3 * t03
            count += 4
    S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]
    return count


@kernel("int64(int64, float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1])")
def feature_factors(first: int, turn: F64, U: F64, S: F64, V: F64, W: F64) -> int:
    """Each feature's part in the blocks it is in, for features first .. n−1; gives the number of multiplications.

    in   turn (n, 4)   U (6, m)   S (3, 3)
    out  V (n, 6): G S row by row   W (n, 6): G C row by row
    """
    count = 0
    for k in range(first, turn.shape[0]):
        a, b, c, d = turn[k, 0], turn[k, 1], turn[k, 2], turn[k, 3]
        for j in range(3):
            V[k, j] = a * S[0, j] + S[1, j] + b * S[2, j]
            V[k, 3 + j] = c * S[0, j] - d * S[2, j]
            W[k, j] = a * U[3, R + j] + U[4, R + j] + b * U[5, R + j]
            W[k, 3 + j] = c * U[3, R + j] - d * U[5, R + j]
            count += 8
    return count


@kernel("int64(float64[:,::1], float64, float64[:,::1])")
def own_variances(slope: F64, sigma: float, own: F64) -> int:
    """σ² M Mᵀ: θθ, θφ, φφ; gives the number of multiplications.  MATH (5.7)

    in   slope (n, 4)   sigma: σ_pixel
    out  own (n, 3)
    """
    count = 0
    for k in range(slope.shape[0]):
        m0, m1, m2, m3 = sigma * slope[k, 0], sigma * slope[k, 1], sigma * slope[k, 2], sigma * slope[k, 3]
        own[k, 0], own[k, 1], own[k, 2] = m0 * m0 + m1 * m1, m0 * m2 + m1 * m3, m2 * m2 + m3 * m3
        count += 10
    return count


@kernel(types.int64(_ROW_FACTORS, types.int64, types.int64, types.float64, _MATRIX))
def full_rows(factors: RowFactors, first: int, last: int, variance: float, out: F64) -> int:
    """The whole rows of the new features first .. last−1 of P after; gives the number of multiplications.

    in   variance: σ_ρ²
    out  out (6 (last − first), m + 6 n)
    """
    turn, U, V, W, own = factors.turn, factors.U, factors.V, factors.W, factors.own
    m = U.shape[1]
    count = 0
    for i in range(first, last):
        row = out[FEATURE * (i - first) : FEATURE * (i - first) + FEATURE]
        count += cross_rows(i, turn, U, W, row)
        x, y, z = by_feature(row[0, m:]), by_feature(row[1, m:]), by_feature(row[2, m:])
        azimuth, elevation = by_feature(row[3, m:]), by_feature(row[4, m:])
        position_blocks(0, U, W, x, y, z)
        count += earlier_blocks(i, turn, V, W, azimuth, elevation)
        count += own_block(i, turn, V, W, own, azimuth[i], elevation[i])
        count += later_blocks(i, turn, V, W, azimuth[i:], elevation[i:])
        row[5, m:] = 0.0
        row[5, m + FEATURE * i + 5] = variance
    return count


@kernel(types.int64(_ROW_FACTORS, types.int64, types.int64, types.float64, _MATRIX, types.float64[::1]))
def half_rows(factors: RowFactors, first: int, last: int, variance: float, cross: F64, out: F64) -> int:
    """As `full_rows`, from each feature's own block on: the upper half; gives the number of multiplications.

    out  cross (6 (last − first), m): P(new, before)
         out: for every i six rows of 6 (n − i) numbers, P(new i, new i .. n−1), one i after the other
    """
    turn, U, V, W, own = factors.turn, factors.U, factors.V, factors.W, factors.own
    n = turn.shape[0]
    count = 0
    at = 0
    for i in range(first, last):
        width = FEATURE * (n - i)
        row = out[at : at + FEATURE * width].reshape((FEATURE, width))
        at += FEATURE * width
        count += cross_rows(i, turn, U, W, cross[FEATURE * (i - first) : FEATURE * (i - first) + FEATURE])
        azimuth, elevation = by_feature(row[3]), by_feature(row[4])
        position_blocks(i, U, W, by_feature(row[0]), by_feature(row[1]), by_feature(row[2]))
        count += own_block(i, turn, V, W, own, azimuth[0], elevation[0])
        count += later_blocks(i, turn, V, W, azimuth, elevation)
        row[5] = 0.0
        row[5, 5] = variance
    return count


@inline_kernel
def cross_rows(i: int, turn: F64, U: F64, W: F64, out: F64) -> int:
    """P(new i, before): the first m columns of the six rows `out`.  MATH (5.5)"""
    a, b, c, d = turn[i, 0], turn[i, 1], turn[i, 2], turn[i, 3]
    x, y, z, azimuth, elevation, inverse = out[0], out[1], out[2], out[3], out[4], out[5]
    m = U.shape[1]
    for j in range(m):
        x[j], y[j], z[j], inverse[j] = U[0, j], U[1, j], U[2, j], 0.0
    for j in range(3):
        azimuth[j], elevation[j] = W[i, j], W[i, 3 + j]
    count = 0
    for j in range(3, m):
        azimuth[j] = a * U[3, j] + U[4, j] + b * U[5, j]
        elevation[j] = c * U[3, j] - d * U[5, j]
        count += 4
    return count


@inline_kernel
def by_feature(row: F64) -> F64:
    """A row's new columns as (n, 6)."""
    return row.reshape((row.size // FEATURE, FEATURE))


@inline_kernel
def position_blocks(first: int, U: F64, W: F64, x: F64, y: F64, z: F64) -> None:
    """P(x, new k), P(y, new k), P(z, new k) for k ≥ first: the same for all new features, nothing to multiply.

    Written anew each time: copying a row made once takes twice as long (15 ms against 7 for 1000 features).
    out  x, y, z (n − first, 6), by feature
    """
    p0, p1, p2, p3, p4, p5 = U[0, R], U[0, R + 1], U[0, R + 2], U[1, R + 1], U[1, R + 2], U[2, R + 2]
    mine = W[first:]
    for k in range(mine.shape[0]):
        x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, 4], x[k, 5] = p0, p1, p2, mine[k, 0], mine[k, 3], 0.0
        y[k, 0], y[k, 1], y[k, 2], y[k, 3], y[k, 4], y[k, 5] = p1, p3, p4, mine[k, 1], mine[k, 4], 0.0
        z[k, 0], z[k, 1], z[k, 2], z[k, 3], z[k, 4], z[k, 5] = p2, p4, p5, mine[k, 2], mine[k, 5], 0.0


@inline_kernel
def earlier_blocks(i: int, turn: F64, V: F64, W: F64, azimuth: F64, elevation: F64) -> int:
    """P(θ_i, new k) and P(φ_i, new k) for k < i: V_k G_iᵀ, with the very operations of block (k, i).  MATH (5.6)

    out  azimuth, elevation (n, 6), by feature
    """
    a, b, c, d = turn[i, 0], turn[i, 1], turn[i, 2], turn[i, 3]
    w0, w1, w2, w3, w4, w5 = W[i, 0], W[i, 1], W[i, 2], W[i, 3], W[i, 4], W[i, 5]
    count = 0
    for k in range(i):
        azimuth[k, 0], azimuth[k, 1], azimuth[k, 2] = w0, w1, w2
        azimuth[k, 3] = V[k, 0] * a + V[k, 1] + V[k, 2] * b
        azimuth[k, 4] = V[k, 3] * a + V[k, 4] + V[k, 5] * b
        azimuth[k, 5] = 0.0
        elevation[k, 0], elevation[k, 1], elevation[k, 2] = w3, w4, w5
        elevation[k, 3] = V[k, 0] * c - V[k, 2] * d
        elevation[k, 4] = V[k, 3] * c - V[k, 5] * d
        elevation[k, 5] = 0.0
        count += 8
    return count


@inline_kernel
def own_block(i: int, turn: F64, V: F64, W: F64, own: F64, azimuth: F64, elevation: F64) -> int:
    """P(θ_i, new i) and P(φ_i, new i), six numbers each.  MATH (5.6), (5.7)"""
    for j in range(3):
        azimuth[j], elevation[j] = W[i, j], W[i, 3 + j]
    azimuth[3] = V[i, 0] * turn[i, 0] + V[i, 1] + V[i, 2] * turn[i, 1] + own[i, 0]
    azimuth[4] = V[i, 0] * turn[i, 2] - V[i, 2] * turn[i, 3] + own[i, 1]
    elevation[3] = azimuth[4]
    elevation[4] = V[i, 3] * turn[i, 2] - V[i, 5] * turn[i, 3] + own[i, 2]
    azimuth[5], elevation[5] = 0.0, 0.0
    return 6


@inline_kernel
def later_blocks(i: int, turn: F64, V: F64, W: F64, azimuth: F64, elevation: F64) -> int:
    """P(θ_i, new k) and P(φ_i, new k) for k > i: V_i G_kᵀ.  MATH (5.6)

    out  azimuth, elevation (n − i, 6): by feature, from i on
    """
    v0, v1, v2, v3, v4, v5 = V[i, 0], V[i, 1], V[i, 2], V[i, 3], V[i, 4], V[i, 5]
    w0, w1, w2, w3, w4, w5 = W[i, 0], W[i, 1], W[i, 2], W[i, 3], W[i, 4], W[i, 5]
    G = turn[i:]
    count = 0
    for k in range(1, G.shape[0]):
        a, b, c, d = G[k, 0], G[k, 1], G[k, 2], G[k, 3]
        azimuth[k, 0], azimuth[k, 1], azimuth[k, 2] = w0, w1, w2
        azimuth[k, 3], azimuth[k, 4], azimuth[k, 5] = v0 * a + v1 + v2 * b, v0 * c - v2 * d, 0.0
        elevation[k, 0], elevation[k, 1], elevation[k, 2] = w3, w4, w5
        elevation[k, 3], elevation[k, 4], elevation[k, 5] = v3 * a + v4 + v5 * b, v3 * c - v5 * d, 0.0
        count += 8
    return count


@kernel("void(int64, float64[:,::1])")
def mirror(m: int, out: F64) -> None:
    """Copy P(new, before), the first m columns of the rows from m on, into P(before, new).  In tiles: see `_TILE`."""
    size = out.shape[0]
    for top in range(0, m, _TILE):
        for left in range(m, size, _TILE):
            for a in range(top, min(top + _TILE, m)):
                for b in range(left, min(left + _TILE, size)):
                    out[a, b] = out[b, a]


# Rows and columns of a tile that is transposed at a time: both sides stay in the first-level cache.
_TILE = 32
