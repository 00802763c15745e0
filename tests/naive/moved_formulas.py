"""Whether a residual stays as it is where the map is moved, seen at random values: no proof, and what a proof is held
against.
"""

import numpy as np

from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.evaluate import F64, compose_group, evaluate, move_point, random_value

_PLANE, _SPACE = ("se2", "point2"), ("se3", "point3", "so3", "idp")
_ROUNDING = 1e-9


def stays(declared: Declaration, moving: tuple[int, ...], seed: int) -> bool | None:
    """Whether the residual is the same after a motion of these variables; None: it is no number before or after."""
    rng = np.random.default_rng(seed)
    values = [random_value(kind, rng) for kind in declared.types[: len(declared.variables)]]
    z, plane, space = (random_value(kind, rng) for kind in (declared.measured, "se2", "se3"))
    after = [
        _moved(kind, value, plane, space) if n in moving else value
        for n, ((_, kind), value) in enumerate(zip(declared.variables, values, strict=True))
    ]
    with np.errstate(all="ignore"):
        r, moved = evaluate(declared, values, z), evaluate(declared, after, z)
    if not (np.isfinite(r).all() and np.isfinite(moved).all()):
        return None
    return bool((np.abs(moved - r) <= _ROUNDING * (1.0 + np.abs(r))).all())


def ends_of(declared: Declaration) -> tuple[int, ...]:
    """The variables that are moved with the map."""
    return tuple(n for n, (_, kind) in enumerate(declared.variables) if kind in (*_PLANE, *_SPACE))


def _moved(kind: str, value: F64, plane: F64, space: F64) -> F64:
    if kind == "idp":
        return _moved_feature(value, space)
    group, motion = ("se2", plane) if kind in _PLANE else ("se3", space)
    if kind.startswith("point"):
        return move_point(group, motion, value)
    return compose_group(group, motion[3:] if kind == "so3" else motion, value)


def _moved_feature(value: F64, space: F64) -> F64:
    theta, phi = value[3:5]
    ray = np.array([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)])
    x, y, z = move_point("se3", space, ray) - space[:3]
    return np.array([*move_point("se3", space, value[:3]), np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z)), value[5]])
