"""Poses as homogeneous matrices.  The numbers of a value are along the last axis; axes before it are of several."""

import numpy as np
from scipy.spatial.transform import Rotation


def pose_matrix(x: np.ndarray) -> np.ndarray:
    """Homogeneous matrix of an SE2 (3 numbers) or SE3 (7 numbers) pose."""
    n = 2 if x.shape[-1] == 3 else 3
    turn = plane_rotation(x[..., 2]) if n == 2 else rotation(x[..., 3:])
    return motion(turn, x[..., :n])


def motion(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Homogeneous matrix of a rotation, which may be scaled, and what is added behind it."""
    n = shift.shape[-1]
    T = np.zeros((*np.broadcast_shapes(turn.shape[:-2], shift.shape[:-1]), n + 1, n + 1))
    T[..., :n, :n], T[..., :n, n], T[..., n, n] = turn, shift, 1.0
    return T


def plane_rotation(theta: np.ndarray) -> np.ndarray:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def rotation(quat: np.ndarray) -> np.ndarray:
    """The matrix of a quaternion x y z w, of any length."""
    return Rotation.from_quat(quat.reshape(-1, 4)).as_matrix().reshape(*quat.shape[:-1], 3, 3)


def turned(vector: np.ndarray) -> np.ndarray:
    """The matrix of a rotation vector."""
    return Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape[:-1], 3, 3)


def quaternion(R: np.ndarray) -> np.ndarray:
    """x y z w of a rotation matrix, with w >= 0."""
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True).reshape(*R.shape[:-2], 4)


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """The inverse of `turned`."""
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-2], 3)


def pose_vector(T: np.ndarray) -> np.ndarray:
    """The inverse of `pose_matrix`; the quaternion has qw >= 0."""
    if T.shape[-1] == 3:
        return np.stack([T[..., 0, 2], T[..., 1, 2], np.arctan2(T[..., 1, 0], T[..., 0, 0])], axis=-1)
    return np.concatenate([T[..., :3, 3], quaternion(T[..., :3, :3])], axis=-1)


def times(M: np.ndarray, v: np.ndarray) -> np.ndarray:
    """M v, of each."""
    return (M @ v[..., None])[..., 0]


def length(v: np.ndarray) -> np.ndarray:
    """|v| of each, as a vector of one number."""
    return np.linalg.norm(v, axis=-1, keepdims=True)


def joined(*parts: np.ndarray) -> np.ndarray:
    """One behind the other; what is of one only is that of each."""
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts], axis=-1)


def wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angle, from −π to π."""
    return np.angle(np.exp(1j * angle))
