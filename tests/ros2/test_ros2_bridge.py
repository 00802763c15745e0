"""The bridge in a process of its own, driven by a robot that speaks only ROS 2 messages, made by another library."""

import contextlib
import json
import math
import queue
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros
import survey
import words
import xxhash
from browser import free_port
from processes import Process

from factorbus.client import Draft, Unavailable, connect

ROBOT = str(Path(__file__).parent / "robot.py")
CAMERA = f"camera=0.3,0,0,0,0,{math.sin(math.pi / 4)},{math.cos(math.pi / 4)}"
TAGS = [[2.5, 1.0, 0.0], [6.0, 2.5, 0.0], [2.5, 6.0, 0.0], [-1.0, 2.5, 0.0], [2.5, 2.5, 0.0]]


def bridge(spawn: Callable[..., Process], endpoint: str, name: str, domain: int, *more: str) -> Process:
    # Made by one who waits: the command gives an answer ten seconds, and files are slow on a machine that is busy.
    with connect(endpoint, client="maker", timeout_s=60) as bus, bus.map(name, mirror=False):
        pass
    made = spawn("-m", "factorbus.cli", "ros2", name, "--connect", endpoint, "--domain", str(domain), *more)
    made.ready()
    return made


@pytest.mark.parametrize(("space", "domain"), [((), 7), (("--space",), 8)])
def test_a_robot_drives_and_is_told_where_it_is(
    endpoint: str, spawn: Callable[..., Process], space: tuple[str, ...], domain: int
) -> None:
    name = f"ros{domain}"
    joined = bridge(spawn, endpoint, name, domain, "--mount", CAMERA, "--display", "0.1", *space)
    robot = spawn(ROBOT, endpoint, str(domain))
    robot.ready()
    robot.tell("go")
    said = json.loads(" ".join(robot.line("done")))

    true, told, corrected = (np.array(said[word]) for word in ("true", "told", "corrected"))
    assert np.hypot(*(told - true)[:2]) > 0.8  # by odometry alone it is lost
    assert np.hypot(*(corrected - true)[:2]) < 0.05
    assert abs(math.remainder(corrected[2] - true[2], math.tau)) < 0.02
    assert said["frames"] == ["map", "odom"]
    assert said["ahead_s"] == pytest.approx(0.1)
    assert said["numbers"] == sorted(set(said["numbers"]))
    found = sorted(said["landmarks"], key=lambda place: [round(number, 1) for number in place])
    np.testing.assert_allclose(found, sorted(TAGS, key=lambda place: [round(number, 1) for number in place]), atol=0.05)
    assert said["path"][0] == "map"
    with connect(endpoint, client="looker", timeout_s=60) as bus, bus.map(name) as looked:
        pose = "se3" if space else "se2"
        keys, _ = looked.estimate.columns(pose)
        assert len(keys) == said["path"][1] == 45
        point = "point3" if space else "point2"
        assert [key & 0xFF for key in looked.estimate.columns(point)[0].tolist()[:4]] == [3, 5, 17, 42]
        assert looked.chi2().chi2 < 3 * 200
    there_is(said["tokens"], domain, said["gid"])
    joined.signal(signal.SIGINT)
    assert joined.wait() == 0


def there_is(tokens: list[str], domain: int, gid: str) -> None:
    """The node and its endpoints, as rmw_zenoh would have announced them."""
    session = {token.split("/")[2] for token in tokens}
    assert len(session) == 1
    assert re.fullmatch("[0-9a-f]{1,32}", *session)
    begin = f"@ros2_lv/{domain}/{next(iter(session))}/0"
    assert f"{begin}/0/NN/%/%/factorbus" in tokens
    ends = {
        (words[5], words[9], words[10], words[12]) for words in (token.split("/") for token in tokens) if len(words) > 9
    }
    assert ends == {
        ("MP", "%tf", "tf2_msgs::msg::dds_::TFMessage_", "::,100:,:,:,,"),
        ("MP", "%factorbus%path", "nav_msgs::msg::dds_::Path_", "::,1:,:,:,,"),
        ("MP", "%factorbus%markers", "visualization_msgs::msg::dds_::MarkerArray_", "::,1:,:,:,,"),
        ("MP", "%factorbus%pose", "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_", "::,1:,:,:,,"),
        ("MS", "%odom", "nav_msgs::msg::dds_::Odometry_", "::,10:,:,:,,"),
        ("MS", "%initialpose", "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_", "::,10:,:,:,,"),
        ("MS", "%detections", "vision_msgs::msg::dds_::Detection3DArray_", "::,10:,:,:,,"),
        ("MS", "%tf_static", "tf2_msgs::msg::dds_::TFMessage_", ":1:,100:,:,:,,"),  # with what was said before
    } | {
        ("SS", f"%factorbus%{name}", "std_srvs::srv::dds_::Trigger_", "::,10:,:,:,,")
        for name in ("settle", "save", "fork", "repair", "accept", "reject")
    }
    (tf,) = [token for token in tokens if "/%tf/" in token]
    number = xxhash.xxh3_128_intdigest(tf.encode())
    low, high = number & (1 << 64) - 1, number >> 64
    assert gid == (low.to_bytes(8, "little") + high.to_bytes(8, "little")).hex()


@pytest.fixture
def node(endpoint: str) -> Any:
    with ros.session(endpoint) as bus:
        made = ros.RosNode(bus, 9)
        made.subscribe("/tf", words.TFMessage)
        yield made


SECOND = 10**9


def test_what_cannot_be_used_is_refused_and_the_rest_goes_on(
    endpoint: str, spawn: Callable[..., Process], node: Any
) -> None:
    joined = bridge(spawn, endpoint, "refusing", 9)
    node.wait_for_endpoints(8)
    bad = ros.odometry(SECOND, (0.0, 0.0, 0.0))
    bad.pose.covariance[0] = -1.0
    node.publish("/odom", bad)
    node.publish("/odom", ros.odometry(2 * SECOND, (0.0, 0.0, math.nan)))
    node.publish("/odom", ros.odometry(3 * SECOND, (0.0, 0.0, 0.0)))
    node.publish("/odom", ros.odometry(2 * SECOND, (9.0, 0.0, 0.0)))  # from before
    node.publish("/detections", ros.detections(3 * SECOND, "nowhere", [("1", (1.0, 0.0, 0.0), 0.1)]))
    node.publish("/initialpose", ros.known_pose(3 * SECOND, (math.inf, 0.0, 0.0), [0.1] * 6))
    node.publish("/odom", ros.odometry(4 * SECOND, (1.0, 0.0, 0.0)))
    while True:
        transform, _ = node.wait_for("/tf")
        if transform.transforms[0].header.stamp.sec == 4:
            break
    assert ros.plane(transform.transforms[0].transform) == pytest.approx((0, 0, 0))
    with connect(endpoint, client="looker", timeout_s=60) as bus, bus.map("refusing") as looked:
        looked.estimate.wait_for(2)
        np.testing.assert_allclose(looked.estimate.columns("se2")[1], [[0, 0, 0], [1, 0, 0]], atol=1e-9)
    joined.signal(signal.SIGTERM)
    assert joined.wait() == 0
    log = joined.errors()
    assert "bad_ros_message=5" in log
    assert "a covariance with the eigenvalue -1" in log


def test_a_map_that_is_not_empty_waits_for_a_pose(endpoint: str, spawn: Callable[..., Process], node: Any) -> None:
    """The second robot's odometry begins anywhere: only a pose says where that is."""
    with connect(endpoint, client="first", timeout_s=60) as bus, bus.map("shared") as looked:
        looked.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
        joined = bridge(spawn, endpoint, "shared", 9, "--letter", "a")
        node.wait_for_endpoints(8)
        for n in range(1, 4):
            node.publish("/odom", ros.odometry(n * SECOND, (float(n), 0.0, 0.0)))
        node.publish("/initialpose", ros.known_pose(3 * SECOND, (5.0, 5.0, math.pi / 2), [0.01] * 6))
        transform, _ = node.wait_for("/tf")
        # There odometry says (3, 0) towards x, and the map (5, 5) towards y.
        assert ros.plane(transform.transforms[0].transform) == pytest.approx((5.0, 2.0, math.pi / 2), abs=1e-6)
        assert looked.uncertainty.covariance(["a0"])["a0"] == pytest.approx(np.diag([0.01] * 3), rel=1e-3)
    joined.signal(signal.SIGINT)
    assert joined.wait() == 0


def test_a_map_that_is_made_anew_is_begun_anew(endpoint: str, spawn: Callable[..., Process], node: Any) -> None:
    joined = bridge(spawn, endpoint, "dropped", 9)
    node.wait_for_endpoints(8)
    with connect(endpoint, client="operator", timeout_s=60) as bus:
        node.publish("/odom", ros.odometry(SECOND, (0.0, 0.0, 0.0)))
        node.wait_for("/tf")
        bus.drop("dropped")
        node.publish("/odom", ros.odometry(2 * SECOND, (1.0, 0.0, 0.0)))  # refused: there is no such map
        for n in range(3, 300):  # what comes before the refusal does is lost with it: robots drive on
            node.publish("/odom", ros.odometry(n * SECOND, (float(n), 0.0, 0.0)))
            with contextlib.suppress(queue.Empty):
                while (transform := node.wait_for("/tf", 0.3)[0].transforms[0]).header.stamp.sec < n:
                    pass
                if "dropped" in [row.name for row in bus.maps()]:
                    break
        with bus.map("dropped", create=False) as looked:
            looked.estimate.wait_for(1)
            keys, values = looked.estimate.columns("se2")
            assert keys[0] & 0xFF == 0
            assert values[0][0] >= 2.0  # it begins where odometry is by then
            assert ros.plane(transform.transform) == pytest.approx((0.0, 0.0, 0.0))
    joined.signal(signal.SIGINT)
    assert joined.wait() == 0


def test_a_service_that_is_killed_costs_nothing(spawn: Callable[..., Process], tmp_path: Path) -> None:
    """The robot's router stays; the service goes while it drives, and comes back with its journal."""
    router = spawn("-m", "factorbus.cli", "serve", "--listen", "tcp/127.0.0.1:0", "--no-warm").ready()[0]
    at = f"tcp/127.0.0.1:{free_port()}"
    keeping = ("-m", "factorbus.cli", "serve", "--listen", at, "--no-warm", "--journal", str(tmp_path / "journal"))
    service = spawn(*keeping)
    service.ready()
    joined = bridge(spawn, at, "kept", 10, "--ros", router)
    with ros.session(router) as bus:
        robot = ros.RosNode(bus, 10)
        robot.subscribe("/tf", words.TFMessage)
        robot.wait_for_endpoints(8)

        def drive(first: int, last: int) -> None:
            for n in range(first, last):
                robot.publish("/odom", ros.odometry(n * SECOND, (float(n), 0.0, 0.0)))

        drive(1, 11)
        while robot.wait_for("/tf")[0].transforms[0].header.stamp.sec < 10:
            pass
        service.signal(signal.SIGKILL)
        drive(11, 61)
        spawn(*keeping).ready()
        with connect(at, client="looker", timeout_s=60) as looking, looking.map("kept", create=False) as looked:
            for n in range(61, 900):  # it goes on by itself; the robot drives, as robots do
                drive(n, n + 1)
                with contextlib.suppress(Unavailable):  # several inserts may be one step
                    looked.estimate.wait_for(looked.estimate.revision + 1, timeout_s=0.2)
                if f"x{n - 1}" in looked.estimate:
                    break
            keys, values = looked.estimate.columns("se2")
            # Every keyframe, each once: the place says which.
            np.testing.assert_allclose(values[:, 0], 1.0 + np.arange(len(keys)), atol=1e-6)
            assert [key & 0xFFFF for key in keys.tolist()] == list(range(len(keys)))
            assert len(keys) >= 60
    joined.signal(signal.SIGINT)
    assert joined.wait() == 0


def test_a_front_end_with_closures_and_gnss_makes_the_map_of_the_same_graph(
    endpoint: str, spawn: Callable[..., Process]
) -> None:
    """Its frames were published before the bridge came, as robots do at their start."""
    made = survey.survey()
    static, *said = survey.said(made)
    with (
        ros.session(endpoint) as bus,
        connect(endpoint, client="looker", timeout_s=60) as looking,
        looking.map("surveyed") as looked,
        looking.map("drafted") as other,
    ):
        robot = ros.RosNode(bus, 11)
        robot.latch("/tf_static", static.message)
        robot.subscribe("/factorbus/path", words.Path)
        robot.subscribe("/factorbus/markers", words.MarkerArray)
        robot.subscribe("/factorbus/pose", words.PoseWithCovarianceStamped)
        topics = ("--pose-graph", "/kimera/pose_graph", "--fix", "/gps/fix")
        joined = bridge(spawn, endpoint, "surveyed", 11, "--display", "0.1", *topics)
        robot.wait_for_endpoints(10)
        for each in said:
            robot.publish(each.topic, each.message)
        other.insert(survey.drafted(made))
        wanted = other.graph().batch.factor_count
        while True:
            seen = looked.estimate.revision  # before the question: a step may come between the two
            if looked.graph().batch.factor_count >= wanted:
                break
            looked.estimate.wait_for(seen + 1)
        looked.settle()
        other.settle()
        assert looked.chi2().chi2 == pytest.approx(other.chi2().chi2, rel=1e-6)
        for estimate in (looked.estimate, other.estimate):
            estimate.wait_for(estimate.revision)
        np.testing.assert_allclose(looked.estimate.columns("se2")[1], other.estimate.columns("se2")[1], atol=1e-4)
        last, stamp = f"x{survey.COUNT - 1}", ros.stamp(survey.at(survey.COUNT - 1))
        newest: dict[str, Any] = {}

        def whole() -> bool:
            if len(newest) < 3 or (pose := newest["/factorbus/pose"]).header.stamp != stamp:
                return False
            drawn = len(newest["/factorbus/path"].poses), len(newest["/factorbus/markers"].markers[1].points)
            near = np.allclose(ros.plane(pose.pose.pose), looked.estimate[last], atol=1e-3)
            # The frame of GNSS is no pose of the robot.
            return drawn == (survey.COUNT, survey.COUNT) and near

        while not whole():  # each is published when something changes, and not again
            topic, message, _ = robot.came.get(timeout=30)
            newest[topic] = message
        pose = newest["/factorbus/pose"]
        c, s = (f(looked.estimate[last][2]) for f in (math.cos, math.sin))
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        wanted = R @ looked.uncertainty.covariance([last])[last] @ R.T
        told = np.array(pose.pose.covariance).reshape(6, 6)[np.ix_((0, 1, 5), (0, 1, 5))]
        np.testing.assert_allclose(told, wanted, rtol=0.02, atol=1e-7)
    joined.signal(signal.SIGINT)
    assert joined.wait() == 0
    log = joined.errors()
    for text in ("the origin of GNSS is", "GNSS's frame f0 by", "its edges of odometry are left out"):
        assert log.count(text) == 1, text


def test_landmark_lists_and_tags_are_heard_by_their_types(
    endpoint: str, spawn: Callable[..., Process], node: Any
) -> None:
    joined = bridge(spawn, endpoint, "listed", 9, "--landmark-list", "/landmark", "--tags", "/tags")
    node.wait_for_endpoints(10)
    node.publish("/odom", ros.odometry(SECOND, (0.0, 0.0, 0.0)))
    node.publish("/landmark", ros.landmark_list(SECOND, "base_link", [("7", (2.0, 1.0, 0.0), 20.0)]))
    node.publish("/tags", ros.tags(SECOND, "base_link", [([8], (3.0, -1.0, 0.0), 0.05)]))
    with connect(endpoint, client="looker", timeout_s=60) as bus, bus.map("listed") as looked:
        looked.estimate.wait_for(3)
        keys, places = looked.estimate.columns("point2")
        assert [key & 0xFF for key in keys.tolist()] == [7, 8]
        np.testing.assert_allclose(places, [[2.0, 1.0], [3.0, -1.0]], atol=1e-6)
    joined.signal(signal.SIGTERM)
    assert joined.wait() == 0
