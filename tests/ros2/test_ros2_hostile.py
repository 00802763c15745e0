"""No message ends the bridge, whatever a driver or an attacker puts into it, and the map stays finite."""

import logging
import math
import queue
import random
import sys
import threading
from typing import Any

import numpy as np
import pytest
import ros
import words
from hypothesis import given, settings
from hypothesis import strategies as st

from factorbus.client.draft import Draft
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import symbol
from factorbus.ros2.bridge import Bridge
from factorbus.ros2.certainty import checked_covariance, information
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.messages import (
    DETECTIONS,
    FIX,
    IMU,
    LANDMARK_LIST,
    LINK,
    MAP_GRAPH,
    ODOMETRY,
    POSE,
    POSE_GRAPH,
    TAGS,
    TRANSFORMS,
    Messages,
)
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import Settings
from factorbus.solver import Options, Solver, SolverError

MESSAGES = Messages("jazzy")
SECOND = 10**9
LARGEST = sys.float_info.max
TOPICS = {
    ODOMETRY: "/odom", POSE: "/initialpose", DETECTIONS: "/detections", FIX: "/fix", POSE_GRAPH: "/graph",
    MAP_GRAPH: "/mapGraph", LINK: "/link", TRANSFORMS: "/tf_static", IMU: "/imu",
    LANDMARK_LIST: "/landmark", TAGS: "/tags",
}  # fmt: skip
WILD = (
    0.0, -0.0, 5e-324, -5e-324, 1e-160, 1e9, -1e9, 1.1e9, 1e12, 1e154, -1e154, 1e155, 1e300, 1e308, LARGEST, -LARGEST,
    -1.0, 1.0, math.inf, -math.inf, math.nan,
)  # fmt: skip
MUTANTS = 12_000


class Estimate:
    """What the mirror of a map tells, of a solver in this process."""

    def __init__(self, solver: Solver) -> None:
        self._solver, self.epoch, self.revision = solver, 1, 0

    def values(self) -> dict[int, np.ndarray]:
        return {int(key): row for g in self._solver.estimate() for key, row in zip(g.keys, g.values, strict=True)}

    def __contains__(self, key: int) -> bool:
        return key in self.values()

    def __getitem__(self, key: int) -> np.ndarray:
        return self.values()[key]


class Robot:
    """A front end with a map behind it: what it drafts is inserted, what is refused is taken back."""

    def __init__(self, space: str) -> None:
        self.front_end = FrontEnd(Settings(space=space, imu="/imu" if space == "space" else ""), 0, (), False)
        self.solver, self.ns = Solver(Options()), SECOND
        self.inserted = self.refused = self.unused = self.said = 0

    def hear(self, type_name: str, data: bytes) -> None:
        topic = TOPICS[type_name]
        try:
            message = MESSAGES.read(topic, type_name, data)
            draft = self.draft(topic, type_name, message)
        except BadRosMessage:
            self.unused += 1
            return
        finally:
            self.said += len(self.front_end.refused) + len(self.front_end.remarks)
            assert all(each.code == "bad_ros_message" for each in self.front_end.refused)
            self.front_end.refused.clear()
            self.front_end.remarks.clear()
        if draft is not None:
            self.insert(draft.batch())

    def draft(self, topic: str, type_name: str, message: Any) -> Draft | None:
        if type_name == TRANSFORMS:
            self.front_end.static(topic, message)
            return None
        return self.front_end.take(topic, type_name, message)

    def insert(self, batch: Batch) -> None:
        assert all(np.isfinite(group.measured).all() for group in batch.factors)
        assert all(np.isfinite(group.information).all() for group in batch.factors)
        try:
            self.solver.stage(batch)
            report = self.solver.step()
        except SolverError:
            self.refused += 1
            values = Estimate(self.solver).values()
            self.front_end.rewind(lambda key: key in values)
            return
        self.inserted += 1
        assert math.isfinite(report.chi2)
        assert all(np.isfinite(group.values).all() for group in self.solver.changed())

    def drive(self) -> None:
        """A metre on, with nothing wrong in it."""
        self.ns += SECOND
        self.hear(ODOMETRY, bytes(ros.odometry(self.ns, (self.ns / SECOND, 0.0, 0.0), [1e-4] * 6).serialize()))


def message(type_name: str, ns: int, numbers: random.Random) -> Any:
    """One with extreme values in a few of its places."""
    made, covariances, points, turns = plain(type_name, ns)
    for covariance in covariances:
        size = math.isqrt(len(covariance))
        diagonal = range(0, size**2, size + 1)
        for _ in range(numbers.choice((0, 1, 1, 2, 6))):
            covariance[numbers.choice((*diagonal, numbers.randrange(size**2)))] = numbers.choice(WILD)
    if numbers.random() < 0.3:
        point = numbers.choice(points)
        of_kinds = "xyz", ("latitude", "longitude", "altitude"), ("translation_weight", "rotation_weight")
        (names,) = [names for names in of_kinds if hasattr(point, names[0])]
        setattr(point, numbers.choice(names), numbers.choice(WILD))
    if turns and numbers.random() < 0.2:
        setattr(numbers.choice(turns), numbers.choice("xyzw"), numbers.choice(WILD))
    if hasattr(made, "header") and numbers.random() < 0.1:
        made.header.stamp = words.Time(numbers.choice((-(2**31), -1, 0, 2**31 - 1)), numbers.choice((0, 2**32 - 1)))
    return made


def plain(type_name: str, ns: int) -> tuple[Any, list[Any], list[Any], list[Any]]:
    """A message with nothing wrong in it, its covariances, its points and its quaternions."""
    n = ns // SECOND
    at = (ns / SECOND, 0.0, 0.0)
    if type_name == IMU:
        sample = ros.imu(ns, [0.01, 0.0, 0.0, 0.1, 0.0, 9.81], "base_link", orientation=0.0)
        covariances = [sample.angular_velocity_covariance, sample.linear_acceleration_covariance]
        return sample, covariances, [sample.angular_velocity, sample.linear_acceleration], [sample.orientation]
    if type_name == FIX:
        fix = ros.nav_fix(ns, (48.0, 11.0 + 1e-5 * at[0], 500.0), kind=n % 4, frame="camera")
        return fix, [fix.position_covariance], [fix], []
    if type_name == DETECTIONS:
        made = ros.detections(ns, "base_link", [(str(k), (1.0 + k, 2.0, 0.0), 0.1) for k in range(3)])
        results = [seen.results[0].pose for seen in made.detections]
    elif type_name == TAGS:
        made = ros.tags(ns, "base_link", [([k], (1.0 + k, 2.0, 0.0), 0.1) for k in range(3)])
        results = [seen.pose.pose for seen in made.detections]
    elif type_name == LANDMARK_LIST:
        made = ros.landmark_list(ns, "base_link", [(str(k), (1.0 + k, 2.0, 0.0), 10.0) for k in range(3)])
        poses = [seen.tracking_from_landmark_transform for seen in made.landmarks]
        return made, [], [*(each.position for each in poses), *made.landmarks], [each.orientation for each in poses]
    elif type_name == ODOMETRY:
        made = ros.odometry(ns, at, [1e-4] * 6)
        results = [made.pose]
    elif type_name == POSE:
        made = ros.known_pose(ns, at, [0.1] * 6)
        results = [made.pose]
    elif type_name == POSE_GRAPH:
        edges = [
            (max(n - k, 0), n - 1, kind, (float(k), 0.0, 0.0)) for k, kind in ((9, 1), (4, 1), (2, 0), (5, 3), (3, 9))
        ]
        made = ros.pose_graph(ns, {n: ns, n - 1: ns - SECOND}, edges)
        poses = [edge.pose for edge in made.edges]
        covariances = [edge.covariance for edge in made.edges]
        return made, covariances, [each.position for each in poses], [each.orientation for each in poses]
    else:
        return of_transforms(type_name, ns)
    covariances = [each.covariance for each in results]
    covariances += [made.twist.covariance] if type_name == ODOMETRY else []
    return made, covariances, [each.pose.position for each in results], [each.pose.orientation for each in results]


def of_transforms(type_name: str, ns: int) -> tuple[Any, list[Any], list[Any], list[Any]]:
    """The same of messages that have no poses but transforms."""
    n = ns // SECOND
    if type_name == TRANSFORMS:
        there = words.Transform(words.Vector3(0.1, 0.0, 0.2), words.Quaternion(0.0, 0.0, 0.0, 1.0))
        made = words.TFMessage([words.TransformStamped(words.Header(ros.stamp(ns), "base_link"), "camera", there)])
        return made, [], [there.translation], [there.rotation]
    links = [ros.link(n, n - k, kind, (-float(k), 0.0, 0.0)) for k, kind in ((8, 1), (3, 2), (1, 0), (0, 7))]
    made = links[0] if type_name == LINK else ros.map_graph(ns, list(range(max(n - 20, 1), n + 1)), links)
    of = [each.transform for each in links]
    return made, [each.information for each in links], [each.translation for each in of], [each.rotation for each in of]


@pytest.mark.parametrize("space", ["plane", "space"])
def test_extreme_numbers_leave_the_map_finite(space: str, record_property: Any) -> None:
    seed = random.randrange(2**32)
    record_property("seed", seed)
    print("seed", seed)
    numbers, robot = random.Random(seed), Robot(space)
    robot.drive()
    for n in range(320):  # and others in the next run
        if n % 40 == 0:  # a map of its own: what is taken in makes each step longer
            robot = Robot(space)
            robot.drive()
        robot.ns += SECOND
        for type_name in TOPICS:
            robot.hear(type_name, bytes(message(type_name, robot.ns, numbers).serialize()))
        robot.drive()
    assert robot.said, "the problem is reported"
    before = robot.inserted
    robot.drive()
    assert robot.inserted == before + 1, "after all of this it still drives"


@pytest.mark.parametrize("type_name", TOPICS)
def test_mutants_of_messages_are_read_or_refused(type_name: str, record_property: Any) -> None:
    """Bytes flipped, overwritten, cut out, doubled and cut off: among them every length and count of the message."""
    seed = random.randrange(2**32)
    record_property("seed", seed)
    print("seed", seed)
    numbers = random.Random(seed)
    end = Robot("plane")
    for n in range(MUTANTS // 6):
        if n % 200 == 0:
            end = Robot("plane")
            end.drive()
        if n % 4 == 0:
            end.drive()
        ahead = SECOND if type_name == ODOMETRY else 0
        data = bytearray(bytes(message(type_name, end.ns + ahead, numbers).serialize()))
        for _ in range(numbers.choice((1, 1, 2, 8))):
            where = numbers.randrange(len(data))
            how = numbers.randrange(5)
            if how == 0:
                data[where] ^= 1 << numbers.randrange(8)
            elif how == 1:
                data[where : where + 4] = numbers.choice((b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80"))
            elif how == 2:
                del data[where : where + numbers.randrange(1, 9)]
            elif how == 3:
                data[where:where] = data[where : where + numbers.randrange(1, 9)]
            else:
                del data[where:]
            data = data or bytearray(b"\0")
        end.hear(type_name, bytes(data))


@pytest.mark.parametrize("type_name", [FIX, ODOMETRY])
def test_a_signalling_nan_is_one_of_the_numbers_that_are_refused(type_name: str) -> None:
    """An operation on it sets the flag of invalid operations, which NumPy reports as a warning; here that fails."""
    signalling = (0x7FF0_0000_0000_0001).to_bytes(8, "little")
    end = Robot("plane")
    end.drive()
    ahead = SECOND if type_name == ODOMETRY else 0
    whole = bytes(message(type_name, end.ns + ahead, random.Random(1)).serialize())
    for where in range(4, len(whole) - 8, 4):
        end.hear(type_name, whole[:where] + signalling + whole[where + 8 :])
    assert end.unused > 2


def covariance(*diagonal: float) -> list[float]:
    return ros.diagonal(*diagonal)


@pytest.mark.parametrize("largest", [1e12, 1e154, 1e308, LARGEST])
def test_an_axis_with_a_huge_variance_is_not_known_and_the_others_are(largest: float) -> None:
    numbers = covariance(0.04, 0.09, largest, largest, largest, 0.01)
    numbers[2] = numbers[12] = largest  # and correlated with one that is
    made = checked_covariance("/odom", np.array(numbers), (0, 1, 2, 3, 4, 5))
    assert made.unknown == (2, 3, 4)
    np.testing.assert_allclose(made.whole, np.diag([0.04, 0.09, 1e6, math.pi**2, math.pi**2, 0.01]))
    assert "in z, roll, pitch" in made.remark()
    assert (
        checked_covariance("/odom", np.array(numbers), (0, 1, 5)).remark() == ""
    )  # in the plane nothing is wrong with it


def test_in_space_odometry_that_does_not_know_its_height_says_so_in_the_map() -> None:
    made = FrontEnd(Settings(space="space"), 0, (), False)
    for n in range(2):
        told = ros.odometry((n + 1) * SECOND, (float(n), 0.0, 0.0))
        told.pose.covariance = covariance(0.0, 0.0, LARGEST, LARGEST, LARGEST, 0.0)
        draft = made.odometry(MESSAGES.read("/odom", ODOMETRY, bytes(told.serialize())))
    assert draft is not None
    omega = np.zeros((6, 6))
    omega[np.triu_indices(6)] = draft.batch().factors[0].information[0]
    sigmas = np.sqrt(1.0 / omega.diagonal()) * [1, 1, 1, 2, 2, 2]
    np.testing.assert_allclose(sigmas[2:5], [1000.0, math.pi, math.pi], rtol=1e-3)
    np.testing.assert_allclose(sigmas[[0, 1, 5]], [0.02, 0.02, 0.01], rtol=1e-3)  # the floors of one metre


@settings(max_examples=300)
@given(st.lists(st.sampled_from(WILD) | st.floats(), min_size=36, max_size=36))
def test_whatever_passes_has_an_inverse(numbers: list[float]) -> None:
    try:
        made = checked_covariance("/t", np.array(numbers), (0, 1, 2, 3, 4, 5))
    except BadRosMessage:
        return
    assert np.linalg.eigvalsh(information(made.whole + np.eye(6)))[0] > 0.0


class Listening:
    """A node that hands over what it is told, and forgets what is published."""

    def __init__(self) -> None:
        self.hear: dict[str, Any] = {}

    def subscribe(self, topic: Any, hear: Any, _kept: bool) -> None:
        self.hear[topic.name] = hear

    def publisher(self, _topic: Any) -> "Listening":
        return self

    def publish(self, _data: bytes) -> None:
        pass


class FakeMap:
    """A map that takes everything, and says when."""

    def __init__(self) -> None:
        self.sent: queue.SimpleQueue[Draft] = queue.SimpleQueue()
        self.estimate = self
        self.epoch, self.revision = 1, 0

    def on_delta(self, _: Any) -> Any:
        return lambda: None

    def snapshot(self) -> Any:
        return type("Nothing", (), {"columns": {}})()

    def __getitem__(self, key: int) -> np.ndarray:
        raise KeyError(key)

    def send(self, draft: Draft, timeout_s: float) -> Any:
        self.sent.put(draft)
        return type("Done", (), {"done": lambda _: True, "result": lambda *_: None})()


def test_a_bridge_says_once_what_it_did_and_survives_a_fault_of_its_own(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, joined, stop = Listening(), FakeMap(), threading.Event()
    topics = Settings(space="space", display_s=60.0, pose_graphs=("/graph",), fixes=("/fix",))
    bridge = Bridge(joined, node, MESSAGES, topics)  # type: ignore[arg-type]
    detections = FrontEnd.detections

    def fails(front_end: FrontEnd, topic: str, message: Any) -> Draft | None:
        if message.header.frame_id == "fault":
            raise ZeroDivisionError("as if")
        return detections(front_end, topic, message)

    monkeypatch.setattr(FrontEnd, "detections", fails)
    running = threading.Thread(target=bridge.run, args=(stop,))
    with caplog.at_level(logging.WARNING, "factorbus.ros2"):
        running.start()
        for n in range(1, 6):
            node.hear["/detections"](bytes(ros.detections(n * SECOND, "fault", [("1", (1, 0, 0), 0.1)]).serialize()))
            node.hear["/odom"](b"\0\1\0\0 no odometry")
            told = ros.odometry(n * SECOND, (float(n), 0.0, 0.0))
            told.twist.covariance = covariance(0.01, 0.01, LARGEST, 1e308, 1e308, 0.01)
            node.hear["/odom"](bytes(told.serialize()))
            node.hear["/fix"](bytes(ros.nav_fix(n * SECOND, (91.0, 11.0, 500.0)).serialize()))
            graph = ros.pose_graph(n * SECOND, {n: n * SECOND}, [(1, n, 1, (1, 0, 0))] if n > 1 else [], [math.nan] * 6)
            node.hear["/graph"](bytes(graph.serialize()))
            turned, _, _, (turn,) = plain(TRANSFORMS, n * SECOND)
            turn.w = 0.0
            node.hear["/tf_static"](bytes(turned.serialize()))
        node.hear["/odom"](bytes(ros.odometry(6 * SECOND, (6.0, 0.0, 0.0)).serialize()))  # after all of it
        drafts = [joined.sent.get(timeout=60) for _ in range(6)]
        stop.set()
        running.join(30)
    assert [draft.batch().variables[0].keys.tolist() for draft in drafts] == [[symbol("x", n)] for n in range(6)]
    said = [record.getMessage() for record in caplog.records]
    assert len([text for text in said if text.startswith("/odom: twist: a covariance with a variance of")]) == 1
    refused = [text.split(":")[0] for text in said if "[bad_ros_message]" in text]
    assert sorted(refused) == ["/fix", "/graph", "/odom", "/tf_static"], "the first on each topic"
    assert len([text for text in said if text.startswith("/graph: robot 0 of the graph is this one")]) == 1
    assert len([text for text in said if "ZeroDivisionError: as if" in text and "[internal]" in text]) == 1
    assert (bridge.counts["internal"], bridge.counts["bad_ros_message"], bridge.counts["remarks"]) == (5, 19, 6)
