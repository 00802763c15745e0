"""How a solver is set up."""

from collections.abc import Callable
from dataclasses import dataclass

from factorbus.solver.errors import UnknownMode

MODES = ("auto", "all-batch")


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of a Solver; the defaults are meant for every graph.

    mode            "all-batch": every step solves the whole system anew; "auto" is that at present
    clock           seconds, for the phases in the report; without one they are zero
    tolerance       an ordinary step stops when the next one would lower χ² by less than this share of it
    negligible      a χ² below this is nothing: 1e-12 is a millionth of a standard deviation, squared.  A step whose new
                    factors add less solves nothing, and no step goes on for less
    max_iterations  at most this many tries (accepted or not) in an ordinary step; the next step goes on from there
    settle_tolerance, settle_iterations   the same for a step that is to converge
    last_pose_last  constrain the ordering: the last pose last, the landmarks it sees right before it
    """

    mode: str = "auto"
    clock: Callable[[], float] | None = None
    tolerance: float = 1e-6
    negligible: float = 1e-12
    max_iterations: int = 10
    settle_tolerance: float = 1e-14
    settle_iterations: int = 500
    last_pose_last: bool = True

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise UnknownMode(self.mode, MODES)
