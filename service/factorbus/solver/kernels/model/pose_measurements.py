"""What a pose knows of the map without a landmark: its position, its heading, which way is down.  MATH §3.4.

Arguments as in `se2`.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.se3 import rotation_matrix


@inline_kernel
def position_se2(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """r = t + R l − z, l where the antenna is on the robot, (z, l) measured.  (3.20)

    A = [ R | R (−l_y, l_x)ᵀ ]
    """
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    lx, ly = c * p[k + 2] - s * p[k + 3], s * p[k + 2] + c * p[k + 3]
    r[0], r[1] = x[i] + lx - p[k], x[i + 1] + ly - p[k + 1]
    A[0, 0], A[0, 1], A[0, 2] = c, -s, -ly
    A[1, 0], A[1, 1], A[1, 2] = s, c, lx


@inline_kernel
def position_se3(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """r = t + R l − z,  A = [ R | −R ⌊l⌋ ].  (3.20)"""
    q = rotation_matrix(x, i + 3)
    l0, l1, l2 = p[k + 3], p[k + 4], p[k + 5]
    for a in range(3):
        q0, q1, q2 = q[3 * a], q[3 * a + 1], q[3 * a + 2]
        r[a] = x[i + a] + q0 * l0 + q1 * l1 + q2 * l2 - p[k + a]
        A[a, 0], A[a, 1], A[a, 2] = q0, q1, q2
        A[a, 3], A[a, 4], A[a, 5] = q2 * l1 - q1 * l2, q0 * l2 - q2 * l0, q1 * l0 - q0 * l1


@inline_kernel
def heading_se2(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """r = wrap(θ − z),  A = [ 0 0 1 ].  (3.21)"""
    r[0] = wrap(x[i + 2] - p[k])
    A[0, 0], A[0, 1], A[0, 2] = 0.0, 0.0, 1.0


@inline_kernel
def attitude_se3(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """A direction g of the map as the robot sees it: r = b − z, b = Rᵀ g;  A = [ 0 | ⌊b⌋ ].  (3.22)"""
    q = rotation_matrix(x, i + 3)
    g0, g1, g2 = p[k + 3], p[k + 4], p[k + 5]
    b0, b1, b2 = q[0] * g0 + q[3] * g1 + q[6] * g2, q[1] * g0 + q[4] * g1 + q[7] * g2, q[2] * g0 + q[5] * g1 + q[8] * g2
    r[0], r[1], r[2] = b0 - p[k], b1 - p[k + 1], b2 - p[k + 2]
    A[:3, :3] = 0.0
    A[0, 3], A[0, 4], A[0, 5] = 0.0, -b2, b1
    A[1, 3], A[1, 4], A[1, 5] = b2, 0.0, -b0
    A[2, 3], A[2, 4], A[2, 5] = -b1, b0, 0.0
