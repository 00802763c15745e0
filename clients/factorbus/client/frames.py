"""Rigid motions of a map: what a frame is, and values as they are in another one.

T_a_b takes coordinates in b to coordinates in a, stored as a pose: (3,) x y θ in the plane, (7,) x y z qx qy qz qw in
space.
"""

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.proto.linear_in_frame import rotation_of
from factorbus.proto.roles import AXES, FRAME, MOUNT

# Numbers of a pose, by the space that a kind of variable is in.
SPACES = {"se2": 3, "point2": 3, "se3": 7, "point3": 7, "idp": 7, "so3": 7, "sim3": 7}


def compose(T_a_b: F64, poses: F64) -> F64:
    """T_a_b ∘ poses, (n, 3) or (n, 7)."""
    if poses.shape[1] == 3:
        turned = poses[:, :2] @ rotation_of(T_a_b).T + T_a_b[:2]
        return np.column_stack([turned, _wrapped(poses[:, 2] + T_a_b[2])])
    turned = poses[:, :3] @ rotation_of(T_a_b).T + T_a_b[:3]
    return np.column_stack([turned, _product(T_a_b[3:], poses[:, 3:])])


def inverse(T_a_b: F64) -> F64:
    """T_b_a."""
    if T_a_b.size == 3:
        return np.array([*(-rotation_of(T_a_b).T @ T_a_b[:2]), -T_a_b[2]])
    return np.array([*(-rotation_of(T_a_b).T @ T_a_b[:3]), *-T_a_b[3:6], T_a_b[6]])


def matrix_of_pose(pose: F64) -> F64:
    """A pose (3,) or (7,) as a matrix, (3, 3) or (4, 4)."""
    T = np.eye(3 if pose.size == 3 else 4)
    T[:-1, :-1], T[:-1, -1] = rotation_of(pose), pose[: len(T) - 1]
    return T


def pose_of_matrix(T: F64) -> F64:
    """The pose (3,) or (7,) of a rigid motion."""
    if len(T) == 3:
        return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])
    R = T[:3, :3]
    # Of 4 q qᵀ the column with the largest diagonal.
    q = np.array(
        [
            [1 + R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], 1 - R[0, 0] + R[1, 1] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], 1 - R[0, 0] - R[1, 1] + R[2, 2], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    column = q[int(q.diagonal().argmax())]
    return np.array([*T[:3, 3], *column / np.linalg.norm(column)])


def difference(measured: F64, pose: F64) -> F64:
    """The residual of a relative pose: measured⁻¹ ∘ pose as (x, y, θ), or (x, y, z, qx, qy, qz) with qw ≥ 0."""
    left = compose(inverse(measured), pose[None])[0]
    return left if left.size == 3 else left[:6] * (1.0 if left[6] >= 0 else -1.0) ** np.array([0, 0, 0, 1, 1, 1])


def moved_values(kind: str, values: F64, T_a_b: F64, role: str = "") -> F64:
    """Values (n, size) of variables of one kind and role (`factorbus.proto.roles`), given in b, as they are in a.

    Vectors are the same in both, unless they are along the axes of the map, and so are mounts.  Of the map's pose f in
    another frame f ∘ x is the same in both: f ∘ T_b_a.
    """
    if role == AXES:
        return values @ rotation_of(T_a_b).T
    if VARIABLE_KINDS[kind].is_vector or role == MOUNT:
        return values
    if role == FRAME:
        back = inverse(T_a_b)[None]
        return np.concatenate([compose(f, back) for f in values])
    if kind in ("se2", "se3"):
        return compose(T_a_b, values)
    if kind == "so3":
        return _product(T_a_b[3:], values)
    if kind == "sim3":  # the unit of a similarity stays what it is in metres
        return np.column_stack([compose(T_a_b, values[:, :7]), values[:, 7]])
    size = values.shape[1] if kind != "idp" else 3
    points = values[:, :size] @ rotation_of(T_a_b).T + T_a_b[:size]
    if kind != "idp":
        return points
    theta, phi = values[:, 3], values[:, 4]
    rays = np.stack([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)], axis=1)
    x, y, z = (rays @ rotation_of(T_a_b).T).T
    return np.column_stack([points, np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z)), values[:, 5]])


def _wrapped(angles: F64) -> F64:
    """Into [−π, π)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _product(p: F64, q: F64) -> F64:
    """Quaternions p ⊗ q, vector part first, of length one; q (n, 4)."""
    v, w = p[:3], p[3]
    vector = w * q[:, :3] + q[:, 3:] * v + np.cross(v, q[:, :3])
    made = np.column_stack([vector, w * q[:, 3] - q[:, :3] @ v])
    return made / np.linalg.norm(made, axis=1, keepdims=True)
