"""Cameras in a map: residuals and Jacobians of what is seen, ⊞ and first values.  MATH §8.

The arguments are those of the solver's kernels (`factorbus.solver.kernels.se3`): x the arena of values with a pose
(x y z, qx qy qz qw: camera to map) from i on and a feature or point from j on; p the payload with the measurement from
k on; r, A, B get the residual and its Jacobians by the increments of both.  A pose moves by (t + R δt, q ⊗ exp(δφ)).

A measurement is a pixel (u, v), for a first sight also ρ₀, and then the lens: its code and `LENS_SIZE` numbers
(`layout.py`).  Each kernel gives a status: GOOD, or why there is no residual; then r, A and B are 0, so that the factor
counts for nothing until it can be seen again.
"""

import math

from factorbus.idp.kernels.compile import F64, inline_kernel
from factorbus.idp.kernels.layout import BEHIND, GOOD, LENS_SIZE, OUTSIDE_LENS, VERTICAL
from factorbus.idp.kernels.lens import project, ray

# Numbers of a measurement: pixel, (ρ₀), code, lens.
FIRST_SIZE, SEEN_SIZE = 4 + LENS_SIZE, 3 + LENS_SIZE
_VERTICAL = 1e-6


@inline_kernel
def idp_first(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> int:
    """A feature y from the camera that saw it first.  MATH (8.1)

    r = ( (x, y, z) − t;  pixel − (u, v);  ρ − ρ₀ )
    A = [ −R 0 ; pixel rows as (8.2) ; 0 ],   B = [ I 0 ; pixel rows ; 0 … 0 1 ]

    The first three rows tie the anchor to the camera: give them a variance far below what matters (1e-10 m², say).
    """
    q = rotation_xyzw(x, i + 3)
    A[:6, :6] = 0.0
    B[:6, :6] = 0.0
    status = pixel_of_feature(x, i, j, p, k, p[k + 3], k + 4, q, r[3:], A[3:], B[3:])
    r[0], r[1], r[2] = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    A[0, 0], A[0, 1], A[0, 2] = -q[0], -q[1], -q[2]
    A[1, 0], A[1, 1], A[1, 2] = -q[3], -q[4], -q[5]
    A[2, 0], A[2, 1], A[2, 2] = -q[6], -q[7], -q[8]
    B[0, 0], B[1, 1], B[2, 2] = 1.0, 1.0, 1.0
    r[5], B[5, 5] = x[j + 5] - p[k + 2], 1.0
    return status


@inline_kernel
def idp_seen(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> int:
    """A feature y seen again by another camera: r = pixel − (u, v).  MATH (8.2)"""
    return pixel_of_feature(x, i, j, p, k, p[k + 2], k + 3, rotation_xyzw(x, i + 3), r, A, B)


@inline_kernel
def point_seen(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> int:
    """A point l seen by a camera: r = pixel of Rᵀ (l − t) − (u, v).  MATH (8.3)

    A = E [ −I | ⌊h⌋ ],   B = E Rᵀ,   h = Rᵀ (l − t),   E = ∂pixel/∂h
    """
    q = rotation_xyzw(x, i + 3)
    a0, a1, a2 = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    h0, h1, h2 = q[0] * a0 + q[3] * a1 + q[6] * a2, q[1] * a0 + q[4] * a1 + q[7] * a2, q[2] * a0 + q[5] * a1 + q[8] * a2
    status, u, v, e0, e1, e2, e3, e4, e5 = project(int(p[k + 2]), p[k + 3 :], h0, h1, h2)
    if status != GOOD:
        r[:2] = 0.0
        A[:2, :6] = 0.0
        B[:2, :3] = 0.0
        return OUTSIDE_LENS if h2 > 0.0 else BEHIND
    r[0], r[1] = u - p[k], v - p[k + 1]
    for n in range(2):
        g0, g1, g2 = (e0, e1, e2) if n == 0 else (e3, e4, e5)
        A[n, 0], A[n, 1], A[n, 2] = -g0, -g1, -g2
        A[n, 3], A[n, 4], A[n, 5] = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
        B[n, 0], B[n, 1] = g0 * q[0] + g1 * q[1] + g2 * q[2], g0 * q[3] + g1 * q[4] + g2 * q[5]
        B[n, 2] = g0 * q[6] + g1 * q[7] + g2 * q[8]
    return status


@inline_kernel
def pixel_of_feature(
    x: F64, i: int, j: int, p: F64, k: int, code: float, lens: int, q: tuple, r: F64, A: F64, B: F64
) -> int:
    """The two rows of a pixel.  MATH (8.2)

    a = ((x, y, z) − t) ρ + m(θ, φ),   h = Rᵀ a,   E = ∂pixel/∂h
    A = E [ −ρ I | ⌊h⌋ ],   B = E Rᵀ [ ρ I | m_θ | m_φ | (x, y, z) − t ]
    """
    rho, st, ct, sp, cp = x[j + 5], math.sin(x[j + 3]), math.cos(x[j + 3]), math.sin(x[j + 4]), math.cos(x[j + 4])
    d0, d1, d2 = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    a0, a1, a2 = d0 * rho + cp * st, d1 * rho - sp, d2 * rho + cp * ct
    h0, h1, h2 = q[0] * a0 + q[3] * a1 + q[6] * a2, q[1] * a0 + q[4] * a1 + q[7] * a2, q[2] * a0 + q[5] * a1 + q[8] * a2
    status, u, v, e0, e1, e2, e3, e4, e5 = project(int(code), p[lens:], h0, h1, h2)
    if status != GOOD:
        r[:2] = 0.0
        A[:2, :6] = 0.0
        B[:2, :6] = 0.0
        return OUTSIDE_LENS if h2 > 0.0 else BEHIND
    r[0], r[1] = u - p[k], v - p[k + 1]
    for n in range(2):
        g0, g1, g2 = (e0, e1, e2) if n == 0 else (e3, e4, e5)
        f0, f1 = g0 * q[0] + g1 * q[1] + g2 * q[2], g0 * q[3] + g1 * q[4] + g2 * q[5]
        f2 = g0 * q[6] + g1 * q[7] + g2 * q[8]
        A[n, 0], A[n, 1], A[n, 2] = -rho * g0, -rho * g1, -rho * g2
        A[n, 3], A[n, 4], A[n, 5] = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
        B[n, 0], B[n, 1], B[n, 2] = rho * f0, rho * f1, rho * f2
        B[n, 3] = cp * (f0 * ct - f2 * st)
        B[n, 4] = -f0 * sp * st - f1 * cp - f2 * sp * ct
        B[n, 5] = f0 * d0 + f1 * d1 + f2 * d2
    return status


@inline_kernel
def first_value(x: F64, i: int, p: F64, k: int, y: F64, j: int) -> int:
    """The y that makes the residual of `idp_first` zero, into y from j on; gives GOOD or why not.  MATH (8.4)"""
    status, a, b, c, _, _, _, _, _, _ = ray(int(p[k + 3]), p[k + 4 :], p[k], p[k + 1])
    q = rotation_xyzw(x, i + 3)
    hx, hy, hz = q[0] * a + q[1] * b + q[2] * c, q[3] * a + q[4] * b + q[5] * c, q[6] * a + q[7] * b + q[8] * c
    s2 = hx * hx + hz * hz
    y[j], y[j + 1], y[j + 2] = x[i], x[i + 1], x[i + 2]
    y[j + 3], y[j + 4], y[j + 5] = math.atan2(hx, hz), math.atan2(-hy, math.sqrt(s2)), p[k + 2]
    return status if s2 > _VERTICAL * _VERTICAL * (s2 + hy * hy) else VERTICAL


@inline_kernel
def move_idp(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """y ⊞ δ = y + δ, with θ in [−π, π).  MATH (8.5)"""
    for c in range(6):
        out[i + c] = x[i + c] + step[d + c]
    theta = out[i + 3]
    out[i + 3] = theta - 2.0 * math.pi * math.floor((theta + math.pi) / (2.0 * math.pi))


@inline_kernel
def rotation_xyzw(x: F64, k: int) -> tuple:
    """R(q) row by row; q (x y z w) at offset k is of unit length."""
    a, b, c, w = x[k], x[k + 1], x[k + 2], x[k + 3]
    return (
        1.0 - 2.0 * (b * b + c * c),
        2.0 * (a * b - w * c),
        2.0 * (a * c + w * b),
        2.0 * (a * b + w * c),
        1.0 - 2.0 * (a * a + c * c),
        2.0 * (b * c - w * a),
        2.0 * (a * c - w * b),
        2.0 * (b * c + w * a),
        1.0 - 2.0 * (a * a + b * b),
    )
