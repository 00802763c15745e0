"""What a step may take: milliseconds as units of the solver's work, by what steps took.  Pure; the clock is the host's.

A step is given units, which are reckoned before the work and make the same bits wherever it is done; the journal has
them.  How many make a millisecond is measured where the service starts, and follows what steps take from then on:

    rate ← rate exp(w clip(ln(units / ms / rate), ±CLIPPED))

with w SLOWER where the step was slower than the rate, else FASTER.  So one step, whatever it met, hardly moves it, and
it comes to rest where most steps take less than was asked.
Reasons: docs/decisions/budget.md.
"""

import math
from collections.abc import Mapping
from typing import Any

from factorbus.proto import codec
from factorbus.service.core.events import BudgetUse, Effect, Publish, Stepped

USUAL_UNITS_PER_MS = 1e8  # where nothing was measured
SLOWER, FASTER, CLIPPED = 0.06, 0.02, 0.5
FAR = 8.0  # times what was measured at the start, either way: beyond it nothing is believed
LEAST_SHARE = 0.1  # of its budget that a step has to use: of shorter ones much is not counted in units
MOST_DOUBLED = 6  # times, in further steps of no use; after that they have no bound
LARGE, SMALL = 9.0, 1.0  # of χ²: what is left may move a variable by 3 of its standard deviations; by no more than 1
_NONE = BudgetUse()


class StepBudget:
    """The budget of one map's steps; budget_ms 0: they have no bound.  units_per_ms: as measured at the start."""

    def __init__(self, budget_ms: float = 0.0, units_per_ms: float = USUAL_UNITS_PER_MS) -> None:
        self.budget_ms, self.units_per_ms = budget_ms, units_per_ms
        self._began = units_per_ms
        self._use, self._step_ms = _NONE, 0.0
        self._ends = False  # the map had a budget, and what that left is not done yet
        self._coming = False  # a large correction, and the event has gone out

    @property
    def complete(self) -> bool:
        """Whether the last step left nothing for later ones."""
        return self._use.complete

    def units(self, doubled: int = 0) -> float:
        """What a step that begins now may take, a whole number of units, or that doubled so often; 0: it has no bound.

        doubled: of a further step, as `Converging` has it.
        """
        if doubled > MOST_DOUBLED:
            return 0.0
        return float(round(self.budget_ms * self.units_per_ms)) * 2.0**doubled

    def change(self, budget_ms: float, units_per_ms: float) -> None:
        """Steps that begin from now on have this budget; 0: no bound, and what was left goes on.

        units_per_ms: as measured, for a map that had none; of one that had, what steps have led to stays.
        """
        if not self.budget_ms:
            self.units_per_ms = self._began = units_per_ms
        self._ends = not budget_ms and not self.complete and bool(self.budget_ms or self._ends)
        self.budget_ms = budget_ms

    def restore(self, use: BudgetUse) -> None:
        """The map was here before, and this is known of its last step."""
        self._use = use

    def stepped(self, stepped: Stepped) -> None:
        """A step was made."""
        if not self.budget_ms and not self._ends:
            return
        self._use, self._step_ms = stepped.use or _NONE, stepped.step_ms
        self._ends = self._ends and not self.complete
        if not self.budget_ms:
            return
        if stepped.use is not None and stepped.strategy != "batch":  # what replaces a step is not counted in units
            self._follow(stepped.use, stepped.step_ms)

    def correction(self, epoch: int, revision: int) -> list[Effect]:
        """The event `correction` after a step: a large one is coming now, or has arrived."""
        left = 0.0 if self._use.complete else self._use.unsolved
        if left >= SMALL if self._coming else left < LARGE:
            return []
        self._coming = not self._coming
        told = {
            "event": "correction",
            "epoch": epoch,
            "revision": revision,
            "state": "coming" if self._coming else "arrived",
            "unsolved": left if left < math.inf else None,
        }
        return [Publish("event", codec.encode_map(told))]

    def _follow(self, use: BudgetUse, step_ms: float) -> None:
        if not step_ms > 0.0 or not use.work >= LEAST_SHARE * use.budget or not use.work > 0.0:
            return
        gap = math.log(use.work / step_ms / self.units_per_ms)
        gap = min(max(gap, -CLIPPED), CLIPPED)
        rate = self.units_per_ms * math.exp((FASTER if gap > 0.0 else SLOWER) * gap)
        self.units_per_ms = min(max(rate, self._began / FAR), self._began * FAR)

    def row(self) -> dict[str, Any]:
        """What the row of a map says of it: nothing where there is none, and no more to do of one that there was."""
        said = self.budget_ms or self._ends
        return {"budget_ms": self.budget_ms, "complete": self.complete} if said else {}

    def stats(self) -> dict[str, Any]:
        """What else the statistics of a map say."""
        if not self.budget_ms:
            return {}
        told = {
            "budget_ms": self.budget_ms,
            "step_ms": self._step_ms,
            "deferred_relinearizations": self._use.deferred_relinearizations,
            "unsolved": self._use.unsolved if self._use.unsolved < math.inf else None,
            "complete": self.complete,
            "units_per_ms": self.units_per_ms,
        }
        return {"budget": told}


def use_of(reported: Mapping[str, Any]) -> BudgetUse | None:
    """What a step made of its budget, by its report; None: it had none."""
    if "budget" not in reported:
        return None
    return BudgetUse(*(reported[name] for name in BudgetUse._fields))
