"""What an expression comes to, in NumPy: the reference for the solver's kernels, and what clients compute with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorbus.proto.expressions.declaration import CONSTANT, Declaration
from factorbus.proto.expressions.operations import SE2, SE3, SO3, Type, tangent_size

F64 = NDArray[np.float64]


def evaluate(declared: Declaration, values: Sequence[F64], z: F64) -> F64:
    """The residual at the values of the variables, for the measurement z."""
    known = [*(np.asarray(value, float) for value in values), np.asarray(z, float)]
    for node in declared.nodes:
        if node.operation == CONSTANT:
            known.append(np.array(node.numbers))
            continue
        of = [known[k] for k in node.of]
        kinds = [declared.types[k] for k in node.of]
        known.append(np.atleast_1d(_DO[node.operation](kinds, [int(k) for k in node.numbers], *of)))
    return known[-1]


def difference_jacobians(declared: Declaration, values: Sequence[F64], z: F64, step: float = 1e-6) -> list[F64]:
    """∂r/∂δ of each variable, by central differences of increments as in `factorbus.solver.graph.variables`."""
    found = []
    for k, kind in enumerate(declared.types[: len(declared.variables)]):
        columns = []
        for c in range(tangent_size(kind)):
            ends = []
            for side in (step, -step):
                delta = np.zeros(tangent_size(kind))
                delta[c] = side
                moved = [*values[:k], retract(kind, np.asarray(values[k], float), delta), *values[k + 1 :]]
                ends.append(evaluate(declared, moved, z))
            columns.append((ends[0] - ends[1]) / (2.0 * step))
        found.append(np.stack(columns, axis=1))
    return found


def retract(kind: Type, x: F64, delta: F64) -> F64:
    """x ⊞ δ."""
    if kind == SO3:
        return _product(x, _exp(delta))
    if kind == SE2:
        return np.array([*(x[:2] + _rotate(SE2, x, delta[:2])), _wrap(x[2] + delta[2])])
    if kind == SE3:
        return np.concatenate([x[:3] + _rotate(SE3, x, delta[:3]), _product(x[3:], _exp(delta[3:]))])
    return x + delta


def _wrap(angle: Any) -> Any:
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


def _product(a: F64, b: F64) -> F64:
    v = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.array([*v, a[3] * b[3] - a[:3] @ b[:3]])


def _exp(v: F64) -> F64:
    angle = float(np.linalg.norm(v))
    return np.array([*(0.5 * np.sinc(0.5 * angle / np.pi) * v), np.cos(0.5 * angle)])


def _positive(q: F64) -> F64:
    return -q if q[3] < 0.0 else q


def _log(q: F64) -> F64:
    q = _positive(q)
    size = float(np.linalg.norm(q[:3]))
    return (2.0 / q[3] if size < 1e-12 else 2.0 * np.arctan2(size, q[3]) / size) * q[:3]


def _turn(kind: Type, x: F64) -> F64:
    """The quaternion of a rotation, or of a pose in space."""
    return x if kind == SO3 else x[3:]


def _rotate(kind: Type, x: F64, v: F64) -> F64:
    if kind == SE2:
        c, s = np.cos(x[2]), np.sin(x[2])
        return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])
    q = _turn(kind, x)
    t = 2.0 * np.cross(q[:3], v)
    return v + q[3] * t + np.cross(q[:3], t)


def _act(kinds: Sequence[Type], _numbers: Sequence[int], x: F64, v: F64) -> F64:
    moved = _rotate(kinds[0], x, v)
    return moved if kinds[0] == SO3 else moved + x[: len(v)]


def compose_group(kind: Type, a: F64, b: F64) -> F64:
    """a ∘ b of rotations or poses."""
    if kind == SO3:
        return _product(a, b)
    if kind == SE2:
        return np.array([*(a[:2] + _rotate(SE2, a, b[:2])), _wrap(a[2] + b[2])])
    return np.concatenate([a[:3] + _rotate(SE3, a, b[:3]), _product(a[3:], b[3:])])


def move_point(kind: Type, pose: F64, point: F64) -> F64:
    """R p + t of a pose."""
    return _act((kind, len(point)), (), pose, point)


def random_value(kind: Type, rng: np.random.Generator) -> F64:
    """A value of a type, for trying an expression out: turned by any angle, numbers of the size of 1."""
    if not isinstance(kind, str):
        return rng.normal(size=kind)
    if kind == SE2:
        return np.array([*rng.normal(size=2), rng.uniform(-np.pi, np.pi)])
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    return q if kind == SO3 else np.concatenate([rng.normal(size=3), q])


def _inverse(kinds: Sequence[Type], _numbers: Sequence[int], a: F64) -> F64:
    kind = kinds[0]
    if kind == SE2:
        return np.array([*-_rotate(SE2, np.array([0.0, 0.0, -a[2]]), a[:2]), _wrap(-a[2])])
    q = _turn(kind, a) * [-1.0, -1.0, -1.0, 1.0]
    return q if kind == SO3 else np.concatenate([-_rotate(SO3, q, a[:3]), q])


def _logarithm(kinds: Sequence[Type], _numbers: Sequence[int], a: F64) -> F64:
    if kinds[0] == SE2:
        return np.array([a[0], a[1], _wrap(a[2])])
    return np.concatenate([a[: len(a) - 4], _log(_turn(kinds[0], a))])


def _cross(_kinds: Sequence[Type], _numbers: Sequence[int], a: F64, b: F64) -> Any:
    return np.cross(a, b) if len(a) == 3 else a[0] * b[1] - a[1] * b[0]


def _over(a: F64, b: F64) -> F64:
    """a / b; no number where b is 0."""
    return a * (np.nan if b[0] == 0.0 else 1.0 / b[0])


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """An operation that looks at values alone."""
    return lambda _kinds, _numbers, *of: function(*of)


_DO: dict[str, Callable[..., Any]] = {
    "compose": lambda kinds, _numbers, a, b: compose_group(kinds[0], a, b),
    "inverse": _inverse,
    "act": _act,
    "rotate": lambda kinds, _numbers, a, b: _rotate(kinds[0], a, b),
    "position": lambda kinds, _numbers, a: a[: 2 if kinds[0] == SE2 else 3],
    "rotation": _plain(lambda a: a[3:]),
    "heading": _plain(lambda a: a[2:]),
    "pose": _plain(lambda a, b: np.concatenate([a, _wrap(b) if len(a) == 2 else b])),
    "log": _logarithm,
    "exp": _plain(_exp),
    "vector_part": _plain(lambda a: _positive(a)[:3]),
    "norm": _plain(np.linalg.norm),
    "dot": _plain(np.dot),
    "cross": _cross,
    "atan2": _plain(np.arctan2),
    "sqrt": _plain(np.sqrt),
    "sin": _plain(np.sin),
    "cos": _plain(np.cos),
    "wrap": _plain(_wrap),
    "select": _plain(lambda a, b, c: b if a[0] >= 0.0 else c),
    "add": _plain(np.add),
    "subtract": _plain(np.subtract),
    "negate": _plain(np.negative),
    "multiply": _plain(np.multiply),
    "divide": _plain(_over),
    "part": lambda _kinds, numbers, a: a[numbers[0] : numbers[0] + numbers[1]],
    "vector": _plain(lambda *all_of: np.concatenate(all_of)),
}
