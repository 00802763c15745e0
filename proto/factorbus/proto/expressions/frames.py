"""What an own kind says of the map's frame: nothing, if its residual is the same wherever the map lies."""

from functools import lru_cache
from itertools import combinations

import numpy as np

from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.evaluate import F64, compose_group, evaluate, move_point, random_value

_TRIES = 3  # random values and motions
_ROUNDING = 1e-9
_MOST_LEFT_OUT = 2  # variables that are on a robot and do not move with the map
_PLANE, _SPACE = ("se2", "point2"), ("se3", "point3", "so3")


@lru_cache(maxsize=256)
def moving_ends(declared: Declaration) -> tuple[int, ...] | None:
    """Which variables move with the map's frame, as all but the mount of a sensor do; None: it says where they are.

    Found by moving them: the most poses and points that can be moved together with the residual staying as it is.
    """
    ends = [n for n, (_, kind) in enumerate(declared.variables) if kind in (*_PLANE, *_SPACE)]
    if not ends:
        return ()
    for left_out in range(min(_MOST_LEFT_OUT, len(ends) - 1) + 1):
        for stay in combinations(reversed(ends), left_out):
            moving = tuple(n for n in ends if n not in stay)
            if all(_stays(declared, moving, seed) for seed in range(_TRIES)):
                return moving
    return None


def _stays(declared: Declaration, moving: tuple[int, ...], seed: int) -> bool:
    rng = np.random.default_rng(seed)
    values = [random_value(kind, rng) for kind in declared.types[: len(declared.variables)]]
    z, motions = (
        random_value(declared.measured, rng),
        {"plane": random_value("se2", rng), "space": random_value("se3", rng)},
    )
    moved = [
        _moved(kind, value, motions) if n in moving else value
        for n, ((_, kind), value) in enumerate(zip(declared.variables, values, strict=True))
    ]
    with np.errstate(all="ignore"):
        before, after = evaluate(declared, values, z), evaluate(declared, moved, z)
        alike = np.abs(after - before) <= _ROUNDING * (1.0 + np.abs(before))
    return bool((alike | (np.isnan(before) & np.isnan(after))).all())


def _moved(kind: str, value: F64, motions: dict[str, F64]) -> F64:
    group, motion = ("se2", motions["plane"]) if kind in _PLANE else ("se3", motions["space"])
    if kind.startswith("point"):
        return move_point(group, motion, value)
    if kind == "so3":
        return compose_group("so3", motion[3:], value)
    return compose_group(group, motion, value)
