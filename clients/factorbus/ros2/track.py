"""What odometry tells: where the robot was at any time of late, and how certain the way from its last keyframe is."""

import bisect
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.ros2.certainty import unknown_motion
from factorbus.ros2.continuity import LONGEST_S
from factorbus.ros2.geometry import Transform, between, carried

_KEPT = 4096
_KEYFRAMES = 1024
_IDENTITY = Transform(np.eye(3), np.zeros(3))


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A pose of the map: its key, where odometry had it, its covariance there, that of the way from the one before.

    T_first_odom: from odometry as it is now to the first one; the identity until it begins anew.
    """

    key: int
    T_odom_base: Transform
    covariance: F64
    way: F64
    T_first_odom: Transform


@dataclass(frozen=True, slots=True)
class Sample:
    """One odometry: when, T_odom_base, its covariance (6, 6, local), its keyframe and the covariance of the way.

    unknown (6, 6, local): what is taken for the axes in which the robot says that it does not know its pose
    """

    stamp_ns: int
    T_odom_base: Transform
    covariance: F64
    keyframe: Keyframe | None
    way: F64
    unknown: F64


@dataclass(frozen=True, slots=True)
class Correction:
    """T_map_odom by a keyframe that the map has a value of.  T_first_odom: as in Keyframe."""

    T_map_odom: Transform
    T_first_odom: Transform


@dataclass(frozen=True, slots=True)
class KeyframePlace:
    """Where the robot was: T_keyframe_base, its covariance (6, 6, local) as far as odometry tells one."""

    keyframe: Keyframe
    T: Transform
    covariance: F64


class OdometryTrack:
    """The last odometry, oldest first.

    The covariance of a way is the sum of Σ Δt² over its samples, carried along, Σ being the covariance of each sample's
    twist: errors of one sample and the next are taken as independent.  Where all twists say zero, it is by what the
    covariance of the pose has grown; in the axes of which the robot says that it does not know them, that is unknown.
    """

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=_KEPT)
        self._keyframes: deque[Keyframe] = deque(maxlen=_KEYFRAMES)
        self._T_first_odom = _IDENTITY

    @property
    def latest(self) -> Sample | None:
        """The last odometry."""
        return self._samples[-1] if self._samples else None

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """Those of late, oldest first."""
        return tuple(self._keyframes)

    @property
    def keyframe(self) -> Keyframe | None:
        """The last one."""
        return self._keyframes[-1] if self._keyframes else None

    def add(self, stamp_ns: int, T_odom_base: Transform, covariance: F64, twist: F64, unknown: F64) -> Sample:
        """An odometry later than the last.  twist (6, 6): covariance of its velocities; unknown: as in Sample."""
        last = self.latest
        way = np.zeros((6, 6))
        if last is not None:
            way = _extended(last, T_odom_base, stamp_ns, twist)
        made = Sample(stamp_ns, T_odom_base, covariance, self.keyframe, way, unknown)
        self._samples.append(made)
        return made

    def add_anew(self, stamp_ns: int, T_odom_base: Transform, covariance: F64, unknown: F64) -> Sample:
        """The first of an odometry that began anew: the robot is taken to be where it was, as far as that is known.

        What came before is in the frame of the new odometry from now on.
        """
        last = self.latest
        if last is not None:
            T_new_old = T_odom_base @ last.T_odom_base.inverse()
            kept = {each.key: each for each in (*(one.keyframe for one in self._samples), *self._keyframes) if each}
            self._T_first_odom @= T_new_old.inverse()
            moved = {
                key: replace(each, T_odom_base=T_new_old @ each.T_odom_base, T_first_odom=self._T_first_odom)
                for key, each in kept.items()
            }
            self._keyframes = deque((moved[each.key] for each in self._keyframes), maxlen=_KEYFRAMES)
            self._samples = deque(
                (
                    replace(
                        each,
                        T_odom_base=T_new_old @ each.T_odom_base,
                        keyframe=moved[each.keyframe.key] if each.keyframe else None,
                    )
                    for each in self._samples
                ),
                maxlen=_KEPT,
            )
            if stamp_ns <= last.stamp_ns:  # by another clock, too
                self._samples.clear()
        way = unknown_motion() + (last.way if last is not None else 0.0)
        made = Sample(stamp_ns, T_odom_base, covariance, self.keyframe, way, unknown)
        self._samples.append(made)
        return made

    def add_by_new_clock(self, stamp_ns: int, T_odom_base: Transform, covariance: F64, unknown: F64) -> Sample:
        """The first of a clock that was set back: what came before has no time any more, but its keyframe counts."""
        last, way = self.latest, np.zeros((6, 6))
        if last is not None:
            way = carried(last.way, last.T_odom_base.inverse() @ T_odom_base)
        self._samples.clear()
        made = Sample(stamp_ns, T_odom_base, covariance, self.keyframe, way, unknown)
        self._samples.append(made)
        return made

    def mark(self, key: int, at: Sample) -> Keyframe:
        """Make a sample a keyframe; those after it belong to it."""
        way = at.way if at.keyframe is self.keyframe else np.zeros((6, 6))
        made = Keyframe(key, at.T_odom_base, at.covariance, way, self._T_first_odom)
        self._keyframes.append(made)
        since: list[Sample] = []
        while self._samples and self._samples[-1].stamp_ns >= at.stamp_ns:
            since.append(_since(made, at, self._samples.pop()))
        self._samples.extend(reversed(since))
        return made

    def try_place(self, stamp_ns: int) -> KeyframePlace | None:
        """Where the robot was; None before the first keyframe."""
        before, T_odom_base = self._interpolated(stamp_ns)
        if before.keyframe is None:
            return None
        T = before.keyframe.T_odom_base.inverse() @ T_odom_base
        way = carried(before.way, before.T_odom_base.inverse() @ T_odom_base)
        return KeyframePlace(before.keyframe, T, _or_growth(way, before, T))

    def place_of(self, sample: Sample) -> KeyframePlace:
        """The same for an odometry that has a keyframe."""
        if sample.keyframe is None:
            raise ValueError("an odometry before the first keyframe has no place in the map")
        T = sample.keyframe.T_odom_base.inverse() @ sample.T_odom_base
        return KeyframePlace(sample.keyframe, T, _or_growth(sample.way, sample, T))

    def covers(self, stamp_ns: int) -> bool:
        """Not before the first odometry that is kept."""
        return bool(self._samples) and stamp_ns >= self._samples[0].stamp_ns

    def moved_m(self, begin_ns: int, end_ns: int) -> float:
        """How far it is from one place to another by odometry; infinite where that is not remembered."""
        if not self.covers(begin_ns):
            return math.inf
        first, last = (self._interpolated(each)[1] for each in (begin_ns, end_ns))
        return float(np.linalg.norm(last.t - first.t))

    def gap_s(self, stamp_ns: int) -> float:
        """How far apart the odometries before and after it are, seconds; 0 at one, and after the last."""
        at = bisect.bisect_right(self._samples, stamp_ns, key=lambda each: each.stamp_ns) - 1
        if at + 1 == len(self._samples) or self._samples[at].stamp_ns == stamp_ns:
            return 0.0
        return 1e-9 * (self._samples[at + 1].stamp_ns - self._samples[at].stamp_ns)

    def before(self, stamp_ns: int) -> Sample:
        """The last odometry that is not later."""
        return self._interpolated(stamp_ns)[0]

    def rewind(self, present: Callable[[int], bool]) -> None:
        """Forget the last keyframes that are not there; odometry from then on belongs to the last that is."""
        dropped: list[Keyframe] = []
        while self._keyframes and not present(self._keyframes[-1].key):
            dropped.insert(0, self._keyframes.pop())
        last = self.latest
        self._samples.clear()
        if last is not None and self.keyframe is not None:
            way = last.way
            for left in reversed(dropped):
                way = carried(left.way, left.T_odom_base.inverse() @ last.T_odom_base) + way
            self._samples.append(replace(last, keyframe=self.keyframe, way=way))

    def forget(self) -> None:
        """Everything."""
        self._samples.clear()
        self._keyframes.clear()
        self._T_first_odom = _IDENTITY

    def _interpolated(self, stamp_ns: int) -> tuple[Sample, Transform]:
        at = bisect.bisect_right(self._samples, stamp_ns, key=lambda each: each.stamp_ns) - 1
        before = self._samples[at]
        if at + 1 == len(self._samples):
            return before, before.T_odom_base
        after = self._samples[at + 1]
        share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        return before, between(before.T_odom_base, after.T_odom_base, share)


def _since(keyframe: Keyframe, at: Sample, sample: Sample) -> Sample:
    """A sample from `at` on, once that is a keyframe: it belongs to it, and its way is what is left of it."""
    way = sample.way - carried(at.way, at.T_odom_base.inverse() @ sample.T_odom_base)
    return replace(sample, keyframe=keyframe, way=way)


def _extended(last: Sample, T_odom_base: Transform, stamp_ns: int, twist: F64) -> F64:
    """The way's covariance one sample on: that so far, carried, and Σ Δt² of the new one."""
    seconds = min(1e-9 * (stamp_ns - last.stamp_ns), LONGEST_S)
    return carried(last.way, last.T_odom_base.inverse() @ T_odom_base) + seconds**2 * twist


def _or_growth(way: F64, sample: Sample, T: Transform) -> F64:
    if way.any() or sample.keyframe is None:
        return way
    return sample.covariance - carried(sample.keyframe.covariance, T) + sample.unknown
