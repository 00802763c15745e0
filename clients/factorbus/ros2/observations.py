"""Landmark observations, vision_msgs/Detection3DArray: which landmark, where from the keyframe, how certain."""

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.symbols import MAX_INDEX, symbol
from factorbus.ros2.certainty import floored, information
from factorbus.ros2.geometry import FARTHEST_M, Transform
from factorbus.ros2.message_parts import Notes
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import Settings
from factorbus.ros2.space import SPACES

_ALL_AXES = (0, 1, 2, 3, 4, 5)


class Observed(NamedTuple):
    """A landmark from its keyframe: its key, where, and the information of that."""

    key: int
    measured: F64
    information: F64


class LandmarkReader:
    """Reads detections.  mount: T_base_sensor of a frame; raises BadRosMessage where that is not known."""

    def __init__(self, settings: Settings, mount: Callable[[str, str], Transform], notes: Notes) -> None:
        self._settings, self._space, self._mount, self._notes = settings, SPACES[settings.space], mount, notes

    def read(self, topic: str, message: Any, T: Transform, way: F64) -> list[Observed]:
        """T: T_keyframe_base, with the covariance `way`.  Raises BadRosMessage: a message is used whole or not."""
        return [self._observed(topic, message, each, T, way) for each in message.detections]

    def _observed(self, topic: str, message: Any, seen: Any, T: Transform, way: F64) -> Observed:
        """q = T p', p' = R p + t with T the keyframe's way, (R, t) the mount: Σ_q = R_q Σ_p R_qᵀ + J Σ_T Jᵀ with
        R_q = R_T R and J = R_T [I, −[p']ₓ].
        """
        position, covariance = self._position(topic, seen)
        mount = self._mount(topic, seen.header.frame_id or message.header.frame_id)
        p = mount.R @ position + mount.t
        R = T.R @ mount.R
        J = T.R @ np.hstack([np.eye(3), -cross_matrix(p)])
        axes = list(self._space.point_axes)
        spread = (R @ covariance @ R.T + J @ way @ J.T)[np.ix_(axes, axes)]
        weight = information(floored(spread, np.full(len(axes), self._settings.floors.landmark_m)))
        key = symbol(self._settings.landmark_letter, landmark_index(_identity(topic, seen)))
        return Observed(key, (T.R @ p + T.t)[axes], weight)

    def _position(self, topic: str, seen: Any) -> tuple[F64, F64]:
        """Where it is in the sensor's frame, (3,), and the covariance of that, (3, 3)."""
        best = _best(seen)
        if best is None:
            where, covariance = seen.bbox.center.position, np.zeros((3, 3))
        else:
            where = best.pose.pose.position
            numbers = _translation_only(best.pose.covariance)
            covariance = self._notes.checked(topic, "position", numbers, _ALL_AXES).whole[:3, :3]
        position = np.array([where.x, where.y, where.z], np.float64)
        if not (np.abs(position) <= FARTHEST_M).all():
            raise BadRosMessage(topic, f"a position of {position.tolist()}", f"at most {FARTHEST_M:g} m in each axis")
        return position, covariance


def landmark_index(identity: str) -> int:
    """The index of a landmark's key: its identity where that is a number, else 56 bits of BLAKE2b of it."""
    if identity.isascii() and identity.isdigit() and int(identity) <= MAX_INDEX:
        return int(identity)
    return int.from_bytes(hashlib.blake2b(identity.encode(), digest_size=7).digest(), "big")


def cross_matrix(p: F64) -> F64:
    """[p]ₓ."""
    x, y, z = p.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _identity(topic: str, seen: Any) -> str:
    """The detection's own id, else the class of its best hypothesis (a tag's number, usually)."""
    best = _best(seen)
    identity = getattr(seen, "id", "") or (_class_of(best) if best is not None else "")
    if not identity:
        raise BadRosMessage(topic, "a detection without id or class", "one that says which landmark it is")
    return identity


def _translation_only(numbers: F64) -> F64:
    made = np.zeros((6, 6))
    made[:3, :3] = np.asarray(numbers, np.float64).reshape(6, 6)[:3, :3]
    return made


def _best(seen: Any) -> Any:
    return max(seen.results, key=lambda each: getattr(each, "hypothesis", each).score, default=None)


def _class_of(result: Any) -> str:
    """Of a hypothesis, which in ROS 1 has a number."""
    return str(result.hypothesis.class_id if hasattr(result, "hypothesis") else result.id)
