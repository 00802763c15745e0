"""GTSAM's iSAM2 as a contestant (Gauss-Newton; its own wildfire threshold is 1e-3, its relinearizeSkip 10).

Its wheel has no factor for a landmark seen as (x, y), so an observation goes in as bearing and range with the
covariance carried over to first order at the measurement,  Σ_br = J Ω⁻¹ Jᵀ,  J = ∂(bearing, range)/∂(x, y).  Its
optimum is thus close to ours but not the same: judged by our χ² it is 0.5 % above ours on victoria_park, 5e-5 on
citytrees10000.  In space a rotation is judged by its rotation vector φ ≈ 2 · (qx, qy, qz), rotation first, so the
information of the quaternion's vector part is divided by four.  GTSAM's own reader of g2o files does not do that; on
request this is as it does, another problem than ours then.  (On parking_garage, whose information is nearly singular,
iSAM2 with Cholesky goes through only so.)
"""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import gtsam
import numpy as np

from factorbus.proto.messages import Batch

from .columns import F64, Values
from .compose import first_values
from .contestants import Failed
from .gtsam_factors import gtsam_factors, held, pose3

Prepared: TypeAlias = tuple[Any, Any]  # GTSAM's graph and values of a step


class Isam2Settings(NamedTuple):
    """By GTSAM's names; skip: relinearizeSkip, whose own value is 10; partial: enablePartialRelinearizationCheck;
    adaptive: enableAdaptiveReorder.  as_gtsam_reads: the information of rotations."""

    threshold: float
    factorization: str = "CHOLESKY"
    wildfire: float = 1e-3
    skip: int = 1
    adaptive: bool = False
    partial: bool = False
    as_gtsam_reads: bool = False

    def made(self) -> Any:
        """GTSAM's object."""
        parameters, search = gtsam.ISAM2Params(), gtsam.ISAM2GaussNewtonParams()
        search.setWildfireThreshold(self.wildfire)
        parameters.setOptimizationParams(search)
        parameters.setRelinearizeThreshold(self.threshold)
        parameters.setFactorization(self.factorization)
        parameters.relinearizeSkip = self.skip
        parameters.enableAdaptiveReorder = self.adaptive
        parameters.enablePartialRelinearizationCheck = self.partial
        return gtsam.ISAM2(parameters)


class Isam2:
    """What is on the clock: `update`, with the back-substitution for the newest pose that it may leave undone; then,
    as reading, `calculateEstimate`."""

    def __init__(self, settings: "Isam2Settings") -> None:
        self._isam, self._as_gtsam_reads = settings.made(), settings.as_gtsam_reads
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._estimate = gtsam.Values()
        self._last_pose = ("se2", -1)
        self._kinds: set[str] = set()
        self._sums = {"relinearized": 0, "eliminated": 0}
        self._updates = 0
        self._result: Any = None

    def prepare(self, batch: Batch) -> None:
        """GTSAM's factors, and first values composed from the present estimate."""
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._count()
        for key, (kind, value) in first_values(batch, self._known).items():
            insert_value(self._values, kind, key, value)
            self._kinds.add(kind)
            if kind in ("se2", "se3"):
                self._last_pose = (kind, key)
        for group in batch.variables:
            if group.fixed:
                for key in group.keys.tolist():
                    self._graph.add(held(group.kind, key, self._values))
        for group in batch.factors:
            for factor in gtsam_factors(group, self._as_gtsam_reads):
                self._graph.add(factor)
        self._estimate = gtsam.Values()  # taking the old one down is not on the clock

    def prepared(self) -> "Prepared":
        """What the next `step` is going to take in."""
        return self._graph, self._values

    def step(self) -> None:
        """Raises Failed."""
        self._update()

    def _update(self, *beside: Any) -> None:
        """With the newest pose.  Raises Failed: an indeterminate system comes as RuntimeError."""
        kind, key = self._last_pose
        try:
            self._result = self._isam.update(self._graph, self._values, *beside)
            if kind == "se2":
                self._isam.calculateEstimatePose2(key)
            else:
                self._isam.calculateEstimatePose3(key)
        except RuntimeError as problem:
            raise _failed(problem) from problem

    def read(self) -> None:
        """All variables."""
        self._estimate = self._isam.calculateEstimate()

    def values(self) -> Values:
        """Keys in ascending order, as GTSAM keeps them."""
        return read_kinds(self._estimate, self._kinds)

    def own_chi2(self) -> float:
        """What GTSAM has for χ²: twice the error of its factors at the estimate."""
        return 2 * self._isam.getFactorsUnsafe().error(self._estimate)

    def facts(self) -> dict[str, Any]:
        """nnz_r counts the scalars of all cliques of the Bayes tree."""
        self._count()
        return {"nnz_r": int(self._isam.treeNnz()), "strategies": {"update": self._updates}, **self._sums}

    def _count(self) -> None:
        if self._result is not None:
            self._sums["relinearized"] += self._result.getVariablesRelinearized()
            self._sums["eliminated"] += self._result.getVariablesReeliminated()
            self._updates, self._result = self._updates + 1, None

    def _known(self, kind: str, key: int) -> F64:
        if kind == "se2":
            pose = self._estimate.atPose2(key)
            return np.array([pose.x(), pose.y(), pose.theta()])
        if kind == "se3":
            pose = self._estimate.atPose3(key)
            return np.concatenate((pose.translation(), pose.rotation().toQuaternion().coeffs()))
        return np.asarray(self._estimate.atPoint2(key))


class Isam2Alone:
    """What is on the clock: `update`.

    iSAM2 leaves the back-substitution of a step to the next `update`, or to the first who asks for an estimate before
    that.  First values are composed from the estimate, so one who composes them during the replay takes that work off
    the clock.  Hence a rehearsal, with estimates; what it composed is what the replay itself takes in, which asks for
    nothing.
    """

    def __init__(self, settings: "Isam2Settings") -> None:
        self._settings, self._isam = settings, settings.made()
        self._plan: list[Prepared] = []
        self._sampled: dict[int, Values] = {}
        self._refused: Failed | None = None
        self._read_s, self._at = 0.0, -1
        self._next: Prepared = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def rehearse(
        self, steps: Sequence[Batch], samples: set[int], progress: Callable[[int], None] = lambda _: None
    ) -> None:
        """Replay with estimates, as far as that goes."""
        rehearsed = Isam2(self._settings)
        for k, batch in enumerate(steps):
            try:
                rehearsed.prepare(batch)
                self._plan.append(rehearsed.prepared())
                rehearsed.step()
            except Failed as problem:
                self._refused = problem
                return
            start = time.process_time()
            rehearsed.read()
            self._read_s += time.process_time() - start
            if k in samples:
                self._sampled[k] = rehearsed.values()
            progress(k)

    def prepare(self, batch: Batch) -> None:
        """The step as rehearsed.  Raises Failed."""
        self._at += 1
        if self._at >= len(self._plan):
            raise self._refused or Failed("not rehearsed")
        self._next, self._plan[self._at] = self._plan[self._at], (None, None)

    def step(self) -> None:
        """Raises Failed."""
        try:
            self._isam.update(*self._next)
        except RuntimeError as problem:
            raise _failed(problem) from problem

    def read(self) -> None:
        """Nothing: that is timed in the rehearsal."""

    def values(self) -> Values:
        """As in the rehearsal."""
        return self._sampled[self._at]

    def facts(self) -> dict[str, Any]:
        """read_s: seconds of calculateEstimate after every step, back-substitution not counted.

        Raises RuntimeError when the replay has not come to what was rehearsed; with a `skip` it comes to what
        relinearizations that were made on other δ leave, so it need not be the same.
        """
        estimate = self._isam.calculateEstimate()
        for kind, (keys, numbers) in self._sampled[self._at].items():
            extract, letter = _EXTRACT[kind]
            again = extract(estimate)
            same = self._settings.skip > 1 or np.allclose(again, numbers, rtol=0, atol=1e-9)
            if len(again) != len(keys) or not same:
                raise RuntimeError(f"iSAM2's estimate of {chr(letter)} is another one than in the rehearsal")
        return {"nnz_r": int(self._isam.treeNnz()), "strategies": {"update": self._at + 1}, "read_s": self._read_s}


def read_kinds(values: Any, kinds: Iterable[str]) -> Values:
    """Of variables of some kinds, keys in ascending order, as GTSAM keeps them."""
    keys = np.array(list(values.keys()), np.int64)
    letters, found = keys >> 56, {}
    for kind in kinds:
        extract, letter = _EXTRACT[kind]
        found[kind] = (keys[letters == letter], extract(values))
    return found


def _failed(problem: RuntimeError) -> Failed:
    return Failed(" ".join(str(problem).split())[:200] or "RuntimeError without words")


def insert_value(values: Any, kind: str, key: int, value: F64) -> None:
    """Into GTSAM's values, a row as ours are."""
    if kind == "se2":
        values.insert(key, gtsam.Pose2(*value.tolist()))
    elif kind == "se3":
        values.insert(key, pose3(value))
    else:
        values.insert(key, np.ascontiguousarray(value))


def _extract_pose3(values: Any) -> F64:
    from scipy.spatial.transform import Rotation

    rows = gtsam.utilities.extractPose3(values)
    return np.concatenate((rows[:, 9:], Rotation.from_matrix(rows[:, :9].reshape(-1, 3, 3)).as_quat()), axis=1)


_EXTRACT = {
    "se2": (lambda values: gtsam.utilities.extractPose2(values), ord("x")),
    "se3": (_extract_pose3, ord("x")),
    "point2": (lambda values: gtsam.utilities.extractPoint2(values), ord("l")),
    "point3": (lambda values: gtsam.utilities.extractPoint3(values), ord("l")),
}
