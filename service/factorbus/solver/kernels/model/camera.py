"""What cameras see in a map: residuals and Jacobians of observations, ⊞ and first values of features.  MATH §3.1.

A camera is an se3 pose, camera to map.  A feature y = (x, y, z, θ, φ, ρ) is where the camera stood that saw it first,
azimuth, elevation and inverse distance; it stands for the point (x, y, z) + m(θ, φ)/ρ, m = (cos φ sin θ, −sin φ,
cos φ cos θ).  A measurement is a pixel (u, v), for a first observation also ρ₀, and then the lens: its code and
`LENS_SIZE` numbers (`factorbus.solver.lenses.layout`).
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.se3 import rotation_matrix
from factorbus.solver.lenses.layout import BEHIND, GOOD, OUTSIDE_LENS, VERTICAL
from factorbus.solver.lenses.models import project, ray

# What an inactive observation adds to χ²: as much as one that is 30 σ off, so that no step gains by it.
INACTIVE_CHI2 = 900.0
_VERTICAL = 1e-6


@part
def observation(kind: int, x: F64, ends: Ends, p: F64, k: int, r: F64, A: F64, B: F64) -> float:
    """Residual and Jacobians of an observation of any kind; other arguments as in `se2`.  MATH (3.14) to (3.17)

    idp_first    r = ( (x, y, z) − t;  pixel − (u, v);  ρ − ρ₀ )
    idp_seen     r = pixel of Rᵀ a − (u, v),   a = ((x, y, z) − t) ρ + m
    point_seen   r = pixel of Rᵀ a − (u, v),   a = l − t

    With h = Rᵀ a and E = ∂pixel/∂h the pixel's rows are E [ −ρ I | ⌊h⌋ ] by the pose (ρ = 1 of a point), and by what is
    seen E Rᵀ [ ρ I | m_θ | m_φ | (x, y, z) − t ], or E Rᵀ.

    r[R_STATUS] gets what became of the pixel.  Where it is not GOOD its rows are 0, so that it counts for nothing, and
    INACTIVE_CHI2 is returned, which it adds to χ²; else 0.
    """
    i, j = ends
    q = rotation_matrix(x, i + 3)
    d0, d1, d2 = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    n, rho, a0, a1, a2 = k + 2, 1.0, d0, d1, d2
    st, ct, sp, cp = 0.0, 0.0, 0.0, 0.0
    if kind != at.POINT_SEEN:
        rho, st, ct, sp, cp = x[j + 5], math.sin(x[j + 3]), math.cos(x[j + 3]), math.sin(x[j + 4]), math.cos(x[j + 4])
        a0, a1, a2 = d0 * rho + cp * st, d1 * rho - sp, d2 * rho + cp * ct
    row = 0
    if kind == at.IDP_FIRST:
        row, n = 3, k + 3
        A[:6, :6] = 0.0
        B[:6, :6] = 0.0
        r[0], r[1], r[2] = d0, d1, d2
        for a in range(3):
            A[a, 0], A[a, 1], A[a, 2] = -q[3 * a], -q[3 * a + 1], -q[3 * a + 2]
            B[a, a] = 1.0
        r[5], B[5, 5] = rho - p[k + 2], 1.0
    h0, h1, h2 = q[0] * a0 + q[3] * a1 + q[6] * a2, q[1] * a0 + q[4] * a1 + q[7] * a2, q[2] * a0 + q[5] * a1 + q[8] * a2
    status, u, v, e0, e1, e2, e3, e4, e5 = project(int(p[n]), p[n + 1 :], h0, h1, h2)
    if status != GOOD:
        r[at.R_STATUS] = OUTSIDE_LENS if h2 > 0.0 else BEHIND
        r[row], r[row + 1] = 0.0, 0.0
        A[row : row + 2, :6] = 0.0
        B[row : row + 2, :6] = 0.0
        return INACTIVE_CHI2
    r[at.R_STATUS] = GOOD
    r[row], r[row + 1] = u - p[k], v - p[k + 1]
    g0, g1, g2 = e0, e1, e2
    for a in range(row, row + 2):
        f0, f1 = g0 * q[0] + g1 * q[1] + g2 * q[2], g0 * q[3] + g1 * q[4] + g2 * q[5]
        f2 = g0 * q[6] + g1 * q[7] + g2 * q[8]
        A[a, 0], A[a, 1], A[a, 2] = -rho * g0, -rho * g1, -rho * g2
        A[a, 3], A[a, 4], A[a, 5] = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
        B[a, 0], B[a, 1], B[a, 2] = rho * f0, rho * f1, rho * f2
        if kind != at.POINT_SEEN:
            B[a, 3] = cp * (f0 * ct - f2 * st)
            B[a, 4] = -f0 * sp * st - f1 * cp - f2 * sp * ct
            B[a, 5] = f0 * d0 + f1 * d1 + f2 * d2
        g0, g1, g2 = e3, e4, e5
    return 0.0


@part
def place_idp(x: F64, i: int, p: F64, k: int, j: int) -> int:
    """The y with which its first observation has no residual, into x from j on; gives GOOD or why not.  MATH (3.18)"""
    status, a, b, c, _, _, _, _, _, _ = ray(int(p[k + 3]), p[k + 4 :], p[k], p[k + 1])
    q = rotation_matrix(x, i + 3)
    hx, hy, hz = q[0] * a + q[1] * b + q[2] * c, q[3] * a + q[4] * b + q[5] * c, q[6] * a + q[7] * b + q[8] * c
    s2 = hx * hx + hz * hz
    x[j], x[j + 1], x[j + 2] = x[i], x[i + 1], x[i + 2]
    x[j + 3], x[j + 4], x[j + 5] = math.atan2(hx, hz), math.atan2(-hy, math.sqrt(s2)), p[k + 2]
    return status if s2 > _VERTICAL * _VERTICAL * (s2 + hy * hy) else VERTICAL


@inline_kernel
def move_idp(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """y ⊞ δ = y + δ, with θ in [−π, π).  MATH (2.4)"""
    for c in range(6):
        out[i + c] = x[i + c] + step[d + c]
    out[i + 3] = wrap(out[i + 3])
