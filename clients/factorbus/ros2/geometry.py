"""Rigid transforms, and how their errors travel.

T_a_b takes coordinates in b to coordinates in a.  An error is local, on the right: T exp(δ), δ the translation (metres)
and then the rotation vector (radians), so that a covariance is 6 × 6 in that order.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.wording import counted

# A place beyond this is none, metres: a double there is exact to a tenth of a micrometre.
FARTHEST_M = 1e9


@dataclass(frozen=True, slots=True)
class Transform:
    """A rotation (3, 3) and a translation (3,)."""

    R: F64
    t: F64

    def __matmul__(self, other: "Transform") -> "Transform":
        return Transform(self.R @ other.R, self.R @ other.t + self.t)

    def inverse(self) -> "Transform":
        """T_b_a of T_a_b."""
        return Transform(self.R.T, -self.R.T @ self.t)

    def angle(self) -> float:
        """By how much it turns, radians."""
        return float(np.linalg.norm(rotation_vector(self.R)))

    def yaw(self) -> float:
        """The heading of its x axis over the ground, radians."""
        return math.atan2(self.R[1, 0], self.R[0, 0])

    def flat(self) -> "Transform":
        """What of it is in the plane: x, y and yaw."""
        return from_plane(self.t[0], self.t[1], self.yaw())


def from_plane(x: float, y: float, yaw: float) -> Transform:
    """A transform in the plane."""
    c, s = math.cos(yaw), math.sin(yaw)
    return Transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, 0.0]))


def from_quaternion(t: Sequence[float], quat_xyzw: Sequence[float]) -> Transform:
    """From a translation and a quaternion, which is normalized.  Raises ValueError: it cannot be, or is too far."""
    numbers = np.array([*t, *quat_xyzw], np.float64)
    if numbers.shape != (7,):
        raise ValueError(counted(len(numbers), "number"))
    norm = math.hypot(*numbers[3:].tolist())
    if not (np.abs(numbers[:3]) <= FARTHEST_M).all() or not 0.5 < norm < 2.0:
        raise ValueError(f"translation {list(t)} and quaternion {list(quat_xyzw)}")
    x, y, z, w = numbers[3:] / norm
    R = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return Transform(np.array(R), numbers[:3])


def from_pose(pose: Any) -> Transform:
    """Of a geometry_msgs/Pose.  Raises ValueError."""
    p, q = pose.position, pose.orientation
    return from_quaternion((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def quaternion(R: F64) -> tuple[float, float, float, float]:
    """x y z w, w not negative, from the largest of the four, so that nothing small is divided by."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    four = np.array([1 + 2 * R[0, 0] - trace, 1 + 2 * R[1, 1] - trace, 1 + 2 * R[2, 2] - trace, 1 + trace])
    rows = np.array([
        [four[0], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
        [R[0, 1] + R[1, 0], four[1], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
        [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], four[2], R[1, 0] - R[0, 1]],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], four[3]],
    ])  # fmt: skip
    row = rows[int(np.argmax(four))]
    row = row / np.linalg.norm(row)
    x, y, z, w = (row if row[3] >= 0 else -row).tolist()
    return x, y, z, w


def rotation_vector(R: F64) -> F64:
    """The logarithm of a rotation (3,)."""
    x, y, z, w = quaternion(R)
    v = np.array([x, y, z])
    s = float(np.linalg.norm(v))
    return v * (2.0 if s < 1e-9 else 2.0 * math.atan2(s, w) / s)


def rotation_exp(vector: F64) -> F64:
    """The exponential of a rotation vector (3, 3)."""
    angle = float(np.linalg.norm(vector))
    half = 0.5 if angle < 1e-9 else math.sin(0.5 * angle) / angle
    x, y, z = (vector * half).tolist()
    return from_quaternion((0.0, 0.0, 0.0), (x, y, z, math.cos(0.5 * angle))).R


def between(a: Transform, b: Transform, share: float) -> Transform:
    """Where `share` (0 to 1) of the way from a to b is: rotation and translation each at constant speed."""
    turn = rotation_vector(a.R.T @ b.R)
    return Transform(a.R @ rotation_exp(share * turn), a.t + share * (b.t - a.t))


def adjoint(T: Transform) -> F64:
    """Ad (6, 6): T exp(δ) T⁻¹ = exp(Ad δ), so [R, [t]ₓ R; 0, R]."""
    x, y, z = T.t.tolist()
    made = np.zeros((6, 6))
    made[:3, :3] = made[3:, 3:] = T.R
    made[:3, 3:] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ T.R
    return made


def carried(covariance: F64, over: Transform) -> F64:
    """The covariance of T_a_b T_b_c in c, of one that T_a_b has in b; over: T_b_c."""
    A = adjoint(over.inverse())
    return A @ covariance @ A.T


def local(covariance: F64, R: F64) -> F64:
    """A pose's covariance as ROS has it, about the fixed axes of its frame, in the axes of the pose itself."""
    turned = covariance.copy()
    for i in (0, 3):
        for k in (0, 3):
            turned[i : i + 3, k : k + 3] = R.T @ covariance[i : i + 3, k : k + 3] @ R
    return turned
