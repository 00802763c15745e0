"""Fixes of GNSS: which are used, from when on, in which frame, where the antenna is, and how certain."""

import math
from typing import Any

import numpy as np
import pytest
import ros
import words
from numpy.testing import assert_allclose
from test_ros2_front_end import covariance_of, only, stamps_of
from zenoh_ros_type.common_interfaces.geometry_msgs import Transform as RosTransform

from factorbus.client import Draft
from factorbus.client.geodetic import geodetic
from factorbus.proto.symbols import symbol
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.messages import FIX, ODOMETRY, POSE, TRANSFORMS, Messages
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import Settings

MESSAGES = Messages("jazzy")
SECOND = 10**9
ORIGIN = (48.1, 11.5, 500.0)
YAW = 0.7  # of the map's x axis, from east to north
NORTH_M = 20.0  # of the map's origin


class Robot:
    """Drives along a quarter circle by exact odometry, with an antenna half a metre ahead and 0.2 m to the left."""

    def __init__(self, antenna: bool = True, **settings: Any) -> None:
        self.front_end, self.last_s = FrontEnd(Settings(**{"keyframe_m": 0.9} | settings), 0, (), False), -1.0
        if antenna:
            self.front_end.static("/tf_static", read(TRANSFORMS, static("gps", (0.5, 0.2, 1.0))))

    def odometry(self, at_s: float) -> Draft | None:
        self.last_s = at_s
        return self.front_end.take("/odom", ODOMETRY, read(ODOMETRY, ros.odometry(int(at_s * SECOND), where(at_s))))

    def fix(self, at_s: float, topic: str = "/fix", **more: Any) -> Draft | None:
        message = ros.nav_fix(int(at_s * SECOND), place(at_s), **more)
        return self.front_end.take(topic, FIX, read(FIX, message))

    def _odometry(self, at_s: float) -> Draft | None:
        """Unless it was said already."""
        return self.odometry(at_s) if at_s > self.last_s else None

    def drive(self, until_s: int, **more: Any) -> list[Draft]:
        """Odometry and a fix each second; what came of it."""
        drafts = [draft for n in range(until_s + 1) for draft in (self._odometry(n), self.fix(n, **more))]
        return [draft for draft in drafts if draft is not None]

    @property
    def said(self) -> list[str]:
        return [text for _, text in self.front_end.remarks]


def read(type_name: str, message: Any) -> Any:
    return MESSAGES.read("/t", type_name, bytes(message.serialize()))


def static(frame: str, at: tuple[float, float, float]) -> Any:
    there = RosTransform(words.Vector3(*at), words.Quaternion(0.0, 0.0, 0.0, 1.0))
    return words.TFMessage([words.TransformStamped(words.Header(ros.stamp(0), "base_link"), frame, there)])


def where(at_s: float) -> tuple[float, float, float]:
    """A metre a second along a circle of 20 m."""
    angle = at_s / 20.0
    return 20.0 * math.sin(angle), 20.0 * (1.0 - math.cos(angle)), angle


def place(at_s: float, lever: tuple[float, float] = (0.5, 0.2)) -> tuple[float, float, float]:
    """Latitude, longitude and altitude of the antenna, which is a metre above the ground."""
    x, y, _ = ros.compose(where(at_s), (*lever, 0.0))
    east, north, _ = ros.compose((0.0, NORTH_M, YAW), (x, y, 0.0))
    latitude, longitude, altitude = geodetic([east, north, 1.0], ORIGIN).tolist()
    return latitude, longitude, altitude


def enu_of_map(at_s: float) -> np.ndarray:
    """Where the antenna is from the first fix."""
    (x, y, _), (x0, y0, _) = (ros.compose((0, 0, YAW), ros.compose(where(t), (0.5, 0.2, 0.0))) for t in (at_s, 0.0))
    return np.array([x - x0, y - y0])


@pytest.mark.parametrize("space", ["plane", "space"])
def test_the_frame_comes_with_all_fixes_so_far_once_the_robot_has_moved_far_enough(space: str) -> None:
    """0.5 m of sigma: beyond 5 m of way, so with the fix of the sixth second."""
    drafts = Robot(space=space).drive(9)
    kind = "position_se2_frame" if space == "plane" else "position_se3_frame"
    with_fixes = [draft for draft in drafts if any(g.kind == kind for g in draft.batch().factors)]
    first = only(with_fixes[0], kind)
    assert first.keys.tolist() == [[symbol("x", n), symbol("f", 0)] for n in range(7)]
    assert stamps_of(drafts[6]) == [6 * SECOND]
    assert [only(draft, kind).keys[0, 0] for draft in with_fixes[1:]] == [symbol("x", n) for n in (7, 8, 9)]
    dim = 2 if space == "plane" else 3
    for n, row in enumerate(first.measured):
        assert_allclose(row[:2], enu_of_map(n), atol=1e-4)  # the Earth is round
        assert_allclose(row[dim:], [0.5, 0.2, 1.0][:dim], atol=1e-9)
    assert_allclose(covariance_of(first, dim), np.diag([0.25, 0.25, 1.0][:dim]), rtol=1e-9)
    (frame,) = [g for g in with_fixes[0].batch().variables if g.keys.tolist() == [symbol("f", 0)]]
    assert frame.values is not None
    row = frame.values[0]
    x0, y0, _ = ros.compose((0, 0, YAW), (0.5, 0.2, 0.0))
    assert_allclose(row[:2], [-x0, -y0], atol=1e-3)
    turn = row[2] if space == "plane" else 2 * math.atan2(row[5], row[6])
    assert turn == pytest.approx(YAW, abs=1e-4)
    if space == "space":
        assert row[2] == pytest.approx(-1.0, abs=1e-3)
        assert only(with_fixes[0], "prior_se3").keys.tolist() == [[symbol("f", 0)]]


def test_it_is_said_what_was_assumed() -> None:
    robot = Robot()
    robot.drive(9)
    assert sum("the origin of GNSS is latitude 48.100" in text for text in robot.said) == 1
    (found,) = [text for text in robot.said if "frame f0" in text]
    assert found.startswith("GNSS's frame f0 by 7 fixes over 5.92 m")
    assert "turned by 0.700 rad" in found


def test_a_fix_between_keyframes_is_carried_by_its_lever_arm() -> None:
    """0.75 s after x9: the antenna was there from x9, and odometry's covariance since then is added."""
    robot = Robot()
    robot.drive(9)
    robot.odometry(9.5)
    assert robot.fix(9.75) is None  # it waits for its odometry
    draft = robot.odometry(9.75)
    made = only(draft, "position_se2_frame")
    assert made.keys[0, 0] == symbol("x", 9)
    way = ros.compose(ros.inverse(where(9.0)), where(9.75))
    assert_allclose(made.measured[0][2:], ros.compose(way, (0.5, 0.2, 0.0))[:2], atol=1e-9)
    assert_allclose(made.measured[0][:2], enu_of_map(9.75), atol=1e-3)
    spread = covariance_of(made, 2)
    assert spread[0, 0] == pytest.approx(0.25 + (0.02 * 0.75) ** 2, rel=0.1)
    assert spread[0, 0] > 0.25 + (0.02 * 0.7) ** 2


@pytest.mark.parametrize(
    ("bad", "wanted"),
    [
        ({"latitude": math.nan}, "-90 to 90"),
        ({"latitude": 91.0}, "-90 to 90"),
        ({"longitude": math.inf}, "-180 to 180"),
        ({"altitude": 1e7}, "or NaN"),
        ({"position_covariance_type": 9}, "0 \\(unknown\\) to 3"),
        ({"position_covariance": [-1.0] + [0.0] * 8}, "none below zero"),
        ({"position_covariance": [math.nan] * 9}, "finite"),
    ],
)
def test_a_fix_that_cannot_be_is_refused(bad: dict[str, Any], wanted: str) -> None:
    robot = Robot()
    robot.drive(3)
    message = ros.nav_fix(3 * SECOND, place(3))
    for name, value in bad.items():
        setattr(message, name, value)
    with pytest.raises(BadRosMessage, match=wanted):
        robot.front_end.fix("/fix", read(FIX, message))


def test_no_fix_is_left_out_and_said() -> None:
    robot = Robot()
    robot.odometry(0)
    assert robot.fix(0, status=-1) is None
    robot.front_end.fix("/fix", read(FIX, ros.nav_fix(0, (0.0, 0.0, 0.0))))
    assert ["no fix (status -1)" in text or "receivers without a fix" in text for text in robot.said] == [True, True]
    assert not list(robot.front_end.open_ends())


def test_an_unknown_covariance_has_the_sigma_of_the_option() -> None:
    robot = Robot(fix_sigma_m=0.25)
    drafts = robot.drive(9, kind=0)
    made = next(g for draft in drafts for g in draft.batch().factors if g.kind == "position_se2_frame")
    assert_allclose(covariance_of(made, 2), np.diag([0.0625] * 2), rtol=1e-9)
    assert sum("0.25 m (--fix-sigma)" in text for text in robot.said) == 10


def test_of_a_diagonal_covariance_the_rest_means_nothing_and_of_a_known_one_all() -> None:
    robot = Robot()
    robot.drive(9)
    told = []
    for kind in (2, 3):
        message = ros.nav_fix(9 * SECOND, place(9), kind=kind)
        message.position_covariance[1] = message.position_covariance[3] = 0.1
        told.append(covariance_of(only(robot.front_end.fix("/fix", read(FIX, message)), "position_se2_frame"), 2))
    assert_allclose(told, [[[0.25, 0.0], [0.0, 0.25]], [[0.25, 0.1], [0.1, 0.25]]], atol=1e-9)


def test_a_fix_without_altitude_says_nothing_of_the_height() -> None:
    robot = Robot(space="space")
    robot.drive(9)
    message = ros.nav_fix(9 * SECOND, place(9))
    message.altitude = math.nan
    made = only(robot.front_end.fix("/fix", read(FIX, message)), "position_se3_frame")
    assert_allclose(np.sqrt(np.diag(covariance_of(made, 3))), [0.5, 0.5, 1e5], rtol=1e-6)


def test_an_antenna_that_nothing_places_is_in_the_middle_and_that_is_said() -> None:
    robot = Robot(antenna=False)
    robot.drive(9)
    assert sum("nothing says where frame 'gps' is" in text for text in robot.said) == 10


@pytest.mark.parametrize("told", [3, 6])
def test_where_an_antenna_is_may_be_told_after_its_first_fixes(told: int) -> None:
    """As on a machine that is busy, where the static transform is not the first to come."""
    robot, drafts = Robot(antenna=False), list[Draft | None]()
    for n in range(8):
        if n == told:
            robot.front_end.static("/tf_static", read(TRANSFORMS, static("gps", (0.5, 0.2, 1.0))))
        drafts += [robot.odometry(n), robot.fix(n)]
    groups = [group for draft in drafts if draft is not None for group in draft.batch().factors]
    levers = [row[2:] for group in groups if group.kind == "position_se2_frame" for row in group.measured]
    assert_allclose(levers, [[0.5, 0.2]] * 8, atol=1e-9)
    assert not any("nothing says" in text for text in robot.said)


def test_a_robot_that_stands_still_collects_but_does_not_align() -> None:
    robot = Robot()
    robot.odometry(0)
    for n in range(1, 30):
        robot.front_end.odometry(read(ODOMETRY, ros.odometry(n * SECOND, where(0))))
        message = ros.nav_fix(n * SECOND, place(0))
        assert robot.front_end.fix("/fix", read(FIX, message)) is None
    ((topic, text),) = robot.front_end.open_ends()
    assert topic == ""  # of no topic that was named
    assert "10 fixes left out: the robot has moved 0 m, and 5 m and 4 fixes are wanted" in text
    assert sum("more than 10 fixes at one keyframe" in text for text in robot.said) == 19


def test_a_wild_first_fix_is_not_the_origin() -> None:
    robot = Robot()
    robot.odometry(0)
    robot.front_end.fix("/fix", read(FIX, ros.nav_fix(0, (-33.0, 151.0, 0.0))))
    drafts = robot.drive(9)
    frame = next(g for draft in drafts for g in draft.batch().variables if g.keys.tolist() == [symbol("f", 0)])
    assert frame.values is not None
    assert frame.values[0][2] == pytest.approx(YAW, abs=1e-4)
    with pytest.raises(BadRosMessage, match="from the first fix"):
        robot.front_end.fix("/fix", read(FIX, ros.nav_fix(9 * SECOND, (-33.0, 151.0, 0.0))))


def test_a_frame_that_was_refused_is_sought_again() -> None:
    robot = Robot()
    robot.drive(6)
    robot.front_end.rewind(lambda key: key <= symbol("x", 6) and key >> 56 == ord("x"))
    drafts = [draft for n in range(7, 16) for draft in (robot.odometry(n), robot.fix(n)) if draft is not None]
    frames = [g for draft in drafts for g in draft.batch().variables if g.keys.tolist() == [symbol("f", 0)]]
    assert len(frames) == 1


def test_where_the_map_begins_with_a_pose_the_frame_is_that_of_the_map() -> None:
    robot = Robot()
    robot.front_end.begin_again(0, (), True)
    robot.odometry(0)
    robot.front_end.pose("/p", read(POSE, ros.known_pose(0, (5.0, 5.0, 1.0), [0.01] * 6)))
    drafts = robot.drive(9)
    frame = next(g for draft in drafts for g in draft.batch().variables if g.keys.tolist() == [symbol("f", 0)])
    assert frame.values is not None
    assert frame.values[0][2] == pytest.approx(YAW - 1.0, abs=1e-3)
