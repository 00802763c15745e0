"""Which values each number among the options may have: its type, the least and the most."""

import math
import sys
import types
from dataclasses import dataclass
from typing import Any

from factorbus.solver.errors import BadOption

# Counts go into float64 settings of the kernels, where whole numbers beyond this are no longer exact.
_MOST_COUNT = 2**53
MOST_BUDGET = 1e15  # of a step: weeks
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

# An amount may be infinite: what it is the threshold of then never happens.  Where that would be to solve nothing, or
# to relinearize nothing, and to say that it has converged, it is a share, or finite.
RANGES = types.MappingProxyType(
    {
        "batch_tolerance": _SHARE,
        "incremental_tolerance": _FINITE,
        "small_loop_threshold": _count(0),
        "big_loop_threshold": _count(0),
        "loop_threshold_share": _FINITE,
        "chi2_epsilon": _SHARE,
        "max_iterations": _count(0),
        "max_nonmonotone_steps": _count(0),
        "converge_tolerance": _SHARE,
        "converge_max_iterations": _count(0),
        "constrain_recent_poses": _count(1),
        "relinearize_threshold": _AMOUNT,
        "relinearize_next_step_share": _FINITE,
        "relinearize_same_step_share": _FINITE,
        "relinearize_full_batch": _count(1),
        "relinearize_max_error": _AMOUNT,
        "relinearize_max_wait": _count(0),
        "relinearize_cooldown_steps": _count(0),
        "relinearize_cooldown_factor": _FINITE,
        "relinearize_cooldown_flops": _FACTOR,
        "max_rounds": _count(1),
        "step_budget": Range(0.0, MOST_BUDGET),
        "converged_share": _FINITE,
        "wildfire_threshold": _SHARE,
        "constrain_recent_steps": _count(0),
        "reroot_min_flops": _AMOUNT,
        "reroot_size_linear": Range(0.0, 1e6),
        "reroot_size_area": Range(0.0, 1e6),
        "reroot_period": _AMOUNT,
        "reroot_ring_ratio": Range(1.0, above=True),
        "reroot_max_extra": _AMOUNT,
        "clique_split_min_pivots": _count(0),
        "clique_split_max_affected": _SHARE,
    }
)
SWITCHES = ("reuse_factor", "initialize_locally", "constrain_last_pose")


def check_numbers(settings: Any) -> None:
    """Every number of a dataclass in its range, every switch True or False.  Raises BadOption."""
    for name in settings.__slots__:
        if name in RANGES:
            check_number(name, getattr(settings, name))
        if name in SWITCHES and not isinstance(value := getattr(settings, name), bool):
            raise BadOption(name, repr(value), "True or False")


def check_number(name: str, value: Any) -> None:
    """That it is in the range of the option of that name.  Raises BadOption."""
    if not (allowed := RANGES[name]).takes(value):
        raise BadOption(name, repr(value), str(allowed))


def check_within(name: str, value: object, least: float, most: float, whole: bool = False) -> None:
    """That a setting of a policy is from `least` to `most`, and no switch.  Raises BadOption."""
    kinds = int if whole else (int, float)
    if not isinstance(value, kinds) or isinstance(value, bool) or not least <= value <= most:
        wanted = "a whole number" if whole else "a number"
        raise BadOption(name, repr(value), f"{wanted} from {least:g} to {most:g}")
