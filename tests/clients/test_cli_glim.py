"""A map that GLIM has saved on the command line: driven, solved, converted and drawn as any graph file is."""

import json
from pathlib import Path

import pytest
from glim_dumps import pose_graph, saved, square_drive

from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, OK

DRIVE = square_drive(41)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return saved(tmp_path / "dump", DRIVE, factors=pose_graph(DRIVE, [(0, 40)]))


def test_it_is_driven_and_solved(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "dump", "--in-process", "--json", "--tum", "out.tum"]) == OK
    shown = capsys.readouterr()
    driven = json.loads(shown.out)
    assert (driven["poses"], driven["read"]["dialect"]) == (41, "glim")
    assert "dump: 41 submaps of 205 frames, each the pose of the lidar at its middle frame" in shown.err
    assert Path("out.tum").read_text().startswith("1700000000.300000001 ")
    assert main(["solve", "dump", "--json"]) == OK
    assert json.loads(capsys.readouterr().out)["chi2"] == pytest.approx(driven["chi2"], rel=1e-6)


def test_it_is_converted_and_drawn(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", "dump", "dump.g2o", "--json"]) == OK
    assert json.loads(capsys.readouterr().out)["poses"] == 41
    assert Path("dump.g2o").read_text().count("EDGE_SE3:QUAT") == 41
    assert main(["plot", "map", "dump", "--out", "dump.svg"]) == OK
    assert Path("dump.svg").stat().st_size > 1000


def test_strict_and_what_is_missing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "graph.bin").unlink()
    assert main(["convert", "dump", "dump.g2o", "--strict"]) == BAD_FILE
    assert (
        "1 graph.bin, there is no such file beside graph.txt; wanted nothing that would be left out"
        in capsys.readouterr().err
    )
    (folder / "000007" / "data.txt").unlink()
    assert main(["replay", "dump", "--in-process"]) == BAD_FILE
    assert "000007/data.txt: it cannot be read (No such file or directory)" in capsys.readouterr().err


def test_a_folder_of_nothing_says_what_could_be_there(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "graph.txt").unlink()
    assert main(["replay", "dump", "--in-process"]) == BAD_FILE
    assert "graph.txt and submaps of a map that GLIM has saved" in capsys.readouterr().err
