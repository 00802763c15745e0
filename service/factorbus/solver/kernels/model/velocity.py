"""Vectors along the axes of the map: velocities measured in a frame whose pose is a variable, as by a GNSS receiver,
MATH §3.9, and the length of one, as of gravity, MATH §3.10.

Arguments as in `se2`.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel
from factorbus.solver.kernels.model.se3 import rotation_matrix


@inline_kernel
def velocity_frame_se2(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """r = R v − z,  A = [ 0 | R (−v_y, v_x)ᵀ ],  B = R.  (3.42)"""
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    u0, u1 = c * x[j] - s * x[j + 1], s * x[j] + c * x[j + 1]
    r[0], r[1] = u0 - p[k], u1 - p[k + 1]
    A[0, 0], A[0, 1], A[0, 2] = 0.0, 0.0, -u1
    A[1, 0], A[1, 1], A[1, 2] = 0.0, 0.0, u0
    B[0, 0], B[0, 1], B[1, 0], B[1, 1] = c, -s, s, c


@inline_kernel
def velocity_frame_se3(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """r = R v − z,  A = [ 0 | −R ⌊v⌋ ],  B = R.  (3.42)"""
    q = rotation_matrix(x, i + 3)
    v0, v1, v2 = x[j], x[j + 1], x[j + 2]
    for a in range(3):
        q0, q1, q2 = q[3 * a], q[3 * a + 1], q[3 * a + 2]
        r[a] = q0 * v0 + q1 * v1 + q2 * v2 - p[k + a]
        A[a, 0], A[a, 1], A[a, 2] = 0.0, 0.0, 0.0
        A[a, 3], A[a, 4], A[a, 5] = q2 * v1 - q1 * v2, q0 * v2 - q2 * v0, q1 * v0 - q0 * v1
        B[a, 0], B[a, 1], B[a, 2] = q0, q1, q2


@inline_kernel
def length_vector3(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """r = |x| − z,  A = xᵀ/|x|, of no length 0.  (3.62)"""
    length = math.sqrt(x[i] * x[i] + x[i + 1] * x[i + 1] + x[i + 2] * x[i + 2])
    r[0], scale = length - p[k], 1.0 / length if length > 0.0 else 0.0
    for c in range(3):
        A[0, c] = scale * x[i + c]
