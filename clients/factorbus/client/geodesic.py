"""The geodesic between two poses, by the exponential and the logarithm of SE(2) and SE(3).  Pure.

    way(a, b, s) = a ∘ exp(s log(a⁻¹ ∘ b)),   0 ≤ s ≤ 1

A pose is (3,) x y θ in the plane or (7,) x y z qx qy qz qw in space.  A tangent is (6,): translation ρ, then the
rotation vector φ.  With θ = ‖φ‖ and K = [φ]ₓ

    exp(ρ, φ) = (V ρ, exp K),   V   = I + (1 − cos θ)/θ² K + (θ − sin θ)/θ³ K²
                                V⁻¹ = I − K/2 + (1 − θ/2 cot θ/2)/θ² K²

The plane is the part of space with z = 0 that turns about z: both have the same formulas.
"""

import math

import numpy as np

from factorbus.client.frames import compose, inverse
from factorbus.proto.arrays import F64

_SERIES = 1e-3  # radians: below, the first two terms of the series are exact to the last digit of V


def along_geodesic(begin: F64, end: F64, share: float) -> F64:
    """The pose at `share` (0 to 1) of the way from `begin` to `end`, which turns by half a turn at most."""
    first = _in_space(begin)
    made = compose(first, exp_of_twist(share * log_of_pose(relative_pose(first, end)))[None])[0]
    return made if begin.size == 7 else _in_plane(made)


def length_of_way(begin: F64, end: F64) -> float:
    """‖log(begin⁻¹ ∘ end)‖, a radian counted as a metre."""
    return float(np.linalg.norm(log_of_pose(relative_pose(begin, end))))


def relative_pose(begin: F64, end: F64) -> F64:
    """begin⁻¹ ∘ end, in space."""
    return compose(inverse(_in_space(begin)), _in_space(end)[None])[0]


def log_of_pose(pose: F64) -> F64:
    """The tangent (6,) of a pose (7,)."""
    v, w = pose[3:6], float(pose[6])
    sine = float(np.linalg.norm(v))
    angle = 2.0 * math.atan2(sine, abs(w))
    phi = v * math.copysign(angle / sine if sine > 0.0 else 2.0, w)
    K = _skew(phi)
    half = 0.5 * angle
    c = 1.0 / 12.0 + angle**2 / 720.0 if angle < _SERIES else (1.0 - half / math.tan(half)) / angle**2
    return np.concatenate([(np.eye(3) - 0.5 * K + c * K @ K) @ pose[:3], phi])


def exp_of_twist(tangent: F64) -> F64:
    """The pose (7,) of a tangent (6,)."""
    phi = tangent[3:]
    angle = float(np.linalg.norm(phi))
    K = _skew(phi)
    if angle < _SERIES:
        b, c, s = 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0, 0.5 - angle**2 / 48.0
    else:
        b, c = (1.0 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
        s = math.sin(0.5 * angle) / angle
    return np.concatenate([(np.eye(3) + b * K + c * K @ K) @ tangent[:3], s * phi, [math.cos(0.5 * angle)]])


def _in_space(pose: F64) -> F64:
    if pose.size == 7:
        return np.concatenate([pose[:3], pose[3:] / np.linalg.norm(pose[3:])])
    return np.array([pose[0], pose[1], 0.0, 0.0, 0.0, math.sin(0.5 * pose[2]), math.cos(0.5 * pose[2])])


def _in_plane(pose: F64) -> F64:
    return np.array([pose[0], pose[1], math.remainder(2.0 * math.atan2(pose[5], pose[6]), math.tau)])


def _skew(phi: F64) -> F64:
    x, y, z = phi.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
