"""Steps that a map has made since it was opened, for plots of who comes late: at most MOST_STEPS, whatever it has made.

When there are too many, every second one of the older half goes.  So the newest are all there, and a long drive is
there from its beginning, the more sparsely the longer ago.
"""

from typing import NamedTuple

import numpy as np

from factorbus.proto.step_history import StepHistory, encode_step_history
from factorbus.service.core.events import Answer, Asker, Stepped

MOST_STEPS = 4096


class KeptStep(NamedTuple):
    """What is kept of a step."""

    revision: int
    chi2: float
    step_ms: float
    eliminated: int
    changed: int


class KeptSteps:
    """One map's.  One thread at a time."""

    def __init__(self, most: int = MOST_STEPS) -> None:
        self._most = most
        self._steps: list[KeptStep] = []

    def add(self, step: Stepped) -> None:
        """The solver has made this one; it replaces any of its revision and later ones, which do not count any more."""
        while self._steps and self._steps[-1].revision >= step.revision:
            self._steps.pop()
        self._steps.append(KeptStep(step.revision, step.chi2, step.step_ms, step.eliminated, step.changed))
        if len(self._steps) > self._most:
            half = len(self._steps) // 2
            self._steps[:half] = self._steps[:half:2]

    def answer(self, asker: Asker, epoch: int, revision: int) -> Answer:
        """To ask/history, of a map that is at this revision."""
        return Answer(asker, encode_step_history(self.history(epoch, revision)))

    def history(self, epoch: int, revision: int) -> StepHistory:
        """All of them."""
        columns = list(zip(*self._steps, strict=True)) or [()] * len(KeptStep._fields)
        revisions, eliminated, changed = (np.array(columns[place], np.int64) for place in (0, 3, 4))
        chi2, step_ms = (np.array(columns[place], np.float64) for place in (1, 2))
        return StepHistory(epoch, revision, revisions, chi2, step_ms, eliminated, changed)
