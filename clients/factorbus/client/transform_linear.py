"""Linear factors of a map that goes into another frame: what they say of where it is, and how they move with it."""

import numpy as np

from factorbus.client.frames import moved_values, rotation_of
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.proto.linear import parts_of
from factorbus.proto.messages import Factors

# Of numbers that cancel: what a factor of a solver's own making differs from zero by.
_ROUNDING = 1e-6


def are_relative(group: Factors, mounts: I64) -> np.ndarray:
    """Of each of the linear factors of a kind, whether it says nothing of where its variables are together.

    With x_n ⊟ y_n after a small motion ξ of the whole frame being G_n ξ, it says nothing if Σ H_n G_n = 0.
    mounts: keys of what is on a robot, and does not move with the frame.
    """
    kinds, y, H, _ = parts_of(group.kind, group.measured)
    said = np.zeros(len(group.keys), bool)
    stay = np.array([VARIABLE_KINDS[kind].is_vector for kind in kinds])
    for n, on_robots in enumerate(np.isin(group.keys, mounts) | stay):
        ends = zip(kinds, y, H, on_robots.tolist(), strict=True)
        parts = [J[n] @ _carried(kind, at[n]) for kind, at, J, is_mount in ends if not is_mount]
        said[n] = not parts or np.abs(sum(parts)).max() <= _ROUNDING * max(np.abs(parts).max(), 1e-300)
    return said


def transform_linear(group: Factors, T_a_b: F64, mounts: I64) -> Factors:
    """y moves with x.  Of a pose x ⊟ y is local, and the same; of a point it turns with the frame, and H against it.

    mounts: keys of what is on a robot, whose y stays.
    """
    parts, y = parts_of(group.kind, group.measured), []
    for kind, values, keys in zip(parts.kinds, parts.y, group.keys.T, strict=True):
        y.append(np.where(np.isin(keys, mounts)[:, None], values, moved_values(kind, values, T_a_b)))
    ends = zip(parts.kinds, parts.y, y, parts.H, strict=True)
    H = [_turned(kind, before, after, J, T_a_b) for kind, before, after, J in ends]
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
