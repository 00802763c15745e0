"""From what a robot says to what goes into the map.  No bus and no clock: messages in, drafts out.

Odometry makes keyframes, which have its time stamp, and the factors between them.  A pose or an observation belongs to
the last keyframe before it: it is carried there by odometry, and what that adds to its covariance is added.  What is
stamped later than the last odometry waits for the next.
"""

import hashlib
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from factorbus.client.draft import Draft
from factorbus.proto.arrays import F64
from factorbus.proto.symbols import MAX_INDEX, format_symbol, symbol
from factorbus.ros2.certainty import Checked, checked_covariance, floored, information
from factorbus.ros2.geometry import FARTHEST_M, Transform, carried, from_pose, local
from factorbus.ros2.messages import LATEST_S, Stamp
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import Settings
from factorbus.ros2.space import SPACES
from factorbus.ros2.track import KeyframePlace, OdometryTrack, Sample
from factorbus.wording import counted

_WAITING = 256
_GAP_S = 60.0  # beyond that nobody knows where between two odometries the robot was
_ELSEWHERE_M, _ELSEWHERE_RAD, _ELSEWHERE_SHARE = 1.0, 0.35, 0.1
_ALL_AXES = (0, 1, 2, 3, 4, 5)


class FrontEnd:
    """One robot's.  `refused` collects what was not used and why, `remarks` what was taken otherwise than it came, as
    (topic, what was done); the bridge empties both.

    first: index of the first key.  landmarks: keys that the map has already.  wait_for_pose: begin with a pose.
    """

    def __init__(self, settings: Settings, first: int, landmarks: Iterable[int], wait_for_pose: bool) -> None:
        self._settings, self._space, self._floors = settings, SPACES[settings.space], settings.floors
        self._track = OdometryTrack()
        self._waiting: deque[tuple[int, str, Any]] = deque(maxlen=_WAITING)
        self.refused: list[BadRosMessage] = []
        self.remarks: list[tuple[str, str]] = []
        self.odometry_frame, self.base_frame = "", ""
        self.begin_again(first, landmarks, wait_for_pose)

    def begin_again(self, first: int, landmarks: Iterable[int], wait_for_pose: bool) -> None:
        """As new, for a map that is another one."""
        self._next, self._landmarks, self._wait_for_pose = first, set(landmarks), wait_for_pose
        self._is_compared = False
        self._track.forget()
        self._waiting.clear()

    def rewind(self, present: Callable[[int], bool]) -> None:
        """An insert was refused: go on from the last keyframe that is in the map."""
        self._track.rewind(present)
        self._landmarks = {key for key in self._landmarks if present(key)}

    @property
    def stamp_ns(self) -> int:
        """Of the last odometry; 0 before the first."""
        latest = self._track.latest
        return latest.stamp_ns if latest else 0

    @property
    def waits_for_pose(self) -> bool:
        """Nothing goes into the map before a pose is received."""
        return self._wait_for_pose and self._track.keyframe is None

    def try_correction(self, value_of: Callable[[int], F64 | None]) -> Transform | None:
        """T_map_odom by the newest keyframe that has a value, if there is one."""
        for keyframe in reversed(self._track.keyframes):
            if (row := value_of(keyframe.key)) is not None:
                return self._space.transform(row) @ keyframe.T_odom_base.inverse()
        return None

    def odometry(self, message: Any) -> Draft | None:
        """A nav_msgs/Odometry.  Raises BadRosMessage: it is not used."""
        sample = self._sample(message)
        draft = Draft()
        keyframe = self._track.keyframe
        if keyframe is None and not self._wait_for_pose:
            row = self._space.row(sample.T_odom_base)
            draft.variable(self._space.pose, self._mark(sample), row, fixed=True, stamp=sample.stamp_ns)
        elif keyframe is not None and self._is_far(sample):
            self._add_keyframe(draft, sample)
        self._use_what_waited(draft)
        return None if _is_empty(draft) else draft

    def pose(self, topic: str, message: Any) -> Draft | None:
        """A geometry_msgs/PoseWithCovarianceStamped in the map's frame.  Raises BadRosMessage."""
        frame = message.header.frame_id
        if frame != self._settings.map_frame:
            raise BadRosMessage(topic, f"a pose in frame {frame!r}", f"one in {self._settings.map_frame!r}")
        return self._take(topic, message)

    def detections(self, topic: str, message: Any) -> Draft | None:
        """A vision_msgs/Detection3DArray.  Raises BadRosMessage."""
        return self._take(topic, message) if message.detections else None

    def _sample(self, message: Any) -> Sample:
        topic = self._settings.odometry
        frames = message.header.frame_id, message.child_frame_id
        if self.base_frame and frames != (self.odometry_frame, self.base_frame):
            raise BadRosMessage(topic, f"frames {frames}", f"{self.odometry_frame, self.base_frame} as before")
        if not all(frames):
            raise BadRosMessage(topic, f"frames {frames}", "names of both the odometry and the base frame")
        stamp_ns = self._stamp(topic, message)
        if self._track.latest is not None and stamp_ns <= self.stamp_ns:
            raise BadRosMessage(topic, f"a stamp of {stamp_ns} ns", f"one after the last, {self.stamp_ns} ns")
        T = self._space.fitted(self._transform(topic, message.pose.pose))
        covariance = self._checked(topic, "pose", message.pose.covariance, self._space.axes)
        twist = self._checked(topic, "twist", message.twist.covariance, self._space.axes)
        self.odometry_frame, self.base_frame = frames
        known, unknown = local(covariance.known, T.R), local(covariance.spread, T.R)
        return self._track.add(stamp_ns, T, known, twist.whole, unknown)

    def _is_far(self, sample: Sample) -> bool:
        T = self._track.place_of(sample).T
        return float(np.linalg.norm(T.t)) >= self._settings.keyframe_m or T.angle() >= self._settings.keyframe_rad

    def _mark(self, sample: Sample) -> int:
        key = symbol(self._settings.letter, self._next)
        self._next += 1
        self._track.mark(key, sample)
        return key

    def _add_keyframe(self, draft: Draft, sample: Sample) -> None:
        place = self._track.place_of(sample)
        weight = information(self._space.residual(self._floored_way(place)))
        key = self._mark(sample)
        draft.variable(self._space.pose, key, stamp=sample.stamp_ns)
        measured = self._space.row(place.T)
        draft.factor(f"between_{self._space.pose}", (place.keyframe.key, key), measured, information=weight)

    def _floored_way(self, place: KeyframePlace) -> F64:
        floors, metres, radians = self._floors, float(np.linalg.norm(place.T.t)), place.T.angle()
        return self._space.floored(
            place.covariance,
            max(floors.drift_m * metres, floors.least_m),
            max(floors.drift_rad * metres + floors.turn_rad * radians, floors.least_rad),
        )

    def _take(self, topic: str, message: Any) -> Draft | None:
        stamp_ns = self._stamp(topic, message)
        if self._track.latest is None or stamp_ns > self.stamp_ns:
            self._waiting.append((stamp_ns, topic, message))
            return None
        draft = Draft()
        self._use(draft, stamp_ns, topic, message)
        return None if _is_empty(draft) else draft

    def _use_what_waited(self, draft: Draft) -> None:
        due = [each for each in self._waiting if each[0] <= self.stamp_ns]
        self._waiting = deque((each for each in self._waiting if each[0] > self.stamp_ns), _WAITING)
        for stamp_ns, topic, message in due:
            try:
                self._use(draft, stamp_ns, topic, message)
            except BadRosMessage as bad:
                self.refused.append(bad)

    def _use(self, draft: Draft, stamp_ns: int, topic: str, message: Any) -> None:
        if not self._track.covers(stamp_ns):
            raise BadRosMessage(topic, f"a stamp of {stamp_ns} ns", "one for which odometry is still remembered")
        if (gap_s := self._track.gap_s(stamp_ns)) > _GAP_S:
            found = f"a stamp of {stamp_ns} ns, where odometry has a gap of {gap_s:.4g} s"
            raise BadRosMessage(topic, found, f"odometry before and after it, at most {_GAP_S:g} s apart")
        if hasattr(message, "detections"):
            self._use_detections(draft, stamp_ns, topic, message)
        else:
            self._use_pose(draft, stamp_ns, topic, message)

    def _use_pose(self, draft: Draft, stamp_ns: int, topic: str, message: Any) -> None:
        T_map_base = self._space.fitted(self._transform(topic, message.pose.pose))
        covariance = self._checked(topic, "pose", message.pose.covariance, self._space.axes).whole
        covariance = local(covariance, T_map_base.R)
        covariance = self._space.floored(covariance, self._floors.pose_m, self._floors.pose_rad)
        begins, sample = self.waits_for_pose, self._track.before(stamp_ns)
        if begins:
            self._mark(sample)
        place = self._track.try_place(stamp_ns)
        if place is None:
            raise BadRosMessage(topic, "a pose from before the first keyframe", "one from after it")
        T_base_keyframe = place.T.inverse()
        T_map_keyframe = T_map_base @ T_base_keyframe
        if place.T.t.any() or place.T.angle() > 0.0:
            covariance = carried(covariance, T_base_keyframe) + carried(self._floored_way(place), T_base_keyframe)
        row = self._space.row(T_map_keyframe)
        if not begins:
            self._compare(topic, T_map_base, place.keyframe.T_odom_base @ place.T)
        if begins:
            draft.variable(self._space.pose, place.keyframe.key, row, stamp=sample.stamp_ns)
        weight = information(self._space.residual(covariance))
        draft.factor(f"prior_{self._space.pose}", (place.keyframe.key,), row, information=weight)

    def _compare(self, topic: str, T_map_base: Transform, T_odom_base: Transform) -> None:
        """Notes where the first pose is not where a map that begins with odometry has the robot."""
        if self._is_compared or self._wait_for_pose:
            return
        self._is_compared = True
        apart = T_odom_base.inverse() @ T_map_base
        metres, way = float(np.linalg.norm(apart.t)), float(np.linalg.norm(T_odom_base.t))
        if metres > _ELSEWHERE_M + _ELSEWHERE_SHARE * way or apart.angle() > _ELSEWHERE_RAD:
            found = f"it says that the robot is {metres:.3g} m and {apart.angle():.3g} rad from where odometry has it"
            advice = "the map begins where odometry does and stays there; with --start pose it begins where poses say"
            self.remarks.append((topic, f"{found}: {advice}"))

    def _use_detections(self, draft: Draft, stamp_ns: int, topic: str, message: Any) -> None:
        place = self._track.try_place(stamp_ns)
        if place is None:
            raise BadRosMessage(topic, "observations from before the first keyframe", "some from after it")
        way = self._floored_way(place)
        # All are looked at before one is used: a message is used whole or not at all.
        seen = [self._observation(topic, message, each, place, way) for each in message.detections]
        for key, measured, weight in seen:
            if key not in self._landmarks:
                self._landmarks.add(key)
                draft.variable(self._space.point, key)
            kind = f"landmark_{self._space.pose}"
            draft.factor(kind, (place.keyframe.key, key), measured, information=weight)

    def _observation(self, topic: str, message: Any, seen: Any, place: KeyframePlace, way: F64) -> tuple[int, F64, F64]:
        """Key of the landmark, where it is from the keyframe, and the information of that.

        q = T p', p' = R p + t with T the keyframe's way, (R, t) the mount: Σ_q = R_q Σ_p R_qᵀ + J Σ_T Jᵀ with
        R_q = R_T R and J = R_T [I, −[p']ₓ].
        """
        position, covariance = self._position(topic, seen)
        mount = self._mount(topic, seen.header.frame_id or message.header.frame_id)
        p = mount.R @ position + mount.t
        R = place.T.R @ mount.R
        J = place.T.R @ np.hstack([np.eye(3), -_cross(p)])
        axes = list(self._space.point_axes)
        spread = (R @ covariance @ R.T + J @ way @ J.T)[np.ix_(axes, axes)]
        weight = information(floored(spread, np.full(len(axes), self._floors.landmark_m)))
        key = symbol(self._settings.landmark_letter, landmark_index(_identity(topic, seen)))
        return key, (place.T.R @ p + place.T.t)[axes], weight

    def _position(self, topic: str, seen: Any) -> tuple[F64, F64]:
        """Where it is in the sensor's frame, (3,), and the covariance of that, (3, 3)."""
        best = _best(seen)
        if best is None:
            where, covariance = seen.bbox.center.position, np.zeros((3, 3))
        else:
            where = best.pose.pose.position
            numbers = _translation_only(best.pose.covariance)
            covariance = self._checked(topic, "position", numbers, _ALL_AXES).whole[:3, :3]
        position = np.array([where.x, where.y, where.z], np.float64)
        if not (np.abs(position) <= FARTHEST_M).all():
            raise BadRosMessage(topic, f"a position of {position.tolist()}", f"at most {FARTHEST_M:g} m in each axis")
        return position, covariance

    def _checked(self, topic: str, what: str, numbers: F64, axes: tuple[int, ...]) -> Checked:
        """A covariance that can be one; what was done with it is noted.  Raises BadRosMessage."""
        made = checked_covariance(topic, numbers, axes)
        if made.unknown:
            self.remarks.append((topic, f"{what}: {made.remark()}"))
        return made

    def _stamp(self, topic: str, message: Any) -> int:
        """Of its header, nanoseconds.  Raises BadRosMessage."""
        stamp = message.header.stamp
        if not (0 <= stamp.sec <= LATEST_S and 0 <= stamp.nanosec < 1_000_000_000):
            wanted = f"0 to {LATEST_S} s and less than 10⁹ ns"
            raise BadRosMessage(topic, f"a stamp of {stamp.sec} s and {stamp.nanosec} ns", wanted)
        return Stamp.of(stamp).ns

    def _mount(self, topic: str, frame: str) -> Transform:
        if frame == self.base_frame:
            return Transform(np.eye(3), np.zeros(3))
        if not frame:
            raise BadRosMessage(topic, "observations without a frame", "the sensor's frame_id in the message's header")
        if frame not in self._settings.mounts:
            wanted = f"{self.base_frame!r}, or where that frame is on the robot: --mount {frame}=x,y,z,qx,qy,qz,qw"
            raise BadRosMessage(topic, f"observations in frame {frame!r}", wanted)
        return self._settings.mounts[frame]

    def _transform(self, topic: str, pose: Any) -> Transform:
        try:
            return from_pose(pose)
        except ValueError as error:
            wanted = f"numbers up to {FARTHEST_M:g} m and a unit quaternion"
            raise BadRosMessage(topic, str(error), wanted) from None


def landmark_index(identity: str) -> int:
    """The index of a landmark's key: its identity where that is a number, else 56 bits of BLAKE2b of it."""
    if identity.isascii() and identity.isdigit() and int(identity) <= MAX_INDEX:
        return int(identity)
    return int.from_bytes(hashlib.blake2b(identity.encode(), digest_size=7).digest(), "big")


def describe(draft: Draft) -> str:
    """What is in it, for a log."""
    keys = [format_symbol(key) for group in draft.batch().variables for key in group.keys.tolist()]
    return f"new {', '.join(keys) or 'nothing'}, {counted(draft.batch().factor_count, 'factor')}"


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


def _cross(p: F64) -> F64:
    x, y, z = p.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _is_empty(draft: Draft) -> bool:
    batch = draft.batch()
    return not batch.variables and not batch.factors
