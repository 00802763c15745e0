"""A ROS 2 node over bare Zenoh, for tests and measurements: nothing of ours, messages by `words`."""

import itertools
import json
import math
import queue
import time
from collections.abc import Callable
from typing import Any

import words
import xxhash
import zenoh
from zenoh.ext import CacheConfig, Int64, UInt8, declare_advanced_publisher, z_deserialize, z_serialize
from zenoh.handlers import Callback


def session(endpoint: str) -> zenoh.Session:
    """As a client of whatever listens there."""
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,  # as rmw_zenoh has it: what is kept for late subscribers needs it
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def topic_key(domain: int, topic: str, cls: type) -> str:
    package, folder, name = words.type_name(cls).split("/")
    return f"{domain}{topic}/{package}::{folder}::dds_::{name}_/{words.type_hash(cls)}"


class RosNode:
    """Publishes and hears; what is heard comes as (topic, message, attachment)."""

    def __init__(self, bus: zenoh.Session, domain: int) -> None:
        self._bus, self._domain, self._gid = bus, domain, xxhash.xxh3_128_digest(b"robot")
        self._publishers: dict[str, Any] = {}
        self._sequence = itertools.count(1)
        self.came: queue.SimpleQueue[tuple[str, Any, Any]] = queue.SimpleQueue()
        self._kept: list[Any] = []

    def publish(self, topic: str, message: Any) -> None:
        """With the attachment that rmw_zenoh's subscriptions want."""
        if topic not in self._publishers:
            self._publishers[topic] = self._bus.declare_publisher(topic_key(self._domain, topic, type(message)))
        gid = [UInt8(byte) for byte in self._gid]
        head = bytes(z_serialize(Int64(next(self._sequence)))) + bytes(z_serialize(Int64(time.time_ns())))
        self._publishers[topic].put(bytes(message.serialize()), attachment=head + bytes(z_serialize(gid)))

    def latch(self, topic: str, message: Any) -> None:
        """Publish what late subscribers get, too (transient local), as rmw_zenoh does."""
        made = declare_advanced_publisher(
            self._bus, topic_key(self._domain, topic, type(message)), cache=CacheConfig(100), publisher_detection=True
        )
        self._kept.append(made)
        made.put(bytes(message.serialize()))

    def subscribe(self, topic: str, cls: Any) -> None:
        def hear(sample: zenoh.Sample) -> None:
            attached = sample.attachment.to_bytes() if sample.attachment else b""
            self.came.put((topic, cls.deserialize(sample.payload.to_bytes()), read_attachment(attached)))

        key = topic_key(self._domain, topic, cls)
        self._kept.append(self._bus.declare_subscriber(key, Callback(hear, indirect=False)))

    def call(self, service: str, timeout_s: float = 60.0, attached: bool = True) -> tuple[bool, str, Any]:
        """(success, message, attachment) of a std_srvs/Trigger, called as rmw_zenoh's clients do."""
        gid = [UInt8(byte) for byte in self._gid]
        head = bytes(z_serialize(Int64(next(self._sequence)))) + bytes(z_serialize(Int64(time.time_ns())))
        key = f"{self._domain}{service}/std_srvs::srv::dds_::Trigger_/{words.TRIGGER_HASH}"
        replies = self._bus.get(
            key,
            payload=bytes(words.TriggerRequest(0).serialize()),
            attachment=head + bytes(z_serialize(gid)) if attached else None,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
        )
        (sample,) = [reply.ok for reply in replies if reply.ok is not None]
        answer = words.TriggerResponse.deserialize(sample.payload.to_bytes())
        return answer.success, answer.message, read_attachment(sample.attachment.to_bytes())

    def tokens(self, count: int) -> list[str]:
        """Who is there, as `ros2 topic list` finds out, once a number of tokens are seen."""
        return sorted(self._watch(lambda seen: len(seen) >= count))

    def wait_for_endpoints(self, count: int) -> list[str]:
        """The tokens of nodes, publishers and subscriptions, once a node and a number of others are seen.

        A token comes after what it stands for; in what order they come is not said.
        """

        def enough(seen: list[str]) -> bool:
            kinds = [token.split("/")[5] for token in seen]
            return kinds.count("MP") + kinds.count("MS") >= count and "NN" in kinds

        return self._watch(enough)

    def _watch(self, enough: Callable[[list[str]], bool], timeout_s: float = 60.0) -> list[str]:
        """The tokens there are and those that come, each once; a single question may come before a router knows."""
        came: queue.SimpleQueue[str] = queue.SimpleQueue()

        def see(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                came.put(str(sample.key_expr))

        key = f"@ros2_lv/{self._domain}/**"
        watching = self._bus.liveliness().declare_subscriber(key, Callback(see, indirect=False), history=True)
        seen: list[str] = []
        while not enough(seen):
            token = came.get(timeout=timeout_s)
            if token not in seen:
                seen.append(token)
        watching.undeclare()
        return seen

    def wait_for(self, topic: str, timeout_s: float = 30.0) -> tuple[Any, Any]:
        """The next message on a topic; others are passed over."""
        end = time.monotonic() + timeout_s
        while True:
            came, message, attached = self.came.get(timeout=max(end - time.monotonic(), 0.001))
            if came == topic:
                return message, attached


def read_attachment(data: bytes) -> tuple[int, int, bytes]:
    """Number, time, gid, by Zenoh's own serialization."""
    number, stamp = z_deserialize(Int64, zenoh.ZBytes(data[:8])), z_deserialize(Int64, zenoh.ZBytes(data[8:16]))
    return int(number), int(stamp), bytes(z_deserialize(list[UInt8], zenoh.ZBytes(data[16:])))


def stamp(ns: int) -> Any:
    return words.Time(ns // 10**9, ns % 10**9)


def pose(x: float, y: float, yaw: float) -> Any:
    turn = words.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return words.Pose(words.Point(x, y, 0.0), turn)


def plane(of: Any) -> tuple[float, float, float]:
    """x, y and yaw of a Pose or a Transform."""
    where, turn = (of.position, of.orientation) if hasattr(of, "position") else (of.translation, of.rotation)
    return where.x, where.y, math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))


def compose(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], math.remainder(a[2] + b[2], math.tau)


def inverse(a: tuple[float, float, float]) -> tuple[float, float, float]:
    c, s = math.cos(a[2]), math.sin(a[2])
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]


def diagonal(*variances: float) -> list[float]:
    """36 numbers."""
    made = [0.0] * 36
    made[::7] = variances
    return made


def odometry(ns: int, where: tuple[float, float, float], speeds: list[float] | None = None) -> Any:
    """speeds: variances of the six velocities."""
    still = words.Twist(words.Vector3(0.0, 0.0, 0.0), words.Vector3(0.0, 0.0, 0.0))
    return words.Odometry(
        words.Header(stamp(ns), "odom"),
        "base_link",
        words.PoseWithCovariance(pose(*where), [0.0] * 36),
        words.TwistWithCovariance(still, diagonal(*(speeds or [0.0] * 6))),
    )


def detections(ns: int, frame: str, seen: list[tuple[str, tuple[float, float, float], float]]) -> Any:
    """seen: identity, position, standard deviation of each."""
    made = []
    for identity, (x, y, z), sigma in seen:
        where = words.Pose(words.Point(x, y, z), words.Quaternion(0.0, 0.0, 0.0, 1.0))
        variances = [sigma**2] * 3 + [0.0] * 3
        result = words.ObjectHypothesisWithPose(
            words.ObjectHypothesis(identity, 1.0), words.PoseWithCovariance(where, diagonal(*variances))
        )
        box = words.BoundingBox3D(where, words.Vector3(0.1, 0.1, 0.1))
        made.append(words.Detection3D(words.Header(stamp(ns), frame), [result], box, ""))
    return words.Detection3DArray(words.Header(stamp(ns), frame), made)


def landmark_list(ns: int, frame: str, seen: list[tuple[str, tuple[float, float, float], float]]) -> Any:
    """seen: identity, position, translation_weight of each."""
    made = [
        words.LandmarkEntry(
            identity, words.Pose(words.Point(x, y, z), words.Quaternion(0.0, 0.0, 0.0, 1.0)), weight, 0.0
        )
        for identity, (x, y, z), weight in seen
    ]
    return words.LandmarkList(words.Header(stamp(ns), frame), made)


def tags(ns: int, frame: str, seen: list[tuple[list[int], tuple[float, float, float], float]]) -> Any:
    """seen: the tag or the tags of a bundle, position, standard deviation of each."""
    made = []
    for numbers, (x, y, z), sigma in seen:
        where = words.Pose(words.Point(x, y, z), words.Quaternion(0.0, 0.0, 0.0, 1.0))
        covariance = diagonal(*[sigma**2] * 3, 0.0, 0.0, 0.0)
        stamped = words.PoseWithCovarianceStamped(
            words.Header(stamp(ns), frame), words.PoseWithCovariance(where, covariance)
        )
        made.append(words.AprilTagDetection(numbers, [0.16] * len(numbers), stamped))
    return words.AprilTagDetectionArray(words.Header(stamp(ns), frame), made)


def known_pose(ns: int, where: tuple[float, float, float], variances: list[float]) -> Any:
    return words.PoseWithCovarianceStamped(
        words.Header(stamp(ns), "map"), words.PoseWithCovariance(pose(*where), diagonal(*variances))
    )


def pose_graph(
    ns: int, nodes: dict[int, int], edges: list[tuple[int, int, int, tuple[float, float, float]]],
    variances: list[float] | None = None, robot: int = 0,
) -> Any:  # fmt: skip
    """nodes: key to its time.  edges: from, to, type, where the second is in the first's frame."""
    covariance = diagonal(*(variances or [0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4]))
    made = [
        words.PoseGraphNode(words.Header(stamp(at), "odom"), robot, key, pose(0, 0, 0)) for key, at in nodes.items()
    ]
    joined = [
        words.PoseGraphEdge(words.Header(stamp(ns), "odom"), a, b, robot, robot, kind, pose(*where), list(covariance))
        for a, b, kind, where in edges
    ]
    return words.PoseGraph(words.Header(stamp(ns), "world"), made, joined)


def link(a: int, b: int, kind: int, where: tuple[float, float, float], variances: list[float] | None = None) -> Any:
    of = pose(*where)
    there = words.Transform(words.Vector3(of.position.x, of.position.y, of.position.z), of.orientation)
    information = [1.0 / each for each in (variances or [0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4])]
    return words.Link(a, b, kind, there, diagonal(*information))


def map_graph(ns: int, numbers: list[int], links: list[Any]) -> Any:
    still = words.Transform(words.Vector3(0.0, 0.0, 0.0), words.Quaternion(0.0, 0.0, 0.0, 1.0))
    return words.MapGraph(words.Header(stamp(ns), "map"), still, numbers, [pose(0.0, 0.0, 0.0) for _ in numbers], links)


def nav_fix(
    ns: int, place: tuple[float, float, float], sigmas: tuple[float, float, float] = (0.5, 0.5, 1.0), kind: int = 2,
    status: int = 0, frame: str = "gps",
) -> Any:  # fmt: skip
    """place: latitude, longitude, altitude.  kind: of the covariance."""
    covariance = [0.0] * 9
    covariance[::4] = [sigma**2 for sigma in sigmas]
    return words.NavSatFix(words.Header(stamp(ns), frame), words.NavSatStatus(status, 1), *place, covariance, kind)


def imu(ns: int, rates: list[float], frame: str = "imu_link", orientation: float = -1.0) -> Any:
    """rates: of gyroscopes and accelerometers.  orientation: the first of its covariance, −1 for none."""
    none = words.Quaternion(0.0, 0.0, 0.0, 1.0) if orientation < 0 else words.Quaternion(0.6, 0.0, 0.0, 0.8)
    return words.Imu(
        words.Header(stamp(ns), frame), none, [orientation] + [0.0] * 8,
        words.Vector3(*rates[:3]), [0.0] * 9, words.Vector3(*rates[3:]), [0.0] * 9,
    )  # fmt: skip


def space_odometry(ns: int, row: list[float]) -> Any:
    """row: x y z qx qy qz qw."""
    made = odometry(ns, (0.0, 0.0, 0.0))
    made.pose.pose = words.Pose(words.Point(*row[:3]), words.Quaternion(*row[3:]))
    return made
