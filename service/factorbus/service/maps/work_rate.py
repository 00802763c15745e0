"""How many units of the solver's work this machine does in a millisecond, by a drive of its own.

Steps of a map with a budget are given units (`core/budget.py`); this is what their number starts from.
"""

import logging
import math
import time
from collections.abc import Iterator

import numpy as np

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.service.core.budget import USUAL_UNITS_PER_MS

log = logging.getLogger(__name__)

_ROUND, _ROUNDS = 60, 8  # poses in a circle, and circles
_LARGE = 1e4  # units: steps of less are passed over, as they take longer than their units say
_AMPLE = 1e13  # units, which no step here takes


class WorkRate:
    """Measured once, when it is first asked for.  measured: False where kernels are not to be compiled for it."""

    def __init__(self, measured: bool) -> None:
        self._rate = 0.0 if measured else USUAL_UNITS_PER_MS

    def units_per_ms(self) -> float:
        """As measured; of a machine on which it cannot be, the usual number."""
        if not self._rate:
            started = time.perf_counter()
            self._rate = measured_rate()
            log.info(
                "%.3g units of work take a millisecond, by a drive of %.2f s", self._rate, time.perf_counter() - started
            )
        return self._rate


def measured_rate() -> float:
    """Of the work of a drive in circles, each pose of which is joined to the one a circle before."""
    from factorbus.solver import Options, Solver

    solver = Solver(Options(clock=time.perf_counter))
    taken = []
    for batch in _circles():
        solver.stage(batch)
        taken.append(solver.step(budget=_AMPLE))
    rates = [each.work / each.step_ms for each in taken if each.work > _LARGE and each.step_ms > 0.0]
    rate = float(np.median(rates)) if rates else USUAL_UNITS_PER_MS
    return rate if math.isfinite(rate) and rate > 0.0 else USUAL_UNITS_PER_MS


def _circles() -> Iterator[Batch]:
    """The steps of the drive: a pose each, joined to the one before and, once around, to the one a circle before."""
    turn, information = 2.0 * math.pi / _ROUND, np.array([[100.0, 0.0, 0.0, 100.0, 0.0, 1000.0]])
    ahead = np.array([[2.0 * math.sin(turn / 2.0), 0.0, turn]])
    for n in range(_ROUND * _ROUNDS):
        first = np.zeros((1, 3)) if n == 0 else None
        near = Factors("between_se2", np.array([[n - 1, n]]), ahead, information)
        around = Factors("between_se2", np.array([[n - _ROUND, n]]), np.array([[0.01, 0.0, 0.0]]), information)
        factors = (near,) if n < _ROUND else (near, around)
        yield Batch((Variables("se2", np.array([n]), first, fixed=n == 0),), factors if n else ())
