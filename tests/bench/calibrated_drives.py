"""Drives in which a scale, another frame, a clock's offset or a bias is to be found out; see `calibration`.

    scale    wheels whose radius is unknown, beside posts that a scanner sees, `between_se2_scale`
    frame    GNSS in a frame that is turned by any angle and somewhere, `position_se3_frame`
    offset   a receiver whose clock is 20 ms off (one standard deviation), `position_se2_offset`
    bias     ranges to four beacons with a bias, `range_se2_bias`

What the robot believes of it is its prior, but for the frame: of that it knows the first place that was measured, what
is down (2 degrees), and nothing else.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from naive.dense_derived import twist_matrix
from naive.dense_factors import boxplus, pose_matrix, pose_vector
from scipy.linalg import expm

from factorbus.client import Draft
from factorbus.client.draft_columns import DOWN

POSES = 60
ODOMETRY, IN_SPACE = np.array([0.02, 0.02, 0.01]), np.array([0.02] * 3 + [0.01] * 3)
_NO_TURN = np.array([0, 0, 0, 0, 0, 0, 1.0])


class Calibrated(NamedTuple):
    """What is to be found out: its kind, its true value, and what each step brings (step, pose, odometry) -> Draft.

    speed: metres from one pose to the next.
    """

    kind: str
    truth: np.ndarray
    step: Callable[[int, np.ndarray, np.ndarray], Draft]
    speed: float = 0.6


def scale(rng: np.random.Generator) -> Calibrated:
    """Wheels tell s⁻¹ of the way."""
    s, posts = rng.normal(1.0, 0.1), rng.uniform(-8, 8, (30, 2))

    def step(n: int, pose: np.ndarray, way: np.ndarray) -> Draft:
        draft = Draft()
        if n == 0:
            _begin(draft, 1.0, 0.1)
            for k, post in enumerate(posts):
                rough = post + rng.normal(0, 0.1, 2)
                draft.point2(f"l{k}", rough).prior_point2(f"l{k}", rough, sigmas=(0.1, 0.1))
        else:
            measured = boxplus("se2", way, rng.normal(0, ODOMETRY)) / (s, s, 1.0)
            draft.between_se2(f"x{n - 1}", f"x{n}", measured, scale="c0", sigmas=ODOMETRY)
        for k in rng.permutation(len(posts))[:3].tolist():
            seen = (np.linalg.inv(pose_matrix(pose)) @ np.append(posts[k], 1.0))[:2]
            draft.landmark_se2(f"x{n}", f"l{k}", seen + rng.normal(0, 0.05, 2), sigmas=(0.05, 0.05))
        return draft

    return Calibrated("vector1", np.array([s]), step)


def frame(rng: np.random.Generator) -> Calibrated:
    """East, north and up of an antenna on the robot; the map is turned by any angle."""
    yaw, level = rng.uniform(-np.pi, np.pi), rng.normal(0, np.radians(2), 2)
    f = boxplus("se3", _NO_TURN, np.array([*rng.normal(0, 50, 3), 0, 0, yaw]))
    f = boxplus("se3", f, np.array([0, 0, 0, *level, 0]))
    lever, sigma = np.array([0.3, 0.1, 1.0]), 0.3

    def step(n: int, pose: np.ndarray, way: np.ndarray) -> Draft:
        draft = Draft()
        z = (pose_matrix(f) @ pose_matrix(pose) @ np.append(lever, 1.0))[:3] + rng.normal(0, sigma, 3)
        if n == 0:
            rough = np.array([*z, 0, 0, 0, 1])
            draft.se3("c0", rough).position_se3("c0", z, sigmas=[100] * 3)
            draft.attitude_se3("c0", DOWN, sigmas=[np.radians(2)] * 3)
        else:
            measured = boxplus("se3", way, rng.normal(0, IN_SPACE))
            draft.between_se3(f"x{n - 1}", f"x{n}", measured, sigmas=IN_SPACE)
        return draft.position_se3(f"x{n}", z, lever=lever, frame="c0", sigmas=[sigma] * 3)

    return Calibrated("se3", f, step)


def offset(rng: np.random.Generator) -> Calibrated:
    """A pose a second, at 15 m/s; the receiver's clock is wrong, and what it measured is where the robot is later."""
    delta, sigma, speed = rng.normal(0, 0.02), 0.1, 15.0

    def step(n: int, pose: np.ndarray, way: np.ndarray) -> Draft:
        draft, twist = Draft(), np.array([speed, 0.0, way[2]])
        there = pose_matrix(pose) @ expm(twist_matrix(twist) * delta)
        if n == 0:
            _begin(draft, 0.0, 0.02)
        else:
            measured = boxplus("se2", way, rng.normal(0, ODOMETRY))
            draft.between_se2(f"x{n - 1}", f"x{n}", measured, sigmas=ODOMETRY)
        z = there[:2, 2] + rng.normal(0, sigma, 2)
        return draft.position_se2(f"x{n}", z, offset="c0", twist=twist, sigmas=(sigma, sigma))

    return Calibrated("vector1", np.array([delta]), step, speed)


def bias(rng: np.random.Generator) -> Calibrated:
    """Distances to beacons that are somewhat known, all too long or too short by the same."""
    b, beacons, sigma = rng.normal(0, 0.5), rng.uniform(-15, 15, (4, 2)), 0.1

    def step(n: int, pose: np.ndarray, way: np.ndarray) -> Draft:
        draft = Draft()
        if n == 0:
            _begin(draft, 0.0, 0.5)
            for k, beacon in enumerate(beacons):
                rough = beacon + rng.normal(0, 0.1, 2)
                draft.point2(f"l{k}", rough).prior_point2(f"l{k}", rough, sigmas=(0.1, 0.1))
        else:
            measured = boxplus("se2", way, rng.normal(0, ODOMETRY))
            draft.between_se2(f"x{n - 1}", f"x{n}", measured, sigmas=ODOMETRY)
        for k, beacon in enumerate(beacons):
            distance = np.linalg.norm(beacon - pose[:2]) + b + rng.normal(0, sigma)
            if distance > 0.5:
                draft.range_se2(f"x{n}", f"l{k}", float(distance), bias="c0", sigmas=sigma)
        return draft

    return Calibrated("vector1", np.array([b]), step)


def way_of(kind: str, n: int, speed: float) -> np.ndarray:
    """From one pose to the next: ahead, in curves, up and down."""
    turn = 0.4 * np.sin(0.5 * n)
    if kind != "se3":
        return pose_vector(expm(twist_matrix(np.array([speed, 0.0, turn]))))
    along = np.array([speed, 0.0, 0.0, 0.3 * np.cos(0.9 * n), 0.3 * np.sin(0.7 * n), turn])
    return boxplus("se3", _NO_TURN, along)


def _begin(draft: Draft, believed: float, sigma: float) -> None:
    draft.vector("c0", [believed]).linear(["c0"], [[believed]], [[[1.0]]], [0.0], sigmas=sigma)


DRIVES = {"scale": scale, "frame": frame, "offset": offset, "bias": bias}
