"""The square drive of `robot` as recordings: MCAP by the mcap library, messages by pycdr2, the others by rosbags."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import robot
import ros
import words
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros_type.common_interfaces.geometry_msgs import Transform

from factorbus.ros2.messages import DETECTIONS, ODOMETRY, POSE, TRANSFORMS, Messages

START_NS = 1_700_000_000 * 10**9
STORE = Messages("jazzy")
# What no type store of ROS 1 has; there a hypothesis has a number, and a detection no id.
_ROS1_TYPES = {
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "int64 id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox"
    ),
    DETECTIONS: "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
    TRANSFORMS: "geometry_msgs/TransformStamped[] transforms",
}  # fmt: skip


class Said(NamedTuple):
    topic: str
    type_name: str
    ns: int
    message: Any

    @property
    def cdr(self) -> bytes:
        return bytes(self.message.serialize())


def mounted(frame: str = "camera", x: float = 0.3, yaw: float = math.pi / 2) -> Any:
    """A /tf_static with a camera on the robot, over a frame between."""
    return words.TFMessage([
        words.TransformStamped(
            words.Header(ros.stamp(START_NS), "base_link"), "mast",
            Transform(words.Vector3(x, 0.0, 0.0), words.Quaternion(0.0, 0.0, 0.0, 1.0)),
        ),
        words.TransformStamped(
            words.Header(ros.stamp(START_NS), "mast"), frame,
            Transform(
                words.Vector3(0.0, 0.0, 0.0), words.Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
            ),
        ),
    ])  # fmt: skip


class Drive(NamedTuple):
    """What the robot said, in order; where it truly ended, and where its odometry has that."""

    said: list[Said]
    true: tuple[float, float, float]
    told: tuple[float, float, float]


def drive() -> Drive:
    said = [Said("/tf_static", TRANSFORMS, START_NS, mounted())]
    true, told, ns = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), START_NS
    said += _say(ns, true, told)
    for _ in range(4):
        leg = (robot.SIDE_M / robot.STEPS, 0.0, 0.0)
        for step in [leg] * robot.STEPS + [(0.0, 0.0, math.pi / 2)]:
            true = ros.compose(true, step)
            told = ros.compose(told, (robot.SCALE * step[0], 0.0, step[2] + robot.CURVATURE * step[0]))
            ns += 10**9
            said += _say(ns, true, told)
    return Drive(said, true, told)


def _say(ns: int, true: tuple[float, float, float], told: tuple[float, float, float]) -> list[Said]:
    camera, seen = ros.compose(true, robot.CAMERA), []
    for name, place in robot.TAGS.items():
        x, y, _ = ros.compose(ros.inverse(camera), (*place, 0.0))
        if math.hypot(x, y) < robot.REACH_M and name.isdigit():
            seen.append((name, (x, y, 0.0), 0.02))
    odometry = ros.odometry(ns, told, [4e-4, 4e-4, 0, 0, 0, 4e-4])
    return [
        Said("/detections", DETECTIONS, ns, ros.detections(ns, "camera", seen)),
        Said("/odom", ODOMETRY, ns, odometry),
    ]


def amcl(ns: int = START_NS + 10**9) -> Said:
    return Said("/amcl_pose", POSE, ns, ros.known_pose(ns, (9.0, 9.0, 0.0), [0.01] * 6))


def write_mcap(
    path: Path, said: Iterable[Said], compression: CompressionType = CompressionType.ZSTD, chunk_size: int = 4096
) -> Path:
    """Small chunks, so that a file that is cut off has some."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_size, compression=compression)
        writer.start("ros2", "tests")
        channels: dict[tuple[str, str], int] = {}
        for number, each in enumerate(said):
            if (each.topic, each.type_name) not in channels:
                text, _ = STORE._store.generate_msgdef(each.type_name, ros_version=2)
                schema = writer.register_schema(each.type_name, "ros2msg", text.encode())
                channels[each.topic, each.type_name] = writer.register_channel(each.topic, "cdr", schema)
            channel = channels[each.topic, each.type_name]
            writer.add_message(channel, log_time=each.ns + number, data=each.cdr, publish_time=each.ns, sequence=number)
        writer.finish()
    return path


def write_rosbag2(path: Path, said: Iterable[Said], storage: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    with Bag2Writer(path, version=9, storage_plugin=storage) as writer:
        topics: dict[str, Any] = {}
        for number, each in enumerate(said):
            if each.topic not in topics:
                topics[each.topic] = writer.add_connection(each.topic, each.type_name, typestore=STORE._store)
            writer.write(topics[each.topic], each.ns + number, each.cdr)
    return path


def write_bag(path: Path, said: Iterable[Said]) -> Path:
    """For ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in _ROS1_TYPES.items():
        store.register(get_types_from_msg(text, name))
    with Bag1Writer(path) as writer:
        topics: dict[str, Any] = {}
        for number, each in enumerate(said):
            if each.topic not in topics:
                topics[each.topic] = writer.add_connection(each.topic, each.type_name, typestore=store)
            read = STORE.read(each.topic, each.type_name, each.cdr)
            data = store.serialize_ros1(_ros1(store, each.type_name, read), each.type_name)
            writer.write(topics[each.topic], each.ns + number, data)
    return path


def _ros1(store: Any, type_name: str, message: Any) -> Any:
    """The same message as ROS 1 has it."""
    types = store.types

    def header(of: Any) -> Any:
        return types["std_msgs/msg/Header"](0, of.stamp, of.frame_id)

    if type_name == ODOMETRY:
        return types[ODOMETRY](header(message.header), message.child_frame_id, message.pose, message.twist)
    if type_name == TRANSFORMS:
        stamped = types["geometry_msgs/msg/TransformStamped"]
        made = [stamped(header(each.header), each.child_frame_id, each.transform) for each in message.transforms]
        return types[TRANSFORMS](made)
    seen = [
        types["vision_msgs/msg/Detection3D"](
            header(each.header),
            [
                types["vision_msgs/msg/ObjectHypothesisWithPose"](
                    int(result.hypothesis.class_id), result.hypothesis.score, result.pose
                )
                for result in each.results
            ],
            each.bbox,
        )
        for each in message.detections
    ]
    return types[DETECTIONS](header(message.header), seen)
