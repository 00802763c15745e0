"""Whether an odometry continues the one before: a clock that was set, a front end that began anew, one wild message.

A front end that is started again begins at the origin of its odometry, and so says a way that the robot has not driven.
A pose is far from the last, d metres away after Δt seconds, where

    d > 1 m + 4 v Δt + 5 m/s² Δt²,   v: the fastest of late, by poses and by twists,

or where it is the origin again (5 cm, 0.05 rad) and the last was not, after a gap, or faster than 2 v.  What follows
decides: a robot that goes on as fast is fast; one that is back where it was had said one wild pose; else it began anew.
A clock was set back where three odometries in a row, each after the other, are before the last.  Pure.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum
from statistics import median

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.ros2.geometry import Transform

_LATE_IN_A_ROW = 3
_REACH_M, _ACCELERATION, _SPEEDS = 1.0, 5.0, 4.0
_HOME_M, _HOME_RAD, _AWAY_M, _AWAY_RAD, _HOME_SPEEDS = 0.05, 0.05, 0.5, 0.35, 2.0
_GAP_S, _GAP_INTERVALS = 1.0, 5.0
_AS_FAST = 0.25  # of the speed of the step before
_RECENT = 16
# After that long nobody knows how far a robot may have come by, and how much its odometry has drifted.
LONGEST_S = 60.0


@dataclass(frozen=True, slots=True)
class ToldOdometry:
    """One odometry as it came.  twist (6, 6): covariance of its velocities; speed: by its velocities, m/s, rad/s."""

    stamp_ns: int
    T_odom_base: Transform
    covariance: F64
    twist: F64
    unknown: F64
    speed: tuple[float, float] = (0.0, 0.0)


class Continues(Enum):
    """How an odometry follows the one before."""

    NEXT = "it goes on"
    CLOCK_BACK = "the clock was set back"
    CLOCK_AHEAD = "the clock was set ahead, or odometry was silent"
    ANEW = "odometry began anew"


@dataclass(frozen=True, slots=True)
class OdometryVerdict:
    """usable: odometries to be used now, in order.  wild: one that is not used.  late: this one is before the last."""

    usable: tuple[tuple[ToldOdometry, Continues], ...] = ()
    wild: ToldOdometry | None = None
    late: bool = False


class OdometryContinuity:
    """Looks at one odometry after the other; at most one is held until the next has come."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Everything: the next is the first."""
        self._last: ToldOdometry | None = None
        self._held: ToldOdometry | None = None
        self._late: list[int] = []
        self._speeds: deque[tuple[float, float]] = deque(maxlen=_RECENT)
        self._intervals: deque[float] = deque(maxlen=_RECENT)

    @property
    def held(self) -> ToldOdometry | None:
        """What waits for the next."""
        return self._held

    def judge(self, told: ToldOdometry) -> OdometryVerdict:
        """What is to be done with an odometry."""
        last, held = self._last, self._held
        if last is None:
            return OdometryVerdict((self._used(told, Continues.NEXT),))
        if told.stamp_ns <= last.stamp_ns:
            return self._judge_late(told)
        self._late.clear()
        if held is not None and told.stamp_ns <= held.stamp_ns:  # its stamp was wild
            self._held = None
            return replace(self.judge(told), wild=held)
        if held is not None:
            return self._judge_held(held, told)
        if self._is_far(last, told) or _seconds(last, told) > LONGEST_S:
            self._held = told
            return OdometryVerdict()
        return OdometryVerdict((self._used(told, _by_time(last, told)),))

    def _judge_late(self, told: ToldOdometry) -> OdometryVerdict:
        """Out of order, or the third of a clock that was set back."""
        if self._late and told.stamp_ns <= self._late[-1]:
            self._late.clear()
        self._late.append(told.stamp_ns)
        if len(self._late) < _LATE_IN_A_ROW:
            return OdometryVerdict(late=True)
        held, last = self._held, self._last
        usual = int(1e9 * self._usual_s())
        anew = last is not None and self._is_far(replace(last, stamp_ns=told.stamp_ns - usual), told)
        self._intervals.clear()
        self._held = None
        return OdometryVerdict((self._used(told, Continues.ANEW if anew else Continues.CLOCK_BACK),), wild=held)

    def _judge_held(self, held: ToldOdometry, told: ToldOdometry) -> OdometryVerdict:
        """A pose was far from that before, or much later; now another one has come."""
        last, self._held = self._last, None
        if last is None:
            raise ValueError("an odometry is held before there was a first one")
        if not self._is_far(last, held):
            return OdometryVerdict((self._used(held, _by_time(last, held)), self._used(told, _by_time(held, told))))
        onward, jump = _speed(held, told), _speed(last, held)
        if not self._is_far(last, told) and self._is_far(held, told):
            return OdometryVerdict((self._used(told, _by_time(last, told)),), wild=held)
        of = 0 if _apart(last, held)[0] > _AWAY_M else 1
        if onward[of] >= _AS_FAST * jump[of]:
            return OdometryVerdict((self._used(held, _by_time(last, held)), self._used(told, _by_time(held, told))))
        first = self._used(held, Continues.ANEW)
        if self._is_far(held, told):
            self._held = told
            return OdometryVerdict((first,))
        return OdometryVerdict((first, self._used(told, _by_time(held, told))))

    def _used(self, told: ToldOdometry, how: Continues) -> tuple[ToldOdometry, Continues]:
        last = self._last
        if last is not None and how is Continues.NEXT:
            self._intervals.append(_seconds(last, told))
            self._speeds.append(_speed(last, told))
        self._late.clear()
        self._last = told
        return told, how

    def _is_far(self, last: ToldOdometry, told: ToldOdometry) -> bool:
        metres, radians = _apart(last, told)
        seconds = min(_seconds(last, told), LONGEST_S)
        speeds = [*self._speeds, last.speed, told.speed]
        v, w = max(each[0] for each in speeds), max(each[1] for each in speeds)
        if metres > _REACH_M + _SPEEDS * v * seconds + _ACCELERATION * seconds**2:
            return True
        away = metres > _AWAY_M or radians > _AWAY_RAD
        if not (away and _is_home(told) and not _is_home(last)):
            return False
        reach = _AWAY_M + _HOME_SPEEDS * v * seconds, _AWAY_RAD + _HOME_SPEEDS * w * seconds
        gap = seconds > max(_GAP_S, _GAP_INTERVALS * self._usual_s())
        return gap or metres > reach[0] or radians > reach[1]

    def _usual_s(self) -> float:
        return median(self._intervals) if self._intervals else 0.0


def _by_time(last: ToldOdometry, told: ToldOdometry) -> Continues:
    return Continues.CLOCK_AHEAD if _seconds(last, told) > LONGEST_S else Continues.NEXT


def _seconds(last: ToldOdometry, told: ToldOdometry) -> float:
    return 1e-9 * (told.stamp_ns - last.stamp_ns)


def _apart(last: ToldOdometry, told: ToldOdometry) -> tuple[float, float]:
    """Metres and radians."""
    T = last.T_odom_base.inverse() @ told.T_odom_base
    return float(np.linalg.norm(T.t)), T.angle()


def _speed(last: ToldOdometry, told: ToldOdometry) -> tuple[float, float]:
    metres, radians = _apart(last, told)
    seconds = _seconds(last, told)
    return metres / seconds, radians / seconds


def _is_home(told: ToldOdometry) -> bool:
    T = told.T_odom_base
    return float(np.linalg.norm(T.t)) < _HOME_M and T.angle() < _HOME_RAD


def speed_of(twist: object) -> tuple[float, float]:
    """Of a geometry_msgs/Twist, m/s and rad/s; 0 where it is not finite."""
    linear, angular = getattr(twist, "linear", None), getattr(twist, "angular", None)
    made = [math.hypot(each.x, each.y, each.z) if each is not None else 0.0 for each in (linear, angular)]
    return (made[0] if math.isfinite(made[0]) else 0.0), (made[1] if math.isfinite(made[1]) else 0.0)
