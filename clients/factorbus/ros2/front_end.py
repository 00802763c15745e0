"""From what a robot says to what goes into the map.  No bus and no clock: messages in, drafts out.

Odometry makes keyframes, which have its time stamp, and the factors between them.  A pose, an observation or a fix of
GNSS belongs to the last keyframe before it: it is carried there by odometry, and what that adds to its covariance is
added.  What is stamped later than the last odometry waits for the next.  Loop closures are of the nodes of a graph,
which are placed in the same way.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from factorbus.client.draft import Draft
from factorbus.proto.arrays import F64
from factorbus.proto.symbols import symbol
from factorbus.ros2.certainty import information
from factorbus.ros2.closures import GraphClosures, NodePlace
from factorbus.ros2.continuity import LONGEST_S, Continues, ToldOdometry
from factorbus.ros2.fixes import Antenna, GnssFixes, read_fix
from factorbus.ros2.geometry import Transform, carried, local
from factorbus.ros2.graphs import heard_graph
from factorbus.ros2.inertial import InertialChain, Moment
from factorbus.ros2.message_parts import Notes, frame_name, stamp_ns_of, transform_of
from factorbus.ros2.messages import FIX, IMU, ODOMETRY, POSE
from factorbus.ros2.mounts import Mounts
from factorbus.ros2.observations import LANDMARK_TYPES, LandmarkReader, cross_matrix, observations_in
from factorbus.ros2.odometry import OdometryReader
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import Settings
from factorbus.ros2.space import SPACES
from factorbus.ros2.track import Correction, KeyframePlace, OdometryTrack, Sample
from factorbus.ros2.waiting import UseMessage, WaitingMessage, WaitingMessages

_STILL = 1e-12  # metres and radians: no way at all
_ELSEWHERE_M, _ELSEWHERE_RAD, _ELSEWHERE_SHARE = 1.0, 0.35, 0.1


class FrontEnd:
    """One robot's.  `refused` collects what was not used and why, `remarks` what was taken otherwise than it came, as
    (topic, what was done); the bridge empties both.

    first: index of the first key.  landmarks: keys that the map has already.  wait_for_pose: begin with a pose.
    frame, gravity: index of the key of GNSS's frame, and of gravity.
    """

    def __init__(
        self, settings: Settings, first: int, landmarks: Iterable[int], wait_for_pose: bool, frame: int = 0,
        gravity: int = 0,
    ) -> None:  # fmt: skip
        self._settings, self._space, self._floors = settings, SPACES[settings.space], settings.floors
        self._track, self._notes = OdometryTrack(), Notes()
        self._waiting = WaitingMessages()
        self._newest: dict[str, int] = {}
        self._odometry = OdometryReader(settings, self._notes)
        self._mounts = Mounts(settings.mounts)
        self._observations = LandmarkReader(settings, self._mount, self._notes)
        self._closures = GraphClosures(settings, self._try_node_place, self._notes)
        self._fixes = GnssFixes(settings, frame, self._notes)
        self._inertial = InertialChain(settings, self._try_mount, self._track.moved_m, gravity, self._notes)
        self.refused, self.remarks = self._notes.refused, self._notes.remarks
        self.begin_again(first, landmarks, wait_for_pose, frame, gravity)

    def begin_again(
        self, first: int, landmarks: Iterable[int], wait_for_pose: bool, frame: int = 0, gravity: int = 0
    ) -> None:
        """As new, for a map that is another one."""
        self._next, self._landmarks, self._wait_for_pose = first, set(landmarks), wait_for_pose
        self._T_map_odom = Transform(np.eye(3), np.zeros(3))
        self._is_compared = False
        self._track.forget()
        self._waiting.clear()
        self._newest.clear()
        self._odometry.forget()
        self._closures.forget()
        self._fixes.forget(frame)
        self._inertial.forget(gravity)

    def rewind(self, present: Callable[[int], bool]) -> None:
        """An insert was refused: go on from the last keyframe that is in the map."""
        self._track.rewind(present)
        self._closures.rewind(present)
        self._fixes.rewind(present)
        self._inertial.rewind(present)
        self._landmarks = {key for key in self._landmarks if present(key)}

    @property
    def odometry_frame(self) -> str:
        """Of the odometry that was read; empty before the first."""
        return self._odometry.frame

    @property
    def base_frame(self) -> str:
        """The robot's, likewise."""
        return self._odometry.base_frame

    @property
    def stamp_ns(self) -> int:
        """Of the last odometry; 0 before the first."""
        latest = self._track.latest
        return latest.stamp_ns if latest else 0

    @property
    def waits_for_pose(self) -> bool:
        """Nothing goes into the map before a pose is received."""
        return self._wait_for_pose and self._track.keyframe is None

    def try_correction(self, value_of: Callable[[int], F64 | None]) -> Correction | None:
        """By the newest keyframe that has a value, if there is one."""
        for keyframe in reversed(self._track.keyframes):
            if (row := value_of(keyframe.key)) is not None:
                T_map_odom = self._space.transform(row) @ keyframe.T_odom_base.inverse()
                return Correction(T_map_odom, keyframe.T_first_odom)
        return None

    def open_ends(self) -> Iterator[tuple[str, str]]:
        """(topic, what still waits), for people, where a recording ends."""
        if text := self._odometry.open_ends():
            yield self._settings.odometry, text
        if text := self._inertial.open_ends():
            yield self._settings.imu, text
        yield from self._closures.open_ends()
        yield from self._waiting.open_ends(self.stamp_ns)
        yield from ((" and ".join(self._settings.fixes), text) for text in self._fixes.open_ends())

    def take(self, topic: str, type_name: str, message: Any) -> Draft | None:
        """A message of any type of `Settings.inputs`.  Raises BadRosMessage."""
        if type_name == ODOMETRY:
            return self.odometry(message)
        if type_name == POSE:
            return self.pose(topic, message)
        if type_name in LANDMARK_TYPES:
            return self.detections(topic, message)
        if type_name == IMU:
            return self.imu(topic, message)
        return self.fix(topic, message) if type_name == FIX else self.graph(topic, type_name, message)

    def static(self, topic: str, message: Any) -> None:
        """A tf2_msgs/TFMessage that says where sensors are.  Raises BadRosMessage: of a part of it."""
        self._mounts.hear(topic, message)

    def odometry(self, message: Any) -> Draft | None:
        """A nav_msgs/Odometry.  Raises BadRosMessage: it is not used."""
        draft = Draft()
        for told, how in self._odometry.read(message, self.stamp_ns):
            self._advance(draft, told, how)
        return None if _is_empty(draft) else draft

    def _advance(self, draft: Draft, told: ToldOdometry, how: Continues) -> None:
        sample, keyframe = self._add(told, how), self._track.keyframe
        if keyframe is None and not self._wait_for_pose:
            row = self._space.row(sample.T_odom_base)
            draft.variable(self._space.pose, self._mark(sample), row, fixed=True, stamp=sample.stamp_ns)
            self._mark_moment(sample)
        elif keyframe is not None and (how is Continues.ANEW or self._is_far(sample)):
            self._add_keyframe(draft, sample)
        self._use_what_waited(draft)
        self._closures.advance(draft)
        self._inertial.advance(draft)

    def _add(self, told: ToldOdometry, how: Continues) -> Sample:
        last = self._track.latest
        pose = told.stamp_ns, told.T_odom_base, told.covariance
        if last is not None and told.stamp_ns <= last.stamp_ns:
            self._set_clock_back(told.stamp_ns)
            if how is Continues.CLOCK_BACK:
                return self._track.add_by_new_clock(*pose, told.unknown)
        if how is Continues.ANEW and last is not None:
            T_new_old = told.T_odom_base @ last.T_odom_base.inverse()
            self._T_map_odom @= T_new_old.inverse()
            return self._track.add_anew(*pose, told.unknown)
        return self._track.add(*pose, told.twist, told.unknown)

    def _set_clock_back(self, stamp_ns: int) -> None:
        """What waits for a time that the former clock had is not used."""
        self._newest.clear()
        self._inertial.set_clock_back(stamp_ns)
        self.refused += self._waiting.set_clock_back(stamp_ns)

    def pose(self, topic: str, message: Any) -> Draft | None:
        """A geometry_msgs/PoseWithCovarianceStamped in the map's frame.  Raises BadRosMessage."""
        frame = message.header.frame_id
        if frame_name(frame) != self._settings.map_frame:
            raise BadRosMessage(topic, f"a pose in frame {frame!r}", f"one in {self._settings.map_frame!r}")
        return self._take(topic, message, self._use_pose)

    def detections(self, topic: str, message: Any) -> Draft | None:
        """A message of one of LANDMARK_TYPES.  Raises BadRosMessage."""
        return self._take(topic, message, self._use_detections) if len(observations_in(message)) else None

    def fix(self, topic: str, message: Any) -> Draft | None:
        """A sensor_msgs/NavSatFix.  Raises BadRosMessage."""
        self._fixes.check_new(topic, message)
        return self._take(topic, message, self._use_fix)

    def imu(self, topic: str, message: Any) -> Draft | None:
        """A sensor_msgs/Imu.  Raises BadRosMessage."""
        self._inertial.hear(topic, message)
        draft = Draft()
        self._inertial.advance(draft)
        return None if _is_empty(draft) else draft

    def graph(self, topic: str, type_name: str, message: Any) -> Draft | None:
        """A pose_graph_tools_msgs/PoseGraph, rtabmap_msgs/MapGraph or rtabmap_msgs/Link.  Raises BadRosMessage."""
        draft = Draft()
        self._closures.hear(topic, heard_graph(topic, type_name, message, self._settings.rotation_first), draft)
        return None if _is_empty(draft) else draft

    def _is_far(self, sample: Sample) -> bool:
        T = self._track.place_of(sample).T
        if self._inertial.is_long():
            return True
        return float(np.linalg.norm(T.t)) >= self._settings.keyframe_m or T.angle() >= self._settings.keyframe_rad

    def _mark(self, sample: Sample) -> int:
        key = symbol(self._settings.letter, self._next)
        self._next += 1
        self._track.mark(key, sample)
        return key

    def _mark_moment(self, sample: Sample) -> None:
        """Of the last keyframe, for the IMU."""
        if self._settings.imu and (keyframe := self._track.keyframe) is not None:
            T_map_base = self._T_map_odom @ keyframe.T_odom_base
            self._inertial.mark(Moment(keyframe.key, sample.stamp_ns, T_map_base))

    def _add_keyframe(self, draft: Draft, sample: Sample) -> None:
        place = self._track.place_of(sample)
        weight = information(self._space.residual(self._floored_way(place)))
        key = self._mark(sample)
        draft.variable(self._space.pose, key, stamp=sample.stamp_ns)
        measured = self._space.row(place.T)
        draft.factor(f"between_{self._space.pose}", (place.keyframe.key, key), measured, information=weight)
        self._mark_moment(sample)

    def _floored_way(self, place: KeyframePlace) -> F64:
        floors, metres, radians = self._floors, float(np.linalg.norm(place.T.t)), place.T.angle()
        return self._space.floored(
            place.covariance,
            max(floors.drift_m * metres, floors.least_m),
            max(floors.drift_rad * metres + floors.turn_rad * radians, floors.least_rad),
        )

    def _take(self, topic: str, message: Any, use: UseMessage) -> Draft | None:
        stamp_ns = stamp_ns_of(topic, message.header.stamp)
        # What is before the last of its topic waits, too: the next odometry tells whether the clock was set back.
        newest = self._newest.get(topic, stamp_ns)
        self._newest[topic] = max(newest, stamp_ns)
        if self._track.latest is None or stamp_ns > self.stamp_ns or stamp_ns < newest:
            if (left := self._waiting.add(WaitingMessage(stamp_ns, topic, message, use), self.stamp_ns)) is not None:
                self.refused.append(left)
            return None
        draft = Draft()
        self._check_covered(stamp_ns, topic)
        use(draft, stamp_ns, topic, message)
        return None if _is_empty(draft) else draft

    def _use_what_waited(self, draft: Draft) -> None:
        for stamp_ns, topic, message, use in self._waiting.due(self.stamp_ns):
            try:
                self._check_covered(stamp_ns, topic)
                use(draft, stamp_ns, topic, message)
            except BadRosMessage as bad:
                self.refused.append(bad)

    def _check_covered(self, stamp_ns: int, topic: str) -> None:
        if not self._track.covers(stamp_ns):
            raise BadRosMessage(topic, f"a stamp of {stamp_ns} ns", "one for which odometry is still remembered")
        if (gap_s := self._track.gap_s(stamp_ns)) > LONGEST_S:
            found = f"a stamp of {stamp_ns} ns, where odometry has a gap of {gap_s:.4g} s"
            raise BadRosMessage(topic, found, f"odometry before and after it, at most {LONGEST_S:g} s apart")

    def _use_pose(self, draft: Draft, stamp_ns: int, topic: str, message: Any) -> None:
        T_map_base = self._space.fitted(transform_of(topic, message.pose.pose))
        covariance = self._notes.checked(topic, "pose", message.pose.covariance, self._space.axes).whole
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
        if _moves(place):
            covariance = carried(covariance, T_base_keyframe) + carried(self._floored_way(place), T_base_keyframe)
        row = self._space.row(T_map_keyframe)
        if not begins:
            self._compare(topic, T_map_base, place.keyframe.T_odom_base @ place.T)
        if begins:
            self._T_map_odom = T_map_keyframe @ place.keyframe.T_odom_base.inverse()
            draft.variable(self._space.pose, place.keyframe.key, row, stamp=sample.stamp_ns)
            self._mark_moment(sample)
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
        for seen in self._observations.read(topic, message, place.T, self._floored_way(place)):
            if seen.key not in self._landmarks:
                self._landmarks.add(seen.key)
                draft.variable(self._space.point, seen.key)
            keys = place.keyframe.key, seen.key
            draft.factor(f"landmark_{self._space.pose}", keys, seen.measured, information=seen.information)

    def _use_fix(self, draft: Draft, stamp_ns: int, topic: str, message: Any) -> None:
        fix = read_fix(topic, message, self._settings.fix_sigma_m, self._space.point_axes, self._notes)
        if fix is None:
            return
        place = self._track.try_place(stamp_ns)
        if place is None:
            raise BadRosMessage(topic, "a fix from before the first keyframe", "one from after it")
        T, way = self._T_map_odom @ place.keyframe.T_odom_base, self._floored_way(place) if _moves(place) else None
        frame, key = message.header.frame_id, place.keyframe.key

        def antenna() -> Antenna:
            at, unplaced = self._lever(frame)
            lever, variance = place.T.R @ at + place.T.t, 0.0
            if way is not None:
                J = np.hstack([np.eye(3), -cross_matrix(at)])
                variance = float(np.linalg.eigvalsh(J @ way @ J.T)[-1])
            return Antenna(key, lever, T.R @ lever + T.t, variance, unplaced)

        self._fixes.use(topic, fix, antenna, draft)

    def _try_mount(self, frame: str) -> Transform | None:
        return self._mounts.try_mount(self.base_frame, frame)

    def _lever(self, frame: str) -> tuple[F64, str]:
        """Where the antenna is on the robot; in its middle, and why, where nothing says where its frame is."""
        mount = self._mounts.try_mount(self.base_frame, frame)
        if mount is None:
            named, advice = (
                (f"nothing says where frame {frame[:80]!r} is", " (--mount)") if frame else ("no frame_id", "")
            )
            return np.zeros(3), f"{named}: the antenna is taken to be at {self.base_frame[:80]!r}{advice}"
        return mount.t, ""

    def _try_node_place(self, topic: str, stamp_ns: int) -> NodePlace | None:
        """Where a node of a graph is, as `GraphClosures` wants it."""
        if self._track.latest is None or stamp_ns > self.stamp_ns:
            return None
        self._check_covered(stamp_ns, topic)
        place = self._track.try_place(stamp_ns)
        if place is None:
            raise BadRosMessage(topic, "a node from before the first keyframe", "one from after it")
        if not _moves(place):
            return NodePlace(place.keyframe.key, Transform(np.eye(3), np.zeros(3)), None)
        return NodePlace(place.keyframe.key, place.T, self._floored_way(place))

    def _mount(self, topic: str, frame: str) -> Transform:
        mount = self._mounts.try_mount(self.base_frame, frame)
        if mount is None and not frame:
            raise BadRosMessage(topic, "observations without a frame", "the sensor's frame_id in the message's header")
        if mount is None:
            wanted = f"{self.base_frame!r}, or where that frame is on the robot: --mount {frame}=x,y,z,qx,qy,qz,qw"
            raise BadRosMessage(topic, f"observations in frame {frame!r}", wanted)
        return mount


def _moves(place: KeyframePlace) -> bool:
    """The robot is not where the keyframe is."""
    return float(np.abs(place.T.t).max()) > _STILL or place.T.angle() > _STILL


def _is_empty(draft: Draft) -> bool:
    batch = draft.batch()
    return not batch.variables and not batch.factors
