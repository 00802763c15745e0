"""What an own kind says of the map's frame: nothing, if its residual is the same wherever the map lies.

It is so where that is proven of the formula (`exact`): its residual, both sides of each `select`, and all that it takes
roots of or divides by, are the same numbers before and after a motion of the map.  Whatever is not proven says where
its variables are.
"""

from functools import lru_cache
from itertools import combinations
from typing import Any

from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.exact import Exact, ExactArithmetic, NotProven, compose_exact, move_exact
from factorbus.proto.expressions.operations import SE2, SE3, SO3

_MOST_LEFT_OUT = 2  # variables that are on a robot and do not move with the map
_MOST_PAIRS_OF = 8  # poses and points: of more than that at most one is left out
_PLANE, _SPACE = ("se2", "point2"), ("se3", "point3", "so3", "idp")
_FEATURE = "idp"  # moves with the map whatever else does


@lru_cache(maxsize=1024)
def moving_ends(declared: Declaration) -> tuple[int, ...] | None:
    """Which variables move with the map's frame, as all but the mount of a sensor do; None: it says where they are.

    The most poses and points of which it is proven that the residual stays as it is where they move together.
    """
    kinds = [kind for _, kind in declared.variables]
    ends = [n for n, kind in enumerate(kinds) if kind in (*_PLANE, *_SPACE)]
    if not ends:
        return ()
    may_stay = [n for n in reversed(ends) if kinds[n] != _FEATURE]
    most = _MOST_LEFT_OUT if len(ends) <= _MOST_PAIRS_OF else 1
    of = ExactArithmetic(declared)
    try:
        before = _values(of)
        unmoved = of.carry_out(before)
        for left_out in range(min(most, len(ends) - 1) + 1):
            for stay in combinations(may_stay, left_out):
                moving = tuple(n for n in ends if n not in stay)
                after = [_moved(of, kinds[n], x) if n in moving else x for n, x in enumerate(before)]
                if of.carry_out(after) == unmoved:
                    return moving
    except NotProven:
        pass
    return None


def _values(of: ExactArithmetic) -> list[Any]:
    """Of the variables and of z."""
    declared = of.declared
    return [of.random_value(kind, n) for n, kind in enumerate(declared.types[: len(declared.variables) + 1])]


def _moved(of: ExactArithmetic, kind: str, value: Any) -> Any:
    """Where the motion of the map takes a variable: one motion for all in the plane, another for all in space."""
    motion = of.random_value(SE2 if kind in _PLANE else SE3, "motion")
    if kind in (SE2, SE3):
        return compose_exact(of, motion, value)
    if kind == SO3:
        return compose_exact(of, motion.quaternion, value)
    where = of.plain(move_exact(of, motion, [x.number for x in value[: 2 if kind in _PLANE else 3]]))
    # Of a feature the direction turns, which is enough to know: any other angles.
    return [*where, Exact(of.some("theta")), Exact(of.some("phi")), value[5]] if kind == _FEATURE else where
