"""An estimate as a robot's tools draw it: nav_msgs/Path and visualization_msgs/MarkerArray."""

from typing import Any

import numpy as np

from factorbus.client import Snapshot
from factorbus.proto.arrays import F64
from factorbus.proto.symbols import symbol
from factorbus.ros2.geometry import Transform, local, quaternion
from factorbus.ros2.messages import LATEST_S, POSE, Messages
from factorbus.ros2.settings import FRAME_LETTER, Settings
from factorbus.ros2.space import SPACES

_SPHERES, _POINTS = 7, 8  # Marker.SPHERE_LIST, Marker.POINTS
_ADD = 0
_LANDMARK_M, _POSE_M = 0.2, 0.1


def path(messages: Messages, settings: Settings, snapshot: Snapshot, stamp_ns: int) -> bytes:
    """The keyframes of this robot (of its letter), in the order of their keys, as CDR.

    Each has its own time stamp; one without, or with one that ROS has no place for, `stamp_ns`, as the whole has.
    """
    space = SPACES[settings.space]
    header = messages.header(stamp_ns, settings.map_frame)
    keys, rows = snapshot.columns.get(space.pose, (np.empty(0, np.int64), np.empty((0, 3))))
    mine = (keys >= symbol(settings.letter, 0)) & (keys < symbol(settings.letter, 0) + (1 << 56))
    stamped = messages.type_of("geometry_msgs/msg/PoseStamped")
    stamps = snapshot.stamps.get(space.pose, np.empty(0, np.int64))[mine]
    headers = [
        messages.header(stamp, settings.map_frame) if 0 <= stamp < (LATEST_S + 1) * 10**9 else header
        for stamp in stamps.tolist()
    ]
    poses = [stamped(own, pose(messages, space.transform(row))) for own, row in zip(headers, rows[mine], strict=True)]
    return messages.write("nav_msgs/msg/Path", messages.type_of("nav_msgs/msg/Path")(header, poses))


def last_keyframe(settings: Settings, snapshot: Snapshot) -> int | None:
    """The key of this robot's last pose in an estimate, if it has one."""
    keys, _ = snapshot.columns.get(SPACES[settings.space].pose, (np.empty(0, np.int64), None))
    mine = keys[(keys >= symbol(settings.letter, 0)) & (keys < symbol(settings.letter, 0) + (1 << 56))]
    return int(mine.max()) if len(mine) else None


def certain_pose(messages: Messages, settings: Settings, snapshot: Snapshot, key: int, covariance: F64) -> bytes:
    """A keyframe as a geometry_msgs/PoseWithCovarianceStamped, as CDR; covariance: of its tangent space.

    ROS has it about the fixed axes of the map: x y z, and the rotation about them.  What a plane has no axis for is 0.
    """
    space = SPACES[settings.space]
    keys, rows = snapshot.columns[space.pose]
    at = int(np.flatnonzero(keys == key)[0])
    T = space.transform(rows[at])
    whole = np.zeros((6, 6))
    whole[np.ix_(space.axes, space.axes)] = covariance
    stamps = snapshot.stamps.get(space.pose, np.full(len(keys), -1, np.int64))
    stamp = int(stamps[at]) if 0 <= stamps[at] < (LATEST_S + 1) * 10**9 else 0
    types = messages.type_of
    numbers = local(whole, T.R.T).ravel()
    made = types("geometry_msgs/msg/PoseWithCovariance")(pose(messages, T), numbers)
    return messages.write(POSE, types(POSE)(messages.header(stamp, settings.map_frame), made))


def markers(messages: Messages, settings: Settings, snapshot: Snapshot, stamp_ns: int) -> bytes:
    """All landmarks as spheres and all poses of robots as points, each one marker, as CDR."""
    space = SPACES[settings.space]
    made = [
        _marker(messages, settings, stamp_ns, "landmarks", _SPHERES, _LANDMARK_M, (0.9, 0.6, 0.0), places)
        for places in [_places(snapshot, space.point, space.flat)]
    ]
    made.append(
        _marker(
            messages, settings, stamp_ns, "poses", _POINTS, _POSE_M, (0.0, 0.45, 0.7),
            _places(snapshot, space.pose, space.flat),
        )
    )  # fmt: skip
    array = messages.type_of("visualization_msgs/msg/MarkerArray")(made)
    return messages.write("visualization_msgs/msg/MarkerArray", array)


def transform(messages: Messages, settings: Settings, child: str, T: Transform, stamp_ns: int) -> bytes:
    """T_map_child as a tf2_msgs/TFMessage, as CDR."""
    x, y, z = T.t.tolist()
    stamped = messages.type_of("geometry_msgs/msg/TransformStamped")(
        messages.header(stamp_ns, settings.map_frame),
        child,
        messages.type_of("geometry_msgs/msg/Transform")(
            messages.type_of("geometry_msgs/msg/Vector3")(x, y, z),
            messages.type_of("geometry_msgs/msg/Quaternion")(*quaternion(T.R)),
        ),
    )
    return messages.write("tf2_msgs/msg/TFMessage", messages.type_of("tf2_msgs/msg/TFMessage")([stamped]))


def pose(messages: Messages, T: Transform) -> Any:
    """A geometry_msgs/Pose."""
    return messages.type_of("geometry_msgs/msg/Pose")(
        messages.type_of("geometry_msgs/msg/Point")(*T.t.tolist()),
        messages.type_of("geometry_msgs/msg/Quaternion")(*quaternion(T.R)),
    )


def _places(snapshot: Snapshot, kind: str, flat: bool) -> list[list[float]]:
    """Of the variables of a kind; GNSS's frames are poses, but no places in the map."""
    keys, rows = snapshot.columns.get(kind, (np.empty(0, np.int64), np.empty((0, 3))))
    if not kind.startswith("point"):
        rows = rows[keys >> 56 != ord(FRAME_LETTER)]
    size = 2 if flat else 3
    return [[*row, 0.0][:3] for row in rows[:, :size].tolist()]


def _marker(
    messages: Messages,
    settings: Settings,
    stamp_ns: int,
    name: str,
    kind: int,
    size_m: float,
    colour: tuple[float, float, float],
    places: list[list[float]],
) -> Any:
    types = messages.type_of
    point, time = types("geometry_msgs/msg/Point"), types("builtin_interfaces/msg/Time")
    nothing = types("sensor_msgs/msg/CompressedImage")(
        types("std_msgs/msg/Header")(time(0, 0), ""), "", np.empty(0, np.uint8)
    )
    return types("visualization_msgs/msg/Marker")(
        header=messages.header(stamp_ns, settings.map_frame),
        ns=name,
        id=0,
        type=kind,
        action=_ADD,
        pose=pose(messages, Transform(np.eye(3), np.zeros(3))),
        scale=types("geometry_msgs/msg/Vector3")(size_m, size_m, size_m),
        color=types("std_msgs/msg/ColorRGBA")(*colour, 1.0),
        lifetime=types("builtin_interfaces/msg/Duration")(0, 0),
        frame_locked=False,
        points=[point(*place) for place in places],
        colors=[],
        texture_resource="",
        texture=nothing,
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=types("visualization_msgs/msg/MeshFile")("", np.empty(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
