"""ROS 2 messages by libraries that the bridge does not use: pycdr2 for CDR, zenoh-ros-type for definitions.

What that does not define is written down here from the definitions of tf2_msgs, visualization_msgs, vision_msgs,
cartographer_ros_msgs, apriltag_ros, pose_graph_tools_msgs and rtabmap_msgs.
The type hashes are computed here too, from REP 2016: the SHA-256 of a description in JSON.
"""

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from typing import Any, get_args, get_origin

from pycdr2 import IdlStruct
from pycdr2.types import array, float32, float64, int32, sequence, uint8, uint32, uint64
from zenoh_ros_type.common_interfaces.geometry_msgs import (
    Point,
    Pose,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from zenoh_ros_type.common_interfaces.nav_msgs import Odometry, Path
from zenoh_ros_type.common_interfaces.sensor_msgs import NavSatFix, NavSatStatus
from zenoh_ros_type.common_interfaces.std_msgs import Header
from zenoh_ros_type.rcl_interfaces.builtin_interfaces import Time


@dataclass
class TFMessage(IdlStruct, typename="TFMessage"):
    transforms: sequence[TransformStamped]


@dataclass
class Imu(IdlStruct, typename="Imu"):
    header: Header
    orientation: Quaternion
    orientation_covariance: array[float64, 9]
    angular_velocity: Vector3
    angular_velocity_covariance: array[float64, 9]
    linear_acceleration: Vector3
    linear_acceleration_covariance: array[float64, 9]


@dataclass
class ColorRGBA(IdlStruct, typename="ColorRGBA"):
    r: float32
    g: float32
    b: float32
    a: float32


@dataclass
class Duration(IdlStruct, typename="Duration"):
    sec: int32
    nanosec: uint32


@dataclass
class CompressedImage(IdlStruct, typename="CompressedImage"):
    header: Header
    format: str
    data: sequence[uint8]


@dataclass
class UVCoordinate(IdlStruct, typename="UVCoordinate"):
    u: float32
    v: float32


@dataclass
class MeshFile(IdlStruct, typename="MeshFile"):
    filename: str
    data: sequence[uint8]


@dataclass
class Marker(IdlStruct, typename="Marker"):
    header: Header
    ns: str
    id: int32
    type: int32
    action: int32
    pose: Pose
    scale: Vector3
    color: ColorRGBA
    lifetime: Duration
    frame_locked: bool
    points: sequence[Point]
    colors: sequence[ColorRGBA]
    texture_resource: str
    texture: CompressedImage
    uv_coordinates: sequence[UVCoordinate]
    text: str
    mesh_resource: str
    mesh_file: MeshFile
    mesh_use_embedded_materials: bool


@dataclass
class MarkerArray(IdlStruct, typename="MarkerArray"):
    markers: sequence[Marker]


@dataclass
class ObjectHypothesis(IdlStruct, typename="ObjectHypothesis"):
    class_id: str
    score: float64


@dataclass
class ObjectHypothesisWithPose(IdlStruct, typename="ObjectHypothesisWithPose"):
    hypothesis: ObjectHypothesis
    pose: PoseWithCovariance


@dataclass
class BoundingBox3D(IdlStruct, typename="BoundingBox3D"):
    center: Pose
    size: Vector3


@dataclass
class Detection3D(IdlStruct, typename="Detection3D"):
    header: Header
    results: sequence[ObjectHypothesisWithPose]
    bbox: BoundingBox3D
    id: str


@dataclass
class Detection3DArray(IdlStruct, typename="Detection3DArray"):
    header: Header
    detections: sequence[Detection3D]


@dataclass
class LandmarkEntry(IdlStruct, typename="LandmarkEntry"):
    id: str
    tracking_from_landmark_transform: Pose
    translation_weight: float64
    rotation_weight: float64


@dataclass
class LandmarkList(IdlStruct, typename="LandmarkList"):
    header: Header
    landmarks: sequence[LandmarkEntry]


@dataclass
class AprilTagDetection(IdlStruct, typename="AprilTagDetection"):
    id: sequence[int32]
    size: sequence[float64]
    pose: PoseWithCovarianceStamped


@dataclass
class AprilTagDetectionArray(IdlStruct, typename="AprilTagDetectionArray"):
    header: Header
    detections: sequence[AprilTagDetection]


@dataclass
class PoseGraphNode(IdlStruct, typename="PoseGraphNode"):
    header: Header
    robot_id: int32
    key: uint64
    pose: Pose


@dataclass
class PoseGraphEdge(IdlStruct, typename="PoseGraphEdge"):
    header: Header
    key_from: uint64
    key_to: uint64
    robot_from: int32
    robot_to: int32
    type: int32
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class PoseGraph(IdlStruct, typename="PoseGraph"):
    header: Header
    nodes: sequence[PoseGraphNode]
    edges: sequence[PoseGraphEdge]


@dataclass
class Link(IdlStruct, typename="Link"):
    from_id: int32
    to_id: int32
    type: int32
    transform: Transform
    information: array[float64, 36]


@dataclass
class MapGraph(IdlStruct, typename="MapGraph"):
    header: Header
    map_to_odom: Transform
    poses_id: sequence[int32]
    poses: sequence[Pose]
    links: sequence[Link]


@dataclass
class TriggerRequest(IdlStruct, typename="Trigger_Request"):
    structure_needs_at_least_one_member: uint8


@dataclass
class TriggerResponse(IdlStruct, typename="Trigger_Response"):
    success: bool
    message: str


# As rmw_zenoh has it in the keys of services from Jazzy on.
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"


PACKAGES = {
    "builtin_interfaces": (Time, Duration),
    "std_msgs": (Header, ColorRGBA),
    "geometry_msgs": (
        Point, Pose, PoseWithCovariance, PoseWithCovarianceStamped, Quaternion, Twist, TwistWithCovariance, Vector3,
        TransformStamped,
    ),
    "nav_msgs": (Odometry, Path),
    "tf2_msgs": (TFMessage,),
    "sensor_msgs": (CompressedImage, Imu, NavSatFix, NavSatStatus),
    "cartographer_ros_msgs": (LandmarkEntry, LandmarkList),
    "apriltag_ros": (AprilTagDetection, AprilTagDetectionArray),
    "pose_graph_tools_msgs": (PoseGraphNode, PoseGraphEdge, PoseGraph),
    "rtabmap_msgs": (Link, MapGraph),
    "visualization_msgs": (Marker, MarkerArray, MeshFile, UVCoordinate),
    "vision_msgs": (ObjectHypothesis, ObjectHypothesisWithPose, BoundingBox3D, Detection3D, Detection3DArray),
}  # fmt: skip


def type_name(cls: type) -> str:
    """As nav_msgs/msg/Odometry; what is not named above is of geometry_msgs."""
    package = next((name for name, types in PACKAGES.items() if cls in types), "geometry_msgs")
    return f"{package}/msg/{cls.__name__}"


# REP 2016: the ids of field types, and what is added for arrays and sequences.
_IDS = {
    "int8": 2, "uint8": 3, "uint16": 5, "int32": 6, "uint32": 7, "uint64": 9, "float32": 10, "float64": 11, "bool": 15,
    "str": 17,
}  # fmt: skip
_ARRAY, _SEQUENCE = 48, 144


def type_hash(cls: type) -> str:
    """RIHS01 of a message."""
    described: dict[str, Any] = {}
    _describe(cls, described)
    mine = type_name(cls)
    others = [described[name] for name in sorted(described) if name != mine]
    text = json.dumps({"type_description": described[mine], "referenced_type_descriptions": others})
    return "RIHS01_" + hashlib.sha256(text.encode()).hexdigest()


def _describe(cls: type, described: dict[str, Any]) -> None:
    name = type_name(cls)
    if name in described:
        return
    described[name] = {"type_name": name, "fields": []}
    for field in dataclasses.fields(cls):
        described[name]["fields"].append({"name": field.name, "type": _field(field.type, described)})


def _field(of: Any, described: dict[str, Any]) -> dict[str, Any]:
    added, capacity = 0, 0
    words = list(get_args(of))[1:] if get_origin(of) is not None else []
    for word in words:
        if hasattr(word, "length") and type(word).__name__ == "array":
            added, capacity, of = _ARRAY, word.length, word.subtype
        elif type(word).__name__ == "sequence":
            added, of = _SEQUENCE, word.subtype
    plain = _plain(of)
    nested = ""
    if dataclasses.is_dataclass(plain):
        _describe(plain, described)  # type: ignore[arg-type]
        nested = type_name(plain)  # type: ignore[arg-type]
        identity = 1
    else:
        identity = _IDS[plain]
    return {"type_id": added + identity, "capacity": capacity, "string_capacity": 0, "nested_type_name": nested}


def _plain(of: Any) -> Any:
    """The name of a basic type, or the class of a nested one."""
    if dataclasses.is_dataclass(of):
        return of
    if of in (str, bool):
        return of.__name__
    return next(str(word) for word in get_args(of)[1:] if isinstance(word, str))
