"""GTSAM's graduated non-convexity as a contestant: a batch at every hundredth pose or so, with all factors until then.

Odometry is known to be right.  A batch starts at the estimate of the one before, and where odometry leads on from it;
the loss is truncated least squares, GTSAM's own choice.
"""

from typing import Any

import gtsam
import numpy as np
from false_closures import is_closure

from factorbus.proto.messages import Batch

from .columns import F64, Values
from .compose import first_values
from .gtsam_factors import gtsam_factors, held
from .isam2 import insert_value, read_kinds

_BELIEVED = 0.5  # a weight: they end at 0 or 1, but for those that are still being decided


class Gnc:
    """What is on the clock: `optimize` of each batch.  every: poses.  Of maps whose poses are in the plane."""

    def __init__(self, every: int) -> None:
        self._every, self._batches = every, 0
        self._graph, self._estimate = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._trusted: list[int] = []
        self._closing: list[int] = []
        self._weights: F64 = np.ones(0)

    def prepare(self, batch: Batch) -> None:
        """GTSAM's factors, and first values composed from the present estimate."""
        for key, (kind, value) in first_values(batch, self._known).items():
            insert_value(self._estimate, kind, key, value)
        for group in batch.variables:
            for key in group.keys.tolist() if group.fixed else ():
                self._add(held(group.kind, key, self._estimate), self._trusted)
        for group in batch.factors:
            for factor, closes in zip(gtsam_factors(group), is_closure(group).tolist(), strict=True):
                self._add(factor, self._closing if closes else self._trusted)

    def step(self) -> None:
        """A batch, where one is due."""
        self._batches += 1
        if self._batches % self._every:
            return
        settings = gtsam.GncLMParams()
        settings.setKnownInliers(self._trusted)
        optimizer = gtsam.GncLMOptimizer(self._graph, self._estimate, settings)
        self._estimate = optimizer.optimize()
        self._weights = np.asarray(optimizer.getWeights())

    def read(self) -> None:
        """Nothing: `optimize` gives the estimate."""

    def values(self) -> Values:
        """Keys in ascending order, as GTSAM keeps them."""
        return read_kinds(self._estimate, ["se2"])

    def believed(self) -> np.ndarray:
        """Of all closures, in their order, whether the last batch had each; later ones count as believed."""
        closing = np.array(self._closing, np.int64)
        seen, believed = closing < self._weights.size, np.ones(closing.size, bool)
        believed[seen] = self._weights[closing[seen]] > _BELIEVED
        return believed

    def _add(self, factor: Any, among: list[int]) -> None:
        among.append(self._graph.size())
        self._graph.add(factor)

    def _known(self, _kind: str, key: int) -> F64:
        pose = self._estimate.atPose2(key)
        return np.array([pose.x(), pose.y(), pose.theta()])
