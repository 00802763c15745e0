"""How a log begins: the first pose, velocity and bias, from what the sensors say in its first seconds."""

from dataclasses import dataclass

import numpy as np

from factorbus.cli.logs.sensor_log import SensorLog
from factorbus.client.frames import compose, inverse
from factorbus.client.imu import initial_from_standstill
from factorbus.proto.arrays import F64, I64
from factorbus.proto.linear_in_frame import rotation_of
from factorbus.proto.problems import BadOption, BadShape

_EXACT, _MOVING, _GYROSCOPE, _ACCELEROMETER = 1e-3, 1.0, 0.01, 0.2


@dataclass(frozen=True, slots=True)
class Start:
    """Values and standard deviations of x0, v0 and b0; why: what they follow from, for people."""

    pose: F64
    velocity: F64
    bias: F64
    sigmas_pose: F64
    sigma_velocity: float
    sigmas_bias: F64
    why: str


def started(log: SensorLog, times: I64) -> Start:
    """Of the first moment."""
    attitude, gyroscope, sigma_gyroscope, still = _level(log, int(times[0]))
    velocity, sigma_velocity = np.zeros(3), 0.05
    bias, sigmas_bias = np.append(gyroscope, np.zeros(3)), np.append(sigma_gyroscope, [_ACCELEROMETER] * 3)
    words = "it stands still in the first second" if still else "it moves from the first second on"
    pose = np.append(np.zeros(3), attitude)
    if log.way is not None and not log.way.relative:
        body = np.array([compose(each, inverse(log.way.mount)[None])[0] for each in log.way.poses[:50]])
        pose = compose(log.way.poses[int(np.argmin(np.abs(log.way.times - times[0])))], inverse(log.way.mount)[None])[0]
        if not still and len(body) > 1:
            velocity = (body[-1, :3] - body[0, :3]) / ((log.way.times[len(body) - 1] - log.way.times[0]) * 1e-9)
            sigma_velocity = 0.3
        sigmas = np.repeat([0.1, 0.05], 3)
        words += "; the first pose is that of the room's cameras"
    elif log.way is not None:
        sigmas = np.array([_EXACT] * 3 + [0.02, 0.02, _EXACT])
        if not still:
            first = compose(inverse(log.way.poses[0]), log.way.poses[1:2])[0, :3]
            ahead = rotation_of(pose) @ rotation_of(log.way.mount) @ first
            velocity, sigma_velocity = ahead / ((log.way.times[1] - log.way.times[0]) * 1e-9), _MOVING
        words += "; the map begins at the robot and looks where it looks"
    else:
        velocity, sigma_velocity, pose, sigmas, told = _by_fixes(log, attitude, still)
        words += told
    return Start(pose, velocity, bias, sigmas, sigma_velocity, sigmas_bias, f"assumed: {words}")


def course(here: F64, there: F64) -> tuple[float, F64]:
    """(yaw, t (3,)) that take places `here` (n, 3) best to `there`."""
    a, b = here - here.mean(axis=0), there - there.mean(axis=0)
    yaw = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum()))
    c, s = np.cos(yaw), np.sin(yaw)
    return yaw, there.mean(axis=0) - np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ here.mean(axis=0)


def _by_fixes(log: SensorLog, attitude: F64, still: bool) -> tuple[F64, float, F64, F64, str]:
    """(velocity, its sigma, pose, its sigmas, in words), where the map is the frame of the fixes."""
    fixes = log.fixes
    if fixes is None:
        raise ValueError("a log without a sensor that tells where the robot is")
    ways = fixes.places - fixes.places[0]
    sure = 3 * float(fixes.sigmas[0, :2].max())
    far = np.flatnonzero(np.linalg.norm(ways[:, :2], axis=1) > max(sure, 0.5))
    yaw, sigma_yaw, velocity = 0.0, 3.0, np.zeros(3)
    told = "; where it looks is not known at first"
    if far.size:
        yaw, sigma_yaw = float(np.arctan2(ways[far[0], 1], ways[far[0], 0])), 0.5
        told = "; it drives along its x axis, the way that the first fixes go"
        if not still:
            velocity = ways[far[0]] / ((fixes.times[far[0]] - fixes.times[0]) * 1e-9)
    turn = np.array([0, 0, 0, 0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
    pose = compose(turn, np.append(np.zeros(3), attitude)[None])[0]
    pose[:3] = fixes.places[0] - rotation_of(pose) @ fixes.lever
    sigmas = np.array([*(2 * fixes.sigmas[0]), 0.05, 0.05, sigma_yaw])
    return velocity, 0.05 if still else max(_MOVING, 0.3 * float(np.linalg.norm(velocity))), pose, sigmas, told


def _level(log: SensorLog, begin: int) -> tuple[F64, F64, F64, bool]:
    """(attitude (4,), bias of the gyroscopes, its sigmas, whether it stands still) by the first second."""
    rows = (log.imu.times >= begin) & (log.imu.times < begin + 10**9)
    rates = log.imu.rates[rows] if rows.sum() > 1 else log.imu.rates[:2]
    try:
        rest = initial_from_standstill(
            np.column_stack([np.ones(len(rates)), rates]), float(np.linalg.norm(log.gravity))
        )
        if float(np.linalg.norm(rest.bias[:3])) < 0.05 and not _drives(log, begin):
            return rest.attitude, rest.bias[:3], np.maximum(rest.sigma_gyroscope, 1e-4), True
    except (BadOption, BadShape):
        pass  # it moves
    up = rates[:, 3:].mean(axis=0)
    roll, pitch = np.arctan2(up[1], up[2]), np.arctan2(-up[0], np.hypot(up[1], up[2]))
    (sr, cr), (sp, cp) = ((np.sin(a / 2), np.cos(a / 2)) for a in (roll, pitch))
    return np.array([sr * cp, cr * sp, -sr * sp, cr * cp]), np.zeros(3), np.full(3, _GYROSCOPE), False


def _drives(log: SensorLog, begin: int) -> bool:
    """Whether another sensor saw it move in the first two seconds: at an even speed an IMU feels nothing."""
    for times, places, sigma in _tracks(log):
        rows = (times >= begin) & (times <= begin + int(1.5e9))
        if rows.any() and np.linalg.norm(places[rows][:, :2] - places[rows][0, :2], axis=1).max() > 6 * sigma:
            return True
    return False


def _tracks(log: SensorLog) -> list[tuple[I64, F64, float]]:
    tracks = list[tuple[I64, F64, float]]()
    if log.way is not None:
        tracks.append((log.way.times, log.way.poses[:, :3], float(log.way.sigmas[0])))
    if log.fixes is not None:
        tracks.append((log.fixes.times, log.fixes.places, float(log.fixes.sigmas[0, :2].max())))
    return tracks
