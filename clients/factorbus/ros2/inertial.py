"""Raw samples of an IMU between keyframes: factors of the kind `imu`, with velocities and biases beside the poses.

Of a robot of letter x: pose x7, velocity V7 of the IMU and its bias B7; of other letters their indices begin at the
letter's number · 2⁴⁰, so that robots share a map.  Gravity is a variable, G0, of 9.80665 m/s²: the map is turned as
odometry began, which need not be upright.  A factor joins a keyframe to the next as soon as samples reach it.  Where
samples are missing no factor does: the next pair begins with a velocity of its own, and the bias walks on.  No bus and
no clock.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorbus.client.draft import Draft
from factorbus.client.imu import STANDARD_GRAVITY, Standstill, initial_from_standstill
from factorbus.proto.arrays import F64
from factorbus.proto.problems import BadOption, BadShape
from factorbus.proto.symbols import format_symbol, symbol
from factorbus.ros2.geometry import Transform, quaternion
from factorbus.ros2.imu_samples import ImuSamples
from factorbus.ros2.message_parts import Notes
from factorbus.ros2.settings import BIAS_LETTER, GRAVITY_LETTER, VELOCITY_LETTER, Settings

MOST_BETWEEN = 1000  # samples between two keyframes
_WAITING = 64  # keyframes that samples may be behind
_BEGIN_S = 1.0 + 1e-6  # of what an IMU says at first
_STILL_M, _STILL_RATE = 0.01, 0.05  # by odometry in that time; mean of gyroscopes, rad/s
_STALE_NS = 10**9  # a sample that is later than a clock that was set back by that is of the former one
_SIGMA_STILL, _SIGMA_MOVING = 0.05, 1.0  # of velocity, m/s
_GYROSCOPE, _ACCELEROMETER = 0.01, 0.2  # of a bias at first, rad/s, m/s²
_LEAST_GYROSCOPE, _SIGMA_GRAVITY = 1e-4, 0.005


@dataclass(frozen=True, slots=True)
class Moment:
    """A keyframe: its key, when it was, and where odometry has it in the map."""

    key: int
    stamp_ns: int
    T_map_base: Transform


class InertialChain:
    """Joins keyframes by what an IMU measured.  try_mount: T_base_frame of a frame, if it is known.
    moved_m: how far the robot has moved by odometry from one time (ns) to another, metres.
    gravity: index of the key of the first gravity that is free.
    """

    def __init__(
        self,
        settings: Settings,
        try_mount: Callable[[str], Transform | None],
        moved_m: Callable[[int, int], float],
        gravity: int,
        notes: Notes,
    ) -> None:
        self._topic, self._noise, self._notes = settings.imu, settings.imu_noise, notes
        self._try_mount, self._moved_m = try_mount, moved_m
        self._offset = first_of_letter(settings.letter)
        self.samples = ImuSamples(settings.imu, notes)
        self.forget(gravity)

    def forget(self, gravity: int) -> None:
        """As new, for a map that is another one."""
        self._gravity = symbol(GRAVITY_LETTER, self._offset + gravity)
        self._has_gravity = False
        self._waiting: deque[Moment] = deque(maxlen=_WAITING)
        self._joined: Moment | None = None
        self._last_bias: Moment | None = None
        self._bias, self._marked_ns = np.zeros(6), 0
        self.samples.forget()

    def rewind(self, present: Callable[[int], bool]) -> None:
        """An insert was refused: go on from what is in the map."""
        self._has_gravity = self._has_gravity and present(self._gravity)
        if self._joined is not None and not (present(self._joined.key) and present(self._velocity(self._joined))):
            self._joined = None
        if self._last_bias is not None and not present(self._bias_key(self._last_bias)):
            self._last_bias = None
        self._waiting = deque((each for each in self._waiting if present(each.key)), _WAITING)

    def hear(self, topic: str, message: Any) -> None:
        """A sensor_msgs/Imu.  Raises BadRosMessage: it is not used."""
        if self.samples.hear(topic, message):
            self._part("")

    def mark(self, moment: Moment) -> None:
        """A new keyframe."""
        if len(self._waiting) == _WAITING:
            self._say_silent(moment)
            self._part("")
            self._waiting.clear()
        self._waiting.append(moment)
        self._marked_ns = moment.stamp_ns

    def set_clock_back(self, stamp_ns: int) -> None:
        """Odometry goes on by another clock, from a time on."""
        if (self.samples.last_ns or 0) > stamp_ns + _STALE_NS:
            self.samples.forget()
        self._part("")
        self._marked_ns = stamp_ns
        self._waiting.clear()

    def is_long(self) -> bool:
        """There are as many samples since the last keyframe as one factor has."""
        last_ns = self.samples.last_ns
        return last_ns is not None and self.samples.count(self._marked_ns, last_ns) >= MOST_BETWEEN

    def advance(self, draft: Draft) -> None:
        """Join what samples reach."""
        while self._waiting:
            first, then = self._pair()
            last_ns = self.samples.last_ns
            if first is None or then is None or last_ns is None or last_ns < then.stamp_ns:
                return
            mount = self._try_mount(self.samples.frame)
            if mount is None:
                self._say_mount()
                self._part("")
                self._drop_until(then)
                continue
            found = self.samples.between(first.stamp_ns, then.stamp_ns)
            if isinstance(found, str):
                self._part(found)
                self._drop_until(then)
                continue
            if self._joined is None:
                self._begin(draft, first, then, found, mount)
            self._join(draft, first, then, found, mount)
            self._joined = then
            self._drop_until(then)
            if self._waiting and self._waiting[0] is then:
                self._waiting.popleft()

    def open_ends(self) -> str:
        """What samples did not reach where a recording ends, for people; empty: nothing."""
        left = max(len(self._waiting) - (self._joined is None), 0)
        return "the last keyframes have no samples of the IMU at their times" if left > 1 else ""

    def _pair(self) -> tuple[Moment | None, Moment | None]:
        """The keyframes to join next."""
        if self._joined is not None:
            return self._joined, self._waiting[0]
        return (self._waiting[0], self._waiting[1]) if len(self._waiting) > 1 else (None, None)

    def _drop_until(self, moment: Moment) -> None:
        while self._waiting and self._waiting[0] is not moment:
            self._waiting.popleft()

    def _begin(self, draft: Draft, first: Moment, then: Moment, samples: F64, mount: Transform) -> None:
        """A velocity, a bias and gravity at a keyframe that no factor leads to."""
        begun = samples[: max(2, int((np.cumsum(samples[:, 0]) <= _BEGIN_S).sum()))]
        mean = begun[:, 4:].mean(axis=0)
        end_ns = first.stamp_ns + int(1e9 * float(begun[:, 0].sum()))
        still = None
        if self._moved_m(first.stamp_ns, end_ns) < _STILL_M:  # at an even speed an IMU feels nothing
            still = _try_standstill(begun, mount)
        R_map_imu = first.T_map_base.R @ mount.R
        velocity, sigma = np.zeros(3), _SIGMA_STILL
        if still is None:
            way = then.T_map_base.t - first.T_map_base.t
            velocity = way / (1e-9 * (then.stamp_ns - first.stamp_ns))
            sigma = max(_SIGMA_MOVING, 2.0 * float(np.linalg.norm(velocity)))
        key, bias_key = self._velocity(first), self._bias_key(first)
        draft.vector(key, velocity)
        draft.linear([key], [velocity], [np.eye(3)], np.zeros(3), sigmas=[sigma] * 3)
        self._add_bias(draft, first, bias_key, still)
        if not self._has_gravity:
            up = R_map_imu @ mean / np.linalg.norm(mean)
            draft.vector(self._gravity, -STANDARD_GRAVITY * up)
            draft.factor("length_vector3", (self._gravity,), [STANDARD_GRAVITY], sigmas=_SIGMA_GRAVITY)
            self._has_gravity = True
            how = "stands still" if still is not None else "moves"
            lean = math.degrees(math.acos(min(1.0, float(up[2]))))
            text = f"the IMU begins at {format_symbol(first.key)}, where the robot {how}: the map's z axis leans"
            self._notes.remark(self._topic, f"{text} {lean:.1f}° from the vertical")

    def _add_bias(self, draft: Draft, first: Moment, key: int, still: Standstill | None) -> None:
        """By standing still, by the bias before, or of unknown size about zero."""
        last = self._last_bias
        if still is not None:
            self._bias = np.append(still.bias[:3], self._bias[3:])
        draft.vector(key, self._bias)
        if last is not None:
            seconds = max(1e-9 * abs(first.stamp_ns - last.stamp_ns), 1e-3)
            walk = np.repeat([self._noise.gyroscope_walk, self._noise.accelerometer_walk], 3) * math.sqrt(seconds)
            pair, zeros = [self._bias_key(last), key], [np.zeros(6)] * 2
            draft.linear(pair, zeros, [-np.eye(6), np.eye(6)], np.zeros(6), kinds=["vector6"] * 2, sigmas=walk)
        if still is not None or last is None:
            gyroscope = np.full(3, _GYROSCOPE)
            if still is not None:
                gyroscope = np.maximum(still.sigma_gyroscope, _LEAST_GYROSCOPE)
            sigmas = np.append(gyroscope, np.full(3, _ACCELEROMETER))
            draft.linear([key], [self._bias], [np.eye(6)], np.zeros(6), sigmas=sigmas)

    def _join(self, draft: Draft, first: Moment, then: Moment, samples: F64, mount: Transform) -> None:
        here, there = ((each.key, self._velocity(each), self._bias_key(each)) for each in (first, then))
        draft.vector(there[1], size=3).vector(there[2], size=6)
        row = [*mount.t.tolist(), *quaternion(mount.R)]
        draft.imu(here, there, samples, noise=self._noise, gravity=self._gravity, bias=self._bias, mount=row)
        self._last_bias = then

    def _part(self, why: str) -> None:
        """No factor leads on from here."""
        if why:
            self._notes.remark(self._topic, f"{why}: keyframes on both sides are not joined by the IMU")
        self._joined = None

    def _say_mount(self) -> None:
        text = f"nothing says where frame {self.samples.frame[:80]!r} is on the robot: the IMU is not used (--mount)"
        if not self.samples.frame:
            text = "its messages have no frame_id, so nothing can say where it is on the robot: the IMU is not used"
        self._notes.remark(self._topic, text)

    def _say_silent(self, moment: Moment) -> None:
        last_ns = self.samples.last_ns
        apart = "" if last_ns is None else f", the last is {1e-9 * (moment.stamp_ns - last_ns):.4g} s before"
        self._notes.remark(
            self._topic, f"no samples at the times of {_WAITING} keyframes{apart}: are its stamps of the same clock?"
        )

    def _velocity(self, moment: Moment) -> int:
        return self._beside(VELOCITY_LETTER, moment)

    def _bias_key(self, moment: Moment) -> int:
        return self._beside(BIAS_LETTER, moment)

    def _beside(self, letter: str, moment: Moment) -> int:
        return symbol(letter, self._offset + (moment.key & (1 << 56) - 1))


def first_of_letter(letter: str) -> int:
    """The first index of velocities, biases and gravity beside the poses of a letter; there are 2⁴⁰ of them."""
    return 0 if letter == "x" else ord(letter) << 40


def _try_standstill(samples: F64, mount: Transform) -> Standstill | None:
    """What standing still tells, where the IMU feels no motion."""
    try:
        still = initial_from_standstill(samples, mount=[*mount.t.tolist(), *quaternion(mount.R)])
    except (BadOption, BadShape):
        return None
    return still if float(np.abs(still.bias[:3]).max()) < _STILL_RATE else None
