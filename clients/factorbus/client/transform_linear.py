"""Linear factors of a map that goes into another frame: what they say of where it is, and how they move with it."""

from collections.abc import Iterable

import numpy as np

from factorbus.client.frames import moved_values, rotation_of
from factorbus.proto.arrays import F64
from factorbus.proto.linear import parts_of
from factorbus.proto.messages import Factors

# Of numbers that cancel: what a factor of a solver's own making differs from zero by.
_ROUNDING = 1e-6


def are_relative(group: Factors) -> np.ndarray:
    """Of each of the linear factors of two variables, whether it says nothing of where the two are together.

    With x_i ⊟ y_i after a small motion ξ of the whole frame being G_i ξ, it says nothing if H₁ G₁ + H₂ G₂ = 0.
    """
    kinds, y, H, _ = parts_of(group.kind, group.measured)
    said = np.zeros(len(group.keys), bool)
    for n in range(len(said)):
        parts = [H[end][n] @ _carried(kinds[end], y[end][n]) for end in (0, 1)]
        said[n] = np.abs(parts[0] + parts[1]).max() <= _ROUNDING * max(np.abs(parts).max(), 1e-300)
    return said


def says_nothing(group: Factors, others: Iterable[Factors]) -> np.ndarray:
    """Of each of the linear factors of one variable, whether it is the rounding of a marginal that is relative.

    Such a one has a factor of two variables, `others`, and what is left of one of them alone: nothing, but for digits.
    """
    told: dict[int, float] = {}
    for pair in others:
        for keys, size in zip(pair.keys.tolist(), _largest(pair), strict=True):
            for key in keys:
                told[key] = max(told.get(key, 0.0), size)
    whole = np.array([told.get(key, 0.0) for key in group.keys[:, 0].tolist()])
    return _largest(group) <= _ROUNDING * whole


def transform_linear(group: Factors, T_a_b: F64) -> Factors:
    """y moves with x.  Of a pose x ⊟ y is local, and the same; of a point it turns with the frame, and H against it."""
    parts = parts_of(group.kind, group.measured)
    y = [moved_values(kind, values, T_a_b) for kind, values in zip(parts.kinds, parts.y, strict=True)]
    ends = zip(parts.kinds, parts.y, y, parts.H, strict=True)
    H = [_turned(kind, before, after, J, T_a_b) for kind, before, after, J in ends]
    return group._replace(measured=parts._replace(y=y, H=H).measured())


def _turned(kind: str, before: F64, after: F64, H: F64, T_a_b: F64) -> F64:
    """H of increments after the motion.  Of a feature's direction that is so to first order."""
    R = rotation_of(T_a_b)
    if kind in ("se2", "se3"):
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


def _largest(group: Factors) -> F64:
    """Of each linear factor the largest number in its H."""
    H = parts_of(group.kind, group.measured).H
    return np.max([np.abs(J).max(axis=(1, 2), initial=0.0) for J in H], axis=0)
