"""What the search for the optimum of a whole graph is asked for, and what it tells on the way."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

VALUES, ODOMETRY, ROTATIONS = "values", "odometry", "rotations"
# What is there is preferred, then what no order of the factors decides.
STARTS = (VALUES, ROTATIONS, ODOMETRY)
BEST = "best"


@dataclass(frozen=True, slots=True)
class BatchSearch:
    """How `solve_batch` searches.

    start: one of `STARTS`, or "best": the lowest end of all of them.
    max_iterations: factorizations and steps of one start at most, those that are not accepted among them.
    polish: afterwards, steps below what χ² can show, for estimates that are the same to the last digits; without, the
    search ends where another step would lower χ² by less than 1e-11 of it.
    memory_limit_bytes: refuse a graph whose optimization needs more; None: no limit.
    """

    start: str = BEST
    max_iterations: int = 500
    polish: bool = True
    memory_limit_bytes: int | None = None


class BatchEvents(Protocol):
    """What `solve_batch` calls while it works.  What these raise ends the search."""

    def on_memory(self, memory_bytes: int) -> None:
        """How much the optimization needs at most; before anything is factorized."""
        ...

    def on_starts(self, chi2: Mapping[str, float]) -> None:
        """χ² of every start that there is, the lowest first."""
        ...

    def on_iteration(self, start: str, iteration: int, chi2: float, damping: float) -> None:
        """A step was accepted: χ² after it, and the damping that it was found with."""
        ...


class NoEvents:
    """Nobody listens."""

    def on_memory(self, memory_bytes: int) -> None:
        pass

    def on_starts(self, chi2: Mapping[str, float]) -> None:
        pass

    def on_iteration(self, start: str, iteration: int, chi2: float, damping: float) -> None:
        pass
