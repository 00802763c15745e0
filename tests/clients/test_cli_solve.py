"""`factorbus solve`: a whole graph file at its optimum, and what the command says, writes and refuses."""

import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from factorbus.cli.driving import solving
from factorbus.cli.driving.columns import merged
from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, FAILED, OK, REFUSED, USAGE
from factorbus.formats import read, write_graph
from factorbus.proto.messages import Batch, Factors
from factorbus.simulate import Spiral, manhattan, sphere
from factorbus.solver import chi2_at

INFO3 = "1 0 0 1 0 1"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def streets(folder: Path, poses: int = 300, seed: int = 2) -> Batch:
    """A world, in town.g2o without values."""
    graph = merged(step.batch for step in manhattan(poses, seed))
    write_graph(folder / "town.g2o", graph)
    return graph


def solved(capsys: pytest.CaptureFixture[str], *words: str, code: int = OK) -> dict[str, Any]:
    """The document of a run."""
    capsys.readouterr()
    assert main(["solve", *words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


def gtsam_chi2(graph: Batch, values: Any) -> float:
    """χ² of the lowest that GTSAM's Levenberg-Marquardt comes to, by factors with isotropic weights of a plane."""
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for group in values:
        for key, row in zip(group.keys.tolist(), group.values, strict=True):
            start.insert(key, gtsam.Pose2(*row.tolist()))
    for group in graph.factors:
        for ends, z, packed in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            model = gtsam.noiseModel.Diagonal.Precisions(packed[[0, 3, 5]])
            factors.add(gtsam.BetweenFactorPose2(*ends, gtsam.Pose2(*z.tolist()), model))
    (first,) = [group for group in values if group.fixed]
    factors.add(gtsam.NonlinearEqualityPose2(int(first.keys[0]), gtsam.Pose2(*first.values[0].tolist())))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-13)
    end = gtsam.LevenbergMarquardtOptimizer(factors, start, parameters).optimize()
    poses = [
        group._replace(values=np.array([[p.x(), p.y(), p.theta()] for p in map(end.atPose2, group.keys.tolist())]))
        for group in values
    ]
    return chi2_at(graph.variables, graph.factors, poses)


def test_streets_end_at_gtsams_optimum_and_are_written(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph = streets(folder)
    told = solved(capsys, "town.g2o", "--out", "optimum.g2o")
    assert (told["poses"], told["factors"], told["converged"]) == (300, graph.factor_count, True)
    assert set(told["starts"]) == {"odometry", "rotations"}
    assert told["start"] in told["starts"]
    assert told["left"] <= 1e-9 * told["chi2"]
    assert told["memory_bytes"] > 0
    end = read(folder / "optimum.g2o").whole()
    assert chi2_at(end.variables, graph.factors, end.variables) == pytest.approx(told["chi2"], rel=1e-9)
    assert told["chi2"] == pytest.approx(gtsam_chi2(graph, end.variables), rel=1e-6)
    assert told["chi2"] <= gtsam_chi2(graph, end.variables) * (1 + 1e-12)
    again = solved(capsys, "optimum.g2o", "--start", "file")
    assert again["start"] == "file"
    assert again["chi2"] == pytest.approx(told["chi2"], rel=1e-9)


@pytest.mark.parametrize("start", ["odometry", "rotations"])
def test_one_start_alone(folder: Path, capsys: pytest.CaptureFixture[str], start: str) -> None:
    streets(folder)
    told = solved(capsys, "town.g2o", "--start", start)
    assert (list(told["starts"]), told["start"]) == ([start], start)
    assert told["chi2"] == pytest.approx(solved(capsys, "town.g2o")["chi2"], rel=1e-9)


def test_a_sphere_of_much_noise_ends_at_the_optimum_from_averaged_rotations(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As low as from the truth, with a standard deviation of 11° about each axis in every factor."""
    steps = list(sphere(300, 1, spiral=Spiral(25, 12), sigma_rotation_rad=0.2))
    graph = merged(step.batch for step in steps)
    write_graph(folder / "sphere.g2o", graph)
    told = solved(capsys, "sphere.g2o")
    assert told["start"] == "rotations"
    truth = merged(Batch(tuple(step.truth)) for step in steps)
    write_graph(folder / "true.g2o", Batch(truth.variables, graph.factors))
    assert told["chi2"] <= solved(capsys, "true.g2o", "--start", "file")["chi2"] * (1 + 1e-9)


def test_progress_is_said_and_the_table_has_the_result(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    streets(folder)
    assert main(["solve", "town.g2o", "--covariance", "x5,x7"]) == OK
    shown = capsys.readouterr()
    assert "memory: " in shown.err
    assert "start rotations: χ² " in shown.err
    assert "rotations 1: χ² " in shown.err
    assert "x7, σ" in shown.out
    assert "iterations" in shown.out


def test_covariances_are_those_of_gtsam(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph = streets(folder, 60)
    told = solved(capsys, "town.g2o", "--covariance", "all.csv", "--out", "end.g2o")
    assert told["written"] == ["end.g2o", "all.csv"]
    rows = {line.split(",")[0]: line.split(",")[1:] for line in (folder / "all.csv").read_text().splitlines()[1:]}
    assert len(rows) == 59
    block = np.array(solved(capsys, "end.g2o", "--covariance", "x40")["covariance"]["x40"])
    assert rows["x40"][0] == "se2"
    np.testing.assert_allclose(np.array(rows["x40"][1:], float), block[np.triu_indices(3)], rtol=1e-5)
    end = {
        key: row
        for group in read(folder / "end.g2o").whole().variables
        for key, row in zip(group.keys.tolist(), group.values, strict=True)
    }
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, row in end.items():
        values.insert(key, gtsam.Pose2(*row.tolist()))
    for group in graph.factors:
        for ends, z, packed in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            model = gtsam.noiseModel.Diagonal.Precisions(packed[[0, 3, 5]])
            factors.add(gtsam.BetweenFactorPose2(*ends, gtsam.Pose2(*z.tolist()), model))
    first = min(end)
    factors.add(gtsam.PriorFactorPose2(first, values.atPose2(first), gtsam.noiseModel.Isotropic.Sigma(3, 1e-7)))
    key = sorted(end)[40]
    np.testing.assert_allclose(block, gtsam.Marginals(factors, values).marginalCovariance(key), rtol=2e-2, atol=1e-9)


def test_false_loops_are_left_out_by_gnc_and_bent_to_by_none(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph = streets(folder)
    clean = solved(capsys, "town.g2o")["chi2"]
    rng = np.random.default_rng(4)
    keys = np.concatenate([group.keys for group in graph.variables])
    pairs = np.sort(rng.choice(keys, (12, 2), replace=False), axis=1)
    false = Factors("between_se2", pairs, rng.uniform(-3, 3, (12, 3)), np.tile([400.0, 0, 0, 400, 0, 400], (12, 1)))
    write_graph(folder / "false.g2o", Batch(graph.variables, (*graph.factors, false)))
    assert solved(capsys, "false.g2o")["chi2"] > 5 * clean
    told = solved(capsys, "false.g2o", "--gnc", "--out", "mended.g2o")
    found = {tuple(each["keys"]) for each in told["gnc"]["false"]}
    planted = {tuple(f"x{key & 0xFFFFFFFF}" for key in pair) for pair in pairs.tolist()}
    assert planted <= found
    assert len(found) <= 12 + 0.05 * told["gnc"]["suspects"]
    assert told["chi2"] <= clean
    assert read(folder / "mended.g2o").batch.factor_count == graph.factor_count + 12 - len(found)
    robust = solved(capsys, "false.g2o", "--loss", "dcs:1.0")
    assert robust["loss"] == {"name": "dcs", "scale": 1.0, "factors": told["gnc"]["suspects"]}
    assert robust["chi2"] < 2 * clean


def test_trajectories_and_other_formats(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    streets(folder, 40)
    for name in ("end.tum", "end.kitti", "end.jrl", "end.pyfg"):
        assert solved(capsys, "town.g2o", "--out", name)["written"] == [name]
        assert (folder / name).stat().st_size > 500
    for name in ("end.jrl", "end.pyfg"):
        assert solved(capsys, name)["chi2"] == pytest.approx(solved(capsys, "town.g2o")["chi2"], rel=1e-6)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["nowhere.g2o"], BAD_FILE, "[bad_file]"),
        (["broken.g2o"], BAD_FILE, "broken.g2o:1"),
        (["bare.g2o", "--start", "file"], BAD_FILE, "no value of a variable to start from"),
        (["bare.g2o", "--covariance", "x77"], USAGE, "has no variable x77"),
        (["bare.g2o", "--covariance", "x-"], USAGE, "'x-'"),
        (["bare.g2o", "--loss", "hubert:1"], USAGE, "there is no loss 'hubert'"),
        (["bare.g2o", "--loss", "huber:0"], USAGE, "--loss"),
        (["bare.g2o", "--out", "end.png"], USAGE, "does not end in"),
        (["bare.g2o", "--max-iterations", "0"], USAGE, "--max-iterations"),
        (["loose.g2o"], REFUSED, "[underconstrained]"),
        (["loose.g2o"], REFUSED, "x2"),
    ],
)
def test_what_cannot_be_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, said: str
) -> None:
    edges = "".join(f"EDGE_SE2 {k} {(k + 1) % 4} 1 0 1.5 {INFO3}\n" for k in range(4))
    (folder / "bare.g2o").write_text(edges)
    (folder / "broken.g2o").write_text("EDGE_SE2 0 1 1 0\n")
    (folder / "loose.g2o").write_text(
        "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in range(4))
        + f"VERTEX_XY 4 2 1\nFIX 0\nEDGE_SE2 0 1 1 0 0 {INFO3}\nEDGE_SE2 2 3 1 0 0 {INFO3}\n"
        + "EDGE_SE2_XY 1 4 1 1 1 0 1\nEDGE_SE2_XY 3 4 -1 1 1 0 1\n"  # the second half may turn about the landmark
    )
    assert main(["solve", *words]) == code
    assert said in capsys.readouterr().err


def test_what_needs_more_memory_than_there_is_is_refused_before_it_is_tried(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    streets(folder, 40)
    monkeypatch.setattr("factorbus.service.process.memory.available", lambda: 10_000)
    assert main(["solve", "town.g2o", "--out", "end.g2o"]) == REFUSED
    shown = capsys.readouterr()
    assert "[too_large]" in shown.err
    assert "the limit is 10000" in shown.err
    assert "start rotations" not in shown.err
    assert not (folder / "end.g2o").exists()


def test_a_search_that_is_cut_short_says_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    streets(folder)
    told = solved(capsys, "town.g2o", "--start", "odometry", "--max-iterations", "1", code=FAILED)
    assert not told["converged"]
    assert told["iterations"] <= 1


def test_worker_threads_change_no_bit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same bits with another core, threads of which begin only once a graph is large."""
    streets(folder)
    request = solving.SolveRequest(Path("town.g2o"), cores=1)
    alone = solving.run_solve(request)
    monkeypatch.setattr("factorbus.cli.driving.optimum.WorkerCores._FROM_BYTES", 1)
    together = solving.run_solve(solving.SolveRequest(Path("town.g2o"), cores=2))
    assert together["chi2"] == alone["chi2"]
