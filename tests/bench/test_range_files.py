"""Range-aided data sets of GTSAM's wheel: the optimum is GTSAM's, and every step of a replay is at its batch optimum.

Here beacons enter at the file's own places; `ranges` drives the same sets as a front end would that knows none of them.
"""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from bench.every.judge import Judge
from bench.range_drives import DATA, GOATS, PLAZA, file_of, trilaterated
from bench.range_solvers import gtsam_optimum
from bench.ranges import driven, missed

from factorbus.formats import read
from factorbus.solver import Options, Solver, solve_batch

STEPS = 500
WORST = 1.002


def written(name: str, folder: Path) -> Path:
    """The data set as a .pyfg, of tables the first poses."""
    if not (DATA / name).exists():
        pytest.skip(f"this wheel of GTSAM has no {name} in {DATA}")
    return file_of(name, folder, STEPS)


@pytest.mark.parametrize("name", [*GOATS, *PLAZA])
def test_the_optimum_is_that_of_gtsam_s_levenberg_marquardt(tmp_path: Path, name: str) -> None:
    graph = read(written(name, tmp_path), strict=True)
    whole = graph.whole()
    ours = solve_batch(whole.variables, whole.factors)
    assert ours.converged
    assert ours.chi2 == pytest.approx(gtsam_optimum(whole, whole.variables), rel=1e-6)


@pytest.mark.parametrize("name", [*GOATS, *PLAZA])
def test_every_step_of_a_replay_is_at_its_batch_optimum(tmp_path: Path, name: str) -> None:
    graph = read(written(name, tmp_path), strict=True)
    solver, judge = Solver(Options()), Judge()
    converged = 0
    for batch in islice(graph.steps(), STEPS):
        judge.take_in(batch)
        solver.stage(batch)
        report = solver.step()
        if report.converged:
            converged += 1
            assert judge.look(solver.estimate()).ratio <= WORST, batch.variables[0].keys
    assert converged > 0.5 * min(STEPS, graph.poses)
    points = {key for group in solver.estimate() if group.kind == "point2" for key in group.keys.tolist()}
    assert len(points) == graph.landmarks, "every beacon has entered"


def test_a_drive_that_knows_no_beacon_finds_all_of_them_and_ends_at_gtsam_s_optimum() -> None:
    ours, theirs = driven("goats_16", None, 100)
    assert ours["chi2_ratio"] <= WORST
    assert ours["unconverged"] == 0
    assert ours["judged"] == ours["steps"] == theirs["steps"]
    assert abs(ours["optimum_off"]) <= 1e-6
    assert len(ours["entered"]) == 4
    assert not ours["waiting"]
    assert ours["beacon_m"] < 12
    assert abs(ours["beacon_m"] - theirs["beacon_m"]) < 0.01


def test_a_beacon_waits_while_its_ranges_leave_two_places() -> None:
    rng, beacon, sigma = np.random.default_rng(4), np.array([3.0, 12.0]), 0.2
    straight = np.column_stack([np.linspace(0, 10, 20), np.zeros(20)])
    around = np.vstack([straight, np.column_stack([np.full(20, 10.0), np.linspace(0, 8, 20)])])
    for at, is_known in ((straight, False), (around, True)):
        z = np.linalg.norm(at - beacon, axis=1) + rng.normal(0, sigma, len(at))
        place, clear = trilaterated(at, z, np.full(len(at), sigma**-2))
        assert (place is not None) == is_known, clear
    assert place is not None
    assert np.linalg.norm(place - beacon) < 0.5


def test_a_near_straight_way_by_far_beacon_is_not_enough() -> None:
    at = np.column_stack([np.linspace(0, 1, 30), np.linspace(0, 0.01, 30)])
    z = np.linalg.norm(at - (60.0, 80.0), axis=1)
    assert trilaterated(at, z, np.ones(30))[0] is None


def test_what_is_missed_is_said() -> None:
    row = {"dataset": "d", "solver": "factorbus", "cpu_s": 0.5, "chi2_ratio": 1.0, "optimum_off": 0.0}
    peer = row | {"solver": "isam2", "cpu_s": 1.0}
    assert missed([row, peer]) == []
    bad = row | {"cpu_s": 1.1, "chi2_ratio": 1.01, "optimum_off": 1e-5}
    assert [each.split(":")[0] for each in missed([bad, peer])] == ["d"] * 3
