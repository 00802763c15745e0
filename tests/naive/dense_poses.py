"""Poses as homogeneous matrices."""

import numpy as np
from scipy.spatial.transform import Rotation


def pose_matrix(x: np.ndarray) -> np.ndarray:
    """Homogeneous matrix of an SE2 (3 numbers) or SE3 (7 numbers) pose."""
    n = 2 if len(x) == 3 else 3
    T = np.eye(n + 1)
    T[:n, n] = x[:n]
    T[:n, :n] = plane_rotation(x[2]) if n == 2 else Rotation.from_quat(x[3:]).as_matrix()
    return T


def plane_rotation(theta: float) -> np.ndarray:
    return np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])


def pose_vector(T: np.ndarray) -> np.ndarray:
    """The inverse of `pose_matrix`; the quaternion has qw >= 0."""
    if len(T) == 3:
        return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)])
