"""Bundle adjustment in a simulated world: cameras on a ring look outward at points, which are seen in pixels.

The calibration is known and without distortion.  Two cameras opposite each other are fixed at the truth: they hold the
map and its scale.  Values of all others are the truth with noise, as a front end's odometry and triangulation leave it.
"""

import math

import numpy as np

from factorbus.proto.camera import Camera
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate.noise import conjugate, diagonal_information, quaternion_product, rotated
from factorbus.simulate.step import POINT, POSE

from .replays.columns import F64

CAMERA = Camera("pinhole", (450.0, 450.0, 376.0, 240.0), 752, 480)
_RING_M, _NEAR_M, _FAR_M, _HIGH_M = 20.0, 26.0, 36.0, 5.0
_POINTS = 17  # for each camera
_FOUND, _LEAST = 0.6, 3  # the share of what is in the image that is found there; a point of fewer pixels is left out
_SIGMA_PIXEL = 1.0
_OFF_M, _OFF_RAD, _POINT_OFF_M = 0.05, math.radians(1.0), 0.1


def bundle(cameras: int, seed: int) -> Batch:
    """A ring of cameras with some 17 points for each, and values for all."""
    rng = np.random.default_rng([seed, 8])
    poses, points = _cameras(cameras, rng), _points(_POINTS * cameras, rng)
    camera, point, pixel = _seen(poses, points, rng)
    used = np.flatnonzero(np.bincount(point, minlength=len(points)) >= _LEAST)
    kept = np.isin(point, used)
    lens = np.tile(CAMERA.lens(), (np.count_nonzero(kept), 1))
    factors = Factors(
        "point_seen",
        np.stack([POSE + camera[kept], POINT + point[kept]], axis=1),
        np.concatenate([pixel[kept], lens], axis=1),
        diagonal_information(np.full(2, _SIGMA_PIXEL), len(lens)),
    )
    held = np.isin(np.arange(cameras), (0, cameras // 2))
    keys, off = POSE + np.arange(cameras), _off(poses, rng)
    moved = points[used] + rng.normal(size=(used.size, 3)) * _POINT_OFF_M
    variables = (
        Variables("se3", keys[held], poses[held], True),
        Variables("se3", keys[~held], off[~held]),
        Variables("point3", POINT + used, moved),
    )
    return Batch(variables, (factors,))


def _cameras(count: int, rng: np.random.Generator) -> F64:
    """(n, 7): z outward, y down, each turned a little."""
    around = 2.0 * np.pi * np.arange(count) / count
    at = np.stack([_RING_M * np.cos(around), _RING_M * np.sin(around), np.zeros(count)], axis=1)
    zero, half = np.zeros(count), around / 2
    turned = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1)
    outward = np.tile([0.5, -0.5, 0.5, -0.5], (count, 1))  # at angle 0: the camera's x, y, z to −y, −z, x
    return _jittered(at, quaternion_product(turned, outward), np.array([0.1] * 3), math.radians(5.0), rng)


def _points(count: int, rng: np.random.Generator) -> F64:
    """(n, 3): between two walls around the ring."""
    around = rng.uniform(0.0, 2.0 * np.pi, count)
    far = rng.uniform(_NEAR_M, _FAR_M, count)
    return np.stack([far * np.cos(around), far * np.sin(around), rng.uniform(-_HIGH_M, _HIGH_M, count)], axis=1)


def _seen(poses: F64, points: F64, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, F64]:
    """Numbers of cameras and points, and the pixels (m, 2)."""
    fx, fy, cx, cy = CAMERA.numbers
    cameras, seen, pixels = [], [], []
    for n, pose in enumerate(poses):
        at = rotated(np.broadcast_to(conjugate(pose[None, 3:]), (len(points), 4)), points - pose[:3])
        ahead = np.flatnonzero(at[:, 2] > 1.0)
        x, y, z = at[ahead].T
        pixel = np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)
        inside = ((pixel >= 0.0) & (pixel < (CAMERA.width, CAMERA.height))).all(axis=1)
        found = inside & (rng.random(ahead.size) < _FOUND)
        cameras.append(np.full(np.count_nonzero(found), n))
        seen.append(ahead[found])
        pixels.append(pixel[found])
    exact = np.concatenate(pixels)
    return np.concatenate(cameras), np.concatenate(seen), exact + rng.normal(size=exact.shape) * _SIGMA_PIXEL


def _off(poses: F64, rng: np.random.Generator) -> F64:
    return _jittered(poses[:, :3], poses[:, 3:], np.array([_OFF_M] * 3), _OFF_RAD, rng)


def _jittered(at: F64, quat: F64, sigmas_m: F64, sigma_rad: float, rng: np.random.Generator) -> F64:
    """Poses (n, 7), moved and turned about their own axes by noise; qw ≥ 0."""
    vector = rng.normal(size=(len(at), 3)) * sigma_rad / 2
    turn = np.concatenate([vector, np.sqrt(1.0 - np.sum(vector * vector, axis=1, keepdims=True))], axis=1)
    quat = quaternion_product(quat, turn)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return np.concatenate([at + rng.normal(size=at.shape) * sigmas_m, np.where(quat[:, 3:] < 0, -quat, quat)], axis=1)
