"""Odometry that does not go on: a clock that was set, a front end that began anew, one wild pose or stamp."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import recordings
import ros
import words
from numpy.testing import assert_allclose
from recordings import Said
from test_ros2_front_end import SECOND, covariance_of, front_end, only, read, say

from factorbus.proto.symbols import symbol
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.messages import DETECTIONS, ODOMETRY, TRANSFORMS
from factorbus.ros2.problems import BadRecording, BadRosMessage
from factorbus.ros2.recorded_drive import read_recording
from factorbus.ros2.settings import Settings

FOUND = Settings(odometry="", poses=(), landmarks=())
Pose = tuple[float, float, float]


def driven(made: FrontEnd, count: int = 6) -> None:
    """A metre a second along x, from 0 on."""
    for n in range(count):
        say(made, n, (float(n), 0.0, 0.0))


def texts(made: FrontEnd) -> list[str]:
    return [text for _, text in made.remarks]


def test_a_clock_that_is_set_back_goes_on_after_three_messages_and_is_said() -> None:
    made = front_end()
    driven(made, 101)
    for n in (1, 2):
        with pytest.raises(BadRosMessage, match="one after the last"):
            say(made, 40 + n, (100.0 + n, 0.0, 0.0))
    edge = only(say(made, 43, (103.0, 0.0, 0.0)), "between_se2")
    assert edge.keys.tolist() == [[symbol("x", 100), symbol("x", 101)]]
    assert_allclose(edge.measured, [[3.0, 0.0, 0.0]], atol=1e-12)
    assert texts(made) == ["the clock was set back by 57 s: odometry goes on by the new one"]
    assert say(made, 44, (104.0, 0.0, 0.0)) is not None


def test_messages_out_of_order_are_no_clock_that_was_set() -> None:
    made = front_end()
    driven(made)
    for at_s in (3.5, 3.2, 3.4, 3.1, 3.1):
        with pytest.raises(BadRosMessage):
            say(made, at_s, (at_s, 0.0, 0.0))
    for n in range(3):  # one late after each
        say(made, 6 + n, (6.0 + n, 0.0, 0.0))
        with pytest.raises(BadRosMessage):
            say(made, 5.1 + n, (5.1 + n, 0.0, 0.0))
    assert not made.remarks


def test_observations_before_the_clock_is_known_to_be_set_wait_and_are_placed_by_the_new_one() -> None:
    made = front_end()
    driven(made, 101)
    seen = ros.detections(100 * SECOND, "base_link", [("7", (1.0, 0.0, 0.0), 0.1)])
    assert made.detections("/tags", read(DETECTIONS, seen)) is not None
    seen = ros.detections(43 * SECOND, "base_link", [("7", (-2.0, 0.0, 0.0), 0.1)])
    assert made.detections("/tags", read(DETECTIONS, seen)) is None, "it would be of the pose at 43 s, long ago"
    for n in (1, 2):
        with pytest.raises(BadRosMessage):
            say(made, 40 + n, (100.0 + n, 0.0, 0.0))
    draft = say(made, 43, (103.0, 0.0, 0.0))
    assert only(draft, "landmark_se2").keys.tolist() == [[symbol("x", 101), symbol("l", 7)]]


def test_odometry_that_begins_anew_is_joined_by_what_is_not_known() -> None:
    made = front_end()
    driven(made, 21)
    assert say(made, 21, (0.0, 0.0, 0.0)) is None, "it may be a wild one"
    draft = say(made, 22, (0.7, 0.0, 0.0))
    assert draft is not None
    edges = only(draft, "between_se2")
    assert edges.keys.tolist() == [[symbol("x", 20), symbol("x", 21)], [symbol("x", 21), symbol("x", 22)]]
    assert_allclose(edges.measured, [[0.0, 0.0, 0.0], [0.7, 0.0, 0.0]], atol=1e-12)
    first = edges._replace(information=edges.information[:1])
    assert_allclose(np.sqrt(np.diag(covariance_of(first, 3))), [1e3, 1e3, math.pi], rtol=1e-3)
    (text,) = texts(made)
    assert text.startswith("odometry began anew: how the robot came there is taken as not known")
    values = {symbol("x", n): np.array([float(n), 0.0, 0.0]) for n in range(21)}
    values[symbol("x", 21)] = np.array([20.0, 0.0, 0.0])
    correction = made.try_correction(values.get)
    assert correction is not None
    assert correction.T_map_odom.t[0] == pytest.approx(20.0), "the robot is where it was"


def test_after_a_refusal_at_a_new_beginning_it_hangs_on_the_keyframe_before() -> None:
    made = front_end()
    driven(made, 21)
    say(made, 21, (0.0, 0.0, 0.0))
    say(made, 22, (0.7, 0.0, 0.0))
    made.rewind(lambda key: key <= symbol("x", 20))
    edge = only(say(made, 23, (1.7, 0.0, 0.0)), "between_se2")
    assert edge.keys.tolist()[0][0] == symbol("x", 20)
    assert_allclose(edge.measured, [[1.7, 0.0, 0.0]], atol=1e-12)
    assert np.sqrt(covariance_of(edge, 3)[0, 0]) > 900.0


def test_one_wild_pose_is_left_out() -> None:
    made = front_end()
    driven(made)
    assert say(made, 6, (500.0, 0.0, 0.0)) is None
    edge = only(say(made, 7, (7.0, 0.0, 0.0)), "between_se2")
    assert_allclose(edge.measured, [[2.0, 0.0, 0.0]], atol=1e-12)
    (refused,) = made.refused
    assert "a pose at 500, 0, 0 m that is far from those before and after it" in str(refused)
    assert not made.remarks


def test_one_wild_stamp_is_left_out() -> None:
    made = front_end()
    driven(made)
    assert say(made, 1e6, (6.0, 0.0, 0.0)) is None
    assert say(made, 7, (7.0, 0.0, 0.0)) is not None
    assert len(made.refused) == 1
    assert not made.remarks


def test_a_clock_that_is_set_ahead_is_said_and_the_way_stays_as_certain() -> None:
    made = front_end()
    driven(made)
    assert say(made, 1.7e9, (6.0, 0.0, 0.0), [1e-4] * 6) is None
    edge = only(say(made, 1.7e9 + 1, (7.0, 0.0, 0.0), [1e-4] * 6), "between_se2")
    assert np.sqrt(covariance_of(edge, 3)[0, 0]) < 1.0
    (text,) = texts(made)
    assert text.startswith("no odometry for 1.7e+09 s, or a clock that was set ahead")


@pytest.mark.parametrize("hertz", [1, 10, 100])
def test_a_fast_robot_is_no_new_beginning(hertz: int) -> None:
    """30 m/s from its first message on, and no velocities said."""
    made = front_end()
    drafts = [say(made, n / hertz, (30.0 * n / hertz, 0.0, 0.0)) for n in range(40)]
    assert not made.remarks
    assert not made.refused
    measured = [row for draft in drafts if draft for g in draft.batch().factors for row in g.measured[:, 0].tolist()]
    assert sum(measured) >= 30.0 * 38 / hertz - 0.6


def test_a_robot_that_comes_home_is_no_new_beginning() -> None:
    made = front_end()
    driven(made)
    for n in range(1, 6):
        say(made, 5 + n, (5.0 - n, 0.0, 0.0))
    assert not made.remarks
    assert not made.refused


@pytest.fixture(scope="module")
def drive() -> recordings.Drive:
    return recordings.drive()


def test_a_recording_whose_clock_is_set_back_is_driven_to_its_end(drive: recordings.Drive, tmp_path: Path) -> None:
    said = [drive.said[0], *(_later(each, -(10**12) if n > 6 else 0) for n, each in enumerate(drive.said[1:], 1))]
    made = read_recording(recordings.write_mcap(tmp_path / "back.mcap", said), FOUND)
    assert made.steps.poses == 43
    (note,) = [note for note in made.notes if "clock" in note and note.startswith("/odom: the")]
    assert note == "/odom: the clock was set back by 997 s: odometry goes on by the new one (1 time)"


def _later(each: Said, by_ns: int) -> Said:
    if each.type_name == TRANSFORMS:
        return each
    pose = each.message
    stamp = ros.stamp(each.ns + by_ns)
    if each.type_name == ODOMETRY:
        return each._replace(message=replace(pose, header=words.Header(stamp, "odom")))
    return each._replace(message=replace(pose, header=words.Header(stamp, "camera")))


def test_a_recording_that_ends_with_a_wild_pose_says_so(drive: recordings.Drive, tmp_path: Path) -> None:
    ns = recordings.START_NS + 45 * 10**9
    wild = Said("/odom", ODOMETRY, ns, ros.odometry(ns, (900.0, 0.0, 0.0)))
    made = read_recording(recordings.write_mcap(tmp_path / "wild.mcap", [*drive.said, wild]), FOUND)
    assert made.steps.poses == 45
    assert any("the last odometry is left out" in note for note in made.notes)


def test_frames_that_are_not_read_are_said(drive: recordings.Drive, tmp_path: Path) -> None:
    said = [drive.said[0]._replace(topic="/arm/tf_static"), *drive.said[1:]]
    made = read_recording(recordings.write_mcap(tmp_path / "arm.mcap", said), FOUND)
    assert "frames of sensors left out: /arm/tf_static; those of /tf_static are read" in made.notes


def test_a_topic_of_two_types_is_said(drive: recordings.Drive, tmp_path: Path) -> None:
    other = drive.said[1]._replace(topic="/tf_static")
    path = recordings.write_mcap(tmp_path / "two.mcap", [drive.said[0], other, *drive.said[1:]])
    made = read_recording(path, FOUND)
    assert "left out, as the form of their messages is not known or not one: /tf_static" in made.notes


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_an_mcap_file_cut_within_its_first_chunk_says_where_it_ends(
    drive: recordings.Drive, tmp_path: Path, share: float
) -> None:
    whole = recordings.write_mcap(tmp_path / "whole.mcap", drive.said).read_bytes()
    at, size = 8, 0
    while whole[at] != 6:  # the opcode of a chunk
        at += 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
    size = 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: at + 9 + int(share * (size - 9))])
    with pytest.raises(BadRecording) as refused:
        read_recording(path, FOUND)
    left = at + size - path.stat().st_size
    assert f"end {left} bytes before its first chunk does, so no message in it is whole" in str(refused.value)
    assert "EndOfFile" not in str(refused.value)
