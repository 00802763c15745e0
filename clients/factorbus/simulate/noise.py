"""Measurements of a true world: drawn so that the residual at the truth has exactly the covariance that is sent.

With r = z⁻¹ T for the true relative pose T, the measurement is z = T r⁻¹ for a drawn r.
"""

import numpy as np

from factorbus.proto.arrays import F64


def diagonal_information(sigmas: F64, count: int) -> F64:
    """Upper triangles (count, r(r+1)/2) of diag(1/σ²).

    in   sigmas (r,)
    """
    packed = np.diag(sigmas**-2.0)[np.triu_indices(len(sigmas))]
    return np.tile(packed, (count, 1))


def relative_se2(start: F64, end: F64) -> F64:
    """T = start⁻¹ end of poses (n, 3): x y (metres), theta (radians, wrapped to [-π, π))."""
    c, s = np.cos(start[:, 2]), np.sin(start[:, 2])
    dx, dy = (end - start)[:, :2].T
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrapped(end[:, 2] - start[:, 2])], axis=1)


def noisy_se2(T: F64, r: F64) -> F64:
    """z = T r⁻¹ of poses (n, 3), so that z⁻¹ T = r."""
    theta = T[:, 2] - r[:, 2]
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([T[:, 0] - c * r[:, 0] + s * r[:, 1], T[:, 1] - s * r[:, 0] - c * r[:, 1], wrapped(theta)], axis=1)


def relative_se3(start: F64, end: F64) -> F64:
    """T = start⁻¹ end of poses (n, 7): x y z (metres), qx qy qz qw."""
    back = conjugate(start[:, 3:])
    return np.concatenate([rotated(back, (end - start)[:, :3]), quaternion_product(back, end[:, 3:])], axis=1)


def noisy_se3(T: F64, r: F64) -> F64:
    """z = T r⁻¹ of poses T (n, 7), so that z⁻¹ T has translation and quaternion vector part r (n, 6); qw >= 0.

    The vector part is half the rotation vector to first order: an angle of standard deviation σ is one of σ/2.
    """
    vector = r[:, 3:]
    scalar = np.sqrt(1 - np.sum(vector * vector, axis=1, keepdims=True))
    quat = quaternion_product(T[:, 3:], np.concatenate([-vector, scalar], axis=1))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    quat = np.where(quat[:, 3:] < 0, -quat, quat)
    return np.concatenate([T[:, :3] - rotated(quat, r[:, :3]), quat], axis=1)


def seen_from(poses: F64, points: F64) -> F64:
    """Rᵀ (l − t): points (n, 2) in the frames of poses (n, 3)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = (points - poses[:, :2]).T
    return np.stack([c * dx + s * dy, c * dy - s * dx], axis=1)


def wrapped(angle: F64) -> F64:
    """The same angle in [-π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def quaternion_product(p: F64, q: F64) -> F64:
    """Quaternions p q, (n, 4) as qx qy qz qw."""
    pv, pw, qv, qw = p[:, :3], p[:, 3:], q[:, :3], q[:, 3:]
    vector = pw * qv + qw * pv + np.cross(pv, qv)
    return np.concatenate([vector, pw * qw - np.sum(pv * qv, axis=1, keepdims=True)], axis=1)


def conjugate(q: F64) -> F64:
    """Inverses of unit quaternions (n, 4)."""
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def rotated(q: F64, v: F64) -> F64:
    """Vectors v (n, 3) turned by q (n, 4)."""
    t = 2 * np.cross(q[:, :3], v)
    return v + q[:, 3:] * t + np.cross(q[:, :3], t)
