"""Loop closures in the plane against the map, and against each other: see `factorbus.solver.closures.evidence`.

A motion T is four numbers here: x, y, and cosine and sine of its heading;  Ad(T) = [ R | (y, −x)ᵀ ; 0 | 1 ].

    r = Log T,   S = N + P + ¾ λ(P_tt) P_θθ [ I | 0 ; 0 | 0 ],   S = L Lᵀ,   d² = |L⁻¹ r|²,
    v = (2π)^{3/2} Π L_aa e^{d²/2}: the volume in which false ones are as likely as a right one
"""

import math
from typing import TypeAlias

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel

SECOND_ORDER = 0.75  # of σ_p² σ_θ²
FULL = (2.0 * math.pi) ** 1.5
HELD = 1e-3  # a share of Ω⁻¹: below, the map is what the closure says
MOST_DISTANCE = 400.0  # e to half of it is still a number

Motion: TypeAlias = tuple[float, float, float, float]


@kernel(
    "void(float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1])"
)
def judge_each_plane(a: F64, b: F64, z: F64, noise: F64, known: F64, out: F64) -> None:
    """Each closure against the map:  T = z⁻¹ a⁻¹ b,  P = J Σ Jᵀ,  J = [ −Ad(b⁻¹a) | I ],  N = Ω⁻¹.

    in   a, b, z (n, 3, 3)  noise (n, 3, 3)  known (6 n, 6 n)
    out  (n, 4, 3): in the first row d² and v, below it S
    """
    J, P = np.zeros((3, 6)), np.empty((3, 3))
    for k in range(len(a)):
        there = motion_to(motion_at(a[k]), motion_at(b[k]))
        loop = motion_to(motion_at(z[k]), there)
        put_adjoint(inverse_of(there), -1.0, 0, J)
        J[0, 3] = J[1, 4] = J[2, 5] = 1.0
        P[:, :] = 0.0
        for m in range(4):
            add_predicted(J, 3 * (m // 2), 6 * k + 3 * (m // 2), 3 * (m % 2), 6 * k + 3 * (m % 2), known, P)
        weigh_motion(loop, P, noise[k], out[k])


@kernel("void(float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1])")
def weights_without_plane(a: F64, b: F64, noise: F64, known: F64, out: F64) -> None:
    """(N − P)⁻¹ = (L (I − L⁻¹ P L⁻ᵀ) Lᵀ)⁻¹ with N = L Lᵀ, of closures that the map has; arguments as above.

    out  (n, 3, 3); an axis whose pivot is below HELD is left out: the closure alone holds what it measures along it
    """
    J, P, B, L, K = np.zeros((3, 6)), np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(len(a)):
        put_adjoint(motion_to(motion_at(b[k]), motion_at(a[k])), -1.0, 0, J)
        J[0, 3] = J[1, 4] = J[2, 5] = 1.0
        P[:, :] = 0.0
        for m in range(4):
            add_predicted(J, 3 * (m // 2), 6 * k + 3 * (m // 2), 3 * (m % 2), 6 * k + 3 * (m % 2), known, P)
        put_weight_without(P, noise[k], L, K, B, out[k])


@inline_kernel
def put_weight_without(P: F64, N: F64, L: F64, K: F64, B: F64, out: F64) -> None:
    """(N − P)⁻¹, as above.  Overwrites P; L and K, with zeros above their diagonals, and B (3, 3) are for scratch."""
    cholesky_plane(N, 0.0, L)
    solve_plane(L, P)  # P := L⁻¹ P L⁻ᵀ, which is symmetric
    transpose_plane(P)
    solve_plane(L, P)
    for r in range(3):
        for c in range(3):
            P[r, c], B[r, c] = (1.0 if r == c else 0.0) - P[r, c], 1.0 if r == c else 0.0
    cholesky_plane(P, HELD, K)
    solve_plane(L, B)
    solve_plane(K, B)
    for r in range(3):
        for c in range(3):
            out[r, c] = B[0, r] * B[0, c] + B[1, r] * B[1, c] + B[2, r] * B[2, c]


@inline_kernel
def solve_plane(L: F64, B: F64) -> None:
    """B := L⁻¹ B."""
    for c in range(3):
        B[0, c] /= L[0, 0]
        B[1, c] = (B[1, c] - L[1, 0] * B[0, c]) / L[1, 1]
        B[2, c] = (B[2, c] - L[2, 0] * B[0, c] - L[2, 1] * B[1, c]) / L[2, 2]


@inline_kernel
def transpose_plane(B: F64) -> None:
    """B := Bᵀ."""
    B[0, 1], B[1, 0] = B[1, 0], B[0, 1]
    B[0, 2], B[2, 0] = B[2, 0], B[0, 2]
    B[1, 2], B[2, 1] = B[2, 1], B[1, 2]


@inline_kernel
def cholesky_plane(S: F64, least: float, L: F64) -> None:
    """L Lᵀ = S; infinite where a pivot is not above `least`."""
    for r in range(3):
        for c in range(r + 1):
            total = S[r, c]
            for m in range(c):
                total -= L[r, m] * L[c, m]
            if r > c:
                L[r, c] = total / L[c, c]
            else:
                L[r, c] = math.sqrt(total) if total > least else math.inf


@kernel(
    "void(float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,::1], int64[::1],"
    " int64[::1], float64[:,:,::1])"
)
def judge_pairs_plane(a: F64, b: F64, z: F64, noise: F64, known: F64, i: I64, j: I64, out: F64) -> None:
    """Closures i[k] and j[k] around the loop that they make:  T = zᵢ⁻¹ (aᵢ⁻¹ aⱼ) zⱼ (bⱼ⁻¹ bᵢ).

    N = Ωᵢ⁻¹ + Ad(B) Ωⱼ⁻¹ Ad(B)ᵀ,  B = zᵢ⁻¹ (aᵢ⁻¹ aⱼ) zⱼ;  arguments as above, of all closures
    out  (m, 4, 3): as above
    """
    J, P, N, G = np.zeros((3, 12)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(i.size):
        p, q = i[k], j[k]
        first = inverse_of(motion_at(z[p]))
        between = motion_product(first, motion_to(motion_at(a[p]), motion_at(a[q])))
        before = motion_product(between, motion_at(z[q]))
        loop = motion_product(before, motion_to(motion_at(b[q]), motion_at(b[p])))
        # aᵢ, bᵢ, aⱼ, bⱼ, as increments at the start of the loop
        put_adjoint(first, -1.0, 0, J)
        put_adjoint(loop, 1.0, 3, J)
        put_adjoint(between, 1.0, 6, J)
        put_adjoint(before, -1.0, 9, J)
        P[:, :] = 0.0
        for m in range(16):
            own, other = m // 4, m % 4
            row = 6 * (p if own < 2 else q) + 3 * (own % 2)
            column = 6 * (p if other < 2 else q) + 3 * (other % 2)
            add_predicted(J, 3 * own, row, 3 * other, column, known, P)
        for r in range(3):
            for c in range(3):
                G[r, c] = J[r, 9] * noise[q, 0, c] + J[r, 10] * noise[q, 1, c] + J[r, 11] * noise[q, 2, c]
        for r in range(3):
            for c in range(3):
                N[r, c] = noise[p, r, c] + G[r, 0] * J[c, 9] + G[r, 1] * J[c, 10] + G[r, 2] * J[c, 11]
        weigh_motion(loop, P, N, out[k])


@inline_kernel
def weigh_motion(T: Motion, P: F64, N: F64, out: F64) -> None:
    """out (4, 3) of a residual Log T, which is predicted with covariance P and measured with N."""
    half, mean = 0.5 * (P[0, 0] - P[1, 1]), 0.5 * (P[0, 0] + P[1, 1])
    largest = max(mean + math.sqrt(half * half + P[0, 1] * P[0, 1]), 0.0)
    more = SECOND_ORDER * largest * max(P[2, 2], 0.0)
    for r in range(3):
        for c in range(3):
            out[1 + r, c] = P[r, c] + N[r, c]
    out[1, 0] += more
    out[2, 1] += more
    l00 = math.sqrt(out[1, 0])
    l10, l20 = out[2, 0] / l00, out[3, 0] / l00
    l11 = math.sqrt(out[2, 1] - l10 * l10)
    l21 = (out[3, 1] - l20 * l10) / l11
    l22 = math.sqrt(out[3, 2] - l20 * l20 - l21 * l21)
    y0 = T[0] / l00
    y1 = (T[1] - l10 * y0) / l11
    y2 = (math.atan2(T[3], T[2]) - l20 * y0 - l21 * y1) / l22
    distance = y0 * y0 + y1 * y1 + y2 * y2
    out[0, 0], out[0, 2] = distance, 0.0
    out[0, 1] = FULL * l00 * l11 * l22 * math.exp(0.5 * min(distance, MOST_DISTANCE))


@inline_kernel
def add_predicted(J: F64, own: int, row: int, other: int, column: int, known: F64, P: F64) -> None:
    """P += J Σ Jᵀ, of the three columns of J from `own` and from `other` on, and of Σ from (row, column) on."""
    for r in range(3):
        for e in range(3):
            total = 0.0
            for f in range(3):
                total += J[r, own + f] * known[row + f, column + e]
            for c in range(3):
                P[r, c] += total * J[c, other + e]


@inline_kernel
def put_adjoint(T: Motion, sign: float, at: int, J: F64) -> None:
    """±Ad(T) in the three columns from `at` on."""
    x, y, c, s = T
    J[0, at], J[0, at + 1], J[0, at + 2] = sign * c, -sign * s, sign * y
    J[1, at], J[1, at + 1], J[1, at + 2] = sign * s, sign * c, -sign * x
    J[2, at], J[2, at + 1], J[2, at + 2] = 0.0, 0.0, sign


@inline_kernel
def motion_at(T: F64) -> Motion:
    """Of a matrix (3, 3)."""
    return T[0, 2], T[1, 2], T[0, 0], T[1, 0]


@inline_kernel
def motion_product(A: Motion, B: Motion) -> Motion:
    """A B."""
    x, y, c, s = A
    return x + c * B[0] - s * B[1], y + s * B[0] + c * B[1], c * B[2] - s * B[3], s * B[2] + c * B[3]


@inline_kernel
def inverse_of(A: Motion) -> Motion:
    """A⁻¹."""
    x, y, c, s = A
    return -c * x - s * y, s * x - c * y, c, -s


@inline_kernel
def motion_to(A: Motion, B: Motion) -> Motion:
    """A⁻¹ B."""
    return motion_product(inverse_of(A), B)
