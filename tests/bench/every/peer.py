"""The same drives by GTSAM's iSAM2, judged in the same way: by its own error function, and its own batch optimum.

Its residuals of relative poses are logarithms, not those of g2o (MATH §3), so its optimum is near ours but another one.
"""

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
from bench.replays.chi2 import UNIT
from bench.replays.contestants import Failed
from bench.replays.isam2 import Isam2, Isam2Settings

from factorbus.proto.messages import Batch

from .judge import FINE, Look

THRESHOLD, WILDFIRE = 0.1, 1e-3  # relinearizeThreshold; the wildfire threshold is its default.  relinearizeSkip is 1
_COARSE = 1e-4  # of χ²: one pass is exact to a hundredth of it, and GTSAM's passes are dear
_FAR = 1.01
_MOST_PASSES = 50


class Isam2Judge:
    """Takes in GTSAM's factors and judges GTSAM's estimates."""

    def __init__(self) -> None:
        self._graph = gtsam.NonlinearFactorGraph()
        self._odometry: list[Any] = []
        self._optimum, self._fits = 0.0, False

    def take_in(self, factors: Any, values: Any) -> None:
        """The next step: GTSAM's factors, and first values of what is new."""
        self._graph.push_back(factors)
        each = [factors.at(n) for n in range(factors.size())]
        self._odometry = [factor for factor in each if _is_odometry(factor)]
        self._fits = len(each) == values.size() == 1 and len(self._odometry) == 1

    def look(self, estimate: Any) -> Look:
        """Judge an estimate of all variables.

        A step of one new pose and its odometry, which has an exact fit, leaves the optimum as it was: while the
        estimate is near that one, it is not looked for again.  Raises RuntimeError as GTSAM does.
        """
        chi2 = 2 * self._graph.error(estimate)
        if self._fits and chi2 - self._optimum <= (_FAR - 1) * max(self._optimum, UNIT):
            return Look(chi2, min(self._optimum, chi2), max(_root(factor, estimate) for factor in self._odometry), 0)
        self._optimum, values, passes = self._minimize(estimate, chi2)
        excess = [_root(factor, estimate) - _root(factor, values) for factor in self._odometry]
        return Look(chi2, self._optimum, max(excess, default=0.0), passes)

    def _minimize(self, values: Any, chi2: float) -> tuple[float, Any, int]:
        """(χ², values, passes) at the optimum from `values`, where it is `chi2`."""
        ordering = self._graph.orderingCOLAMD()
        for passes in range(1, _MOST_PASSES + 1):
            linear = self._graph.linearize(values)
            delta = linear.optimize(ordering)
            small = chi2 - 2 * linear.error(delta) <= (_COARSE if passes == 1 else FINE) * max(chi2, UNIT)
            trial = values.retract(delta)
            reached = 2 * self._graph.error(trial)
            if reached > chi2 and not small:
                trial = self._damped(values)
                reached = 2 * self._graph.error(trial)
                small = chi2 - reached <= FINE * max(chi2, UNIT)
            if reached <= chi2:
                values, chi2 = trial, reached
            if small:
                break
        return chi2, values, passes

    def _damped(self, values: Any) -> Any:
        """Where Levenberg-Marquardt comes to."""
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(FINE)
        parameters.setAbsoluteErrorTol(0.0)
        return gtsam.LevenbergMarquardtOptimizer(self._graph, values, parameters).optimize()


class Watched(Isam2):
    """iSAM2 as a contestant that shows GTSAM's own values."""

    @property
    def estimate(self) -> Any:
        """After `read`."""
        return self._estimate


def follow_isam2(
    batches: Sequence[Batch], every: int = 1, progress: Callable[[int], None] = lambda _: None
) -> tuple[list[Look], str]:
    """Every `every`-th step and the last one judged; then why it gave up, or was replayed with QR, where that is so.

    With Cholesky, GTSAM takes what a weak prior holds for indeterminate.
    """
    looks, note = _followed(batches, "CHOLESKY", every, progress)
    if "ndeterminate" not in note:
        return looks, note
    looks, again = _followed(batches, "QR", every, progress)
    return looks, f"by QR, since Cholesky gave up at {note}" + (f"; and QR at {again}" if again else "")


def _followed(
    batches: Sequence[Batch], factorization: str, every: int, progress: Callable[[int], None]
) -> tuple[list[Look], str]:
    isam2, judge, looks = Watched(Isam2Settings(THRESHOLD, factorization, WILDFIRE)), Isam2Judge(), []
    for k, batch in enumerate(batches):
        try:
            isam2.prepare(batch)
            judge.take_in(*isam2.prepared())
            isam2.step()
            isam2.read()
            if k % every == every - 1 or k == len(batches) - 1:
                looks.append(judge.look(isam2.estimate))
        except (Failed, RuntimeError) as problem:
            return looks, f"step {k}: {' '.join(str(problem).split())[:120]}"
        progress(k)
    return looks, ""


def _is_odometry(factor: Any) -> bool:
    """Between poses that follow each other."""
    if not isinstance(factor, (gtsam.BetweenFactorPose2, gtsam.BetweenFactorPose3)):
        return False
    i, j = factor.keys()
    return abs(i - j) == 1


def _root(factor: Any, values: Any) -> float:
    return max(2 * factor.error(values), 0.0) ** 0.5
