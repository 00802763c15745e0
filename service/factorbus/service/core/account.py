"""What a map has done so far: counts and durations, for whoever asks.

An insert that is done at once is noted only, and counted when time goes by or somebody asks: its answer leaves when the
thread that brought it is let go, and waits for all that is done before.  Measured: 10 of 500 µs.
"""

from collections import Counter
from typing import Any, NamedTuple

from factorbus.service.core.histogram import Histogram

# As many as may be noted before they are counted in any case; the clock comes four times a second.
_NOTED = 1024


class Done(NamedTuple):
    """An insert that was folded in by a step of its own; seconds are those since it arrived."""

    strategy: str
    chi2: float
    solver_ms: float
    seconds: float
    answered_bytes: int
    published_bytes: int


class Account:
    """One map's.  One thread at a time."""

    def __init__(self) -> None:
        self.chi2 = 0.0  # as it was before what is noted
        self._accepted = self._received = self._answered = self._published = 0
        self._refusals: Counter[str] = Counter()
        self._strategies: Counter[str] = Counter()
        self._solver_ms = 0.0
        self._step_s, self._insert_s = Histogram(), Histogram()
        self._noted: list[Done] = []

    def received(self, size: int) -> None:
        """An insert of so many bytes came in."""
        self._received += size

    def accepted(self, answered_bytes: int) -> None:
        """An insert was; its answer has so many bytes."""
        self._accepted += 1
        self._answered += answered_bytes

    def refused(self, problem: Any) -> None:
        """An insert was: a problem with a code."""
        self._refusals[problem.code] += 1

    def stepped(self, strategy: str, chi2: float, solver_ms: float, published_bytes: int) -> None:
        """The solver made a step; its delta has so many bytes."""
        self.count()  # what was noted came before
        self._step(strategy, chi2, solver_ms, published_bytes)

    def took(self, seconds: float) -> None:
        """From the arrival of an insert until the solver was done with it."""
        self._insert_s.add(seconds)

    def note(self, done: Done) -> None:
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
