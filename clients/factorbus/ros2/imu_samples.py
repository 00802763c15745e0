"""sensor_msgs/Imu as samples: what is used of a message, and what was measured between two times."""

import math
from collections import deque
from itertools import islice
from typing import Any

import numpy as np

from factorbus.client.imu import STANDARD_GRAVITY, cut_samples
from factorbus.client.imu_samples import GAP, implausible_units
from factorbus.proto.arrays import F64
from factorbus.ros2.message_parts import Notes, stamp_ns_of
from factorbus.ros2.problems import BadRosMessage

_KEPT, _RECENT = 65_536, 1024
_FEWEST = 4  # samples of a factor: of one, the errors of way and velocity are the same number, and no covariance
_LATE_IN_A_ROW = 3
_LARGEST = 1e4  # rad/s and m/s²: beyond that a number is none, in whatever units
_NOT_SAID = -1.0  # in the first place of a covariance: the sensor has none of these numbers
_NO_GRAVITY = 0.3  # of 9.8 m/s²: who measures less at the median has taken gravity away


class ImuSamples:
    """The last samples of an IMU, oldest first, of one frame and one clock."""

    def __init__(self, topic: str, notes: Notes) -> None:
        self._topic, self._notes = topic, notes
        self.frame = ""
        self._times: deque[int] = deque(maxlen=_KEPT)
        self._rates: deque[tuple[float, ...]] = deque(maxlen=_KEPT)
        self._late: list[int] = []

    @property
    def first_ns(self) -> int | None:
        """The time of the first that is kept."""
        return self._times[0] if self._times else None

    @property
    def last_ns(self) -> int | None:
        """The time of the last."""
        return self._times[-1] if self._times else None

    def forget(self) -> None:
        """All samples; the frame stays."""
        self._times.clear()
        self._rates.clear()
        self._late.clear()

    def hear(self, topic: str, message: Any) -> bool:
        """Keep a message; whether its clock was set back.  Raises BadRosMessage: it is not used."""
        stamp_ns = stamp_ns_of(topic, message.header.stamp)
        w, a = message.angular_velocity, message.linear_acceleration
        rates = (w.x, w.y, w.z, a.x, a.y, a.z)
        for name, covariance in (("angular velocity", message.angular_velocity_covariance),
                                 ("acceleration", message.linear_acceleration_covariance)):  # fmt: skip
            if covariance[0] == _NOT_SAID:
                raise BadRosMessage(topic, f"an IMU without {name} (−1 in its covariance)", "both of them")
        if not all(math.isfinite(each) and abs(each) <= _LARGEST for each in rates):
            seen = ", ".join(f"{each:.4g}" for each in rates)
            raise BadRosMessage(topic, f"rates and accelerations of {seen}", f"finite ones up to {_LARGEST:g}")
        frame = message.header.frame_id
        if self.frame and frame != self.frame:
            raise BadRosMessage(topic, f"frame {frame!r}", f"{self.frame!r} as before: one topic for each IMU")
        turn = message.orientation
        if message.orientation_covariance[0] != _NOT_SAID and any((turn.x, turn.y, turn.z)):
            self._notes.remark(topic, "its orientation is not used: a filter made it of the same samples")
        self.frame = frame
        back = self.last_ns is not None and stamp_ns <= self.last_ns and self._set_back(topic, stamp_ns)
        self._late.clear()
        self._times.append(stamp_ns)
        self._rates.append(tuple(map(float, rates)))
        return back

    def _set_back(self, topic: str, stamp_ns: int) -> bool:
        """True: samples go on by another clock.  Raises BadRosMessage: one that came twice, or out of order."""
        last_ns = self._times[-1]
        if stamp_ns == last_ns:
            raise BadRosMessage(topic, f"a stamp of {stamp_ns} ns twice", "one sample for each time")
        if self._late and stamp_ns <= self._late[-1]:
            self._late.clear()
        self._late.append(stamp_ns)
        if len(self._late) < _LATE_IN_A_ROW:
            raise BadRosMessage(topic, f"a stamp of {stamp_ns} ns", f"one after the last, {last_ns} ns")
        self._notes.remark(topic, f"the clock was set back by {1e-9 * (last_ns - stamp_ns):.4g} s")
        self.forget()
        return True

    def count(self, begin_ns: int, end_ns: int) -> int:
        """How many there are between two times."""
        return len(self._rows(begin_ns, end_ns))

    def between(self, begin_ns: int, end_ns: int) -> F64 | str:
        """(n, 7) durations, rates and accelerations from one time to another; or why there are none, in words."""
        if not self._times or self._times[0] > begin_ns:
            return "its samples begin after a keyframe"
        rows = self._rows(begin_ns, end_ns)
        times = np.array([self._times[n] - begin_ns for n in rows], np.int64)
        rates = np.array([self._rates[n] for n in rows], np.float64)
        recent = np.array(list(islice(reversed(self._times), _RECENT)), np.int64)
        usual_ns = -float(np.median(np.diff(recent))) if len(recent) > 1 else 0.0
        if float(np.diff(np.append(times, end_ns - begin_ns)).max()) > GAP * usual_ns:
            return f"a gap in its samples, of more than {GAP:g} of their intervals"
        seconds = 1e-9 * (end_ns - begin_ns)
        samples = cut_samples(1e-9 * times, rates[:, :3], rates[:, 3:], 0.0, seconds, longest_s=math.inf)
        if wrong := _wrong_units(samples):
            return wrong
        if len(samples) < _FEWEST:
            samples = np.repeat(samples, _FEWEST, axis=0)
            samples[:, 0] /= _FEWEST
        return samples

    def _rows(self, begin_ns: int, end_ns: int) -> range:
        """Of those that hold in that time: from the last at its beginning or before to the last before its end."""
        first = max(_first_at(self._times, begin_ns + 1) - 1, 0)
        return range(first, _first_at(self._times, end_ns))


def _first_at(times: deque[int], stamp_ns: int) -> int:
    """The number of times before a stamp; most questions are about the last ones."""
    n = len(times)
    for time_ns in reversed(times):
        if time_ns < stamp_ns:
            return n
        n -= 1
    return 0


def _wrong_units(samples: F64) -> str:
    """What is implausible of samples, for people; empty: nothing."""
    if wrong := implausible_units(samples, np.array([0.0, 0.0, -STANDARD_GRAVITY])):
        return "; ".join(wrong)
    force = float(np.median(np.linalg.norm(samples[:, 4:], axis=1)))
    if force < _NO_GRAVITY * STANDARD_GRAVITY:
        return f"the median of |acceleration| is {force:.1g} m/s², and about 9.8 is wanted: gravity is part of it"
    return ""
