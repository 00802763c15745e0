"""What a sensor off the robot's centre has measured of its own way, as what that says of the robot's way.

A sensor sits at L on the robot (robot T_robot_sensor: coordinates of the sensor to those of the robot) and measures how
itself has moved, z = (x_i L)^-1 (x_j L): a wheel off the middle, a camera on a mast, a scanner at the bumper.  Then

    x_i^-1 x_j = L z L^-1 = z',   e = z^-1 (x_i L)^-1 (x_j L) = L^-1 e' L,   e' = z'^-1 x_i^-1 x_j                   (1)

for any error e of the sensor, however large.  With e' = (t', R') and L = (l, Q) the residuals, (t, theta) in the plane
and (t, v) in space, v the vector part of the quaternion, hang together by

    t = Q^T (t' + (R' - I) l),   theta = theta',   v = Q^T v'                                                       (2)

exactly.  To first order in the error, (R' - I) l = theta' (-l_y, l_x), in space 2 v' x l, so r = A r' with

    A = [ Q^T  Q^T (-l_y, l_x) ; 0  1 ],   in space  [ Q^T  -2 Q^T [l]x ; 0  Q^T ]                                   (3)

the adjoint of L^-1 in the tangent space of the residuals, and the information matrix becomes A^T W A.  The measurement
is moved exactly; of the weight, what (3) misses of t is theta^2 |l| / 2 at most, in space 2 |v|^2 |l|: with an error
of a degree and a lever of a metre 0.15 mm.  MATH §3.7.
"""

import numpy as np

from factorbus.client.frames import compose, inverse
from factorbus.proto.arrays import F64
from factorbus.proto.linear_in_frame import rotation_of
from factorbus.proto.problems import BadShape

# How far a quaternion may be from unit length, as the service has it.
_TOLERANCE = 1e-3


def transform_se2(measured: F64, mount: F64) -> tuple[F64, F64]:
    """(z', A) of z and L, both x y (metres) theta (radians); A (3, 3): r = A r'."""
    Q, A = rotation_of(mount), np.eye(3)
    A[:2, :2], A[:2, 2] = Q.T, Q.T @ (-mount[1], mount[0])
    return _carried(measured, mount), A


def transform_se3(where: str, measured: F64, mount: F64) -> tuple[F64, F64]:
    """(z', A) of z and L, both x y z (metres) qx qy qz qw; A (6, 6): r = A r'.  Raises BadShape: no unit quaternion."""
    _check_unit(f"{where}: mount", mount)
    _check_unit(f"{where}: measured", measured)
    x, y, z = mount[:3]
    Q, A = rotation_of(mount), np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = Q.T
    A[:3, 3:] = -2.0 * Q.T @ np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return _carried(measured, mount), A


def _carried(measured: F64, mount: F64) -> F64:
    """z' = L z L^-1."""
    return compose(mount, compose(measured, inverse(mount)[None]))[0]


def _check_unit(where: str, pose: F64) -> None:
    norm = float(np.linalg.norm(pose[3:]))
    if not abs(norm - 1.0) <= _TOLERANCE:
        raise BadShape(f"{where}: quaternion", f"length {norm:g}", "1: qx qy qz qw")
