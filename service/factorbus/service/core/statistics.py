"""What a map has done so far: counts and durations, for statistics.

An insert that is done at once is noted only, and counted when time goes by or somebody asks: its answer leaves when the
thread that brought it is let go, and waits for all that is done before.  Measured: 10 of 500 µs.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

from factorbus.service.core.events import Effect, Refuse

# As many as may be noted before they are counted in any case; the clock comes four times a second.
_NOTED = 1024

# Seconds; the last count is of what took longer.
BOUNDS_S = (
    0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 60.0,
)  # fmt: skip


class InsertDone(NamedTuple):
    """An insert that was applied in by a step of its own; seconds are those since it arrived."""

    strategy: str
    chi2: float
    solver_ms: float
    seconds: float
    answered_bytes: int
    published_bytes: int


class MapStatistics:
    """One map's.  One thread at a time."""

    def __init__(self) -> None:
        self.chi2 = 0.0  # as it was before what is noted
        self.closures: Mapping[str, int] | None = None  # how many are in each state, where they are tested
        self._accepted = self._received = self._answered = self._published = 0
        self._refusals: Counter[str] = Counter()
        self._strategies: Counter[str] = Counter()
        self._solver_ms = 0.0
        self._step_s, self._insert_s = Histogram(), Histogram()
        self._noted: list[InsertDone] = []

    def received(self, size: int) -> None:
        """An insert of `size` bytes came in."""
        self._received += size

    def accepted(self, answered_bytes: int) -> None:
        """An insert was; its answer has `answered_bytes` bytes."""
        self._accepted += 1
        self._answered += answered_bytes

    def refused(self, problem: Any) -> None:
        """An insert was: a problem with a code."""
        self._refusals[problem.code] += 1

    def count_refused(self, effects: list[Effect]) -> list[Effect]:
        """`effects`, of which those that refuse something are counted."""
        for effect in effects:
            if isinstance(effect, Refuse):
                self.refused(effect.problem)
        return effects

    def stepped(self, strategy: str, chi2: float, solver_ms: float, published_bytes: int) -> None:
        """The solver made a step; its delta has `published_bytes` bytes."""
        self.count()  # what was noted came before
        self._step(strategy, chi2, solver_ms, published_bytes)

    def took(self, seconds: float) -> None:
        """From the arrival of an insert until the solver was done with it."""
        self._insert_s.add(seconds)

    def note(self, done: InsertDone) -> None:
        """To be counted later."""
        self._noted.append(done)
        if len(self._noted) >= _NOTED:
            self.count()

    def count(self) -> None:
        """What was noted."""
        noted, self._noted = self._noted, []
        for done in noted:
            self.accepted(done.answered_bytes)
            self._step(done.strategy, done.chi2, done.solver_ms, done.published_bytes)
            self.took(done.seconds)

    def stats(self) -> dict[str, Any]:
        """What anybody may ask of it."""
        self.count()
        refused = self._refusals.total()
        return {
            "chi2": self.chi2,
            "inserts": {
                "accepted": self._accepted,
                "refused": refused - self._refusals["busy"],
                "busy": self._refusals["busy"],
            },
            "strategies": dict(self._strategies),
            "solver_ms": self._solver_ms,
            **({} if self.closures is None else {"closure_states": dict(self.closures)}),
        }

    def for_operators(self) -> dict[str, Any]:
        """And what only an operator does."""
        self.count()
        return {
            "refusals": dict(self._refusals),
            "step_s": self._step_s.as_dict(),
            "insert_s": self._insert_s.as_dict(),
            "bytes": {"received": self._received, "answered": self._answered, "published": self._published},
        }

    def _step(self, strategy: str, chi2: float, solver_ms: float, published_bytes: int) -> None:
        self.chi2 = chi2
        self._solver_ms += solver_ms
        self._strategies[strategy] += 1
        self._step_s.add(solver_ms / 1e3)
        self._published += published_bytes


class Histogram:
    """Counts of durations.  One thread at a time."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def add(self, seconds: float) -> None:
        """One more."""
        self._counts[bisect_left(BOUNDS_S, seconds)] += 1
        self._sum_s += seconds

    def as_dict(self) -> dict[str, Any]:
        """`bounds_s`, `counts` (one more than bounds: what took longer), `sum_s`."""
        return {"bounds_s": list(BOUNDS_S), "counts": list(self._counts), "sum_s": self._sum_s}
