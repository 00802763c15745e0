"""Map → odometry with corrections blended: by odometry's stamps, and so that the robot's pose does not jump."""

import signal
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import ros
import words
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from processes import Process
from test_ros2_bridge import bridge
from test_ros2_front_end import MESSAGES, SECOND, front_end, read, say

from factorbus.client import Draft, connect
from factorbus.proto.symbols import symbol
from factorbus.ros2.bridge import Bridge
from factorbus.ros2.geometry import Transform, from_plane, rotation_exp
from factorbus.ros2.messages import ODOMETRY
from factorbus.ros2.settings import Settings
from factorbus.ros2.smoothing import SmoothedCorrection
from factorbus.ros2.track import Correction

SMOOTH_S = 2.0
IDENTITY = Transform(np.eye(3), np.zeros(3))
seeds = st.integers(0, 2**32 - 1)


def transform(rng: np.random.Generator, metres: float, radians: float) -> Transform:
    return Transform(rotation_exp(rng.uniform(-1, 1, 3) * radians), rng.uniform(-1, 1, 3) * metres)


def apart(a: Transform, b: Transform) -> tuple[float, float]:
    """Metres, radians."""
    left = a.inverse() @ b
    return float(np.linalg.norm(left.t)), left.angle()


@given(seeds, st.floats(0.1, 1e4))
def test_a_robot_far_from_the_origin_of_its_odometry_goes_straight(seed: int, far_m: float) -> None:
    """The map has it a metre and a tenth of a radian off: that way it goes, wherever odometry began."""
    rng = np.random.default_rng(seed)
    old, T_odom_base = transform(rng, 100.0, 3.0), transform(rng, far_m, 3.0)
    new = old @ T_odom_base @ transform(rng, 1.0, 0.1) @ T_odom_base.inverse()
    smoothed = SmoothedCorrection(SMOOTH_S)
    assert apart(smoothed.at(Correction(old, IDENTITY), SECOND), old) == pytest.approx((0.0, 0.0), abs=1e-9 * far_m)
    published = [smoothed.at(Correction(new, IDENTITY), SECOND + n * SECOND // 10) for n in range(21)]
    robot = [each @ T_odom_base for each in published]
    whole = apart(old @ T_odom_base, new @ T_odom_base)
    assert apart(robot[0], old @ T_odom_base) == pytest.approx((0.0, 0.0), abs=1e-6)
    left = np.array([apart(each, new @ T_odom_base) for each in robot])
    assert (np.diff(left, axis=0) < 1e-6).all(), "nearer all the time"
    for a, b in pairwise(robot):
        assert apart(a, b)[0] <= 0.051 * whole[0] + 1e-6
        assert apart(a, b)[1] <= 0.051 * whole[1] + 1e-6
    assert smoothed.at(Correction(new, IDENTITY), SECOND + 2 * SECOND + 1) is not None
    assert apart(smoothed.at(Correction(new, IDENTITY), 4 * SECOND), new) == (0.0, pytest.approx(0.0, abs=1e-7))


def test_without_a_time_it_is_as_it_is() -> None:
    smoothed = SmoothedCorrection(0.0)
    for n in range(3):
        raw = Correction(from_plane(float(n), 0.0, 0.1 * n), IDENTITY)
        assert smoothed.at(raw, SECOND) is raw.T_map_odom


def test_once_the_time_has_passed_it_is_exactly_as_it_is() -> None:
    smoothed, raw = SmoothedCorrection(SMOOTH_S), Correction(from_plane(5.0, 0.0, 3.0), IDENTITY)
    smoothed.at(Correction(IDENTITY, IDENTITY), SECOND)
    assert smoothed.at(raw, 2 * SECOND) is not raw.T_map_odom
    assert smoothed.at(raw, 4 * SECOND) is raw.T_map_odom


def test_a_clock_that_was_set_back_neither_ends_a_blend_nor_holds_it() -> None:
    smoothed, raw = SmoothedCorrection(SMOOTH_S), Correction(from_plane(4.0, 0.0, 0.0), IDENTITY)
    smoothed.at(Correction(IDENTITY, IDENTITY), 1000 * SECOND)
    smoothed.at(raw, 1000 * SECOND)
    at_s = (1001.0, 3.0, 3.5, 4.0, 5.0)
    assert [smoothed.at(raw, int(t * SECOND)).t[0] for t in at_s] == pytest.approx([2.0, 2.0, 3.0, 4.0, 4.0])


def test_the_next_map_is_taken_as_it_is() -> None:
    smoothed, raw = SmoothedCorrection(SMOOTH_S), Correction(from_plane(4.0, 0.0, 0.0), IDENTITY)
    smoothed.at(Correction(IDENTITY, IDENTITY), SECOND)
    smoothed.forget()
    assert smoothed.at(raw, SECOND) is raw.T_map_odom


@pytest.mark.parametrize("anew_s", [21, 40])
def test_odometry_that_begins_anew_within_a_blend_leaves_the_robot_where_it_is(anew_s: int) -> None:
    made, smoothed = front_end(), SmoothedCorrection(100.0)
    values = {symbol("x", n): np.array([float(n), 0.0, 0.0]) for n in range(60)}

    def robot(x: float) -> Transform:
        correction = made.try_correction(values.get)
        assert correction is not None
        return smoothed.at(correction, made.stamp_ns) @ from_plane(x, 0.0, 0.0)

    for n in range(21):
        say(made, n, (float(n), 0.0, 0.0))
    assert apart(robot(20.0), from_plane(20.0, 0.0, 0.0))[0] < 1e-12
    values |= {key: value + np.array([0.0, 10.0, 0.0]) for key, value in values.items()}  # a loop was closed
    for n in range(21, anew_s):
        say(made, n, (float(n), 0.0, 0.0))
    before = robot(anew_s - 1.0)
    say(made, anew_s, (0.0, 0.0, 0.0))
    say(made, anew_s + 1, (0.7, 0.0, 0.0))
    values[symbol("x", anew_s)] = np.array([anew_s - 1.0, 10.0, 0.0])
    values[symbol("x", anew_s + 1)] = np.array([anew_s - 0.3, 10.0, 0.0])
    after = robot(0.7)
    assert after.t[0] == pytest.approx(anew_s - 1.0 + 0.7, abs=1e-9)
    assert 0.0 <= after.t[1] - before.t[1] <= 10.0 * 2.5 / 100.0
    assert after.t[1] < 3.0, "the blend goes on"


class Node:
    """Keeps what is published, by topic."""

    def __init__(self) -> None:
        self.hear: dict[str, Any] = {}
        self.published: dict[str, list[bytes]] = {}

    def subscribe(self, topic: Any, hear: Any, _kept: bool) -> None:
        self.hear[topic.name] = hear

    def publisher(self, topic: Any) -> Any:
        kept = self.published.setdefault(topic.name, [])
        return type("Publisher", (), {"publish": lambda _, data: kept.append(data)})()

    def transforms(self, topic: str) -> list[tuple[float, ...]]:
        """Seconds, x, y, yaw."""
        read = [words.TFMessage.deserialize(data).transforms[0] for data in self.published[topic]]
        return [(each.header.stamp.sec + 1e-9 * each.header.stamp.nanosec, *ros.plane(each.transform)) for each in read]


class StillMap:
    """A map with the values that it is given."""

    def __init__(self) -> None:
        self.estimate, self.epoch, self.revision = self, 1, 0
        self.values: dict[int, np.ndarray] = {}
        self.step: Any = None

    def on_delta(self, callback: Any) -> Any:
        self.step = callback
        return lambda: None

    def snapshot(self) -> Any:
        return type("Nothing", (), {"columns": {}})()

    def __getitem__(self, key: int) -> np.ndarray:
        return self.values[key]


@pytest.mark.parametrize("smooth_s", [0.0, 2.0])
def test_a_bridge_blends_and_says_the_raw_one_beside(smooth_s: float) -> None:
    node, joined = Node(), StillMap()
    settings = Settings(smooth_s=smooth_s, tolerance_s=0.0, keyframe_m=1e9)
    made = Bridge(joined, node, MESSAGES, settings)  # type: ignore[arg-type]
    assert ("/factorbus/tf_raw" in node.published) is bool(smooth_s), "without a time nothing is new in the graph"

    def drive(at_s: float, x: float) -> None:
        told = read(ODOMETRY, ros.odometry(int(at_s * SECOND), (x, 0.0, 0.0)))
        if made._front_end.odometry(told) is None:
            made._correct()

    drive(1.0, 0.0)
    joined.values[symbol("x", 0)] = np.zeros(3)
    joined.step(None)
    joined.values[symbol("x", 0)] = np.array([0.0, 4.0, 0.0])
    joined.step(None)
    for n in range(1, 6):
        drive(1.0 + 0.5 * n, 0.2 * n)
    seconds = [1.0, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5]
    raw = [(t, 0.0, 0.0 if n == 0 else 4.0, 0.0) for n, t in enumerate(seconds)]
    if not smooth_s:
        assert_allclose(node.transforms("/tf"), raw, atol=1e-12)
        return
    assert_allclose(node.transforms("/factorbus/tf_raw"), raw, atol=1e-12)
    blended = [(t, 0.0, y, 0.0) for t, y in zip(seconds, (0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 4.0), strict=True)]
    assert_allclose(node.transforms("/tf"), blended, atol=1e-12)


def test_a_correction_reaches_a_robot_little_by_little(endpoint: str, spawn: Callable[..., Process]) -> None:
    """Over the bus: another client says where x3 is, and the robot drives on."""
    topics = ("--smooth-s", "4", "--tf-raw", "/raw", "--tolerance", "0")
    with ros.session(endpoint) as bus, connect(endpoint, client="surveyor", timeout_s=60) as other:
        node = ros.RosNode(bus, 12)
        node.subscribe("/tf", words.TFMessage)
        node.subscribe("/raw", words.TFMessage)
        joined = bridge(spawn, endpoint, "smooth", 12, *topics)
        node.wait_for_endpoints(9)
        for n in range(4):
            node.publish("/odom", ros.odometry((1 + n) * SECOND, (float(n), 0.0, 0.0)))
        while node.wait_for("/tf")[0].transforms[0].header.stamp.sec < 4:
            pass
        with other.map("smooth") as looked:
            sure = Draft().prior_se2("x3", (3.0, 2.0, 0.0), sigmas=(1e-4, 1e-4, 1e-4))
            looked.estimate.wait_for(looked.stats()["revision"])
            looked.insert(sure, settle=True)
            looked.wait_converged()
            x, y, yaw = looked.estimate["x3"]
        wanted = Transform(from_plane(x, y, yaw).R, np.array([x, y, 0.0])) @ from_plane(3.0, 0.0, 0.0).inverse()
        while abs(ros.plane(node.wait_for("/raw")[0].transforms[0].transform)[1] - wanted.t[1]) > 1e-6:
            pass
        robot = [np.array([3.0, 0.0, 0.0])]
        for n in range(1, 51):  # it stands
            node.publish("/odom", ros.odometry(4 * SECOND + n * SECOND // 10, (3.0, 0.0, 0.0)))
            while True:
                (told,) = node.wait_for("/tf")[0].transforms
                if told.header.stamp == ros.stamp(4 * SECOND + n * SECOND // 10):
                    break
            robot.append(np.array(ros.compose(ros.plane(told.transform), (3.0, 0.0, 0.0))))
        whole = float(np.linalg.norm(robot[-1] - robot[0]))
        assert whole > 1.5
        assert_allclose(robot[-1], [x, y, yaw], atol=1e-9)
        steps = [float(np.linalg.norm(b - a)) for a, b in pairwise(robot)]
        assert max(steps) < 2.0 * whole * 0.1 / 4.0, "no jump"
        assert_allclose(robot[20][1], 0.5 * y, rtol=0.2)
    joined.signal(signal.SIGINT)
    assert joined.wait() == 0


@pytest.mark.parametrize("smooth_s", ["-1", "nan", "inf", "soon"])
def test_the_command_refuses_a_time_that_is_none(spawn: Callable[..., Process], smooth_s: str) -> None:
    refused = spawn("-m", "factorbus.cli", "ros2", "never", "--smooth-s", smooth_s)
    assert refused.wait() == 2
    assert "--smooth-s" in refused.errors()
