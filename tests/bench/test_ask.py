"""The bench of covariances: its numbers hang together, and GTSAM's Marginals agree at the data sets' ends."""

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from bench import ask
from bench.replays.problems import SIMULATED, Problem

from factorbus.solver import Options, Solver, solve_batch
from factorbus.solver.covariance.blocks import CovarianceBlocks


def test_rows_and_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ask, "problem_named", lambda name, poses: SIMULATED[0].shortened(120))
    monkeypatch.setattr(ask, "_CANDIDATES", 200)
    found = ask.run(120)
    assert len(found["targets"]) == 5
    assert found["every_step"]["worst_difference_to_recursion"] < 1e-8
    assert all(target["seen"] > 0 for target in found["targets"])
    assert found["large"]["worst_difference_to_gtsam"] < 0.05
    assert "manhattan" in ask.report(found).lower()


@pytest.mark.data
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", ["intel", "manhattan3500", "city10000"])
def test_blocks_are_gtsam_s_at_the_end_of_a_data_set(datasets: Path, name: str) -> None:
    """At the batch optimum, where both are linearized."""
    assert datasets.is_dir()
    graph = Solver(Options(mode="all-batch"))
    problem: Problem = ask.problem_named(name, 0)
    for batch in ask.load(problem):
        graph.stage(batch)
    graph.step(settle=True)
    assert solve_batch(*graph.graph()).chi2 == pytest.approx(graph.chi2(), rel=1e-9)
    _, worst = ask.time_gtsam(graph, CovarianceBlocks(graph.covariances.factored()).diagonal(), _between)
    assert worst < 1e-7
    assert np.isfinite(worst)


def _between(i: int, j: int, z: gtsam.Pose2, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
    """GTSAM's factor with our residual, MATH (3.2)."""

    def error(_factor: gtsam.CustomFactor, values: gtsam.Values, H: Any) -> np.ndarray:
        first, second = values.atPose2(i), values.atPose2(j)
        d = first.between(second)
        if H is not None:
            back = z.rotation().matrix().T
            H[0], H[1] = -np.eye(3), np.eye(3)
            H[0][:2, :2], H[0][:2, 2] = -back, back @ [d.y(), -d.x()]
            H[1][:2, :2] = back @ d.rotation().matrix()
        relative = z.between(d)
        return np.array([relative.x(), relative.y(), relative.theta()])

    return gtsam.CustomFactor(noise, [i, j], error)
