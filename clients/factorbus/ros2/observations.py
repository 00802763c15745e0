"""Landmark observations: which landmark, where from the keyframe, how certain."""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.symbols import MAX_INDEX, symbol
from factorbus.ros2.certainty import floored, information
from factorbus.ros2.geometry import FARTHEST_M, Transform
from factorbus.ros2.message_parts import Notes
from factorbus.ros2.messages import DETECTIONS, LANDMARK_LIST, TAGS
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import Settings
from factorbus.ros2.space import SPACES

LANDMARK_TYPES = (DETECTIONS, LANDMARK_LIST, TAGS)
_ALL_AXES = (0, 1, 2, 3, 4, 5)
# A weight of less counts as this: σ = 1 km, as of an axis that is not known; more than the other is far below floors.
_LEAST_WEIGHT, _LARGEST_WEIGHT = 1e-3, 1e9


class Observed(NamedTuple):
    """A landmark from its keyframe: its key, where, and the information of that."""

    key: int
    measured: F64
    information: F64


class _Sighting(NamedTuple):
    """What any of the messages says: of which landmark, in which frame, where in it (a geometry_msgs/Point), and the
    covariance (3, 3) of that."""

    identity: str
    frame: str
    where: Any
    covariance: F64


class LandmarkReader:
    """Reads messages of LANDMARK_TYPES.  mount: T_base_sensor of a frame; raises BadRosMessage where that is not known.

    Σ of a position is the message's covariance; of a LandmarkList it is I/w², w its translation_weight: Cartographer
    multiplies the residual by it.
    """

    def __init__(self, settings: Settings, mount: Callable[[str, str], Transform], notes: Notes) -> None:
        self._settings, self._space, self._mount, self._notes = settings, SPACES[settings.space], mount, notes

    def read(self, topic: str, message: Any, T: Transform, way: F64) -> list[Observed]:
        """T: T_keyframe_base, with the covariance `way`.  Raises BadRosMessage: a message is used whole or not."""
        return [self._observed(topic, each, T, way) for each in self._sightings(topic, message)]

    def _observed(self, topic: str, seen: _Sighting, T: Transform, way: F64) -> Observed:
        """q = T p', p' = R p + t with T the keyframe's way, (R, t) the mount: Σ_q = R_q Σ_p R_qᵀ + J Σ_T Jᵀ with
        R_q = R_T R and J = R_T [I, −[p']ₓ].
        """
        position = np.array([seen.where.x, seen.where.y, seen.where.z], np.float64)
        if not (np.abs(position) <= FARTHEST_M).all():
            raise BadRosMessage(topic, f"a position of {position.tolist()}", f"at most {FARTHEST_M:g} m in each axis")
        mount = self._mount(topic, seen.frame)
        p = mount.R @ position + mount.t
        R = T.R @ mount.R
        J = T.R @ np.hstack([np.eye(3), -cross_matrix(p)])
        axes = list(self._space.point_axes)
        spread = (R @ seen.covariance @ R.T + J @ way @ J.T)[np.ix_(axes, axes)]
        weight = information(floored(spread, np.full(len(axes), self._settings.floors.landmark_m)))
        key = symbol(self._settings.landmark_letter, landmark_index(seen.identity))
        return Observed(key, (T.R @ p + T.t)[axes], weight)

    def _sightings(self, topic: str, message: Any) -> Iterator[_Sighting]:
        """Those that say where something is."""
        frame = message.header.frame_id
        for seen in observations_in(message):
            if hasattr(seen, "translation_weight"):
                weight = _checked_weight(topic, seen.translation_weight)
                if weight:
                    where = seen.tracking_from_landmark_transform.position
                    yield _Sighting(_entry_name(topic, seen), frame, where, np.eye(3) / weight**2)
                else:
                    self._notes.remark(topic, "landmarks with a translation_weight of 0 are left out")
            elif hasattr(seen, "size"):
                pose = seen.pose.pose
                own = seen.pose.header.frame_id or frame
                yield _Sighting(_tag_name(topic, seen), own, pose.pose.position, self._covariance(topic, pose))
            else:
                yield self._detection(topic, seen, frame)

    def _detection(self, topic: str, seen: Any, frame: str) -> _Sighting:
        best = _best(seen)
        if best is None:
            where, covariance = seen.bbox.center.position, np.zeros((3, 3))
        else:
            where, covariance = best.pose.pose.position, self._covariance(topic, best.pose)
        return _Sighting(_identity(topic, seen), seen.header.frame_id or frame, where, covariance)

    def _covariance(self, topic: str, pose: Any) -> F64:
        """Of the position in a geometry_msgs/PoseWithCovariance, (3, 3)."""
        return self._notes.checked(topic, "position", _translation_only(pose.covariance), _ALL_AXES).whole[:3, :3]


def observations_in(message: Any) -> Sequence[Any]:
    """The parts of a message of LANDMARK_TYPES; the first LandmarkLists had another name for them."""
    for name in ("detections", "landmarks", "landmark"):
        if hasattr(message, name):
            return getattr(message, name)
    return ()


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


def _checked_weight(topic: str, weight: float) -> float:
    """0, or a weight whose square has an inverse."""
    if not 0.0 <= weight < math.inf:
        raise BadRosMessage(topic, f"a translation_weight of {weight:g}", "a finite number, none below zero")
    return min(max(weight, _LEAST_WEIGHT), _LARGEST_WEIGHT) if weight else 0.0


def _entry_name(topic: str, seen: Any) -> str:
    if not seen.id:
        raise BadRosMessage(topic, "a landmark without id", "one that says which landmark it is")
    return seen.id


def _tag_name(topic: str, seen: Any) -> str:
    """The number of a tag, or those of a bundle."""
    numbers = [int(number) for number in seen.id]
    if not numbers:
        raise BadRosMessage(topic, "a tag without id", "one that says which tag it is")
    return " ".join(map(str, numbers))


def _translation_only(numbers: F64) -> F64:
    made = np.zeros((6, 6))
    made[:3, :3] = np.asarray(numbers, np.float64).reshape(6, 6)[:3, :3]
    return made


def _best(seen: Any) -> Any:
    return max(seen.results, key=lambda each: getattr(each, "hypothesis", each).score, default=None)


def _class_of(result: Any) -> str:
    """Of a hypothesis, which in ROS 1 has a number."""
    return str(result.hypothesis.class_id if hasattr(result, "hypothesis") else result.id)
