"""Loop closures from the graphs of front ends: to which keyframes, how certain, once, and what is said of the rest."""

import math
from typing import Any

import numpy as np
import pytest
import ros
from numpy.testing import assert_allclose
from test_ros2_front_end import TINY, covariance_of, exp, only

from factorbus.client import Draft
from factorbus.proto.symbols import symbol
from factorbus.ros2 import closures
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.geometry import from_plane
from factorbus.ros2.messages import LINK, MAP_GRAPH, ODOMETRY, POSE_GRAPH, Messages
from factorbus.ros2.settings import Settings

MESSAGES = Messages("jazzy")
SECOND = 10**9
HERE = (0.0, 0.0, 0.0)


class Robot:
    """A front end that has driven a metre a second for ten seconds, a keyframe each metre from x0 at 0 s on."""

    def __init__(self, seconds: int = 10, **settings: Any) -> None:
        self.front_end = FrontEnd(Settings(**{"keyframe_m": 0.9} | settings), 0, (), False)
        for n in range(seconds + 1):
            self.drive(float(n))

    def drive(self, at_s: float, speeds: list[float] | None = None) -> Draft | None:
        return self.take("/odom", ODOMETRY, ros.odometry(int(at_s * SECOND), (at_s, 0.0, 0.0), speeds))

    def take(self, topic: str, type_name: str, message: Any) -> Draft | None:
        return self.front_end.take(topic, type_name, MESSAGES.read(topic, type_name, bytes(message.serialize())))

    def graph(self, nodes: dict[int, float], edges: list[tuple[int, int, int, Any]], **more: Any) -> Draft | None:
        """nodes: by key the second in which they are."""
        stamps = {key: int(at_s * SECOND) for key, at_s in nodes.items()}
        return self.take("/graph", POSE_GRAPH, ros.pose_graph(10 * SECOND, stamps, edges, **more))

    @property
    def said(self) -> list[str]:
        return [text for _, text in self.front_end.remarks]


def test_a_closure_between_keyframes_is_a_factor_between_them_as_it_came() -> None:
    made = only(Robot().graph({5: 1, 9: 8}, [(5, 9, 1, (0.25, -0.5, 0.125))]), "between_se2")
    assert made.keys.tolist() == [[symbol("x", 1), symbol("x", 8)]]
    assert_allclose(made.measured, [[0.25, -0.5, 0.125]], atol=1e-12)
    assert_allclose(covariance_of(made, 3), np.diag([0.01, 0.01, 0.02**2]), rtol=1e-9)  # the floor: 0.02 rad


@pytest.mark.parametrize("space", ["plane", "space"])
def test_between_keyframes_it_is_carried_by_odometry_with_the_covariance_of_its_derivatives(space: str) -> None:
    """Node 1 is 0.25 m after x0, node 2 0.5 m after x3: what each of the three ways adds, by differences."""
    floors = TINY.__class__(**dict.fromkeys(TINY.__dataclass_fields__, 1e-07))
    robot, speeds = Robot(0, space=space, floors=floors), [0.04, 0.01, 0.09, 0.02, 0.03, 0.05]
    for at_s in (0.25, 1.0, 2.0, 3.0, 3.5, 4.0):
        robot.drive(at_s, speeds)
    variances = [0.4, 0.3, 0.2, 0.1, 0.2, 0.3]
    draft = robot.graph({1: 0.25, 2: 3.5}, [(1, 2, 1, (2.0, 1.0, 0.5))], variances=variances)
    made = only(draft, "between_se2" if space == "plane" else "between_se3")
    assert made.keys.tolist() == [[symbol("x", 0), symbol("x", 3)]]
    first, there, second = from_plane(0.25, 0, 0), from_plane(2.0, 1.0, 0.5), from_plane(0.5, 0, 0)
    T = first @ there @ second.inverse()
    axes = [0, 1, 5] if space == "plane" else list(range(6))

    def off(of: int, delta: np.ndarray) -> np.ndarray:
        parts = [first, there, second]
        parts[of] = parts[of] @ exp(delta)
        left = T.inverse() @ parts[0] @ parts[1] @ parts[2].inverse()
        skew = 0.5 * (left.R - left.R.T)
        return np.array([*left.t, skew[2, 1], skew[0, 2], skew[1, 0]])

    wanted = np.zeros((6, 6))
    for of, spread in enumerate((0.0625 * np.array(speeds), np.array(variances), 0.25 * np.array(speeds))):
        spread = spread * np.isin(range(6), axes)
        J = np.column_stack([(off(of, 1e-6 * e) - off(of, -1e-6 * e)) / 2e-6 for e in np.eye(6)])
        wanted += J @ np.diag(spread) @ J.T
    halves = np.ones(3) if space == "plane" else np.array([1, 1, 1, 2.0, 2, 2])
    told = covariance_of(made, len(axes)) * np.outer(halves, halves)
    assert_allclose(told, wanted[np.ix_(axes, axes)], rtol=1e-5, atol=1e-8)
    assert_allclose(made.measured[0][:2], T.t[:2], atol=1e-9)


def test_a_graph_that_comes_again_brings_only_what_is_new() -> None:
    robot = Robot()
    edges: list[tuple[int, int, int, Any]] = [(1, 8, 1, HERE), (1, 2, 0, HERE)]
    assert robot.graph({1: 1, 2: 2, 8: 8}, edges) is not None
    assert robot.graph({1: 1, 2: 2, 8: 8}, edges) is None
    assert robot.graph({}, [(8, 1, 1, HERE)]) is None  # the other way round
    more = only(robot.graph({1: 1, 2: 2, 8: 8}, [*edges, (2, 8, 1, HERE)]), "between_se2")
    assert more.keys.tolist() == [[symbol("x", 2), symbol("x", 8)]]
    assert sum("edges of odometry are left out" in text for text in robot.said) == 1
    assert not robot.front_end.refused


def test_an_edge_waits_for_its_node_and_a_node_for_its_odometry() -> None:
    robot = Robot()
    assert robot.graph({1: 1}, [(1, 12, 1, HERE), (1, 12, 0, HERE)]) is None
    assert robot.graph({1: 1}, [(1, 12, 1, HERE)]) is None
    assert sum("it waits for it" in text for text in robot.said) == 1, "once"
    assert [text for _, text in robot.front_end.open_ends()] == [
        "1 closure still waits for a node; the first is the edge from node 1 of robot 0 to node 12 of robot 0"
    ]
    assert robot.graph({12: 12}, []) is None  # its odometry is not there yet
    robot.drive(11.0)
    draft = robot.drive(12.0)
    assert draft is not None
    keys = [keys for group in draft.batch().factors for keys in group.keys.tolist()]
    assert [symbol("x", 1), symbol("x", 12)] in keys
    assert [symbol("x", 11), symbol("x", 12)] in keys
    assert not list(robot.front_end.open_ends())


def test_only_so_many_edges_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closures, "_WAITING", 3)
    robot = Robot()
    robot.graph({1: 1}, [(1, n, 1, HERE) for n in range(100, 105)])
    assert [str(bad.detail["seen"]) for bad in robot.front_end.refused] == [
        f"the edge from node 1 of robot 0 to node {n} of robot 0: a node that did not come" for n in (100, 101)
    ]
    draft = robot.graph({n: n - 95 for n in range(100, 105)}, [])
    assert only(draft, "between_se2").keys[:, 1].tolist() == [symbol("x", n) for n in (7, 8, 9)]


def test_what_changes_is_removed_or_rejected_is_said_and_the_map_keeps_it() -> None:
    robot, nodes = Robot(), {n: float(n) for n in range(6)}
    edges: list[tuple[int, int, int, Any]] = [(0, 4, 1, HERE), (0, 3, 1, HERE), (0, 5, 1, HERE), (1, 5, 3, HERE)]
    assert len(only(robot.graph(nodes, edges), "between_se2").keys) == 3
    assert sum("rejected are left out" in text for text in robot.said) == 1
    for _ in range(2):  # said once
        assert robot.graph(nodes, [(0, 4, 1, (0.1, 0.0, 0.0)), (0, 5, 3, HERE), (1, 5, 3, HERE)]) is None
    for text in (
        "a closure came again with other numbers; the first ones stay in the map",
        "the front end has rejected a closure that is in the map, where it stays",
        "the front end has removed a closure that is in the map, where it stays",
    ):
        assert robot.said.count(text) == 1


def test_a_part_of_a_graph_removes_nothing() -> None:
    robot = Robot()
    robot.graph({1: 1, 8: 8}, [(1, 8, 1, HERE)])
    robot.graph({9: 9}, [(1, 9, 1, HERE)])
    assert not any("removed" in text for text in robot.said)


def test_edges_that_are_none_between_places_of_this_robot_are_left_out_and_said() -> None:
    robot = Robot()
    edges: list[tuple[int, int, int, Any]] = [(1, 2, 2, HERE), (1, 2, 4, HERE), (1, 2, 77, HERE), (3, 4, 1, HERE)]
    assert robot.graph({1: 1, 2: 2, 3: 3, 4: 3.5}, edges) is None
    for word in ("LANDMARK", "MESH", "type 77", "at the same keyframe"):
        assert any(word in text for text in robot.said), word
    assert robot.graph({5: 5, 6: 6}, [(5, 6, 1, HERE)], robot=1) is None
    assert any("robots other than 0" in text for text in robot.said)
    second = Robot(robot_id=1)
    assert second.graph({5: 5, 6: 6}, [(5, 6, 1, HERE)], robot=0) is None
    assert second.graph({5: 5, 6: 6}, [(5, 6, 1, HERE)], robot=1) is not None


def test_a_node_from_before_what_is_remembered_has_no_place() -> None:
    robot = Robot()
    robot.front_end.begin_again(0, (), False)
    robot.drive(11.0)
    assert robot.graph({1: 1, 2: 11}, [(1, 2, 1, HERE)]) is None
    assert any("no place on odometry" in text for text in robot.said)
    (bad,) = robot.front_end.refused
    assert "a node without a place" in str(bad.detail["seen"])
    assert not bad.of_message


def test_after_a_refusal_edges_of_keyframes_that_are_not_there_are_not_taken_for_inserted() -> None:
    robot = Robot()
    robot.graph({1: 1, 2: 2, 8: 8}, [(1, 8, 1, HERE), (1, 2, 1, HERE)])
    robot.front_end.rewind(lambda key: key < symbol("x", 8))
    robot.drive(12.0)  # x11, which hangs on x7
    draft = robot.graph({8: 12, 1: 1}, [(1, 8, 1, HERE), (1, 2, 1, HERE)])
    assert only(draft, "between_se2").keys.tolist() == [[symbol("x", 1), symbol("x", 11)]]


def test_covariances_of_gtsam_have_rotation_first() -> None:
    variances = [1e-3, 1e-3, 1e-3, 0.04, 0.09, 0.16]
    told = [
        covariance_of(only(robot.graph({1: 1, 2: 8}, [(1, 2, 1, HERE)], variances=variances), "between_se2"), 3)
        for robot in (Robot(rotation_first=True), Robot(rotation_first=False))
    ]
    assert_allclose(told[0], np.diag([0.04, 0.09, 1e-3]), rtol=1e-6)
    assert_allclose(told[1], np.diag([0.05**2, 0.05**2, 0.16]), rtol=1e-6)  # floors of 5 cm


def test_a_covariance_of_zeros_means_the_floor() -> None:
    draft = Robot().graph({1: 1, 2: 8}, [(1, 2, 1, HERE)], variances=[0.0] * 6)
    assert_allclose(covariance_of(only(draft, "between_se2"), 3), np.diag([0.05**2, 0.05**2, 0.02**2]), rtol=1e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0])
def test_a_bad_edge_is_refused_once_and_the_others_are_used(bad: float) -> None:
    robot = Robot()
    good = ros.pose_graph(10 * SECOND, {n: n * SECOND for n in range(1, 9)}, [(1, n, 1, HERE) for n in (5, 6, 7, 8)])
    good.edges[0].covariance[0] = bad
    good.edges[1].pose.position.x = math.nan if bad < 0 else bad
    good.edges[2].pose.orientation.w = 0.0
    good.nodes[0].header.stamp.nanosec = 1
    for n in range(2):
        draft = robot.take("/graph", POSE_GRAPH, good)
        assert (draft is None) == (n == 1)
    assert sum("covariance" in str(each.detail["seen"]) for each in robot.front_end.refused) == 1
    assert all(not each.of_message and "the edge from node 1" in each.message for each in robot.front_end.refused)


def test_the_newest_node_of_a_map_graph_is_that_of_its_header() -> None:
    """And it stays where it was when the graph is published again later, without a new one."""
    robot = Robot()
    for number, at_s in enumerate((1, 5, 8), 1):
        numbers = [*range(1, number + 1), -4]  # below 0 is a landmark
        assert (
            robot.take("/mapGraph", MAP_GRAPH, ros.map_graph(at_s * SECOND, numbers, [ros.link(1, 1, 9, HERE)])) is None
        )
    graph = ros.map_graph(9 * SECOND, [1, 2, 3], [ros.link(3, 1, 1, (-7.0, 0.0, 0.0)), ros.link(1, 2, 0, HERE)])
    made = only(robot.take("/mapGraph", MAP_GRAPH, graph), "between_se2")
    assert made.keys.tolist() == [[symbol("x", 8), symbol("x", 1)]]
    assert_allclose(covariance_of(made, 3), np.diag([0.01, 0.01, 0.02**2]), rtol=1e-9)
    draft = robot.take("/link", LINK, ros.link(3, 2, 4, (-3.0, 0.0, 0.0)))
    assert only(draft, "between_se2").keys.tolist() == [[symbol("x", 8), symbol("x", 5)]]
    assert any("Gravity" in text for text in robot.said)


def test_an_information_without_some_axes_says_nothing_of_them() -> None:
    robot = Robot(space="space")
    robot.take("/mapGraph", MAP_GRAPH, ros.map_graph(SECOND, [1], []))
    of_plane = ros.link(2, 1, 1, HERE)
    for axis in (2, 3, 4):
        of_plane.information[7 * axis] = 0.0
    made = only(robot.take("/mapGraph", MAP_GRAPH, ros.map_graph(8 * SECOND, [1, 2], [of_plane])), "between_se3")
    sigmas = np.sqrt(np.diag(covariance_of(made, 6))) * [1, 1, 1, 2, 2, 2]
    assert_allclose(sigmas[2:5], [1000.0, math.pi, math.pi], rtol=1e-3)
    assert_allclose(sigmas[[0, 1, 5]], [0.1, 0.1, 0.02], rtol=1e-3)
    assert any("in z, roll, pitch" in text for text in robot.said)


@pytest.mark.parametrize("information", [[-1.0], [math.nan], [1.0, 5.0]])
def test_an_information_that_cannot_be_is_refused(information: list[float]) -> None:
    robot = Robot()
    robot.take("/mapGraph", MAP_GRAPH, ros.map_graph(SECOND, [1], []))
    bad = ros.link(2, 1, 1, HERE)
    bad.information[: len(information)] = information
    assert robot.take("/mapGraph", MAP_GRAPH, ros.map_graph(8 * SECOND, [1, 2], [bad])) is None
    (refused,) = robot.front_end.refused
    assert "the edge from node 2 to node 1: an information that is not" in refused.message
