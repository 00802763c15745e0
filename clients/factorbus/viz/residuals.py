"""How badly each factor fits an estimate: rᵀ Ω r, by the formulas of `proto/README.md`, §3, in NumPy.

For colouring what is drawn; the solver has its own, compiled, and a test holds the two together.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.evaluate import evaluate
from factorbus.proto.expressions.operations import value_size
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.linear import parts_of
from factorbus.proto.messages import Factors, Variables
from factorbus.viz.derived_residuals import derived_residual
from factorbus.viz.inertial import inertial_residual

_WIDEST = 7  # numbers of a pose in space


def chi2_of_factors(group: Factors, values: "Values") -> F64:
    """rᵀ Ω r of each factor of `group` (m,); NaN where a variable has no value or the kind is not one of ours."""
    residual = _residual_of(group.kind)
    if residual is None or not len(group.keys):
        return np.full(len(group.keys), np.nan)
    r = residual(*(values.rows(column) for column in group.keys.T), group.measured)
    omega = _full(group.information, r.shape[1])
    return np.einsum("mi,mij,mj->m", r, omega, r)


def _residual_of(kind: str) -> Callable[..., F64] | None:
    known = FACTOR_KINDS.get(kind)
    if known is not None and known.own is not None:
        return _of_own(known.own)
    if known is not None and known.is_linear:
        return _linear(kind)
    if known is not None and known.imu is not None:
        return partial(inertial_residual, known.imu)
    return _RESIDUALS.get(kind)


class Values:
    """Values of variables of any kind, found by key."""

    def __init__(self, variables: Sequence[Variables]) -> None:
        groups = [group for group in variables if group.values is not None]
        self._keys = np.concatenate([np.empty(0, np.int64), *(group.keys for group in groups)])
        self._place = np.argsort(self._keys)
        self._keys = self._keys[self._place]
        width = max([_WIDEST, *(group.values.shape[1] for group in groups if group.values is not None)])
        wide = [np.pad(g.values, ((0, 0), (0, width - g.values.shape[1]))) for g in groups if g.values is not None]
        self._values = np.concatenate([np.empty((0, width)), *wide])[self._place]

    def rows(self, keys: I64) -> F64:
        """Values (m, width), of smaller kinds with zeros behind them; NaN for keys that have none."""
        found = np.full((len(keys), self._values.shape[1]), np.nan)
        if len(self._keys):
            at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
            here = self._keys[at] == keys
            found[here] = self._values[at[here]]
        return found


def _full(triangle: F64, dim: int) -> F64:
    """Symmetrical matrices (m, dim, dim) of upper triangles, row by row."""
    full = np.zeros((len(triangle), dim, dim))
    upper = np.triu_indices(dim)
    full[:, upper[0], upper[1]] = triangle
    full[:, upper[1], upper[0]] = triangle
    return full


def _wrap(angle: F64) -> F64:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _into_plane(pose: F64, point: F64) -> F64:
    """Rᵀ (p − t) in the plane."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = (point[:, :2] - pose[:, :2]).T
    return np.stack([c * x + s * y, c * y - s * x], axis=1)


def _less_se2(a: F64, b: F64) -> F64:
    """a⁻¹ ∘ b in the plane."""
    return np.column_stack([_into_plane(a, b), _wrap(b[:, 2] - a[:, 2])])


def _turned_back(quat: F64, v: F64) -> F64:
    """R(q)ᵀ v."""
    u, w = -quat[:, :3], quat[:, 3:4]
    t = 2 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def _into_space(pose: F64, point: F64) -> F64:
    """Rᵀ (p − t) in space."""
    return _turned_back(pose[:, 3:7], point[:, :3] - pose[:, :3])


def _less_se3(a: F64, b: F64) -> F64:
    """a⁻¹ ∘ b in space, as x y z qx qy qz qw with qw ≥ 0."""
    u, w = -a[:, 3:6], a[:, 6:7]
    v, s = b[:, 3:6], b[:, 6:7]
    vector = w * v + s * u + np.cross(u, v)
    scalar = w * s - np.sum(u * v, axis=1, keepdims=True)
    sign = np.where(scalar < 0, -1.0, 1.0)
    return np.column_stack([_into_space(a, b), sign * vector, sign * scalar])


def _less_so3(a: F64, b: F64) -> F64:
    """a⁻¹ ∘ b of rotations, with qw ≥ 0."""
    none = np.zeros((len(a), 3))
    return _less_se3(np.column_stack([none, a[:, :4]]), np.column_stack([none, b[:, :4]]))[:, 3:]


def _less_sim3(a: F64, b: F64) -> F64:
    """a⁻¹ ∘ b of poses with a scale."""
    left, scale = _less_se3(a, b), a[:, 7:8]
    return np.column_stack([left[:, :3] / scale, left[:, 3:], b[:, 7:8] / scale])


def _sim3_error(z: F64, x: F64) -> F64:
    """z⁻¹ ∘ x as x y z, qx qy qz with qw ≥ 0, ln s."""
    left = _less_sim3(z, x)
    return np.column_stack([left[:, :6], np.log(left[:, 7])])


def _bearing_range(pose: F64, point: F64, z: F64) -> F64:
    u = _into_plane(pose, point)
    return np.column_stack([_wrap(np.arctan2(u[:, 1], u[:, 0]) - z[:, 0]), np.hypot(*u.T) - z[:, 1]])


def _position(pose: F64, z: F64, turned: Callable[[F64, F64], F64]) -> F64:
    """Of an antenna in the map: t + R l − z."""
    n = z.shape[1] // 2
    return pose[:, :n] + turned(pose, z[:, n:]) - z[:, :n]


def _turned_in_plane(pose: F64, v: F64) -> F64:
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]])


def _turned_in_space(pose: F64, v: F64) -> F64:
    return _turned_back(pose[:, 3:7] * (-1.0, -1.0, -1.0, 1.0), v)


def _unit(v: F64) -> F64:
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def _distance(pose: F64, point: F64, z: F64, n: int) -> F64:
    return np.linalg.norm(point[:, :n] - pose[:, :n], axis=1, keepdims=True) - z


def _linear(kind: str) -> Callable[..., F64]:
    """Σ H (x ⊟ y) + b."""

    def residual(*ends_and_z: F64) -> F64:
        *ends, z = ends_and_z
        of, y, H, b = parts_of(kind, z)
        steps = (_LESS.get(end, _less_vector)(at, x) for end, at, x in zip(of, y, ends, strict=True))
        return b + sum(np.einsum("mij,mj->mi", J, step) for J, step in zip(H, steps, strict=True))

    return residual


def _less_vector(y: F64, x: F64) -> F64:
    return x[:, : y.shape[1]] - y


def _less_idp(y: F64, x: F64) -> F64:
    step = x[:, :6] - y
    step[:, 3] = _wrap(step[:, 3])
    return step


def _compose_se2(pose: F64, mount: F64) -> F64:
    """pose ∘ mount in the plane."""
    return np.column_stack([pose[:, :2] + _turned_in_plane(pose, mount[:, :2]), pose[:, 2:3] + mount[:, 2:3]])


def _compose_se3(pose: F64, mount: F64) -> F64:
    """pose ∘ mount in space."""
    u, w = pose[:, 3:6], pose[:, 6:7]
    v, s = mount[:, 3:6], mount[:, 6:7]
    scalar = w * s - np.sum(u * v, axis=1, keepdims=True)
    place = pose[:, :3] + _turned_in_space(pose, mount[:, :3])
    return np.column_stack([place, w * v + s * u + np.cross(u, v), scalar])


def _of_own(declared: Declaration) -> Callable[..., F64]:
    """The residual of a kind that a client has written itself, factor by factor."""
    sizes = [value_size(kind) for kind in declared.types[: len(declared.variables)]]

    def residual(*ends: F64) -> F64:
        rows = zip(*ends, strict=True)
        found = [evaluate(declared, [x[:n] for x, n in zip(row, sizes, strict=False)], row[-1]) for row in rows]
        return np.array(found).reshape(-1, declared.residual_size)

    return residual


# x ⊟ y, as linear factors have it.
_LESS: Mapping[str, Callable[[F64, F64], F64]] = {
    "se2": _less_se2,
    "se3": lambda y, x: _less_se3(y, x)[:, :6] * (1.0, 1.0, 1.0, 2.0, 2.0, 2.0),
    "idp": _less_idp,
    "so3": lambda y, x: 2.0 * _less_so3(y, x)[:, :3],
    "sim3": lambda y, x: _sim3_error(y, x) * (1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 1.0),
}
_RESIDUALS: dict[str, Callable[..., F64]] = {
    "prior_se2": lambda x, z: _less_se2(z, x),
    "prior_se3": lambda x, z: _less_se3(z, x)[:, :6],
    "prior_point2": lambda p, z: p[:, :2] - z,
    "prior_point3": lambda p, z: p[:, :3] - z,
    "between_se2": lambda a, b, z: _less_se2(z, _less_se2(a, b)),
    "between_se3": lambda a, b, z: _less_se3(z, _less_se3(a, b))[:, :6],
    "landmark_se2": lambda a, p, z: _into_plane(a, p) - z,
    "landmark_se3": lambda a, p, z: _into_space(a, p) - z,
    "bearing_range_se2": _bearing_range,
    "position_se2": lambda x, z: _position(x, z, _turned_in_plane),
    "position_se3": lambda x, z: _position(x, z, _turned_in_space),
    "heading_se2": lambda x, z: _wrap(x[:, 2:3] - z),
    "attitude_se3": lambda x, z: _turned_back(x[:, 3:7], _unit(z[:, 3:])) - _unit(z[:, :3]),
    "range_se2": lambda a, p, z: _distance(a, p, z, 2),
    "range_se3": lambda a, p, z: _distance(a, p, z, 3),
    "range_between_se2": lambda a, b, z: _distance(a, b, z, 2),
    "range_between_se3": lambda a, b, z: _distance(a, b, z, 3),
    "velocity_frame_se2": lambda f, v, z: _turned_in_plane(f, v) - z,
    "velocity_frame_se3": lambda f, v, z: _turned_in_space(f, v[:, :3]) - z,
    "length_vector3": lambda v, z: np.linalg.norm(v[:, :3], axis=1)[:, None] - z,
    "bearing_se2": lambda a, p, z: _bearing_range(a, p, np.column_stack([z, z]))[:, :1],
    "bearing_se3": lambda a, p, z: _unit(_into_space(a, p)) - _unit(z),
    "prior_so3": lambda x, z: _less_so3(z, x)[:, :3],
    "between_so3": lambda a, b, z: _less_so3(z, _less_so3(a, b))[:, :3],
    "attitude_so3": lambda x, z: _turned_back(x[:, :4], _unit(z[:, 3:])) - _unit(z[:, :3]),
    "prior_sim3": lambda x, z: _sim3_error(z, x),
    "between_sim3": lambda a, b, z: _sim3_error(z, _less_sim3(a, b)),
    "landmark_sim3": lambda a, p, z: _into_space(a, p) / a[:, 7:8] - z,
    "position_sim3": lambda x, z: x[:, :3] - z,
}
_RESIDUALS |= {
    name: derived_residual(kind, _RESIDUALS[kind.base], _compose_se2 if kind.connects[0] == "se2" else _compose_se3)
    for name, kind in FACTOR_KINDS.items()
    if kind.base in _RESIDUALS
}
