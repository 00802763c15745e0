"""iSAM2 that relinearizes what fits into a budget: the idea of RA-ISAM2, and nothing else, as a rival of `budget.py`.

Of the variables whose δ is above iSAM2's threshold, those with the largest δ are relinearized, as many as keep the step
within its time; the others are held where they are (`noRelinKeys`) and are candidates again in the next step.  A step's
time is reckoned by a model that follows what steps took: so long for each variable that is eliminated again
(`predictUpdateInfo` names them) and so long for the rest.  Choosing and reckoning are off the clock, which is in the
rival's favour.  Nothing else is bounded: what a loop eliminates and what back-substitution reaches takes what it takes.
"""

import time
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from bench.replays.chi2 import chi2_at
from bench.replays.columns import F64, I64, columns_of
from bench.replays.contestants import Failed
from bench.replays.isam2 import Isam2, Isam2Settings

from factorbus.proto.messages import Batch

THRESHOLD, WILDFIRE = 0.1, 1e-3  # as in the other benchmarks: relinearizeThreshold; GTSAM's wildfire threshold
_FACTORIZATION = "CHOLESKY"
_HALVINGS = 7  # of the number of candidates: to a hundredth of them
_FOLLOW = 0.05  # of the way from what a variable was reckoned to take to what it took
_FIRST_MS = 0.005  # for a variable, before anything was measured
_FEW = 50  # variables: steps of fewer say nothing of the time for each
_DIMS = {"se2": 3, "se3": 6, "point2": 2}


class Isam2WithinBudget(Isam2):
    """A contestant like iSAM2 itself.

    took_ms, took_cpu_s   what its last step took
    held_back             how many variables above the threshold that step did not relinearize
    """

    def __init__(self, budget_ms: float) -> None:
        super().__init__(Isam2Settings(THRESHOLD, _FACTORIZATION, WILDFIRE))
        self._budget_ms, self._ms_each, self._ms_beside = budget_ms, _FIRST_MS, 0.0
        self._dims: dict[int, int] = {}
        self.took_ms, self.took_cpu_s, self.held_back = 0.0, 0.0, 0

    def prepare(self, batch: Batch) -> None:
        """As iSAM2; the dimensions of what is new are noted."""
        super().prepare(batch)
        for group in batch.variables:
            self._dims.update(dict.fromkeys(group.keys.tolist(), _DIMS[group.kind]))

    def step(self) -> None:
        """Raises Failed."""
        parameters, affected = self._choose()
        began, cpu = time.perf_counter(), time.process_time()
        self._update(parameters)
        self.took_ms, self.took_cpu_s = 1e3 * (time.perf_counter() - began), time.process_time() - cpu
        if affected >= _FEW:
            self._ms_each += _FOLLOW * (max(self.took_ms - self._ms_beside, 0.0) / affected - self._ms_each)
        else:
            self._ms_beside += _FOLLOW * (self.took_ms - self._ms_beside)

    def newest_position(self) -> F64:
        """Of the newest pose, as `read` has it."""
        kind, key = self._last_pose
        return self._known(kind, key)[: 2 if kind == "se2" else 3]

    def _choose(self) -> tuple[Any, int]:
        """What may be relinearized, and how many variables that eliminates again."""
        candidates = self._candidates()
        few, many = 0, len(candidates)  # the first `few` fit, or are none
        parameters, affected = self._predicted(candidates[many:])
        self.held_back = 0
        if not self._fits(affected) and many:
            for _ in range(_HALVINGS):
                if many - few <= 1:
                    break
                middle = (few + many) // 2
                _, affected = self._predicted(candidates[middle:])
                few, many = (middle, many) if self._fits(affected) else (few, middle)
            parameters, affected = self._predicted(candidates[few:])
            self.held_back = len(candidates) - few
        return parameters, affected

    def _candidates(self) -> I64:
        """Keys of which a component of δ is above the threshold, the largest first."""
        keys = np.array(sorted(key for key in self._dims if self._isam.valueExists(key)), np.int64)
        if not len(keys):
            return keys
        dims = np.array([self._dims[key] for key in keys.tolist()])
        delta: F64 = np.abs(self._isam.getDelta().vector())
        largest = np.maximum.reduceat(delta, np.concatenate(([0], np.cumsum(dims)[:-1])))
        order = np.argsort(-largest, kind="stable")
        return keys[order[largest[order] >= THRESHOLD]]

    def _predicted(self, held_back: I64) -> tuple[Any, int]:
        parameters, held = gtsam.ISAM2UpdateParams(), gtsam.KeyList()
        for key in held_back.tolist():
            held.push_back(key)
        parameters.noRelinKeys = held
        keys, _ = self._isam.predictUpdateInfo(self._graph, self._values, parameters)
        return parameters, keys.size()

    def _fits(self, affected: int) -> bool:
        return self._ms_beside + self._ms_each * affected <= self._budget_ms


class Rival:
    """It takes the steps of a replay one by one, and is judged after each by the χ² of all others.

    failed: why it gave up, or empty.
    """

    def __init__(self, batches: Sequence[Batch], budget_ms: float) -> None:
        self._columns, self._isam2 = columns_of(batches), Isam2WithinBudget(budget_ms)
        self.step_ms, self.chi2, self.held_back = list[float](), list[float](), list[int]()
        self.cpu_s, self.failed = 0.0, ""

    def take(self, batch: Batch) -> None:
        """The next step, unless it has failed."""
        if self.failed:
            return
        isam2, step = self._isam2, len(self.step_ms)
        try:
            isam2.prepare(batch)
            isam2.step()
            isam2.read()
        except Failed as failed:
            self.failed = f"step {step}: {failed}"
            return
        self.step_ms.append(isam2.took_ms)
        self.cpu_s += isam2.took_cpu_s
        self.held_back.append(isam2.held_back)
        self.chi2.append(chi2_at(self._columns, isam2.values(), step))

    def newest_position(self) -> F64:
        """Of the newest pose, (2,) or (3,)."""
        return self._isam2.newest_position()
