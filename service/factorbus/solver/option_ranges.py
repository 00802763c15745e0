"""Which values each number among the options may have: its type, the least and the most."""

import math
import sys
import types
from dataclasses import dataclass
from typing import Any

from factorbus.solver.errors import BadOption

# Counts go into float64 settings of the kernels, where whole numbers beyond this are no longer exact.
_MOST_COUNT = 2**53
_MOST_NUMBER = int(sys.float_info.max)


@dataclass(frozen=True, slots=True)
class Range:
    """least ≤ value ≤ most, or least < value if `above`; whole: a whole number.  NaN is in no range."""

    least: float = 0.0
    most: float = math.inf
    above: bool = False
    whole: bool = False

    def __str__(self) -> str:
        what = "a whole number" if self.whole else "a number"
        low = f"above {self.least:g}" if self.above else f"{self.least:g} or more"
        if self.most in (math.inf, _MOST_COUNT):
            return f"{what}, {low}"
        return f"{what}, {low}, {self.most:g} at most"

    def takes(self, value: Any) -> bool:
        """Whether `value` is such a number."""
        if isinstance(value, bool) or not isinstance(value, int if self.whole else (int, float)):
            return False
        if not self.whole and isinstance(value, int) and abs(value) > _MOST_NUMBER:
            return False
        return (value > self.least if self.above else value >= self.least) and value <= self.most


def _count(least: int) -> Range:
    return Range(least, _MOST_COUNT, whole=True)


_SHARE, _FINITE, _AMOUNT, _FACTOR = Range(0.0, 1.0), Range(most=1e9), Range(), Range(above=True)

# An amount may be infinite: what it is the threshold of then never happens.  Where that would be to solve nothing, and
# to say that it has converged, it is a share, or finite.
RANGES = types.MappingProxyType(
    {
        "tolerance": _SHARE,
        "tol": _FINITE,
        "small_loop": _count(0),
        "big_loop": _count(0),
        "loop_share": _FINITE,
        "negligible": _SHARE,
        "max_iterations": _count(0),
        "nonmonotone_steps": _count(0),
        "settle_tolerance": _SHARE,
        "settle_iterations": _count(0),
        "recent_poses": _count(1),
        "bent": _AMOUNT,
        "bent_soon": _AMOUNT,
        "bent_now": _AMOUNT,
        "many": _count(1),
        "bent_most": _AMOUNT,
        "patience": _count(0),
        "rest": _count(0),
        "reluctance": _FINITE,
        "dear": _FACTOR,
        "rounds": _count(1),
        "converged_share": _AMOUNT,
        "ripple": _SHARE,
        "recent_steps": _count(0),
        "heavy": _AMOUNT,
        "near": Range(0.0, 1e6),
        "around": Range(0.0, 1e6),
        "worth": _AMOUNT,
        "rings": Range(1.0, above=True),
        "detour": _AMOUNT,
        "split_pivots": _count(0),
        "split_share": _SHARE,
    }
)
SWITCHES = ("keep_factor", "place_new", "last_pose_last")


def check_numbers(options: Any) -> None:
    """Every number in its range, every switch True or False.  Raises BadOption."""
    for name, allowed in RANGES.items():
        if not allowed.takes(value := getattr(options, name)):
            raise BadOption(name, repr(value), str(allowed))
    for name in SWITCHES:
        if not isinstance(value := getattr(options, name), bool):
            raise BadOption(name, repr(value), "True or False")
