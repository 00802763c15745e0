"""Graph files on the command line: what is left out is said once, in the document too, and options decide."""

import json
from pathlib import Path

import numpy as np
import pytest

from factorbus.cli.commands.convert import _written
from factorbus.cli.driving.columns import merged
from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, OK, REFUSED, USAGE
from factorbus.cli.process import reading
from factorbus.formats import GRAPHS, IDS, READS, GraphFile, read
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol

INFO3 = "1 0 0 1 0 1"
LOOP = "".join(f"EDGE_SE2 {k} {(k + 1) % 4} 1 0 1.5 {INFO3}\n" for k in range(4))
MORE = LOOP + "ROBOTLASER1 0 1 2\nROBOTLASER1 1 1 2\nVERTEX_SE2 9 0 0 0\n"
SLAMPP = "".join(f"EDGE2 {i} {j} 1 0 1.57 45 0 0 45 0 400\n" for i, j in ((0, 1), (1, 2), (0, 2)))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def robots() -> str:
    """a0 a2 a4 and b1 b3 b5, each in a row, as GTSAM numbers them."""
    lines = []
    for letter, first, y in (("a", 0, 0), ("b", 1, 100)):
        keys = [symbol(letter, first + 2 * k) for k in range(3)]
        lines += [f"VERTEX_SE2 {key} {k} {y} 0" for k, key in enumerate(keys)]
        lines += [f"EDGE_SE2 {keys[k]} {keys[k + 1]} 1 0 0 {INFO3}" for k in range(2)]
    return "\n".join(lines) + "\n"


def test_the_options_are_those_of_the_reader_and_the_writer() -> None:
    assert set(reading.DIALECTS) == set(READS)
    assert set(reading.IDS) == set(IDS) - {"apart"}
    assert reading.GRAPHS == GRAPHS


def test_convert_says_what_it_leaves_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "a.g2o").write_text(MORE)
    assert main(["convert", "a.g2o", "b.g2o", "--json"]) == OK
    shown = capsys.readouterr()
    assert "a.g2o: 2 ROBOTLASER1 left out: " in shown.err
    assert "a.g2o: 1 vertex that replay and solve leave out: no edge names 9" in shown.err
    told = json.loads(shown.out)
    assert "b.g2o: 5 poses, 0 landmarks, 4 factors" in shown.err
    assert told["read"]["left_out"] == {"ROBOTLASER1": 2}
    assert "VERTEX_SE2 9 0 0 0" in (folder / "b.g2o").read_text()
    assert told["read"]["notes"] == [line[7:] for line in shown.err.splitlines() if line.startswith("a.g2o: ")]
    assert (told["files"], told["poses"], told["factors"]) == (["b.g2o"], 5, 4)


def test_convert_counts_what_is_in_the_file_that_it_wrote(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen = f"VERTEX_XY 5 1 1\nEDGE_SE2_XY 0 5 1 1 1 0 1\nEDGE_SE2_XY 1 5 0 1 1 0 1\nEDGE_SE2 0 1 1 0 0 {INFO3}\n"
    (folder / "a.g2o").write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n{seen}")
    assert main(["convert", "a.g2o", "b.jrl", "--json"]) == OK
    shown = capsys.readouterr()
    assert "b.jrl: 2 landmark_se2 left out: " in shown.err
    assert "b.jrl: 2 poses, 1 landmark, 1 factor" in shown.err
    told = json.loads(shown.out)
    assert (told["poses"], told["landmarks"], told["factors"]) == (2, 1, 1)


def test_a_trajectory_is_converted_with_its_times(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pose = "1.0 2.0 3.0 0.0 0.0 0.6 0.8\n"
    way = f"1403636579.763555584 {pose}1403636579.863555585 {pose}"
    (folder / "a.tum").write_text(f"# time tx ty tz qx qy qz qw\n{way}")
    assert main(["convert", "a.tum", "b.tum"]) == OK
    assert (folder / "b.tum").read_text() == way
    assert main(["convert", "a.tum", "c.kitti"]) == OK
    assert len((folder / "c.kitti").read_text().splitlines()) == 2
    capsys.readouterr()
    assert main(["convert", "a.tum", "d.g2o"]) == OK
    said = "d.g2o: 2 time stamps left out: g2o has no record for the time of se3 variables"
    assert said in capsys.readouterr().err
    assert read(folder / "d.g2o").poses == 2
    assert main(["convert", "a.tum", "e.g2o", "--strict"]) == BAD_FILE
    assert not (folder / "e.g2o").exists()
    capsys.readouterr()
    assert main(["replay", "a.tum", "--in-process"]) == BAD_FILE
    assert "a.tum: a trajectory, which has no measurements; wanted a graph, with its factors" in capsys.readouterr().err


def test_batches_put_together_keep_their_time_stamps() -> None:
    groups = [Variables("se2", np.array([n]), None, False, np.array([7]) if n == 2 else None) for n in range(3)]
    (together,) = merged(Batch((group,)) for group in groups).variables
    assert together.stamps is not None
    assert together.stamps.tolist() == [NO_STAMP, NO_STAMP, 7]
    assert merged([Batch((groups[0],))]).variables[0].stamps is None


def test_strict_refuses_and_writes_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "a.g2o").write_text(MORE)
    assert main(["convert", "a.g2o", "b.g2o", "--strict"]) == BAD_FILE
    assert "a.g2o:5: ROBOTLASER1, no g2o record that is read; wanted nothing that would have" in capsys.readouterr().err
    (folder / "c.graph").write_text("EDGE2 0 1 1 0 0 1 0 1 1 0 0\nBR 1 5 0.1 2 0.1 0.1\n")
    assert main(["convert", "c.graph", "b.g2o", "--strict"]) == BAD_FILE
    assert "1 bearing_range_se2, g2o has no record for such factors" in capsys.readouterr().err
    assert not (folder / "b.g2o").exists()
    assert main(["convert", "c.graph", "b.g2o"]) == OK
    assert "b.g2o: 1 bearing_range_se2 left out: g2o has no record for such factors" in capsys.readouterr().err


def test_strict_takes_a_vertex_that_is_written_as_it_was(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (
        "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_SE2 8 5 5 0\nVERTEX_XY 9 1 1\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    )
    (folder / "a.g2o").write_text(text)
    assert main(["convert", "a.g2o", "b.g2o", "--strict"]) == OK
    assert sorted((folder / "b.g2o").read_text().splitlines()) == sorted(text.splitlines())
    capsys.readouterr()
    assert main(["replay", "a.g2o", "--in-process", "--strict"]) == BAD_FILE
    assert "2 vertices, no edge names 8, 9; wanted nothing that would be left out" in capsys.readouterr().err


def test_one_of_each_is_counted_as_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "a.g2o").write_text("VERTEX_SE2 0 0 0 0\nVERTEX_XY 1 1 0\nEDGE_SE2_XY 0 1 1 0 1 0 1\n")
    assert main(["convert", "a.g2o", "b.g2o"]) == OK
    assert capsys.readouterr().err == "b.g2o: 1 pose, 1 landmark, 1 factor\n"
    assert main(["convert", "a.g2o", "b.tum"]) == OK
    assert capsys.readouterr().err.splitlines() == [
        "b.tum: 1 landmark left out: a trajectory has poses alone",
        "b.tum: 1 factor left out: a trajectory has poses alone",
        "b.tum: 1 pose, 0 landmarks, 0 factors",
    ]


def test_a_trajectory_for_each_robot(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "ab.g2o").write_text(robots())
    for form in ("tum", "kitti"):
        assert main(["convert", "ab.g2o", f"out.{form}"]) == OK
        assert f"out-a.{form}, out-b.{form}: 6 poses" in capsys.readouterr().err
        assert not (folder / f"out.{form}").exists()
        assert main(["convert", "ab.g2o", f"b.{form}", "--robot", "b"]) == OK
        assert (folder / f"b.{form}").read_text() == (folder / f"out-b.{form}").read_text()
        assert capsys.readouterr().err.splitlines() == [
            f"b.{form}: 4 factors left out: a trajectory has poses alone",
            f"b.{form}: 3 poses left out: of other robots than 'b'",
            f"b.{form}: 3 poses, 0 landmarks, 0 factors",
        ]
    assert [line.split()[:3] for line in (folder / "out-b.tum").read_text().splitlines()] == [
        ["1", "0.0", "100.0"],
        ["3", "1.0", "100.0"],
        ["5", "2.0", "100.0"],
    ]
    assert main(["convert", "ab.g2o", "c.tum", "--robot", "b", "--json"]) == OK
    told = json.loads(capsys.readouterr().out)
    assert (told["poses"], told["landmarks"], told["factors"]) == (3, 0, 0)
    assert main(["convert", "ab.g2o", "c.tum", "--robot", "c"]) == REFUSED
    assert "there are a, b, and none is 'c'" in capsys.readouterr().err
    assert main(["convert", "ab.g2o", "c.g2o", "--robot", "a"]) == USAGE


def test_two_robots_of_3_m_are_no_trajectory_of_200(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """a0 a2 a4 a6 and b1 b3 b5 b7, 100 m apart: one through all, by their numbers, has 697 m."""
    lines = []
    for letter, first, y in (("a", 0, 0), ("b", 1, 100)):
        lines += [f"VERTEX_SE2 {symbol(letter, first + 2 * k)} {k} {y} 0" for k in range(4)]
    (folder / "ab.g2o").write_text("\n".join(lines) + "\n")
    for form, columns in (("tum", slice(1, 3)), ("kitti", slice(3, 8, 4))):
        assert main(["convert", "ab.g2o", f"out.{form}"]) == OK
        assert not (folder / f"out.{form}").exists()
        for robot, y in (("a", 0.0), ("b", 100.0)):
            rows = np.loadtxt(folder / f"out-{robot}.{form}")[:, columns]
            assert np.linalg.norm(np.diff(rows, axis=0), axis=1).sum() == pytest.approx(3.0)
            assert rows[:, 1].tolist() == [y] * 4
        if form == "tum":
            assert np.loadtxt(folder / "out-b.tum")[:, 0].tolist() == [1, 3, 5, 7]


@pytest.mark.parametrize(
    ("text", "target", "said"),
    [
        ("PARAMS_SE2OFFSET 0 0 0 0\n", "b.g2o", "nothing that a .g2o would have"),
        ("PARAMS_SE2OFFSET 0 0 0 0\n", "b.tum", "no pose, and a .tum has nothing else"),
        ("VERTEX_XY 0 1 2\n", "b.kitti", "no pose, and a .kitti has nothing else"),
    ],
)
def test_a_file_with_nothing_in_it_is_not_written(
    folder: Path, capsys: pytest.CaptureFixture[str], text: str, target: str, said: str
) -> None:
    (folder / "a.g2o").write_text(text)
    assert main(["convert", "a.g2o", target]) == BAD_FILE
    assert said in capsys.readouterr().err
    assert not (folder / target).exists()


def test_poses_without_a_time_among_others_are_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    groups = tuple(
        Variables("se2", np.array([symbol("a", n)]), np.zeros((1, 3)), False, np.array([7 if n else NO_STAMP]))
        for n in range(3)
    )
    graph = GraphFile("a.g2o", "g2o", Batch(groups), ())
    files, notes, counts = _written(graph, folder / "b.tum", False, None, "auto")
    assert ([file.name for file in files], counts["poses"]) == (["b.tum"], 2)
    assert len((folder / "b.tum").read_text().splitlines()) == 2
    assert any("1 pose left out: a0 has no time stamp, and others have one" in note for note in notes)


def test_ids_come_out_as_they_went_in_unless_asked(folder: Path) -> None:
    (folder / "ab.g2o").write_text(robots())
    assert main(["convert", "ab.g2o", "c.g2o"]) == OK
    assert sorted((folder / "c.g2o").read_text().splitlines()) == sorted((folder / "ab.g2o").read_text().splitlines())
    assert main(["convert", "ab.g2o", "d.g2o", "--ids", "counted"]) == OK
    assert "EDGE_SE2 3 4 1 0 0" in (folder / "d.g2o").read_text()


def test_the_dialect_can_be_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "a.txt").write_text(SLAMPP)
    assert main(["convert", "a.txt", "b.g2o"]) == OK
    assert "a.txt: read as isam text" in capsys.readouterr().err
    assert main(["convert", "a.txt", "c.g2o", "--dialect", "slam++"]) == OK
    assert "read as" not in capsys.readouterr().err
    one, other = (read(folder / name).batch.factors[0].information for name in ("b.g2o", "c.g2o"))
    assert (one[0, 0], other[0, 0]) == (45.0**2, 45.0)


def test_a_replay_says_how_the_file_was_read(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "a.g2o").write_text(MORE)
    asked = ["replay", "a.g2o", "--in-process", "--json", "--mode", "inc-l", "--tum", "t.tum", "--out", "o.g2o"]
    assert main(asked) == OK
    shown = capsys.readouterr()
    told = json.loads(shown.out)
    assert told["read"]["left_out"] == {"ROBOTLASER1": 2, "vertices": 1}
    assert "a.g2o: 2 ROBOTLASER1 left out" in shown.err
    assert " 4/4 " in shown.err, "the bar ends where the drive does"
    assert (told["written"], told["poses"]) == (["o.g2o", "t.tum"], 4)
    assert main([*asked, "--strict"]) == BAD_FILE
    assert json.loads(capsys.readouterr().out)["problem"]["detail"] == {
        "file": "a.g2o",
        "line": 5,
        "seen": "ROBOTLASER1, no g2o record that is read",
        "wanted": "nothing that would have to be left out (strict)",
    }
    (folder / "a.txt").write_text(SLAMPP)
    chi2 = []
    for more in ([], ["--dialect", "slam++"]):
        assert main(["replay", "a.txt", "--in-process", "--json", "--mode", "inc-l", *more]) == OK
        chi2.append(json.loads(capsys.readouterr().out)["chi2"])
    assert chi2[0] > 40 * chi2[1]


def test_a_robot_log_is_replayed_converted_and_held_against_its_truth(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "manhattan", "--poses", "12", "--out", "a.jrl", "--truth", "truth.tum"]) == OK
    assert main(["convert", "a.jrl", "b.tum", "--ground-truth"]) == OK
    assert (folder / "b.tum").read_text() == (folder / "truth.tum").read_text()
    assert main(["convert", "a.jrl", "b.jrl", "--strict"]) == OK
    assert "a.jrl: ground truth of 12 variables" in capsys.readouterr().err
    assert (folder / "b.jrl").read_text() == (folder / "a.jrl").read_text()
    asked = ["replay", "a.jrl", "--in-process", "--mode", "inc-l", "--json", "--out", "c.jrl", "--plot", "c.png"]
    assert main(asked) == OK
    told = json.loads(capsys.readouterr().out)
    assert (told["read"]["ground_truth"], told["error_m"]["poses"]) == (12, 12)
    assert 0 < told["error_m"]["rms"] < told["error_m"]["max"] < 1
    assert read(folder / "c.jrl").summary()["ground_truth"] == 12
    assert main(["convert", "a.jrl", "d.g2o"]) == OK
    assert "12 ground truth values left out: g2o has no place to say so" in capsys.readouterr().err
    assert main(["convert", "a.jrl", "d.g2o", "--strict"]) == BAD_FILE
    assert main(["convert", "a.jrl", "d.g2o", "--ground-truth"]) == USAGE
    assert main(["convert", "d.g2o", "d.tum", "--ground-truth"]) == BAD_FILE
    assert "d.g2o: no ground truth; wanted a .jrl with its groundtruth" in capsys.readouterr().err


def test_ranges_go_from_pyfg_to_pyfg_and_through_a_replay(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moves = "".join(f"EDGE_SE2 0 A{k} A{k + 1} 1 0 1.57 1 0 0 1 0 1\n" for k in range(3))
    seen = "".join(f"EDGE_RANGE 0 A{k} L0 {z} 1\n" for k, z in enumerate((5, 4.5, 4.1, 4.6)))
    poses = "".join(f"VERTEX_SE2 0 A{k} {x} {y} 0\n" for k, (x, y) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))))
    (folder / "a.pyfg").write_text(f"{poses}VERTEX_XY L0 4 3\n{moves}{seen}")
    assert main(["convert", "a.pyfg", "b.pyfg", "--strict"]) == OK
    assert "b.pyfg: 4 poses, 1 landmark, 7 factors" in capsys.readouterr().err
    assert read(folder / "b.pyfg").batch.factor_count == 7
    assert main(["convert", "a.pyfg", "c.pyfg", "--ids", "keys"]) == USAGE
    assert main(["replay", "a.pyfg", "--in-process", "--mode", "inc-l", "--out", "d.pyfg"]) == OK
    assert "1 fixed variable written as free" in capsys.readouterr().err
    again = read(folder / "d.pyfg").batch
    assert {group.kind for group in again.factors} == {"between_se2", "range_se2"}
