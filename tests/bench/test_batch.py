"""`bench batch`: the solvers come to one optimum, bars are held against rows, and the whole command on one world."""

import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import batch
from bench.batch_solvers import BATCH_SOLVERS, OURS, OURS_ALONE, PEER, chi2_at_end
from bench.bundle_world import bundle
from bench.replays.contestants import Failed
from bench.replays.worlds import batches, on_torus, torus

from factorbus.cli.driving.columns import merged
from factorbus.proto.messages import Batch
from factorbus.simulate import Spiral, city_trees, manhattan, sphere
from factorbus.simulate.step import POSE
from factorbus.solver import BatchSearch, solve_batch

BATCH = Path(__file__).parent / "batch.py"
WORLDS = {
    "streets": lambda: odometry_of(batches(manhattan(120, 3))),
    "trees": lambda: odometry_of(batches(city_trees(60, 3))),
    "sphere": lambda: odometry_of(batches(sphere(120, 3, spiral=Spiral(20, 6)))),
    "bundle": lambda: bundle(40, 3),
}


def odometry_of(steps: Iterable[Batch]) -> Batch:
    return batch.composed(merged([*steps]))


@pytest.mark.parametrize("world", WORLDS)
def test_all_solvers_come_to_the_same_optimum_however_often(world: str) -> None:
    graph = WORLDS[world]()
    ends: dict[str, float] = {}
    for solver in BATCH_SOLVERS:
        prepared = solver.prepare(graph)
        for _ in range(2):
            prepared.reset()
            end = prepared.run()
            assert end.iterations > 0
            ends.setdefault(solver.name, chi2_at_end(graph, end))
            assert chi2_at_end(graph, end) == pytest.approx(ends[solver.name], rel=1e-9)
    assert min(ends.values()) == pytest.approx(ends[OURS], rel=1e-6)
    assert max(ends.values()) <= batch._THERE * ends[OURS]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_on_a_torus_of_noisy_rotations_odometry_leads_to_the_optimum_that_the_truth_leads_to(seed: int) -> None:
    graph, truth = odometry_of(torus(600, seed, batch._NOISY)), on_torus(np.arange(600))
    true = [group._replace(values=truth[group.keys - POSE]) for group in graph.variables]
    best = solve_batch(true, graph.factors, BatchSearch("values", polish=False))
    found = BATCH_SOLVERS[0].prepare(graph).run()
    assert BATCH_SOLVERS[0].name == OURS
    assert chi2_at_end(graph, found) == pytest.approx(best.chi2, rel=1e-8)


def test_a_bundle_is_what_it_is_said_to_be() -> None:
    graph = bundle(40, 7)
    held, free, points = graph.variables
    assert (held.fixed, len(held.keys), len(free.keys)) == (True, 2, 38)
    found = solve_batch(graph.variables, graph.factors, BatchSearch("values"))
    count = graph.factor_count
    freedom = 2 * count - 6 * len(free.keys) - 3 * len(points.keys)
    assert found.converged
    assert abs(found.chi2 - freedom) < 5.0 * np.sqrt(2.0 * freedom)
    seen = np.unique(graph.factors[0].keys[:, 1], return_counts=True)[1]
    assert seen.min() >= 3


def test_a_lens_with_distortion_is_none_of_the_peers() -> None:
    graph = bundle(20, 7)
    graph.factors[0].measured[:, 7] = 0.01
    for solver in BATCH_SOLVERS:
        if not solver.name.startswith(OURS):
            with pytest.raises(Failed, match="one without distortion"):
                solver.prepare(graph)


def row(solver: str, cpu_s: float, chi2: float = 10.0, status: str = "done") -> dict[str, Any]:
    return {"dataset": "a", "start": "file", "solver": solver, "cpu_s": cpu_s, "chi2": chi2, "status": status}


def missed(*rows: dict[str, Any]) -> list[str]:
    return [each["what"] for each in batch.judged(rows) if not each["met"]]


def test_bars() -> None:
    assert missed(row(OURS, 1.0), row(OURS_ALONE, 0.5), row(PEER, 3.5)) == []
    assert missed(row(OURS, 2.0), row(OURS_ALONE, 0.5), row(PEER, 1.6)) == []  # that start is what they have, too
    assert missed(row(OURS, 1.0), row(OURS_ALONE, 0.1, 11.0), row(PEER, 0.5)) == []  # from there it ends elsewhere
    assert missed(row(OURS, 1.0), row(PEER, 2.0)) == ["gtsam lm over ours, geometric mean of 1"]
    assert missed(row(OURS, 1.0), row("g2o gn", 0.9)) == ["a, file: faster than g2o gn"]
    assert missed(row(OURS, 1.0, 10.1), row("g2o gn", 2.0)) == ["a, file: lowest χ² to 1e-6"]
    assert missed(row(OURS, 1.0), row("g2o gn", 0.1, 11.0)) == []  # it is elsewhere
    assert missed(row(OURS, 1.0), row(PEER, 0.0, 0.0, "failed: indeterminate")) == []


@pytest.mark.timeout(280)
def test_the_command_prints_a_document() -> None:
    arguments = ["--quick", "--only", "streets", "--seed", "5", "--solvers", f"{OURS}; {PEER}", "--json"]
    ran = subprocess.run([sys.executable, str(BATCH), *arguments], capture_output=True, text=True, check=False)
    assert ran.returncode in (0, 1), ran.stderr
    told = json.loads(ran.stdout)
    assert told["seed"] == 5
    assert [each["solver"] for each in told["rows"]] == [OURS, PEER]
    ours = told["rows"][0]
    assert {"dataset", "start", "cpu_s", "wall_s", "iterations", "chi2", "versions"} <= set(ours)
    assert ours["chi2"] <= (1 + 1e-6) * told["rows"][1]["chi2"]
    assert 0 < ours["cpu_s"] <= 1.1 * ours["wall_s"] + 0.01
    assert "gtsam" in told["rows"][1]["versions"]


def test_a_solver_that_is_not_there_is_refused() -> None:
    ran = subprocess.run(
        [sys.executable, str(BATCH), "--solvers", "gtsan"], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 1
    assert "there are factorbus; " in ran.stderr
