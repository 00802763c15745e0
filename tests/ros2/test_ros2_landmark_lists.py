"""Landmarks as Cartographer's front ends and apriltag_ros have them: the same map as Detection3DArray makes of them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
import ros
import words
from numpy.testing import assert_allclose

from factorbus.proto.messages import Factors
from factorbus.proto.symbols import symbol
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.geometry import from_plane
from factorbus.ros2.messages import DETECTIONS, LANDMARK_LIST, ODOMETRY, TAGS, Messages
from factorbus.ros2.observations import landmark_index, observations_in
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.recorded_drive import read_recording
from factorbus.ros2.settings import Settings

MESSAGES = Messages("jazzy")
SECOND = 10**9
HERE = (1.0, 0.5, 0.0)


def hear(type_name: str, message: Any, **settings: Any) -> tuple[FrontEnd, Factors | None]:
    """What a robot that stands at its first keyframe makes of a message: the front end and the factors."""
    made = FrontEnd(Settings(**settings), 0, (), False)
    made.odometry(MESSAGES.read("/odom", ODOMETRY, bytes(ros.odometry(SECOND, (0.0, 0.0, 0.0)).serialize())))
    draft = made.take("/l", type_name, MESSAGES.read("/l", type_name, bytes(message.serialize())))
    return made, draft.batch().factors[0] if draft is not None else None


def factors(type_name: str, message: Any, **settings: Any) -> Factors:
    _, made = hear(type_name, message, **settings)
    assert made is not None
    return made


def sigmas(made: Factors) -> list[float]:
    """Of the first axis of each."""
    return np.sqrt(1.0 / made.information[:, 0]).tolist()


@pytest.mark.parametrize("space", ["plane", "space"])
def test_they_make_the_factors_that_detections_of_the_same_certainty_make(space: str) -> None:
    """The weight multiplies the residual: w = 1/σ."""
    settings = {"space": space, "mounts": {"camera": from_plane(0.3, 0.0, 0.5)}}
    wanted = factors(DETECTIONS, ros.detections(SECOND, "camera", [("7", HERE, 0.25), ("9", HERE, 0.5)]), **settings)
    listed = factors(
        LANDMARK_LIST, ros.landmark_list(SECOND, "camera", [("7", HERE, 4.0), ("9", HERE, 2.0)]), **settings
    )
    tagged = factors(TAGS, ros.tags(SECOND, "camera", [([7], HERE, 0.25), ([9], HERE, 0.5)]), **settings)
    for made in (listed, tagged):
        assert (made.kind, made.keys.tolist()) == (wanted.kind, wanted.keys.tolist())
        assert_allclose(made.measured, wanted.measured, atol=1e-12)
        assert_allclose(made.information, wanted.information, rtol=1e-12)
    assert_allclose(sigmas(wanted), [0.25, 0.5], rtol=1e-3)


def test_a_weight_makes_nothing_more_certain_than_the_floor_nor_less_than_unknown() -> None:
    """Cartographer's examples have weights of 10⁴ and more."""
    seen = [(str(n), HERE, weight) for n, weight in enumerate((1e308, 1e6, 100.0, 10.0, 1e-3, 1e-160, 5e-324))]
    made = factors(LANDMARK_LIST, ros.landmark_list(SECOND, "base_link", seen))
    assert_allclose(sigmas(made), [0.01, 0.01, 0.01, 0.1, 1000.0, 1000.0, 1000.0], rtol=0.01)


def test_what_has_no_weight_is_left_out_and_said() -> None:
    """Cartographer gets nothing out of it either."""
    seen = [("1", HERE, 0.0), ("2", HERE, 10.0)]
    front_end, made = hear(LANDMARK_LIST, ros.landmark_list(SECOND, "base_link", seen))
    assert made is not None
    assert made.keys.tolist() == [[symbol("x", 0), symbol("l", 2)]]
    assert front_end.remarks == [("/l", "landmarks with a translation_weight of 0 are left out")]
    assert hear(LANDMARK_LIST, ros.landmark_list(SECOND, "base_link", seen[:1]))[1] is None
    assert hear(LANDMARK_LIST, ros.landmark_list(SECOND, "nowhere", []))[1] is None, "nothing in sight"


@pytest.mark.parametrize(
    ("type_name", "message", "text"),
    [
        (LANDMARK_LIST, ros.landmark_list(SECOND, "base_link", [("1", HERE, -1.0)]), "translation_weight of -1"),
        (LANDMARK_LIST, ros.landmark_list(SECOND, "base_link", [("1", HERE, float("nan"))]), "weight of nan"),
        (LANDMARK_LIST, ros.landmark_list(SECOND, "base_link", [("1", HERE, float("inf"))]), "weight of inf"),
        (LANDMARK_LIST, ros.landmark_list(SECOND, "base_link", [("", HERE, 1.0)]), "without id"),
        (LANDMARK_LIST, ros.landmark_list(SECOND, "base_link", [("1", (1e10, 0.0, 0.0), 1.0)]), "at most 1e.09 m"),
        (LANDMARK_LIST, ros.landmark_list(SECOND, "camera", [("1", HERE, 1.0)]), "--mount camera="),
        (TAGS, ros.tags(SECOND, "base_link", [([], HERE, 0.1)]), "without id"),
        (TAGS, ros.tags(SECOND, "base_link", [([1], (float("nan"), 0.0, 0.0), 0.1)]), "at most 1e.09 m"),
        (TAGS, ros.tags(SECOND, "camera", [([1], HERE, 0.1)]), "--mount camera="),
    ],
)
def test_what_says_nothing_usable_is_refused(type_name: str, message: Any, text: str) -> None:
    with pytest.raises(BadRosMessage, match=text):
        hear(type_name, message)


def test_a_bundle_is_a_landmark_of_its_own() -> None:
    made = factors(TAGS, ros.tags(SECOND, "base_link", [([3, 4], HERE, 0.1), ([3], HERE, 0.1)]))
    assert made.keys[:, 1].tolist() == [symbol("l", landmark_index("3 4")), symbol("l", 3)]


def test_the_first_lists_had_their_entries_under_another_name() -> None:
    class Former:
        landmark = ("a", "b")

    assert observations_in(Former()) == ("a", "b")


def as_lists(drive: recordings.Drive, type_name: str) -> list[recordings.Said]:
    """The drive of recordings, its detections as another message."""
    said = []
    for each in drive.said:
        if each.type_name == DETECTIONS:
            seen = [
                (one.results[0].hypothesis.class_id, one.results[0].pose.pose.position)
                for one in each.message.detections
            ]
            places = [(name, (at.x, at.y, at.z)) for name, at in seen]
            made = (
                ros.landmark_list(each.ns, "camera", [(name, at, 50.0) for name, at in places])
                if type_name == LANDMARK_LIST
                else ros.tags(each.ns, "camera", [([int(name)], at, 0.02) for name, at in places])
            )
            said.append(recordings.Said("/marks", type_name, each.ns, made))
        else:
            said.append(each)
    return said


@pytest.mark.parametrize("type_name", [LANDMARK_LIST, TAGS])
def test_a_recording_of_them_is_found_by_its_types_and_is_the_same_map(type_name: str, tmp_path: Path) -> None:
    drive, found = recordings.drive(), Settings(odometry="", poses=(), landmarks=())
    reference = read_recording(recordings.write_mcap(tmp_path / "detections.mcap", drive.said), found)
    made = read_recording(recordings.write_mcap(tmp_path / "marks.mcap", as_lists(drive, type_name)), found)
    assert made.used == {"/odom": 45, "/marks": 45}
    assert f"landmarks: /marks ({type_name})" in made.notes
    assert len(made.steps) == len(reference.steps)
    for one, other in zip(made.steps, reference.steps, strict=True):
        for mine, theirs in zip(one.factors, other.factors, strict=True):
            assert mine.keys.tolist() == theirs.keys.tolist()
            assert_allclose(mine.measured, theirs.measured, atol=1e-12)
            assert_allclose(mine.information, theirs.information, rtol=1e-9)


def test_another_librarys_bytes_are_read_whole() -> None:
    made = ros.landmark_list(17, "camera", [("dock", (1.0, 2.0, 3.0), 4.0)])
    read = MESSAGES.read("/l", LANDMARK_LIST, bytes(made.serialize()))
    (entry,) = read.landmarks
    at = entry.tracking_from_landmark_transform.position
    assert (entry.id, at.x, at.y, at.z, entry.translation_weight) == ("dock", 1.0, 2.0, 3.0, 4.0)
    tagged = words.AprilTagDetectionArray.deserialize(
        MESSAGES.write(TAGS, MESSAGES.read("/t", TAGS, bytes(ros.tags(17, "c", [([3, 4], HERE, 0.1)]).serialize())))
    )
    assert (list(tagged.detections[0].id), tagged.detections[0].pose.header.frame_id) == ([3, 4], "c")
