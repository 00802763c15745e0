"""Optima known from elsewhere: GTSAM on the same graph, and the reference table of the public data sets."""

import time
from pathlib import Path

import gtsam
import numpy as np
import pytest
from naive.dense_least_squares import full

from factorbus.formats import read
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import city_trees, manhattan
from factorbus.solver import Options, Solver, solve_batch
from factorbus.solver.kernels.bayes_tree.thresholds import LEAST_CHI2

# χ² at the optimum in g2o's convention, vertex 0 held fixed: file → (optimum, relative, absolute tolerance).
OPTIMA = {
    "intel": (546.46111, 1e-6, 0.0),
    "killian": (5.760417e-8, 0.0, 1e-6),
    "killian_freiburg": (10344.6653, 1e-6, 0.0),
    "manhattan3500": (6532.7447, 1e-6, 0.0),
    "citytrees10000": (8668.9281, 1e-6, 0.0),
    "victoria_park": (6184.1206, 1e-6, 0.0),
    "sphere2500": (727.1492, 1e-6, 0.0),
    "city10000": (31931.4120, 1e-6, 0.0),
    "w10000": (171545.447, 1e-6, 0.0),
    "w10000_toro": (289.72589, 1e-6, 0.0),
    # Its information matrices are nearly singular: χ² is flat below the sixth digit.
    "parking_garage": (1.238688, 1e-5, 0.0),
}
_ORDINARY = ("intel", "killian")


def replay(path: Path) -> tuple[Solver, float]:
    """Pose by pose, then settled; gives the solver and the χ² of its last ordinary step."""
    solver = Solver()
    chi2 = 0.0
    for batch in read(path).steps():
        solver.stage(batch)
        report = solver.step()
        assert (
            report.chi2 <= (1 + Options().converged_share) * report.chi2_before + LEAST_CHI2
        )  # else it would have been replaced
        chi2 = report.chi2
    solver.step(settle=True)
    return solver, chi2


@pytest.mark.timeout(3000)
@pytest.mark.parametrize(
    "name", [name if name in _ORDINARY else pytest.param(name, marks=pytest.mark.data) for name in OPTIMA]
)
def test_a_replay_ends_at_the_reference_optimum(datasets: Path, name: str) -> None:
    optimum, relative, absolute = OPTIMA[name]
    start = time.thread_time()
    solver, before = replay(datasets / f"{name}.g2o")
    print(f"{name}: {time.thread_time() - start:.1f} s, χ² {before:.9g}, settled {solver.chi2():.12g}")
    assert solver.chi2() == pytest.approx(optimum, rel=relative, abs=absolute)
    assert before == pytest.approx(optimum, rel=5e-4, abs=1e-6)


@pytest.mark.parametrize(("mode", "relative"), [("all-batch", 1e-5), ("inc-l", 1e-4)])
@pytest.mark.parametrize("name", ["killian_freiburg", "manhattan3500", "sphere2500", "citytrees10000", "victoria_park"])
def test_the_first_steps_of_a_replay_are_at_the_batch_optimum_of_what_they_have(
    datasets: Path, name: str, mode: str, relative: float
) -> None:
    solver = Solver(Options(mode=mode))
    for batch, _ in zip(read(datasets / f"{name}.g2o").steps(), range(400), strict=False):
        solver.stage(batch)
        solver.step()
    assert solver.chi2() == pytest.approx(solve_batch(*solver.graph()).chi2, rel=relative, abs=1e-9)


@pytest.mark.parametrize("world", [manhattan, city_trees])
def test_the_optimum_is_gtsams(world) -> None:
    """In the plane with isotropic noise on x and y, GTSAM's residuals have the same χ² as ours to first order only; so
    its optimum is evaluated with our χ², and ours with its own: each must be best by its own measure."""
    solver = Solver()
    for step in world(poses=150, seed=2):
        solver.stage(Batch(step.batch.variables, tuple(map(as_bearing_range, step.batch.factors))))
        solver.step()
    ours = solver.step(settle=True).chi2
    variables, factors = solver.graph()
    graph, values = gtsam_problem(variables, factors)
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-15)
    params.setAbsoluteErrorTol(1e-15)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    at_theirs = chi2_at(variables, factors, theirs)
    assert ours <= at_theirs * (1 + 1e-12)
    assert 2 * graph.error(theirs) <= 2 * graph.error(values) * (1 + 1e-12)
    assert ours == pytest.approx(at_theirs, rel=1e-3)
    assert 2 * graph.error(values) == pytest.approx(ours, rel=1e-2)


def as_bearing_range(group: Factors) -> Factors:
    """Observations of points as bearing and range, which GTSAM has too; other factors as they are."""
    if group.kind != "landmark_se2":
        return group
    x, y = group.measured.T
    z = np.stack([np.arctan2(y, x), np.hypot(x, y)], axis=1)
    return Factors("bearing_range_se2", group.keys, z, np.tile([2000.0, 0.0, 100.0], (len(z), 1)))


def gtsam_problem(variables, factors) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for group in variables:
        for key, value in zip(group.keys.tolist(), group.values, strict=True):
            if group.kind == "se2":
                values.insert(key, gtsam.Pose2(*value))
                if group.fixed:
                    graph.add(gtsam.NonlinearEqualityPose2(key, gtsam.Pose2(*value)))
            else:
                values.insert(key, gtsam.Point2(*value))
    for group in factors:
        for keys, z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            if group.kind == "between_se2":
                noise = gtsam.noiseModel.Gaussian.Information(full(upper))
                graph.add(gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(*z), noise))
            elif group.kind == "bearing_range_se2":
                noise = gtsam.noiseModel.Gaussian.Information(full(upper))
                graph.add(gtsam.BearingRangeFactor2D(*keys, gtsam.Rot2(z[0]), z[1], noise))
            else:
                raise AssertionError(f"{group.kind} has no factor of the same χ² in gtsam")
    return graph, values


def chi2_at(variables, factors, values: gtsam.Values) -> float:
    moved = []
    for group in variables:
        rows = []
        for key in group.keys.tolist():
            if group.kind == "se2":
                pose = values.atPose2(key)
                rows.append([pose.x(), pose.y(), pose.theta()])
            else:
                rows.append(values.atPoint2(key))
        moved.append(Variables(group.kind, group.keys, np.array(rows, float), group.fixed))
    solver = Solver()
    solver.stage(Batch(tuple(moved), tuple(factors)))
    return solver.step().chi2_before
