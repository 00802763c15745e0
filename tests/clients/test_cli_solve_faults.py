"""`factorbus solve` where something is wrong: options that do not go together, files that cannot be written whole,
graphs at the edge of what numbers can say."""

import json
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from factorbus.cli.driving import solving
from factorbus.cli.driving.columns import merged
from factorbus.cli.main import main
from factorbus.cli.output.exits import FAILED, OK, REFUSED, USAGE
from factorbus.formats import read, write_graph, write_kitti, write_tum, write_whole
from factorbus.proto.messages import Batch
from factorbus.simulate import manhattan

INFO3 = "1 0 0 1 0 1"
SQUARE = "".join(f"EDGE_SE2 {k} {(k + 1) % 4} 1 0 1.5 {INFO3}\n" for k in range(4))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "square.g2o").write_text(SQUARE)
    return tmp_path


@pytest.fixture(scope="module")
def town() -> Batch:
    steps = list(manhattan(60, 2))
    return Batch(merged(Batch(tuple(step.truth)) for step in steps).variables, merged(s.batch for s in steps).factors)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """As a disk that is full: what is written beyond `size` bytes of a file is refused by the kernel."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("ending", [".g2o", ".pyfg", ".jrl", ".tum", ".kitti"])
def test_a_file_that_does_not_fit_leaves_the_one_that_was_there(tmp_path: Path, town: Batch, ending: str) -> None:
    path = tmp_path / f"graph{ending}"
    path.write_text("what took an hour\n")
    write = {".tum": write_tum, ".kitti": write_kitti}.get(ending, write_graph)
    with files_of_at_most(1000), pytest.raises(OSError, match="File too large"):
        write(path, town)
    assert path.read_text() == "what took an hour\n"
    assert os.listdir(tmp_path) == [path.name]
    write(path, town)
    assert path.stat().st_size > 1000
    assert os.listdir(tmp_path) == [path.name]


def test_a_link_stays_one_permissions_stay_and_a_pipe_is_written_to(tmp_path: Path) -> None:
    real, link, pipe = tmp_path / "real.tum", tmp_path / "link.tum", tmp_path / "pipe.tum"
    real.write_text("old")
    real.chmod(0o640)
    link.symlink_to(real)
    write_whole(link, "new")
    assert link.is_symlink()
    assert (real.read_text(), real.stat().st_mode & 0o777) == ("new", 0o640)
    os.mkfifo(pipe)
    end = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(pipe, "through")
        assert os.read(end, 100) == b"through"
    finally:
        os.close(end)
    assert sorted(os.listdir(tmp_path)) == ["link.tum", "pipe.tum", "real.tum"]


def test_the_graph_is_written_also_where_the_covariances_cannot_be(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "pipe.csv").symlink_to("/dev/full")
    assert main(["solve", "square.g2o", "--out", "end.g2o", "--covariance", "pipe.csv"]) == FAILED
    said = capsys.readouterr().err
    assert "pipe.csv cannot be written: No space left on device; make room there" in said
    assert "[cannot_write]" in said
    assert read(folder / "end.g2o").poses == 4


@pytest.mark.parametrize("name", ["end.G2O", "end.TUM", "end.Jrl"])
def test_an_ending_in_capitals_is_refused_and_never_means_another_form(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert main(["solve", "square.g2o", "--out", name]) == USAGE
    assert f"{name} does not end in .g2o" in capsys.readouterr().err
    assert not (folder / name).exists()


def test_a_probability_without_gnc_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", "square.g2o", "--probability", "0.5"]) == USAGE
    assert "--probability is of --gnc" in capsys.readouterr().err


def test_more_cores_than_there_are_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", "square.g2o", "--cores", "4096", "--json"]) == OK
    shown = capsys.readouterr()
    assert f"--cores 4096: there are {json.loads(shown.out)['cores']} here" in shown.err


def test_memory_is_said_and_checked_before_false_factors_are_looked_for(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["solve", "square.g2o", "--gnc"]) == OK
    said = capsys.readouterr().err
    assert said.index("memory: ") < said.index("false")
    assert said.count("memory: ") == 1
    monkeypatch.setattr("factorbus.service.process.memory.available", lambda: 1000)
    assert main(["solve", "square.g2o", "--gnc"]) == REFUSED
    said = capsys.readouterr().err
    assert "[too_large]" in said
    assert "false" not in said


def test_covariances_of_a_graph_without_anything_free(folder: Path) -> None:
    (folder / "held.g2o").write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nFIX 0 1\nEDGE_SE2 0 1 1 0 0 {INFO3}\n")
    assert main(["solve", "held.g2o", "--covariance", "all.csv"]) == OK
    assert (folder / "all.csv").read_text() == "key,kind,upper_triangle\n"


def test_keys_may_have_blanks_between_them(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", "square.g2o", "--covariance", "x1, x2", "--json"]) == OK
    assert set(json.loads(capsys.readouterr().out)["covariance"]) == {"x1", "x2"}


def test_what_rounding_left_of_an_exact_fit_has_converged(folder: Path) -> None:
    (folder / "tight.g2o").write_text(
        "VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0 0.1 0 0 0.1 0 1\nEDGE_SE2 1 2 0 0 0 1e13 0 0 1e13 0 1000\n"
    )
    found = solving.run_solve(solving.SolveRequest(Path("tight.g2o")))
    assert found["converged"]
    assert found["iterations"] < 20
    assert found["chi2"] < 1e-15


@pytest.mark.parametrize("away", [0.0, 5e6])
def test_starts_are_told_apart_however_far_the_map_is_from_its_origin(folder: Path, away: float) -> None:
    """A place in UTM coordinates is millions of metres from the origin; a start that is off by metres is another."""
    corners = ((0, 0), (1.5, -0.5), (0.7, 1.9), (-0.8, 1.2))
    vertices = "".join(f"VERTEX_SE2 {k} {x + away!r} {y - away!r} {1.2 * k}\n" for k, (x, y) in enumerate(corners))
    (folder / "utm.g2o").write_text(f"{vertices}FIX 0\n{SQUARE}")
    found = solving.run_solve(solving.SolveRequest(Path("utm.g2o")))
    assert set(found["starts"]) == {"file", "odometry", "rotations"}
    assert found["chi2"] == pytest.approx(0.0200485, rel=1e-3)


def test_the_same_start_with_its_rotations_written_otherwise_is_not_tried_twice(folder: Path) -> None:
    """θ + 2π and −q are as far from θ and q as numbers are, and the same rotations."""
    turn = 2 * np.pi
    composed = ((0, 0, 0), (1, 0, 1.5), (1.0707372, 0.9974950, 3.0 - turn), (0.0807447, 1.1386150, 4.5 - turn))
    vertices = "".join(f"VERTEX_SE2 {k} {x} {y} {theta}\n" for k, (x, y, theta) in enumerate(composed))
    (folder / "turned.g2o").write_text(f"{vertices}FIX 0\n{SQUARE}")
    assert len(solving.run_solve(solving.SolveRequest(Path("turned.g2o")))["starts"]) == 2


def test_a_tukey_loss_far_above_all_residuals_is_none(folder: Path) -> None:
    plain = solving.run_solve(solving.SolveRequest(Path("square.g2o")))
    wide = solving.run_solve(solving.SolveRequest(Path("square.g2o"), loss=("tukey", 1e7)))
    assert wide["converged"]
    assert wide["chi2"] == pytest.approx(plain["chi2"], rel=1e-9)


def test_gnc_says_that_it_trusts_priors(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    priors = "".join(f"EDGE_PRIOR_SE2 {k} {x} {y} 0 100 0 0 100 0 100\n" for k, x, y in ((0, 0, 0), (2, 9, 9)))
    (folder / "priors.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n" + priors)
    assert main(["solve", "priors.g2o", "--gnc", "--json"]) == OK
    told, said = capsys.readouterr()
    assert json.loads(told)["gnc"] == {"suspects": 0, "false": [], "trusted": 2}
    assert "2 factors of one variable (priors, positions) trusted" in said
