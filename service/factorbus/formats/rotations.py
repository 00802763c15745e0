"""Rotations as files have them: quaternions to be normalized, and the roll, pitch and yaw of iSAM."""

import numpy as np

from factorbus.formats.errors import refuse_first
from factorbus.formats.weights import packed_upper, squared, unpacked_symmetric, unpacked_triangle
from factorbus.proto.arrays import F64, I64

_NORM_TOLERANCE = 0.02  # two digits of each component are not far more exact than that
_UNIT = 8 * np.finfo(float).eps
_RPY_FROM_YPR = (0, 1, 2, 5, 4, 3)


def normalized_poses(file: str, name: str, lines: I64, poses: F64) -> F64:
    """SE3 poses (n, 7) with quaternions of norm 1.  Those that have it are kept bit for bit.

    Raises FormatError where a norm is far from 1.
    """
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    refuse_first(
        file,
        lines,
        np.abs(norms - 1) > _NORM_TOLERANCE,
        lambda row: f"{name} with a quaternion of norm {norms[row]:.6g}",
        "a unit quaternion qx qy qz qw",
    )
    scale = np.where(np.abs(norms - 1) <= _UNIT, 1.0, norms)
    return np.concatenate([poses[:, :3], poses[:, 3:] / scale[:, None]], axis=1)


def isam_edges3(ids: I64, measured: F64, root: F64) -> tuple[I64, F64, F64]:
    """iSAM's EDGE3 in our terms: (ids, measured, information).

    in   measured (n, 6): x y z roll pitch yaw, R = Rz(yaw) Ry(pitch) Rx(roll)   root (n, 21)
    out  measured (n, 7)   information (n, 21) of (x, y, z, vector part of the error quaternion)

    iSAM weighs the differences of the angles themselves, in the order yaw, pitch, roll, after it has swapped the
    rotation part of the root: (yaw, pitch, roll) has the rows (66 56 46), (55 45), (44).  An edge to a lower
    pose it takes as the inverse edge, with the weight as it stands.  The angles are carried over to the vector part v
    of the error quaternion to first order: the body turns by 2v = E(roll, pitch) d(roll, pitch, yaw), so

        Ω = Jᵀ (RᵀR) J,   J = diag(I, 2 E⁻¹)
    """
    back = ids[:, 0] > ids[:, 1]
    poses = np.concatenate([measured[:, :3], quat_xyzw(measured[:, 3:])], axis=1)
    poses[back] = inverse_poses(poses[back])
    angles = measured[:, 3:].copy()
    angles[back] = _roll_pitch_yaw(poses[back, 3:])
    ids = np.where(back[:, None], ids[:, ::-1], ids)

    R = unpacked_triangle(root, 6)
    R[:, [3, 3, 3, 4, 4, 5], [3, 4, 5, 4, 5, 5]] = R[:, [5, 4, 3, 4, 3, 3], [5, 5, 5, 4, 4, 3]]
    information = unpacked_symmetric(squared(packed_upper(R), 6), 6)
    information = information[:, _RPY_FROM_YPR][:, :, _RPY_FROM_YPR]
    J = np.tile(np.eye(6), (len(ids), 1, 1))
    J[:, 3:, 3:] = 2 * _angle_rates(angles)
    return ids, poses, packed_upper(np.swapaxes(J, 1, 2) @ information @ J)


def quat_xyzw(angles: F64) -> F64:
    """Quaternions (n, 4), qx qy qz qw with qw >= 0, of Rz(yaw) Ry(pitch) Rx(roll).

    in   angles (n, 3): roll pitch yaw (radians)
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles / 2).T, np.sin(angles / 2).T
    quat = np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=1,
    )
    return np.where(quat[:, 3:] < 0, -quat, quat)


def rotate_vectors(quat: F64, vectors: F64) -> F64:
    """R(quat) v for each row.

    in   quat (n, 4) qx qy qz qw   vectors (n, 3)
    """
    u, w = quat[:, :3], quat[:, 3:]
    t = 2 * np.cross(u, vectors)
    return vectors + w * t + np.cross(u, t)


def inverse_poses(poses: F64) -> F64:
    """The inverse of each pose: (n, 3) x y theta, or (n, 7) x y z qx qy qz qw."""
    if poses.shape[1] == 3:
        back = np.einsum("nji,nj->ni", rotation_matrices(poses), poses[:, :2])
        return np.concatenate([-back, -poses[:, 2:]], axis=1)
    conjugate = poses[:, 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    return np.concatenate([-rotate_vectors(conjugate, poses[:, :3]), conjugate], axis=1)


def compose_poses(a: F64, b: F64) -> F64:
    """a b for each pair of poses, both (n, 3) or both (n, 7)."""
    if a.shape[1] == 3:
        places = a[:, :2] + np.einsum("nij,nj->ni", rotation_matrices(a), b[:, :2])
        return np.concatenate([places, a[:, 2:] + b[:, 2:]], axis=1)
    (u, v), (s, t) = (a[:, 3:6], b[:, 3:6]), (a[:, 6:], b[:, 6:])
    vector = s * v + t * u + np.cross(u, v)
    scalar = s * t - np.sum(u * v, axis=1, keepdims=True)
    quat = np.concatenate([vector, scalar], axis=1)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return np.concatenate([a[:, :3] + rotate_vectors(a[:, 3:], b[:, :3]), quat], axis=1)


def rotation_matrices(poses: F64) -> F64:
    """The rotation of each pose: (n, 2, 2) of (n, 3), (n, 3, 3) of (n, 7)."""
    if poses.shape[1] == 3:
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        return np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    columns = [rotate_vectors(poses[:, 3:], np.broadcast_to(axis, (len(poses), 3))) for axis in np.eye(3)]
    return np.stack(columns, axis=2)


def quats_of_matrices(R: F64) -> F64:
    """Quaternions (n, 4), qx qy qz qw, of rotation matrices (n, 3, 3): each by the largest of its components."""
    x, y, z = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    squares = np.stack([1 + x - y - z, 1 - x + y - z, 1 - x - y + z, 1 + x + y + z], axis=1)
    largest = squares.argmax(axis=1)
    columns = np.zeros((len(R), 4, 4))  # 4 qᵢ qⱼ
    columns[:, range(4), range(4)] = squares
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        columns[:, i, j] = columns[:, j, i] = R[:, i, j] + R[:, j, i]
        columns[:, 3, k] = columns[:, k, 3] = R[:, j, i] - R[:, i, j]
    quat = columns[np.arange(len(R)), largest]
    return quat / np.linalg.norm(quat, axis=1, keepdims=True)


def _roll_pitch_yaw(quat: F64) -> F64:
    x, y, z, w = quat.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=1)


def _angle_rates(angles: F64) -> F64:
    """E⁻¹ (n, 3, 3): d(roll, pitch, yaw) = E⁻¹ ω for a turn ω in the frame of the body."""
    (sr, sp, _), (cr, cp, _) = np.sin(angles).T, np.cos(angles).T
    rates = np.zeros((len(angles), 3, 3))
    rates[:, 0, 0] = 1
    rates[:, 0, 1], rates[:, 0, 2] = sr * sp / cp, cr * sp / cp
    rates[:, 1, 1], rates[:, 1, 2] = cr, -sr
    rates[:, 2, 1], rates[:, 2, 2] = sr / cp, cr / cp
    return rates
