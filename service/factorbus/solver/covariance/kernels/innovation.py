"""The innovation of factors that a map does not have: what it predicts of them, and how far off they are.  MATH §10.3.

T = H Σ Hᵀ,   Ω = L Lᵀ,   M = I + Lᵀ T L,   d² = (Lᵀ r)ᵀ M⁻¹ Lᵀ r,   gain = ½ ln det M       (10.5), (10.6)
"""

import math
from typing import NamedTuple

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel

_DIM = 6
RESIDUAL, FIRST, SECOND = range(3)  # columns of `sizes`, the fields of `Sizes`


class Sizes(NamedTuple):
    """How many numbers the residual of a factor has, and the tangent spaces of its ends; 0: there is no second end."""

    residual: int
    first: int
    second: int


@kernel(
    "void(int64[:,::1], int64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1],"
    " float64[:,:,::1])"
)
def predicted_covariances(ends: I64, sizes: I64, A: F64, B: F64, diagonal: F64, cross: F64, T: F64) -> None:
    """The covariance of the residuals of factors between ends[k, 0] and ends[k, 1] (−1: none).

    in   sizes (n, 3): see `Sizes`   A, B (n, 6, 6)   diagonal (variables, d, d)  cross (n, d, d): Σ between the ends
    out  T (n, e, e)
    """
    scratch = np.empty((2, _DIM, _DIM))
    for k in range(len(ends)):
        size, i, j = Sizes(sizes[k, RESIDUAL], sizes[k, FIRST], sizes[k, SECOND]), ends[k, 0], max(0, ends[k, 1])
        if size.residual == 3 and size.first == 3 and size.second == 3:
            # With constants the loops are unrolled: three times as fast.
            predicted_covariance(Sizes(3, 3, 3), A[k], B[k], diagonal[i], diagonal[j], cross[k], scratch, T[k])
        else:
            predicted_covariance(size, A[k], B[k], diagonal[i], diagonal[j], cross[k], scratch, T[k])


@inline_kernel
def predicted_covariance(
    size: Sizes, A: F64, B: F64, first: F64, second: F64, cross: F64, scratch: F64, T: F64
) -> None:
    """T = H Σ Hᵀ,  H = [ A  B ]"""
    G, S = scratch[0], scratch[1]
    T[:, :] = 0.0
    add_triple_product(size.residual, size.first, size.first, A, first, A, G, T)
    if size.second > 0:
        add_triple_product(size.residual, size.second, size.second, B, second, B, G, T)
        S[:, :] = 0.0
        add_triple_product(size.residual, size.first, size.second, A, cross, B, G, S)
        for a in range(size.residual):
            for b in range(size.residual):
                T[a, b] += S[a, b] + S[b, a]


@inline_kernel
def add_triple_product(rows: int, di: int, dj: int, A: F64, sigma: F64, B: F64, G: F64, out: F64) -> None:
    """out += A Σ Bᵀ"""
    for a in range(rows):
        for j in range(dj):
            total = 0.0
            for i in range(di):
                total += A[a, i] * sigma[i, j]
            G[a, j] = total
    for a in range(rows):
        for b in range(rows):
            total = 0.0
            for j in range(dj):
                total += G[a, j] * B[b, j]
            out[a, b] += total


@kernel("void(int64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[::1], float64[::1])")
def distances_and_gains(sizes: I64, r: F64, W: F64, T: F64, distance: F64, gain: F64) -> None:
    """How far off measurements are, and what they would tell.

    in   sizes (n, 3): see `Sizes`   r (n, 6 or more)   W (n, 6, 6)   T (n, e, e)
    out  distance (n,): d²   gain (n,): nats
    """
    L, M, y = np.empty((_DIM, _DIM)), np.empty((_DIM, _DIM)), np.empty(_DIM)
    for k in range(len(sizes)):
        if sizes[k, RESIDUAL] == 3:
            distance[k], gain[k] = distance_and_gain(3, r[k], W[k], T[k], L, M, y)
        else:
            distance[k], gain[k] = distance_and_gain(sizes[k, RESIDUAL], r[k], W[k], T[k], L, M, y)


@inline_kernel
def distance_and_gain(dr: int, r: F64, W: F64, T: F64, L: F64, M: F64, y: F64) -> tuple[float, float]:
    """(d², gain)"""
    for a in range(dr):
        for b in range(a + 1):
            L[a, b] = W[a, b]
    lower_factor(dr, L)
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
    lower_factor(dr, M)
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
def lower_factor(n: int, S: F64) -> None:
    """S := L of S = L Lᵀ, in its lower triangle."""
    for a in range(n):
        for b in range(a + 1):
            total = S[a, b]
            for k in range(b):
                total -= S[a, k] * S[b, k]
            S[a, b] = math.sqrt(total) if a == b else total / S[b, b]
