"""A robot with an IMU, GNSS and a visual odometry; where its sensors are, and where the map is, is unknown.

The map begins where the robot stands still for two seconds, z up, x where it looks.  Then it drives in curves, up and
down, and rolls.  What is true of it is consistent with the IMU to the last digit: each sample holds until the next.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorbus.proto.arrays import F64
from factorbus.simulate.noise import conjugate, quaternion_product, rotated
from factorbus.simulate.parameters import checked_run

_HZ, _ODOMETRY_HZ, _GNSS_HZ = 100, 2, 1
_GRAVITY = 9.80665
_STILL_S = 2.0


class SensorErrors(NamedTuple):
    """How the sensors err.  The first four are densities, the others standard deviations in metres and radians.

    bias (6,): gyroscopes, accelerometers.  mount (6,), lever (3,): where a sensor is, from where it is believed to be:
    `camera` (7,), which looks ahead, and the middle of the body.  odometry (6,): from one image to the next.
    """

    gyroscope: float = 1e-3
    accelerometer: float = 1e-2
    gyroscope_walk: float = 1e-5
    accelerometer_walk: float = 1e-4
    bias: F64 = np.repeat([0.01, 0.1], 3)
    mount: F64 = np.repeat([0.1, np.radians(5.0)], 3)
    lever: F64 = np.full(3, 0.3)
    gnss: F64 = np.array([0.5, 0.5, 1.0])
    odometry: F64 = np.repeat([0.02, 0.01], 3)
    camera: F64 = np.array([0.2, 0.0, 0.1, -0.5, 0.5, -0.5, 0.5])


@dataclass(frozen=True, slots=True, eq=False)
class InertialWorld:
    """Truth and measurements; times are seconds from the first sample on.

    imu (n, 7): time, gyroscopes, accelerometers.  gnss (k, 4): time, metres east, north, up.  odometry (j, 8): time,
    pose of the camera in the frame of its first one.  truth (n, 8): time, pose of the body in the map; velocity (n, 3).
    frame (7,): the pose of the map east, north, up.  lever (3,): where the antenna is, mount (7,): where the camera is,
    both on the body.  bias (6,): at the beginning.
    """

    imu: F64
    gnss: F64
    odometry: F64
    truth: F64
    velocity: F64
    frame: F64
    lever: F64
    mount: F64
    bias: F64
    errors: SensorErrors


def inertial(poses: int = 200, seed: int = 1) -> InertialWorld:
    """A drive of `poses` images of the camera, two a second.  Raises BadParameter."""
    checked_run(poses, seed)
    rng, errors = np.random.default_rng([seed, 3]), SensorErrors()
    yaw, bias = rng.uniform(-np.pi, np.pi), rng.normal(0, errors.bias)
    frame = np.array([*rng.normal(0, 50, 3), 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
    lever, mount = rng.normal(0, errors.lever), _turned(errors.camera, rng.normal(0, errors.mount))
    rates, truth, velocity = _drive((poses - 1) * (_HZ // _ODOMETRY_HZ) + 1, rng.uniform(0, 2 * np.pi, 4))
    h, n = 1.0 / _HZ, len(rates)
    walk = np.repeat([errors.gyroscope_walk, errors.accelerometer_walk], 3) * np.sqrt(h)
    drift = bias + np.vstack([np.zeros(6), np.cumsum(rng.normal(0, walk, (n - 1, 6)), axis=0)])
    density = np.repeat([errors.gyroscope, errors.accelerometer], 3) / np.sqrt(h)
    time = np.arange(n) * h
    imu = _columns(time, rates + drift + rng.normal(0, density, (n, 6)))
    fixed = slice(0, n, _HZ // _GNSS_HZ)
    antenna = truth[fixed, :3] + rotated(truth[fixed, 3:], np.tile(lever, (len(truth[fixed]), 1)))
    there = (
        frame[:3] + rotated(np.tile(frame[3:], (len(antenna), 1)), antenna) + rng.normal(0, errors.gnss, antenna.shape)
    )
    seen = slice(0, n, _HZ // _ODOMETRY_HZ)
    return InertialWorld(
        imu, _columns(time[fixed], there), _columns(time[seen], _odometry(truth[seen], mount, errors, rng)),
        _columns(time, truth), velocity, frame, lever, mount, bias, errors,
    )  # fmt: skip


def _columns(time: NDArray[np.floating], rows: F64) -> F64:
    return np.concatenate([time[:, None], rows], axis=1, dtype=np.float64)


def _drive(n: int, phases: F64) -> tuple[F64, F64, F64]:
    """(rates (n, 6), poses (n, 7), velocities (n, 3)) that integrate into each other."""
    h = 1.0 / _HZ
    t = np.arange(n + 1) * h
    moving = np.clip((t - _STILL_S) / 3.0, 0.0, 1.0)
    moving = moving * moving * (3 - 2 * moving)
    speed = moving * (5 + 2 * np.sin(0.4 * t + phases[0]))
    heading = np.concatenate([[0.0], np.cumsum(moving[:-1] * (0.08 + 0.35 * np.sin(0.2 * t[:-1] + phases[1])) * h)])
    pitch, roll = moving * 0.12 * np.sin(0.5 * t + phases[2]), moving * 0.15 * np.sin(0.7 * t + phases[3])
    quat = quaternion_product(quaternion_product(_about(2, heading), _about(1, pitch)), _about(0, roll))
    climb = 0.1 * np.sin(0.3 * t)
    v = speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading), climb])
    delta = quaternion_product(conjugate(quat[:-1]), quat[1:])
    delta *= np.sign(delta[:, 3:])
    size = np.linalg.norm(delta[:, :3], axis=1, keepdims=True)
    gyroscope = 2 * np.arctan2(size, delta[:, 3:]) * delta[:, :3] / np.maximum(size, 1e-300) / h
    pushed = np.diff(v, axis=0) / h
    felt = rotated(conjugate(quat[:-1]), pushed + np.array([0, 0, _GRAVITY]))
    place = np.vstack([np.zeros(3), np.cumsum(h * v[:-1] + 0.5 * h * h * pushed, axis=0)])[:-1]
    return np.column_stack([gyroscope, felt]), np.column_stack([place, quat[:-1]]), v[:-1]


def _odometry(truth: F64, mount: F64, errors: SensorErrors, rng: np.random.Generator) -> F64:
    """Poses of a camera, put together from what it measured of each step."""
    camera = _composed(truth, np.tile(mount, (len(truth), 1)))
    found = [np.array([0, 0, 0, 0, 0, 0, 1.0])]
    for before, after in pairwise(camera):
        step = _composed(_inverse(before)[None], after[None])[0]
        found.append(_composed(found[-1][None], _turned(step, rng.normal(0, errors.odometry))[None])[0])
    return np.array(found)


def _turned(pose: F64, by: F64) -> F64:
    """A pose moved by (6,) in its own frame: metres, a rotation vector."""
    angle = float(np.linalg.norm(by[3:]))
    quat = np.append(np.sinc(angle / 2 / np.pi) * by[3:] / 2, np.cos(angle / 2))
    return _composed(pose[None], np.append(by[:3], quat)[None])[0]


def _composed(a: F64, b: F64) -> F64:
    quat = quaternion_product(a[:, 3:], b[:, 3:])
    return np.column_stack([a[:, :3] + rotated(a[:, 3:], b[:, :3]), quat / np.linalg.norm(quat, axis=1, keepdims=True)])


def _inverse(pose: F64) -> F64:
    back = conjugate(pose[None, 3:])
    return np.concatenate([-rotated(back, pose[None, :3])[0], back[0]])


def _about(axis: int, angle: F64) -> F64:
    quat = np.zeros((len(angle), 4))
    quat[:, axis], quat[:, 3] = np.sin(angle / 2), np.cos(angle / 2)
    return quat
