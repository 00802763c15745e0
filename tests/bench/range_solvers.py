"""A range-only drive, step by step, by our solver and by iSAM2; and GTSAM's optimum of our objective.

The wheel's BetweenFactorPose2 measures its error by the logarithm, ours is that of g2o (MATH (3.2)): another
objective, 2.8e-6 apart at the optimum of goats_16.  iSAM2 gets the wheel's own factors, so each is held against the
optimum of its own objective; `gtsam_optimum` gets relative poses as a factor with our residual, and its own ranges.
"""

import time
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import gtsam
import numpy as np
from bench.every.judge import Judge
from bench.replays.columns import F64, symmetric
from bench.replays.compose import first_values
from bench.replays.gtsam_factors import gtsam_factors, held

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.version import __version__
from factorbus.solver import Options, Solver


class Ours:
    """The default mode of our solver."""

    versions = f"factorbus {__version__}"

    def __init__(self) -> None:
        self._solver, self._judge = Solver(Options()), Judge()
        self.converged = False

    def step(self, batch: Batch) -> float:
        """Take in a batch and estimate; CPU seconds, with reading all estimates."""
        before = time.process_time()
        self._solver.stage(batch)
        self.converged = self._solver.step().converged
        self._estimate = self._solver.estimate()
        took = time.process_time() - before
        self._judge.take_in(batch)
        return took

    def places(self) -> dict[int, F64]:
        """Of all variables at the estimate."""
        return {
            key: row for group in self._estimate for key, row in zip(group.keys.tolist(), group.values, strict=True)
        }

    def ratio(self) -> float:
        """χ² of the estimate over that of its batch optimum."""
        return self._judge.look(self._estimate).ratio

    def settle(self) -> tuple[float, Batch]:
        """(χ² where it comes to rest, the graph with its values there)."""
        self._solver.step(settle=True)
        self._estimate = self._solver.estimate()
        variables, factors = self._solver.graph()
        return self._solver.chi2(), Batch(
            tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in variables),
            tuple(Factors(g.kind, g.keys, g.measured, g.information) for g in factors),
        )


class Isam2:
    """GTSAM's: what moved by 0.1 is relinearized, looked at in every step."""

    versions = f"gtsam {version('gtsam')}"

    def __init__(self) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(0.1)
        parameters.relinearizeSkip = 1
        self._isam, self._all, self.converged = gtsam.ISAM2(parameters), gtsam.NonlinearFactorGraph(), True
        self._estimate = gtsam.Values()

    def step(self, batch: Batch) -> float:
        """Take in a batch; CPU seconds of update() alone."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, (kind, value) in first_values(batch, self._known).items():
            values.insert(key, gtsam.Pose2(*value.tolist()) if kind == "se2" else np.ascontiguousarray(value))
        for group in batch.variables:
            for key in group.keys.tolist() if group.fixed else ():
                graph.add(held(group.kind, key, values))
        for group in batch.factors:
            for factor in gtsam_factors(group):
                graph.add(factor)
        before = time.process_time()
        self._isam.update(graph, values)
        took = time.process_time() - before
        self._estimate = self._isam.calculateEstimate()
        self._all.push_back(graph)
        return took

    def places(self) -> dict[int, F64]:
        """Of all variables at the estimate: x and y."""
        poses = gtsam.utilities.allPose2s(self._estimate)
        points = gtsam.utilities.extractPoint2(self._estimate)
        keys = [key for key in self._estimate.keys() if not poses.exists(key)]  # noqa: SIM118  (not a dict)
        found = dict(zip(poses.keys(), gtsam.utilities.extractPose2(poses), strict=True))
        return found | dict(zip(keys, points, strict=True))

    def ratio(self) -> float:
        """χ² of the estimate over that of Levenberg-Marquardt's optimum from there."""
        best = 2 * self._all.error(gtsam.LevenbergMarquardtOptimizer(self._all, self._estimate).optimize())
        chi2 = 2 * self._all.error(self._estimate)
        return max(chi2 / best if best > 1.0 else 1.0 + chi2 - best, 1.0)

    def _known(self, kind: str, key: int) -> F64:
        if kind != "se2":
            return np.asarray(self._estimate.atPoint2(key))
        pose = self._estimate.atPose2(key)
        return np.array([pose.x(), pose.y(), pose.theta()])


def gtsam_optimum(batch: Batch, estimate: Any) -> float:
    """χ² at the end of GTSAM's Levenberg-Marquardt from `estimate`."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for group in estimate:
        for key, row in zip(group.keys.tolist(), group.values, strict=True):
            values.insert(key, gtsam.Pose2(*row.tolist()) if group.kind == "se2" else row.copy())
    for group in batch.factors:
        for factor in relative_poses(group) if group.kind == "between_se2" else gtsam_factors(group):
            graph.add(factor)
    for key in (key for group in batch.variables if group.fixed for key in group.keys.tolist()):
        graph.add(gtsam.NonlinearEqualityPose2(key, values.atPose2(key)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-13)
    params.setAbsoluteErrorTol(1e-13)
    params.setMaxIterations(200)
    return 2 * graph.error(gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize())


def relative_poses(group: Factors) -> Iterator[Any]:
    """As GTSAM's factors with the residual (3.2): E = z⁻¹ a⁻¹ b as (x, y, θ)."""
    rows = zip(group.keys.tolist(), group.measured, symmetric(group.information), strict=True)
    for keys, z, information in rows:
        measured = gtsam.Pose2(*z.tolist())

        def error(_: Any, values: Any, jacobians: Any, ends: list[int] = keys, measured: Any = measured) -> np.ndarray:
            relative = values.atPose2(ends[0]).between(values.atPose2(ends[1]))
            E = measured.between(relative)
            if jacobians is not None:
                B = np.eye(3)
                B[:2, :2] = E.rotation().matrix()
                jacobians[0], jacobians[1] = -B @ relative.inverse().AdjointMap(), B
            return np.array([E.x(), E.y(), E.theta()])

        yield gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Information(information), keys, error)


SOLVERS: dict[str, Any] = {"factorbus": Ours, "isam2": Isam2}
