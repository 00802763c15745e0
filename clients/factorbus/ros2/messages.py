"""The ROS messages that are used: their type hashes, and CDR to objects and back, by rosbags.

Landmarks come as what has for each observation an identity and a position in metres: vision_msgs/Detection3DArray,
which has a covariance too, cartographer_ros_msgs/LandmarkList, which has weights, and the AprilTagDetectionArray of
apriltag_ros (that of apriltag_msgs has corners in pixels; markers are for drawing).  Loop closures come as front ends
publish their graphs: pose_graph_tools_msgs/PoseGraph (Kimera), rtabmap_msgs/MapGraph and Link.  These are in no type
store, so their definitions stand here, as they are for ROS 2.
"""

import struct
from dataclasses import dataclass
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.trigger import register_trigger
from factorbus.wording import counted

ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
LANDMARK_LIST = "cartographer_ros_msgs/msg/LandmarkList"
TAGS = "apriltag_ros/msg/AprilTagDetectionArray"
PATH = "nav_msgs/msg/Path"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
FIX = "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
POSE_GRAPH = "pose_graph_tools_msgs/msg/PoseGraph"
MAP_GRAPH = "rtabmap_msgs/msg/MapGraph"
LINK = "rtabmap_msgs/msg/Link"
# The same messages of ROS 1, where their packages had other names; their definitions come with the recordings.
FORMER_NAMES = {
    "pose_graph_tools/msg/PoseGraph": POSE_GRAPH,
    "rtabmap_ros/msg/MapGraph": MAP_GRAPH,
    "rtabmap_ros/msg/Link": LINK,
}
MARKERS = "visualization_msgs/msg/MarkerArray"

# The last second that a stamp may have: time in messages is a signed 32-bit count, and transforms are stamped ahead.
LATEST_S = (1 << 31) - 2

# What stands in keys for a hash where the distribution has none.
NO_HASH = "TypeHashNotSupported"
DISTRIBUTIONS = {
    "humble": Stores.ROS2_HUMBLE,
    "jazzy": Stores.ROS2_JAZZY,
    "kilted": Stores.ROS2_KILTED,
    "lyrical": Stores.ROS2_LYRICAL,
}

_VISION = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    DETECTIONS: "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}
_LANDMARKS = {
    "cartographer_ros_msgs/msg/LandmarkEntry": (
        "string id\ngeometry_msgs/Pose tracking_from_landmark_transform\n"
        "float64 translation_weight\nfloat64 rotation_weight"
    ),
    LANDMARK_LIST: "std_msgs/Header header\ncartographer_ros_msgs/LandmarkEntry[] landmarks",
    "apriltag_ros/msg/AprilTagDetection": ("int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose"),
    TAGS: "std_msgs/Header header\napriltag_ros/AprilTagDetection[] detections",
}
_GRAPHS = {
    "pose_graph_tools_msgs/msg/PoseGraphNode": (
        "std_msgs/Header header\nint32 robot_id\nuint64 key\ngeometry_msgs/Pose pose"
    ),
    "pose_graph_tools_msgs/msg/PoseGraphEdge": (
        "std_msgs/Header header\nuint64 key_from\nuint64 key_to\nint32 robot_from\nint32 robot_to\nint32 type\n"
        "int32 ODOM=0\nint32 LOOPCLOSE=1\nint32 LANDMARK=2\nint32 REJECTED_LOOPCLOSE=3\nint32 MESH=4\n"
        "int32 POSE_MESH=5\nint32 MESH_POSE=6\ngeometry_msgs/Pose pose\nfloat64[36] covariance"
    ),
    POSE_GRAPH: (
        "std_msgs/Header header\npose_graph_tools_msgs/PoseGraphNode[] nodes\n"
        "pose_graph_tools_msgs/PoseGraphEdge[] edges"
    ),
    LINK: "int32 from_id\nint32 to_id\nint32 type\ngeometry_msgs/Transform transform\nfloat64[36] information",
    MAP_GRAPH: (
        "std_msgs/Header header\ngeometry_msgs/Transform map_to_odom\nint32[] poses_id\n"
        "geometry_msgs/Pose[] poses\nrtabmap_msgs/Link[] links"
    ),
}


@dataclass(frozen=True, slots=True)
class Stamp:
    """Time as ROS has it."""

    ns: int

    @classmethod
    def of(cls, message: Any) -> "Stamp":
        """Of a builtin_interfaces/Time."""
        return cls(message.sec * 1_000_000_000 + message.nanosec)


def register_further_types(store: Any) -> None:
    """Add what landmarks and loop closures come as to a type store."""
    for name, text in {**_VISION, **_LANDMARKS, **_GRAPHS}.items():
        store.register(get_types_from_msg(text, name))


class Messages:
    """The types of one distribution.  Everything in `type_of` is a dataclass whose fields are those of the message."""

    def __init__(self, distribution: str) -> None:
        self._store = get_typestore(DISTRIBUTIONS[distribution])
        self._hashed = distribution != "humble"
        register_further_types(self._store)
        register_trigger(self._store)

    def hash(self, type_name: str) -> str:
        """RIHS01_ and the SHA-256 of the type's description (REP 2016), or what stands for it."""
        return self._store.hash_rihs01(type_name) if self._hashed else NO_HASH

    def type_of(self, type_name: str) -> Any:
        """The class to make messages of."""
        return self._store.types[type_name]

    def time(self, ns: int) -> Any:
        """A builtin_interfaces/Time."""
        return self.type_of("builtin_interfaces/msg/Time")(ns // 1_000_000_000, ns % 1_000_000_000)

    def header(self, ns: int, frame: str) -> Any:
        """A std_msgs/Header."""
        return self.type_of("std_msgs/msg/Header")(self.time(ns), frame)

    def write(self, type_name: str, message: Any) -> bytes:
        """CDR, little-endian, with its four bytes of encapsulation."""
        return bytes(self._store.serialize_cdr(message, type_name, little_endian=True))

    def read(self, topic: str, type_name: str, data: bytes) -> Any:
        """A message from CDR of either byte order.  Raises BadRosMessage."""
        try:
            return self._store.deserialize_cdr(data, type_name)
        except (SerdeError, LookupError, ValueError, ArithmeticError, MemoryError, struct.error) as error:
            raise BadRosMessage(
                topic, f"{counted(len(data), 'byte')} that cannot be read ({error})", f"a {type_name}"
            ) from None
