"""A point of which a pose knows only how far it is, or only where it is to be seen; how far two poses are apart.

MATH §3.5.  Arguments as in `se2`.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.se3 import rotation_matrix

# Closer than this there is no direction: Jacobians are zero, so that a point may lie on a pose.
_NEAR = 1e-150


@inline_kernel
def range_se2(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """r = |l − t| − ρ,  n = (l − t)/|l − t|,  A = [ −(Rᵀ n)ᵀ | 0 ],  B = nᵀ.  (3.23)"""
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    tx, ty = x[j] - x[i], x[j + 1] - x[i + 1]
    distance = math.sqrt(tx * tx + ty * ty)
    inverse = 1.0 / distance if distance > _NEAR else 0.0
    nx, ny = tx * inverse, ty * inverse
    r[0] = distance - p[k]
    A[0, 0], A[0, 1], A[0, 2] = -c * nx - s * ny, s * nx - c * ny, 0.0
    B[0, 0], B[0, 1] = nx, ny


@inline_kernel
def range_se3(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """As `range_se2`."""
    q = rotation_matrix(x, i + 3)
    t0, t1, t2 = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    distance = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
    inverse = 1.0 / distance if distance > _NEAR else 0.0
    n0, n1, n2 = t0 * inverse, t1 * inverse, t2 * inverse
    r[0] = distance - p[k]
    B[0, 0], B[0, 1], B[0, 2] = n0, n1, n2
    for a in range(3):
        A[0, a] = -(q[a] * n0 + q[3 + a] * n1 + q[6 + a] * n2)
        A[0, 3 + a] = 0.0


@inline_kernel
def range_between_se2(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """r = |t_j − t_i| − ρ,  n = (t_j − t_i)/|t_j − t_i|,  A = [ −(R_iᵀ n)ᵀ | 0 ],  B = [ (R_jᵀ n)ᵀ | 0 ].  (3.34)"""
    tx, ty = x[j] - x[i], x[j + 1] - x[i + 1]
    distance = math.sqrt(tx * tx + ty * ty)
    inverse = 1.0 / distance if distance > _NEAR else 0.0
    nx, ny = tx * inverse, ty * inverse
    r[0] = distance - p[k]
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    A[0, 0], A[0, 1], A[0, 2] = -c * nx - s * ny, s * nx - c * ny, 0.0
    c, s = math.cos(x[j + 2]), math.sin(x[j + 2])
    B[0, 0], B[0, 1], B[0, 2] = c * nx + s * ny, c * ny - s * nx, 0.0


@inline_kernel
def range_between_se3(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """As `range_between_se2`."""
    t0, t1, t2 = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    distance = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
    inverse = 1.0 / distance if distance > _NEAR else 0.0
    n0, n1, n2 = t0 * inverse, t1 * inverse, t2 * inverse
    r[0] = distance - p[k]
    q, s = rotation_matrix(x, i + 3), rotation_matrix(x, j + 3)
    for a in range(3):
        A[0, a] = -(q[a] * n0 + q[3 + a] * n1 + q[6 + a] * n2)
        B[0, a] = s[a] * n0 + s[3 + a] * n1 + s[6 + a] * n2
        A[0, 3 + a], B[0, 3 + a] = 0.0, 0.0


@inline_kernel
def bearing_se2(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """r = wrap(atan2(u_y, u_x) − β), u = Rᵀ (l − t);  g = (−u_y, u_x)/|u|²,  A = g [ −I | (u_y, −u_x)ᵀ ],  B = g Rᵀ.

    (3.24)
    """
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    tx, ty = x[j] - x[i], x[j + 1] - x[i + 1]
    ux, uy = c * tx + s * ty, c * ty - s * tx
    square = ux * ux + uy * uy
    inverse = 1.0 / square if square > _NEAR else 0.0
    gx, gy = -uy * inverse, ux * inverse
    r[0] = wrap(math.atan2(uy, ux) - p[k])
    A[0, 0], A[0, 1], A[0, 2] = -gx, -gy, gx * uy - gy * ux
    B[0, 0], B[0, 1] = gx * c - gy * s, gx * s + gy * c


@inline_kernel
def bearing_se3(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """r = n − z, n = u/|u|, u = Rᵀ (l − t);  P = (I − n nᵀ)/|u|,  A = [ −P | ⌊n⌋ ],  B = P Rᵀ.  (3.25)"""
    q = rotation_matrix(x, i + 3)
    t0, t1, t2 = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    u0, u1, u2 = q[0] * t0 + q[3] * t1 + q[6] * t2, q[1] * t0 + q[4] * t1 + q[7] * t2, q[2] * t0 + q[5] * t1 + q[8] * t2
    distance = math.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    inverse = 1.0 / distance if distance > _NEAR else 0.0
    n = (u0 * inverse, u1 * inverse, u2 * inverse)
    for a in range(3):
        r[a] = n[a] - p[k + a]
        for b in range(3):
            A[a, b] = inverse * (n[a] * n[b] - (1.0 if a == b else 0.0))
    A[0, 3], A[0, 4], A[0, 5] = 0.0, -n[2], n[1]
    A[1, 3], A[1, 4], A[1, 5] = n[2], 0.0, -n[0]
    A[2, 3], A[2, 4], A[2, 5] = -n[1], n[0], 0.0
    for a in range(3):
        for b in range(3):
            B[a, b] = -(A[a, 0] * q[3 * b] + A[a, 1] * q[3 * b + 1] + A[a, 2] * q[3 * b + 2])
