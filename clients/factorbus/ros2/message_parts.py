"""What messages have in common, checked: stamps, poses, covariances.  What cannot be used raises BadRosMessage."""

from typing import Any

from factorbus.proto.arrays import F64
from factorbus.ros2.certainty import Checked, checked_covariance
from factorbus.ros2.geometry import FARTHEST_M, Transform, from_pose, from_quaternion
from factorbus.ros2.messages import LATEST_S, Stamp
from factorbus.ros2.problems import BadRosMessage


class Notes:
    """What was not used and why, and what was taken otherwise than it came, as (topic, what was done)."""

    def __init__(self) -> None:
        self.refused: list[BadRosMessage] = []
        self.remarks: list[tuple[str, str]] = []

    def remark(self, topic: str, text: str) -> None:
        """To be said once, and counted."""
        self.remarks.append((topic, text))

    def checked(self, topic: str, what: str, numbers: F64, axes: tuple[int, ...]) -> Checked:
        """A covariance that can be one; what was done with it is noted.  Raises BadRosMessage."""
        made = checked_covariance(topic, numbers, axes)
        if made.unknown:
            self.remark(topic, f"{what}: {made.remark()}")
        return made


def frame_name(told: str) -> str:
    """Of a frame: "/base_link" is base_link, as tf has it; drivers and bags of ROS 1 have the slash."""
    return told.removeprefix("/")


def stamp_ns_of(topic: str, stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time.  Raises BadRosMessage."""
    if not (0 <= stamp.sec <= LATEST_S and 0 <= stamp.nanosec < 1_000_000_000):
        wanted = f"0 to {LATEST_S} s and less than 10⁹ ns"
        raise BadRosMessage(topic, f"a stamp of {stamp.sec} s and {stamp.nanosec} ns", wanted)
    return Stamp.of(stamp).ns


def transform_of(topic: str, pose: Any) -> Transform:
    """Of a geometry_msgs/Pose or a geometry_msgs/Transform.  Raises BadRosMessage."""
    try:
        if hasattr(pose, "position"):
            return from_pose(pose)
        t, q = pose.translation, pose.rotation
        return from_quaternion((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
    except ValueError as error:
        wanted = f"numbers up to {FARTHEST_M:g} m and a unit quaternion"
        raise BadRosMessage(topic, str(error), wanted) from None
