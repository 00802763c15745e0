"""Rotation matrices (n, d, d) of angles and quaternions and back, and the nearest one to a matrix."""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64


def matrices_of_angles(theta: F64) -> F64:
    """(n, 2, 2) of angles (n,), radians."""
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def matrices_of_quaternions(q: F64) -> F64:
    """(n, 3, 3) of quaternions (n, 4), qx qy qz qw."""
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions_of(R: F64) -> F64:
    """Unit quaternions (n, 4), qw ≥ 0, of rotation matrices (n, 3, 3): the largest of its numbers is found first."""
    xx, yy, zz = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    squares = np.stack([1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz], axis=1)
    x = np.stack([squares[:, 0], R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 2, 1] - R[:, 1, 2]], axis=1)
    y = np.stack([x[:, 1], squares[:, 1], R[:, 1, 2] + R[:, 2, 1], R[:, 0, 2] - R[:, 2, 0]], axis=1)
    z = np.stack([x[:, 2], y[:, 2], squares[:, 2], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    w = np.stack([x[:, 3], y[:, 3], z[:, 3], squares[:, 3]], axis=1)
    chosen = np.stack([x, y, z, w], axis=1)[np.arange(len(R)), np.argmax(squares, axis=1)]
    chosen = np.where(chosen[:, 3:] < 0.0, -chosen, chosen)
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def nearest_rotations(M: F64) -> F64:
    """The rotations that are nearest to matrices (n, d, d) in the norm of Frobenius; of a zero matrix the identity."""
    d = M.shape[1]
    if d == 2:
        c, s = M[:, 0, 0] + M[:, 1, 1], M[:, 1, 0] - M[:, 0, 1]
        return matrices_of_angles(np.arctan2(s, c))
    U, _, Vt = np.linalg.svd(M)
    U[:, :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    return U @ Vt


def residuals_of(R: F64) -> F64:
    """How far rotations are from none: the angle (n, 1), or the vector part of the quaternion (n, 3)."""
    if R.shape[1] == 2:
        return np.arctan2(R[:, 1, 0], R[:, 0, 0])[:, None]
    return quaternions_of(R)[:, :3]


def angles_of(R: F64) -> F64:
    """The angle of each rotation, 0 to π."""
    trace = np.trace(R, axis1=1, axis2=2)
    if R.shape[1] == 2:
        return np.abs(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    return np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0))


def turned_rays(angles: F64, turn: F64) -> F64:
    """Azimuth and elevation (n, 2) of rays turned by rotations (n, 3, 3)."""
    theta, phi = angles.T
    m = np.stack([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)], axis=1)
    m = (turn @ m[:, :, None])[:, :, 0]
    return np.stack([np.arctan2(m[:, 0], m[:, 2]), np.arcsin(np.clip(-m[:, 1], -1.0, 1.0))], axis=1)
