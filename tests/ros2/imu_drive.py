"""A simulated drive with an IMU as a robot says it, and the same as a draft, by nothing of the bridge's.

Odometry begins leaning, so that gravity is not along the map's z axis, and the IMU is turned on the robot.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import ros
import words
from recordings import START_NS, Said
from zenoh_ros_type.common_interfaces.geometry_msgs import Transform

from factorbus.client import Draft, ImuNoise, cut_samples, initial_from_standstill
from factorbus.client.frames import compose, inverse
from factorbus.proto.arrays import F64
from factorbus.proto.linear_in_frame import rotation_of
from factorbus.ros2.messages import IMU, ODOMETRY, TRANSFORMS
from factorbus.simulate import inertial

GRAVITY = 9.80665
MOUNT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.sin(0.5), math.cos(0.5)])
LEANING = np.array([1.0, -2.0, 0.5, math.sin(0.1), 0.0, 0.0, math.cos(0.1)])
NOISE = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)
SIGMA = np.repeat([0.01, 0.002], 3)  # of odometry, from one to the next
_EVERY = 20  # samples between two odometries


class ImuDrive(NamedTuple):
    """imu (n, 7): seconds, rates and accelerations along the IMU's axes.  odometry: (time, measured), truth (k, 7).

    bias (6,): at the beginning, along the IMU's axes.
    """

    imu: F64
    odometry: list[tuple[float, F64]]
    truth: F64
    bias: F64


def imu_drive(poses: int = 24, seed: int = 1) -> ImuDrive:
    world = inertial(poses + 1, seed)
    R = rotation_of(MOUNT)
    imu = world.imu.copy()
    imu[:, 1:4], imu[:, 4:] = imu[:, 1:4] @ R, imu[:, 4:] @ R
    rows, random = world.truth[::_EVERY], np.random.default_rng([seed, 9])
    told = [LEANING]
    for before, after in zip(rows[:-1, 1:], rows[1:, 1:], strict=True):
        step = compose(inverse(before), after[None])[0]
        noise = random.normal(0, SIGMA) * min(1.0, float(np.linalg.norm(step[:3])))
        small = np.append(noise[:3], [*(0.5 * noise[3:]), 1.0])
        small[3:] /= np.linalg.norm(small[3:])
        told.append(compose(told[-1], compose(step, small[None]))[0])
    truth = np.array([compose(LEANING, compose(inverse(rows[0, 1:]), row[None, 1:]))[0] for row in rows])
    bias = np.concatenate([world.bias[:3] @ R, world.bias[3:] @ R])
    return ImuDrive(imu, list(zip(rows[:, 0].tolist(), told, strict=True)), truth, bias)


def at(seconds: float) -> int:
    return START_NS + round(seconds * 1e9)


def said(made: ImuDrive, late_s: float = 0.0) -> list[Said]:
    """In the order in which it is heard; samples come `late_s` after they were taken."""
    there = Transform(words.Vector3(*MOUNT[:3]), words.Quaternion(*MOUNT[3:]))
    static = words.TFMessage(
        [words.TransformStamped(words.Header(ros.stamp(START_NS), "base_link"), "imu_link", there)]
    )
    heard = [(t + late_s, Said("/imu/data_raw", IMU, at(t), ros.imu(at(t), rates))) for t, *rates in made.imu.tolist()]
    heard += [
        (t + 1e-4, Said("/odom", ODOMETRY, at(t), ros.space_odometry(at(t), row.tolist()))) for t, row in made.odometry
    ]
    heard.sort(key=lambda each: each[0])
    return [Said("/tf_static", TRANSFORMS, START_NS, static), *(each for _, each in heard)]


def keyframes(made: ImuDrive) -> Iterator[tuple[float, F64]]:
    """A pose half a metre or 0.35 rad from the last one."""
    last = None
    for t, row in made.odometry:
        if last is not None:
            way = compose(inverse(last), row[None])[0]
            if np.linalg.norm(way[:3]) < 0.5 and 2 * math.acos(min(1.0, abs(way[6]))) < 0.35:
                continue
        last = row
        yield t, row


def drafted(made: ImuDrive, mount: F64 = MOUNT) -> Draft:
    """The graph that has to come of it, with the IMU at `mount`."""
    (begin, first), *more = keyframes(made)
    times, rates = made.imu[:, 0], made.imu[:, 1:]
    samples = cut_samples(times, rates[:, :3], rates[:, 3:], begin, more[0][0])
    still = initial_from_standstill(samples[:100], mount=mount)
    bias = np.append(still.bias[:3], np.zeros(3))
    up = rotation_of(first) @ rotation_of(mount) @ samples[:100, 4:].mean(axis=0)
    draft = Draft().se3("x0", first, fixed=True, stamp=at(begin)).vector("V0", np.zeros(3)).vector("B0", bias)
    draft.linear(["V0"], [np.zeros(3)], [np.eye(3)], np.zeros(3), sigmas=[0.05] * 3)
    sigmas = np.append(np.maximum(still.sigma_gyroscope, 1e-4), [0.2] * 3)
    draft.linear(["B0"], [bias], [np.eye(6)], np.zeros(6), sigmas=sigmas)
    draft.vector("G0", -GRAVITY * up / np.linalg.norm(up)).factor("length_vector3", ("G0",), [GRAVITY], sigmas=0.005)
    last_t, last = begin, first
    for n, (t, row) in enumerate(more, 1):
        way = compose(inverse(last), row[None])[0]
        metres, radians = float(np.linalg.norm(way[:3])), 2 * math.acos(min(1.0, abs(way[6])))
        floors = np.repeat([max(0.02 * metres, 0.001), max(0.01 * metres + 0.02 * radians, 0.001)], 3)
        draft.se3(f"x{n}", stamp=at(t)).vector(f"V{n}", size=3).vector(f"B{n}", size=6)
        draft.between_se3(f"x{n - 1}", f"x{n}", way, sigmas=floors)
        samples = cut_samples(times, rates[:, :3], rates[:, 3:], last_t, t)
        before, here = ((f"x{k}", f"V{k}", f"B{k}") for k in (n - 1, n))
        draft.imu(before, here, samples, noise=NOISE, gravity="G0", bias=bias, mount=mount)
        last_t, last = t, row
    return draft
