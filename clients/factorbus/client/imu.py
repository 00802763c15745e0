"""What an IMU measured between two poses, as an inertial factor; and what standing still tells before the first one.

    samples = cut_samples(times_s, gyroscope, accelerometer, 1.0, 1.1)
    Draft().imu(("x0", "v0", "b0"), ("x1", "v1", "b1"), samples, noise=ImuNoise(1e-3, 1e-2, 1e-5, 1e-4))

Frames: what it measures, and its bias, is in the IMU's frame, whose pose on the robot is its mount; velocities and
gravity are along the axes of the map.  A bias is (gyroscopes, rad/s; accelerometers, m/s²).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import all_finite, as_numbers, checked_bound, checked_number, checked_row, of_type, seen
from factorbus.client.certainty import Certainty
from factorbus.client.imu_samples import refuse_gaps, refuse_not_finite, warn_implausible
from factorbus.client.key_numbers import Key, key_numbers
from factorbus.proto.arrays import F64
from factorbus.proto.inertial import BIAS, MOST_SAMPLES, RESIDUAL, SAMPLE, ImuForm
from factorbus.proto.linear_in_frame import rotation_of
from factorbus.proto.problems import BadOption, BadShape
from factorbus.proto.symbols import format_symbol

STANDARD_GRAVITY = 9.80665  # m/s²
_UNIT = np.eye(RESIDUAL)[np.triu_indices(RESIDUAL)]
# The most that an IMU at rest turns and shakes: standard deviations, rad/s and m/s².
_STILL = 0.05, 0.5
# How far from gravity the mean acceleration at rest may be, m/s².
_BIASED = 1.0
_NOTHING, _IN_THE_MIDDLE = np.empty(0), np.array([0, 0, 0, 0, 0, 0, 1.0])
_TOLERANCE = 1e-3  # how far a quaternion may be from unit length


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """How an IMU errs, as its data sheet or its Allan variance says, each in continuous time.

    gyroscope:            noise density, rad/s/√Hz           accelerometer:       noise density, m/s²/√Hz
    gyroscope_walk:       of its bias, rad/s/√s (rad/s²/√Hz)  accelerometer_walk:  of its bias, m/s²/√s (m/s³/√Hz)
    integration:          what integration adds to a position, m/√s; a factor of one sample needs some
    Raises BadOption: one of the first four is not above 0, or the last below.
    """

    gyroscope: float
    accelerometer: float
    gyroscope_walk: float
    accelerometer_walk: float
    integration: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = as_numbers(f"ImuNoise: {field.name}", value, "a number")
            number = float(numbers.sum()) if numbers.size == 1 else np.nan
            if not (np.isfinite(number) and (number > 0.0 or (field.name == "integration" and number == 0.0))):
                wanted = "0 or more" if field.name == "integration" else "a finite number above 0"
                raise BadOption(f"ImuNoise: {field.name}", seen(value), wanted)


@dataclass(frozen=True, slots=True)
class Standstill:
    """What an IMU tells while it stands still.

    attitude (4,): of the robot in a map whose z axis is up, qx qy qz qw; about the vertical it is 0.
    bias (6,): along the axes of the IMU, gyroscopes, rad/s; accelerometers, m/s²: what differs from gravity along the
    vertical, no more is seen.
    gravity (3,): in that map, m/s².
    sigma_gyroscope (3,): standard deviation of the first three numbers of the bias, rad/s.
    sigma_tilt: of the attitude about horizontal axes, radians, if accelerometers had no bias.
    """

    attitude: F64
    bias: F64
    gravity: F64
    sigma_gyroscope: F64
    sigma_tilt: float


class Moments(NamedTuple):
    """The variables of an inertial factor, and what of gravity and the mount is none.

    keys: poses, velocities and biases, the mount, gravity.  where: for an error.  gravity (3,), mount (7,), or ().
    """

    keys: list[int]
    where: str
    form: ImuForm
    gravity: F64
    mount: F64


def moments(
    kind: str, first: Sequence[Key], second: Sequence[Key], gravity: Key | ArrayLike, mount: Key | ArrayLike | None
) -> Moments:
    """The variables of a factor; a gravity or a mount that is a key is one.  Raises BadShape, BadSymbol, BadOption."""
    keys = [*moment(f"{kind}: first", first), *moment(f"{kind}: second", second)]
    has_mount, has_gravity = isinstance(mount, str | int), isinstance(gravity, str | int)
    numbers = key_numbers([*keys, *[cast("Key", mount)] * has_mount, *[cast("Key", gravity)] * has_gravity]).tolist()
    where = " ".join([kind, *map(format_symbol, numbers)])
    g = _NOTHING if has_gravity else checked_row(f"{where}: gravity", cast("ArrayLike", gravity), 3)
    m = _NOTHING if has_mount else _checked_mount(f"{where}: mount", cast("ArrayLike | None", mount))
    return Moments(numbers, where, ImuForm(0, has_mount, has_gravity), g, m)


def _checked_mount(what: str, mount: ArrayLike | None) -> F64:
    """(7,): where there is none, the robot's pose."""
    m = checked_row(what, _IN_THE_MIDDLE if mount is None else mount, 7)
    if not abs(np.linalg.norm(m[3:]) - 1.0) <= _TOLERANCE:
        raise BadShape(what, f"a quaternion of length {np.linalg.norm(m[3:]):g}", "1: x y z qx qy qz qw")
    return m


def imu_factor(of: Moments, samples: ArrayLike, noise: ImuNoise, bias: ArrayLike) -> tuple[str, F64]:
    """(kind, measurement) of a factor; see `Draft.imu`.  Raises BadShape, BadOption, NotFiniteNumbers."""
    rows = checked_samples(f"{of.where}: samples", samples)
    sensor = of_type(f"{of.where}: noise", noise, ImuNoise, "an ImuNoise")
    b = checked_row(f"{of.where}: bias", bias, BIAS)
    if len(rows) > MOST_SAMPLES:
        wanted = f"1 to {MOST_SAMPLES}; put a pose in between, or join samples in pairs"
        raise BadShape(f"{of.where}: samples", len(rows), wanted)
    warn_implausible(rows, of.gravity if of.gravity.size else np.array([0.0, 0.0, -STANDARD_GRAVITY]))
    row = np.concatenate([astuple(sensor), b, of.gravity, of.mount, rows.ravel()])
    return ImuForm(len(rows), of.form.mount, of.form.gravity).name, row


def cut_samples(
    times_s: ArrayLike,
    gyroscope: ArrayLike,
    accelerometer: ArrayLike,
    begin_s: float,
    end_s: float,
    longest_s: float | None = None,
) -> F64:
    """The samples (n, 7) from `begin_s` to `end_s`, two poses' times: duration, gyroscopes, accelerometers.

    times_s (m,): when each was taken, increasing; gyroscope, accelerometer (m, 3): rad/s, m/s².
    A sample holds until the next one, the last one to `end_s`; what the first and the last hold is cut at the poses.
    longest_s: how long one may hold, without 10 times the median interval of all that are given; where samples were
    lost for longer, the robot's motion is not known by this IMU, and the noise would say that it is.
    Raises BadShape, BadOption, NotFiniteNumbers: among others, no sample at `begin_s` or before, a longer gap.
    """
    times = all_finite("times_s", as_numbers("times_s", times_s))
    rates = [all_finite(n, as_numbers(n, x)) for n, x in (("gyroscope", gyroscope), ("accelerometer", accelerometer))]
    for name, each in zip(("gyroscope", "accelerometer"), rates, strict=True):
        if times.ndim != 1 or each.shape != (times.size, 3):
            raise BadShape(name, f"shape {each.shape} with times of shape {times.shape}", "(m, 3) with times (m,)")
    if (np.diff(times) <= 0.0).any():
        raise BadOption("times_s", "a time that is not after the one before", "increasing times")
    begin_s, end_s = checked_number("begin_s", begin_s), checked_number("end_s", end_s)
    if not begin_s < end_s:
        raise BadOption("begin_s, end_s", f"{begin_s!r}, {end_s!r}", "begin_s before end_s")
    if not times.size or times[0] > begin_s:
        first = f"the first sample is at {times[0]:g} s" if times.size else "no samples"
        raise BadOption("times_s", first, f"one at begin_s ({begin_s:g} s) or before")
    held = np.minimum(np.append(times[1:], np.inf), end_s) - np.maximum(times, begin_s)
    refuse_gaps(times, held, end_s, longest_s)
    return np.column_stack([held, *rates])[held > 0.0]


def initial_from_standstill(
    samples: ArrayLike, gravity: float = STANDARD_GRAVITY, mount: ArrayLike | None = None
) -> Standstill:
    """Where down is, and the bias of the gyroscopes, by the samples (n, 7) of an IMU that stands still.

    gravity: its magnitude, m/s².  mount: the IMU's pose on the robot, as of `Draft.imu`.
    Raises BadShape, NotFiniteNumbers, BadOption: it moves, or measures another gravity.
    """
    rows, gravity = checked_samples("samples", samples), checked_bound("gravity", gravity)
    if len(rows) < 2:
        raise BadShape("samples", len(rows), "2 or more of standing still; a second of them is good")
    mean, spread = rows[:, 1:].mean(axis=0), rows[:, 1:].std(axis=0, ddof=1)
    turning, shaking = float(spread[:3].max()), float(spread[3:].max())
    if turning > _STILL[0] or shaking > _STILL[1]:
        moving = f"standard deviations of {turning:.3g} rad/s and {shaking:.3g} m/s²"
        raise BadOption("samples", moving, f"an IMU at rest: {_STILL[0]:g} rad/s and {_STILL[1]:g} m/s² at most")
    up = mean[3:]
    size = float(np.linalg.norm(up))
    if abs(size - gravity) > _BIASED:
        units = "" if abs(size - 1.0) > 0.1 else f"; is it in g? Multiply by {STANDARD_GRAVITY}"
        wanted = f"{gravity:g} ± {_BIASED:g} m/s²: specific force, which at rest points up{units}"
        raise BadOption("samples", f"a mean acceleration of {size:.4g} m/s²", wanted)
    error = spread / np.sqrt(len(rows))
    R = rotation_of(_checked_mount("mount", mount))
    return Standstill(
        _upright(R @ up / size),
        np.concatenate([mean[:3], up * (1.0 - gravity / size)]),
        np.array([0.0, 0.0, -gravity]),
        error[:3],
        float(error[3:].max() / size),
    )


def _upright(up: F64) -> F64:
    """The shortest rotation that takes `up` of the pose to the z axis, without the part about that axis."""
    roll, pitch = np.arctan2(up[1], up[2]), np.arctan2(-up[0], np.hypot(up[1], up[2]))
    (sr, cr), (sp, cp) = ((np.sin(a / 2), np.cos(a / 2)) for a in (roll, pitch))
    return np.array([sr * cp, cr * sp, -sr * sp, cr * cp])


def checked_samples(what: str, samples: ArrayLike) -> F64:
    """(n, 7), n ≥ 1, each of some duration."""
    rows = as_numbers(what, samples)
    if rows.ndim != 2 or rows.shape[1] != SAMPLE or not len(rows):
        wanted = "(n, 7): duration (s), gyroscopes (rad/s, 3), accelerometers (m/s², 3)"
        raise BadShape(what, f"shape {rows.shape}", wanted)
    refuse_not_finite(what, rows)
    if (rows[:, 0] <= 0.0).any():
        first = int(np.flatnonzero(rows[:, 0] <= 0.0)[0])
        raise BadOption(what, f"sample {first} lasts {rows[first, 0]:g} s", "durations above 0 s")
    return rows


def known_by_noise(certainty: Certainty, information: F64 = _UNIT) -> Certainty:
    """With Ω where none is given: one, of a residual that is whitened."""
    if "sigmas" in certainty or "information" in certainty:
        return certainty
    return {**certainty, "information": information}


def moment(what: str, keys: Sequence[Key]) -> Sequence[Key]:
    """The keys of a pose, a velocity and a bias.  Raises BadShape, BadOption."""
    if isinstance(keys, str) or len(of_type(what, keys, Sequence, "three keys")) != 3:
        raise BadShape(what, repr(keys)[:80], "three keys: of a pose, a velocity and a bias")
    return keys
