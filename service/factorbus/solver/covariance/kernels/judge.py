"""What a map expects of a factor that it has not taken in.  MATH §10.3.

T = H Σ Hᵀ,   Ω = L Lᵀ,   M = I + Lᵀ T L,   d² = (Lᵀ r)ᵀ M⁻¹ Lᵀ r,   gain = ½ ln det M       (10.5), (10.6)
"""

import math

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel

_DIM = 6


@kernel(
    "void(int64[:,::1], int64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1],"
    " float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[::1], float64[::1])"
)
def judge(
    ends: I64, sizes: I64, r: F64, A: F64, B: F64, W: F64, diagonal: F64, cross: F64, T: F64, distance: F64, gain: F64
) -> None:
    """Factors between ends[k, 0] and ends[k, 1] (−1: none).

    in   sizes (n, 3): of the residual and of the ends   r (n, 6 or more)  A, B, W (n, 6, 6)
         diagonal (variables, d, d)  cross (n, d, d): Σ between the ends
    out  T (n, e, e)   distance (n,): d²   gain (n,): nats
    """
    G, M, y = np.empty((_DIM, _DIM)), np.empty((_DIM, _DIM)), np.empty(_DIM)
    for k in range(len(ends)):
        dr, di, dj, i, j = sizes[k, 0], sizes[k, 1], sizes[k, 2], ends[k, 0], max(0, ends[k, 1])
        if dr == 3 and di == 3 and dj == 3:  # with constants the loops are unrolled: three times as fast
            expect(3, 3, 3, A[k], B[k], diagonal[i], diagonal[j], cross[k], G, M, T[k])
            distance[k], gain[k] = hold(3, r[k], W[k], T[k], G, M, y)
        else:
            expect(dr, di, dj, A[k], B[k], diagonal[i], diagonal[j], cross[k], G, M, T[k])
            distance[k], gain[k] = hold(dr, r[k], W[k], T[k], G, M, y)


@inline_kernel
def expect(
    dr: int, di: int, dj: int, A: F64, B: F64, first: F64, second: F64, cross: F64, G: F64, S: F64, T: F64
) -> None:
    """T = H Σ Hᵀ,  H = [ A  B ]"""
    T[:, :] = 0.0
    spread(dr, di, di, A, first, A, G, T)
    if dj > 0:
        spread(dr, dj, dj, B, second, B, G, T)
        S[:, :] = 0.0
        spread(dr, di, dj, A, cross, B, G, S)
        for a in range(dr):
            for b in range(dr):
                T[a, b] += S[a, b] + S[b, a]


@inline_kernel
def hold(dr: int, r: F64, W: F64, T: F64, L: F64, M: F64, y: F64) -> tuple[float, float]:
    """(d², gain)"""
    for a in range(dr):
        for b in range(a + 1):
            L[a, b] = W[a, b]
    lower(dr, L)
    for a in range(dr):
        y[a] = 0.0
        for k in range(a, dr):
            y[a] += L[k, a] * r[k]
        for b in range(a + 1):
            total = 1.0 if a == b else 0.0
            for k in range(a, dr):
                for c in range(b, dr):
                    total += L[k, a] * T[k, c] * L[c, b]
            M[a, b] = total
    lower(dr, M)
    total, root = 0.0, 1.0  # √det M
    for a in range(dr):
        value = y[a]
        for b in range(a):
            value -= M[a, b] * y[b]
        y[a] = value / M[a, a]
        total += y[a] * y[a]
        root *= M[a, a]
    return total, math.log(root)


@inline_kernel
def spread(dr: int, di: int, dj: int, A: F64, sigma: F64, B: F64, G: F64, out: F64) -> None:
    """out += A Σ Bᵀ"""
    for a in range(dr):
        for j in range(dj):
            total = 0.0
            for i in range(di):
                total += A[a, i] * sigma[i, j]
            G[a, j] = total
    for a in range(dr):
        for b in range(dr):
            total = 0.0
            for j in range(dj):
                total += G[a, j] * B[b, j]
            out[a, b] += total


@inline_kernel
def lower(n: int, S: F64) -> None:
    """S := L of S = L Lᵀ, in its lower triangle."""
    for a in range(n):
        for b in range(a + 1):
            total = S[a, b]
            for k in range(b):
                total -= S[a, k] * S[b, k]
            S[a, b] = math.sqrt(total) if a == b else total / S[b, b]
