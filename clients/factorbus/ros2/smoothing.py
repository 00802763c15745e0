"""What is published of map → odometry: a correction blended over a time, so that a robot's pose does not jump.

The time is that of odometry's stamps: it is right for a simulation or a recording at any speed, and tf2, which goes
straight from stamp to stamp, sees the blend as it is meant.  A clock that was set back lets no time pass.

Odometry that began anew changes map → odometry by as much as odometry itself, and the robot stays where it is: that is
no correction.  So what is blended is map → first odometry, in which it is left out.  Pure.
"""

import numpy as np

from factorbus.client.blending import PoseBlend
from factorbus.proto.arrays import F64
from factorbus.proto.linear_in_frame import rotation_of
from factorbus.ros2.geometry import Transform, quaternion
from factorbus.ros2.track import Correction


class SmoothedCorrection:
    """smooth_s: over how long; 0: corrections are published as they are."""

    def __init__(self, smooth_s: float) -> None:
        self._smooth_s = smooth_s
        self.forget()

    def forget(self) -> None:
        """Everything: the next is taken as it is."""
        self._blend: PoseBlend | None = None
        self._passed_s, self._last_ns = 0.0, 0

    def at(self, correction: Correction, stamp_ns: int) -> Transform:
        """T_map_odom to be published with an odometry's stamp."""
        if not self._smooth_s:
            return correction.T_map_odom
        raw = _row(correction.T_map_odom @ correction.T_first_odom.inverse())
        if self._blend is None:
            self._blend, self._last_ns = PoseBlend(raw, self._smooth_s), stamp_ns
        self._passed_s += 1e-9 * max(stamp_ns - self._last_ns, 0)
        self._last_ns = stamp_ns
        self._blend.correct(raw, self._passed_s)
        if not self._blend.left_s(self._passed_s):
            return correction.T_map_odom
        row = self._blend.at(self._passed_s)
        return Transform(rotation_of(row), row[:3]) @ correction.T_first_odom


def _row(T: Transform) -> F64:
    return np.array([*T.t.tolist(), *quaternion(T.R)])
