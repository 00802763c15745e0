"""TUM trajectories: read and written to the nanosecond, and what else there is to say of the times of poses."""

from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.formats import (
    FormatError,
    GraphFile,
    as_g2o,
    kitti_text,
    read,
    tum_notes,
    tum_text,
    write_tum,
)
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import LEAST_STAMP, MOST_STAMP, NO_STAMP
from factorbus.proto.symbols import symbol

POSE = "1 2 3 0 0 0.6 0.8"
NS = 1_403_636_579_763_555_584


def poses(stamps: list[int] | None, letter: str = "x", kind: str = "se2") -> Variables:
    count = 3 if stamps is None else len(stamps)
    values = np.arange(3.0 * count).reshape(count, 3) / 8
    if kind == "se3":
        values = np.hstack([values, np.tile([0.0, 0.0, 0.6, 0.8], (count, 1))])
    keys = np.array([symbol(letter, n) for n in range(count)])
    return Variables(kind, keys, values, False, None if stamps is None else np.array(stamps))


def times(text: str) -> list[str]:
    return [line.split()[0] for line in text.splitlines()]


def stamps_in(tmp_path: Path, lines: str) -> list[int]:
    file = tmp_path / "way.tum"
    file.write_text(lines)
    (group,) = read(file).batch.variables
    assert group.stamps is not None
    return group.stamps.tolist()


@given(st.lists(st.integers(LEAST_STAMP, MOST_STAMP), min_size=1, max_size=9))
def test_what_is_written_is_read_to_the_nanosecond(tmp_path_factory: pytest.TempPathFactory, given: list[int]) -> None:
    file = tmp_path_factory.mktemp("tum") / "way.tum"
    batch = Batch((poses(given, kind="se3"),))
    assert write_tum(file, batch) == [file]
    (group,) = read(file).batch.variables
    assert group.stamps is not None
    order = np.lexsort((np.arange(len(given)), np.array(given)))
    assert group.stamps.tolist() == sorted(given)
    assert group.values is not None
    assert batch.variables[0].values is not None
    np.testing.assert_array_equal(group.values, batch.variables[0].values[order])


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("1403636579.763555584", NS),
        ("1403636579.763555527", 1_403_636_579_763_555_527),
        ("1.403636579763555584e+09", NS),
        ("1403636579", 1_403_636_579_000_000_000),
        ("0", 0),
        (".5", 500_000_000),
        ("-0.000000001", -1),
        ("+1.", 10**9),
        ("0.0000000014999", 1),
        ("1e-300", 0),
        ("9223372036.854775807", MOST_STAMP),
        ("-9223372036.854775807", LEAST_STAMP),
    ],
)
def test_a_time_in_any_form_keeps_its_digits(tmp_path: Path, text: str, stamp: int) -> None:
    assert stamps_in(tmp_path, f"# time tx ty tz qx qy qz qw\n{text} {POSE}\n") == [stamp]


@pytest.mark.parametrize("text", ["9223372036.854775808", "-9223372036.854775808", "1e11", "1e999", "9" * 400])
def test_a_time_beyond_an_int64_of_nanoseconds_is_refused_with_its_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(FormatError, match=r"way.tum:3: a time of '.*'; wanted seconds such as") as refused:
        stamps_in(tmp_path, f"# a comment\n0.5 {POSE}\n{text} {POSE}\n")
    assert refused.value.line == 3


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("1.5 1 2 3 0 0 0.6", r"way.tum:2: TUM pose with 6 fields; wanted 7"),
        ("1.5 1 2 3 0 0 0.6 0.8 9", r"way.tum:2: TUM pose with 8 fields; wanted 7"),
        ("1.5 1 2 x 0 0 0.6 0.8", r"way.tum:2: TUM pose with 'x'"),
        ("1.5 1 2 nan 0 0 0.6 0.8", r"way.tum:2: TUM pose with a number that is not finite"),
        ("1.5 1 2 3 0 0 6 8", r"way.tum:2: TUM pose with a quaternion of norm 10"),
        ("nan 1 2 3 0 0 0.6 0.8", r"way.tum:2: a time of 'nan'"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", r"way.tum:2: a time of 'EDGE_SE2'"),
    ],
)
def test_what_is_wrong_is_named_by_its_line(tmp_path: Path, line: str, text: str) -> None:
    with pytest.raises(FormatError, match=text):
        stamps_in(tmp_path, f"0.5 {POSE}\n{line}\n")


def test_a_trajectory_is_poses_and_nothing_measured(tmp_path: Path) -> None:
    file = tmp_path / "way.txt"
    file.write_text(f"2.5 {POSE}\n1.5 {POSE}\n2.5 {POSE}\n")
    found = read(file)
    (group,) = found.batch.variables
    assert (found.dialect, found.poses, found.batch.factors, found.notes) == ("tum", 3, (), ())
    assert (group.kind, group.keys.tolist(), group.fixed) == ("se3", [symbol("x", n) for n in range(3)], False)
    assert group.stamps is not None
    assert group.stamps.tolist() == [2_500_000_000, 1_500_000_000, 2_500_000_000]
    for use in (found.steps, found.whole):
        with pytest.raises(FormatError, match="a trajectory, which has no measurements"):
            use()


def test_a_graph_that_has_times_keeps_them_in_its_replay() -> None:
    """Also where it is cut up, put in order, and rid of what nothing joins to the rest."""
    keys = np.array([symbol("x", n) for n in (2, 0, 9, 1)])
    given = Variables("se2", keys, np.zeros((4, 3)), False, np.array([22, NO_STAMP, 99, 11]))
    ends = np.array([[symbol("x", n), symbol("x", n + 1)] for n in range(2)])
    edges = Factors("between_se2", ends, np.zeros((2, 3)), np.tile([1.0, 0, 0, 1, 0, 1], (2, 1)))
    graph = GraphFile("made.g2o", "g2o", Batch((given,), (edges,)), (np.arange(2),))
    for batches in (graph.steps(), [graph.whole()]):
        groups = [group for batch in batches for group in batch.variables]
        times = {
            key: t
            for g in groups
            if g.stamps is not None
            for key, t in zip(g.keys.tolist(), g.stamps.tolist(), strict=True)
        }
        assert times == {symbol("x", 1): 11, symbol("x", 2): 22}
        assert sum(group.keys.size for group in groups) == 3


def test_a_dialect_that_is_named_is_taken_at_its_word(tmp_path: Path) -> None:
    file = tmp_path / "way.g2o"
    file.write_text(f"7 {POSE}\n")
    assert read(file, "tum").dialect == "tum"
    with pytest.raises(FormatError, match=": no pose; wanted"):
        read(file, "g2o").steps()
    with pytest.raises(FormatError, match=r"one of g2o, toro, isam, slam\+\+, pyfg, jrl, tum, bal"):
        read(file, "kitti")


def test_times_are_the_stamps_and_the_order_is_theirs() -> None:
    batch = Batch((poses([NS + 2, NS, -1_500_000_000]),))
    text = tum_text(batch)
    assert times(text) == ["-1.500000000", "1403636579.763555584", "1403636579.763555586"]
    assert [line.split()[1] for line in text.splitlines()] == ["0.75", "0.375", "0.0"]
    assert [line.split()[3] for line in kitti_text(batch).splitlines()] == ["0.75", "0.375", "0.0"]
    assert tum_notes(batch) == ()


def test_without_stamps_they_are_the_numbers_of_the_keys() -> None:
    assert times(tum_text(Batch((poses(None),)))) == ["0", "1", "2"]
    assert times(tum_text(Batch((poses([NO_STAMP] * 3),)))) == ["0", "1", "2"]
    keys = np.array([NS, NS + 1])
    assert times(tum_text(Batch((Variables("se2", keys, np.zeros((2, 3))),)))) == [str(NS), str(NS + 1)]


def test_a_pose_without_a_time_among_others_is_left_out_and_said(tmp_path: Path) -> None:
    batch = Batch((poses([7, NO_STAMP, 9]), poses(None, "y")))
    files = write_tum(tmp_path / "out.tum", batch)
    assert [times(file.read_text()) for file in files] == [["0.000000007", "0.000000009"], ["0", "1", "2"]]
    assert tum_notes(batch) == ("1 pose left out: x1 has no time stamp, and others have one",)
    assert tum_notes(batch, "y") == ()
    assert len(kitti_text(batch, "x").splitlines()) == 3, "which has no times"


def test_g2o_has_no_record_for_a_time_and_says_so() -> None:
    batch = Batch((poses([1, NO_STAMP, 3]),))
    written = as_g2o(batch)
    assert written.left_out == {"time stamps": 2}
    assert written.notes == ("2 time stamps left out: g2o has no record for the time of se2 variables",)
    assert written.text == as_g2o(Batch((poses(None),))).text
    with pytest.raises(FormatError, match="2 time stamps"):
        as_g2o(batch, strict=True)


@given(st.integers(LEAST_STAMP, MOST_STAMP))
def test_seconds_are_exact(stamp: int) -> None:
    (time,) = times(tum_text(Batch((poses([stamp]),))))
    assert Decimal(time) * 10**9 == stamp
    assert len(time.split(".")[1]) == 9


def test_the_pose_of_the_map_in_another_frame_is_no_robot() -> None:
    frame = Variables("se2", np.array([symbol("f", 0)]), np.array([[10.0, 0.2, 0.3]]))
    fix = Factors(
        "position_se2_frame", np.array([[symbol("x", 0), symbol("f", 0)]]), np.array([[1.0, 0, 0, 0]]),
        np.array([[1.0, 0, 1]]),
    )  # fmt: skip
    rows = tum_text(Batch((poses(None), frame), (fix,))).splitlines()
    assert [row.split()[0] for row in rows] == ["0", "1", "2"]


def test_a_mount_is_no_robot() -> None:
    """It is a pose on the robot: no trajectory of its own, and so no choice of a robot where there is one."""
    mount = Variables("se2", np.array([symbol("m", 0)]), np.array([[0.1, 0.2, 0.3]]))
    way = Factors(
        "between_se2_mount", np.array([[symbol("x", 0), symbol("x", 1), symbol("m", 0)]]), np.array([[1.0, 0, 0]]),
        np.array([[1.0, 0, 0, 1, 0, 1]]),
    )  # fmt: skip
    rows = tum_text(Batch((poses(None), mount), (way,))).splitlines()
    assert [row.split()[0] for row in rows] == ["0", "1", "2"]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n"),
        ("00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0\n"),
        ("00.kitti", "1 0 0 0 0 1 0 0 0 0 1\n"),
    ],
)
def test_a_trajectory_of_kitti_is_called_one(tmp_path: Path, name: str, text: str) -> None:
    """Also where a line of it is broken: none is a pose of TUM that lacks numbers."""
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(FormatError, match=rf"{name}:1: a KITTI pose, which is written and not read; wanted a graph"):
        read(path)
