"""Rigid motions of a map: what a frame is, and variables and factors as they are in another one.

T_a_b takes coordinates in b to coordinates in a, stored as a pose: (3,) x y θ in the plane, (7,) x y z qx qy qz qw in
space.
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.messages import Factors

# Numbers of a pose, by the space that a kind of variable is in.
SPACES = {"se2": 3, "point2": 3, "se3": 7, "point3": 7, "idp": 7}
# Of numbers that cancel: what a factor of a solver's own making differs from zero by.
_ROUNDING = 1e-6


def compose(T_a_b: F64, poses: F64) -> F64:
    """T_a_b ∘ poses, (n, 3) or (n, 7)."""
    if poses.shape[1] == 3:
        turned = poses[:, :2] @ rotation(T_a_b).T + T_a_b[:2]
        return np.column_stack([turned, _wrapped(poses[:, 2] + T_a_b[2])])
    turned = poses[:, :3] @ rotation(T_a_b).T + T_a_b[:3]
    return np.column_stack([turned, _product(T_a_b[3:], poses[:, 3:])])


def inverse(T_a_b: F64) -> F64:
    """T_b_a."""
    if T_a_b.size == 3:
        return np.array([*(-rotation(T_a_b).T @ T_a_b[:2]), -T_a_b[2]])
    return np.array([*(-rotation(T_a_b).T @ T_a_b[:3]), *-T_a_b[3:6], T_a_b[6]])


def rotation(pose: F64) -> F64:
    """R of a pose, (2, 2) or (3, 3)."""
    if pose.size == 3:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return np.array([[c, -s], [s, c]])
    x, y, z, w = pose[3:] / np.linalg.norm(pose[3:])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def difference(measured: F64, pose: F64) -> F64:
    """The residual of a relative pose: measured⁻¹ ∘ pose as (x, y, θ), or (x, y, z, qx, qy, qz) with qw ≥ 0."""
    left = compose(inverse(measured), pose[None])[0]
    return left if left.size == 3 else left[:6] * (1.0 if left[6] >= 0 else -1.0) ** np.array([0, 0, 0, 1, 1, 1])


def moved_values(kind: str, values: F64, T_a_b: F64) -> F64:
    """Values (n, size) of variables of one kind, given in b, as they are in a."""
    if kind in ("se2", "se3"):
        return compose(T_a_b, values)
    size = values.shape[1] if kind != "idp" else 3
    points = values[:, :size] @ rotation(T_a_b).T + T_a_b[:size]
    if kind != "idp":
        return points
    theta, phi = values[:, 3], values[:, 4]
    rays = np.stack([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)], axis=1)
    x, y, z = (rays @ rotation(T_a_b).T).T
    return np.column_stack([points, np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z)), values[:, 5]])


def moved_factors(group: Factors, T_a_b: F64) -> Factors:
    """Relative factors given in b, as they are in a: most are the same in every frame."""
    move = _MOVES.get(group.kind)
    return move(group, T_a_b) if move else group


def is_relative(group: Factors) -> np.ndarray:
    """Of each of the linear factors of two poses, whether it says nothing of where the two are together.

    With x_i ⊟ y_i after a small motion ξ of the whole frame being G_i ξ, it says nothing if H₁ G₁ + H₂ G₂ = 0.
    """
    size = 3 if group.kind.endswith("se2") else 7
    dim = 3 if size == 3 else 6
    said = np.zeros(len(group.keys), bool)
    for n, row in enumerate(group.measured):
        y, H = row[: 2 * size].reshape(2, size), row[2 * size : 2 * size + 2 * dim * dim].reshape(2, dim, dim)
        parts = [H[end] @ _carried(y[end]) for end in (0, 1)]
        said[n] = np.abs(parts[0] + parts[1]).max() <= _ROUNDING * max(np.abs(parts).max(), 1e-300)
    return said


def says_nothing(group: Factors, others: Iterable[Factors]) -> np.ndarray:
    """Of each of the linear factors of one pose, whether it is the rounding of a marginal that is relative.

    Such a one has a factor of two poses, `others`, and what is left of the second alone: nothing, but for digits.
    """
    told: dict[int, float] = {}
    for pair in others:
        for keys, size in zip(pair.keys.tolist(), _largest(pair), strict=True):
            for key in keys:
                told[key] = max(told.get(key, 0.0), size)
    whole = np.array([told.get(key, 0.0) for key in group.keys[:, 0].tolist()])
    return _largest(group) <= _ROUNDING * whole


def _largest(group: Factors) -> F64:
    """Of each linear factor the largest number in its H."""
    ends, size, dim = group.keys.shape[1], *((3, 3) if group.kind.endswith("se2") else (7, 6))
    return np.abs(group.measured[:, ends * size : ends * (size + dim * dim)]).max(axis=1, initial=0.0)


def _carried(y: F64) -> F64:
    """G: the local increment of a pose y when the frame that it is in moves by ξ = (translation, rotation)."""
    R = rotation(y)
    if y.size == 3:
        return np.block([[R.T, (R.T @ [-y[1], y[0]])[:, None]], [np.zeros((1, 2)), np.ones((1, 1))]])
    t = np.array([[0, -y[2], y[1]], [y[2], 0, -y[0]], [-y[1], y[0], 0]])
    return np.block([[R.T, -R.T @ t], [np.zeros((3, 3)), R.T]])


def _moved_linear(group: Factors, T_a_b: F64) -> Factors:
    """r = Σ H (x ⊟ y) + b is of increments local to y, so it is the same where y moves with x."""
    size, measured = T_a_b.size, group.measured.copy()
    for end in range(group.keys.shape[1]):
        columns = slice(end * size, (end + 1) * size)
        measured[:, columns] = compose(T_a_b, measured[:, columns])
    return group._replace(measured=measured)


def _moved_first(group: Factors, T_a_b: F64) -> Factors:
    """The first three rows of the residual are along the map's axes: Ω turns with them."""
    rows, columns = np.triu_indices(6)
    turn = np.eye(6)
    turn[:3, :3] = rotation(T_a_b)
    full = np.zeros((len(group.keys), 6, 6))
    full[:, rows, columns] = full[:, columns, rows] = group.information
    return group._replace(information=np.ascontiguousarray((turn @ full @ turn.T)[:, rows, columns]))


_MOVES: Mapping[str, Callable[[Factors, F64], Factors]] = {
    "idp_first": _moved_first,
    "linear_pair_se2": _moved_linear,
    "linear_pair_se3": _moved_linear,
}


def _wrapped(angles: F64) -> F64:
    """Into [−π, π)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _product(p: F64, q: F64) -> F64:
    """Quaternions p ⊗ q, vector part first, of length one; q (n, 4)."""
    v, w = p[:3], p[3]
    vector = w * q[:, :3] + q[:, 3:] * v + np.cross(v, q[:, :3])
    made = np.column_stack([vector, w * q[:, 3] - q[:, :3] @ v])
    return made / np.linalg.norm(made, axis=1, keepdims=True)
