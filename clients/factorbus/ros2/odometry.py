"""nav_msgs/Odometry, read and judged: its frames, its covariances, and whether it continues the one before."""

import math
from typing import Any

from factorbus.ros2.continuity import Continues, OdometryContinuity, OdometryVerdict, ToldOdometry, speed_of
from factorbus.ros2.geometry import Transform, local
from factorbus.ros2.message_parts import Notes, frame_name, stamp_ns_of, transform_of
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import Settings
from factorbus.ros2.space import SPACES

_BASE_FRAME = "base_link"  # of odometry that does not say whose it is, as REP 105 has it
_LEANS_RAD, _RISES_M = 0.1, 1.0  # no drive in the plane


class OdometryReader:
    """frame, base_frame: of the odometry that was read; empty before the first."""

    def __init__(self, settings: Settings, notes: Notes) -> None:
        self._topic, self._space, self._notes = settings.odometry, SPACES[settings.space], notes
        self._continuity = OdometryContinuity()
        self.frame, self.base_frame = "", ""
        self._first_m: float | None = None
        self._is_flat = True

    def forget(self) -> None:
        """The next odometry is the first; its frames are those of before."""
        self._continuity.forget()

    def read(self, message: Any, last_ns: int) -> tuple[tuple[ToldOdometry, Continues], ...]:
        """The odometries that are to be used now, oldest first.  last_ns: the stamp of the last that was used.

        Raises BadRosMessage: this one is not used.
        """
        told = self._told(message)
        verdict = self._continuity.judge(told)
        if verdict.wild is not None:
            self._notes.refused.append(self._wild(verdict.wild))
        if verdict.late:
            seen, wanted = f"a stamp of {told.stamp_ns} ns", f"one after the last, {last_ns} ns"
            raise BadRosMessage(self._topic, seen, wanted)
        self._say(verdict, last_ns)
        return verdict.usable

    def open_ends(self) -> str:
        """What is still held where a recording ends, for people; empty: nothing."""
        held = self._continuity.held
        return "the last odometry is left out: it is far from the one before, and none follows" if held else ""

    def _told(self, message: Any) -> ToldOdometry:
        frames = frame_name(message.header.frame_id), frame_name(message.child_frame_id) or _BASE_FRAME
        if self.base_frame and frames != (self.frame, self.base_frame):
            raise BadRosMessage(self._topic, f"frames {frames}", f"{self.frame, self.base_frame} as before")
        if not message.header.frame_id:
            wanted = "the name of the odometry's frame in the message's header"
            raise BadRosMessage(self._topic, f"frames {frames}", wanted)
        if not message.child_frame_id and not self.base_frame:
            self._notes.remark(self._topic, f"no child_frame_id: the robot's frame is taken to be {_BASE_FRAME!r}")
        stamp_ns = stamp_ns_of(self._topic, message.header.stamp)
        there = transform_of(self._topic, message.pose.pose)
        T = self._space.fitted(there)
        covariance = self._notes.checked(self._topic, "pose", message.pose.covariance, self._space.axes)
        twist = self._notes.checked(self._topic, "twist", message.twist.covariance, self._space.axes)
        self.frame, self.base_frame = frames
        if self._space.flat and self._is_flat:
            self._compare_with_plane(there)
        known, unknown = local(covariance.known, T.R), local(covariance.spread, T.R)
        return ToldOdometry(stamp_ns, T, known, twist.whole, unknown, speed_of(message.twist.twist))

    def _compare_with_plane(self, there: Transform) -> None:
        """Says, once, that what the plane leaves out is not small."""
        self._first_m = float(there.t[2]) if self._first_m is None else self._first_m
        lean, rise = math.acos(max(-1.0, min(1.0, float(there.R[2, 2])))), float(there.t[2]) - self._first_m
        if lean > _LEANS_RAD or abs(rise) > _RISES_M:
            self._is_flat = False
            found = f"odometry leans by {lean:.2f} rad" if lean > _LEANS_RAD else f"odometry rises by {rise:.1f} m"
            self._notes.remark(
                self._topic, f"{found}: height, roll and pitch are left out in the plane, --space has them"
            )

    def _wild(self, wild: ToldOdometry) -> BadRosMessage:
        x, y, z = wild.T_odom_base.t.tolist()
        seen = f"a pose at {x:.4g}, {y:.4g}, {z:.4g} m that is far from those before and after it"
        return BadRosMessage(self._topic, seen, "poses that follow each other")

    def _say(self, verdict: OdometryVerdict, last_ns: int) -> None:
        for told, how in verdict.usable:
            seconds = 1e-9 * (told.stamp_ns - last_ns)
            last_ns = told.stamp_ns
            if how is Continues.CLOCK_BACK:
                text = f"the clock was set back by {-seconds:.4g} s: odometry goes on by the new one"
            elif how is Continues.CLOCK_AHEAD:
                text = f"no odometry for {seconds:.4g} s, or a clock that was set ahead: it goes on from where it was"
            elif how is Continues.ANEW:
                by = f", and the clock was set back by {-seconds:.4g} s" if seconds <= 0.0 else ""
                text = (
                    f"odometry began anew{by}: how the robot came there is taken as not known, "
                    "so closures, fixes or poses have to tell"
                )
            else:
                continue
            self._notes.remark(self._topic, text)
