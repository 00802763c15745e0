"""Linear factors of a map that goes into another frame: what they say of where it is, and how they move with it."""

import numpy as np

from factorbus.client.frames import rotation_of, turned_values
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.proto.linear import parts_of
from factorbus.proto.messages import Factors

# Of numbers that cancel: what a factor of a solver's own making differs from zero by.
_ROUNDING = 1e-6


def are_relative(group: Factors, mounts: I64, axes: I64) -> np.ndarray:
    """Of each of the linear factors of a kind, whether it says nothing of where its variables are together.

    With x_n ⊟ y_n after a small motion ξ of the whole frame being G_n ξ, it says nothing if Σ H_n G_n = 0, nor if it is
    on velocities alone, which are as certain in any frame.
    mounts: keys of what is on a robot, and does not move with the frame.  axes: of vectors that turn with it.
    """
    kinds, y, H, _ = parts_of(group.kind, group.measured)
    said, along = np.zeros(len(group.keys), bool), np.isin(group.keys, axes)
    stay = np.array([VARIABLE_KINDS[kind].is_vector for kind in kinds]) | np.isin(group.keys, mounts)
    for n, (stays, turns) in enumerate(zip(stay & ~along, along, strict=True)):
        ends = zip(kinds, y, H, stays.tolist(), strict=True)
        parts = [J[n] @ _carried(kind, at[n]) for kind, at, J, stays_here in ends if not stays_here]
        said[n] = (stays | turns).all() or np.abs(sum(parts)).max() <= _ROUNDING * max(np.abs(parts).max(), 1e-300)
    return said


def transform_linear(group: Factors, T_a_b: F64, mounts: I64, axes: I64) -> Factors:
    """y moves with x.  Of a pose x ⊟ y is local, and the same; of a point it turns with the frame, and H against it, as
    of a vector along the frame's axes.

    mounts: keys of what is on a robot, whose y stays.  axes: keys of such vectors.
    """
    parts, y, H = parts_of(group.kind, group.measured), [], []
    for kind, values, J, keys in zip(parts.kinds, parts.y, parts.H, group.keys.T, strict=True):
        moved = turned_values(kind, keys, values, T_a_b, axes)
        y.append(np.where(np.isin(keys, mounts)[:, None], values, moved))
        turned, along = _turned(kind, values, y[-1], J, T_a_b), np.isin(keys, axes)
        H.append(np.where(along[:, None, None], J @ rotation_of(T_a_b).T, turned) if along.any() else turned)
    return group._replace(measured=parts._replace(y=y, H=H).measured())


def _turned(kind: str, before: F64, after: F64, H: F64, T_a_b: F64) -> F64:
    """H of increments after the motion.  Of a feature's direction that is so to first order."""
    R = rotation_of(T_a_b)
    if kind in ("se2", "se3") or VARIABLE_KINDS[kind].is_vector:
        return H
    if kind != "idp":
        return H @ R.T
    turned = H.copy()
    turned[:, :, :3] = H[:, :, :3] @ R.T
    for n, (y, there) in enumerate(zip(before, after, strict=True)):
        turned[n, :, 3:5] = H[n, :, 3:5] @ np.linalg.inv(_angles(there) @ R @ _ray(y)[1])
    return turned


def _carried(kind: str, y: F64) -> F64:
    """G: the increment of a value when the frame that it is in moves by ξ = (translation, rotation)."""
    if kind == "vector2":  # along the axes of the frame
        return np.array([[0.0, 0.0, -y[1]], [0.0, 0.0, y[0]]])
    if kind == "vector3":
        return np.column_stack([np.zeros((3, 3)), -_cross(y)])
    if kind == "point2":
        return np.array([[1.0, 0.0, -y[1]], [0.0, 1.0, y[0]]])
    if kind == "se2":
        R = rotation_of(y)
        return np.block([[R.T, (R.T @ [-y[1], y[0]])[:, None]], [np.zeros((1, 2)), np.ones((1, 1))]])
    moved = np.column_stack([np.eye(3), -_cross(y)])
    if kind == "point3":
        return moved
    if kind == "idp":
        turn = np.column_stack([np.zeros((2, 3)), -_angles(y) @ _cross(_ray(y)[0])])
        return np.concatenate([moved, turn, np.zeros((1, 6))])
    R = rotation_of(y)
    return np.concatenate([R.T @ moved, np.column_stack([np.zeros((3, 3)), R.T])])


def _cross(v: F64) -> F64:
    """⌊v⌋"""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _ray(y: F64) -> tuple[F64, F64]:
    """(the direction m of a feature, its Jacobian (3, 2) by θ and φ)."""
    (s, t), (c, d) = np.sin(y[3:5]), np.cos(y[3:5])
    return np.array([d * s, -t, d * c]), np.array([[d * c, -t * s], [0.0, -d], [-d * s, -t * c]])


def _angles(y: F64) -> F64:
    """The Jacobian (2, 3) of θ and φ by the direction."""
    x, _, z = _ray(y)[0]
    flat = x * x + z * z
    return np.array([[z / flat, 0.0, -x / flat], [0.0, -1.0 / np.sqrt(flat), 0.0]])
