"""First values for what is new in a step: composed from the first factor that reaches it, as our solver does it."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from factorbus.proto.messages import Batch

from .columns import ENDS, F64

Known = Callable[[str, int], F64]


def first_values(batch: Batch, known: Known) -> dict[int, tuple[str, F64]]:
    """key -> (kind, value) of the new variables of `batch`; known(kind, key): the present estimate of an old one.

    Raises ValueError when a variable has neither a value nor a factor that reaches it.
    """
    found: dict[int, tuple[str, F64]] = {}
    waiting: dict[int, str] = {}
    for group in batch.variables:
        for row, key in enumerate(group.keys.tolist()):
            if group.values is None:
                waiting[key] = group.kind
            else:
                found[key] = (group.kind, group.values[row])
    while waiting:
        before = len(waiting)
        for kind, (i, j), z in _factors(batch):
            first, second = ENDS[kind]
            if j in waiting and i not in waiting:
                found[j] = (waiting.pop(j), _FORWARD[kind](_value(first, i, found, known), z))
            elif i in waiting and j not in waiting and kind in _BACKWARD:
                found[i] = (waiting.pop(i), _BACKWARD[kind](_value(second, j, found, known), z))
        if len(waiting) == before:
            raise ValueError(f"{len(waiting)} new variables have no value and no factor that reaches them")
    return found


def _factors(batch: Batch) -> Iterator[tuple[str, list[int], F64]]:
    """Factors between poses before observations, each kind in its order; none that has one end: it reaches no other."""
    pairs = [group for group in batch.factors if group.kind in ENDS]
    for group in sorted(pairs, key=lambda group: not group.kind.startswith("between")):
        for ends, z in zip(group.keys.tolist(), group.measured, strict=True):
            yield group.kind, ends, z


def _value(kind: str, key: int, found: dict[int, tuple[str, F64]], known: Known) -> F64:
    return found[key][1] if key in found else known(kind, key)


def compose_se2(a: F64, b: F64) -> F64:
    """a b."""
    x, y = _point_se2(a, b)
    return np.array([x, y, math.remainder(a[2] + b[2], 2 * math.pi)])


def inverse_se2(a: F64) -> F64:
    """a⁻¹."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]])


def compose_se3(a: F64, b: F64) -> F64:
    """a b, with quaternions (x y z w)."""
    v, w = a[3:6], a[6]
    q = np.array([*(w * b[3:6] + b[6] * v + np.cross(v, b[3:6])), w * b[6] - v @ b[3:6]])
    return np.array([*_point_se3(a, b), *(q / np.linalg.norm(q))])


def inverse_se3(a: F64) -> F64:
    """a⁻¹."""
    turned = np.array([0, 0, 0, *-a[3:6], a[6]])
    return np.array([*-_point_se3(turned, a), *turned[3:]])


def _point_se2(a: F64, z: F64) -> F64:
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([a[0] + c * z[0] - s * z[1], a[1] + s * z[0] + c * z[1]])


def _point_se3(a: F64, z: F64) -> F64:
    twice = 2 * np.cross(a[3:6], z[:3])
    return a[:3] + z[:3] + a[6] * twice + np.cross(a[3:6], twice)


def _bearing_range(a: F64, z: F64) -> F64:
    return _point_se2(a, z[1] * np.array([math.cos(z[0]), math.sin(z[0])]))


_FORWARD: dict[str, Callable[[F64, F64], F64]] = {
    "between_se2": compose_se2,
    "between_se3": compose_se3,
    "landmark_se2": _point_se2,
    "landmark_se3": _point_se3,
    "bearing_range_se2": _bearing_range,
}
_BACKWARD: dict[str, Callable[[F64, F64], F64]] = {
    "between_se2": lambda b, z: compose_se2(b, inverse_se2(z)),
    "between_se3": lambda b, z: compose_se3(b, inverse_se3(z)),
}
