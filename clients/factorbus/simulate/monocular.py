"""A camera that moves through a cloud of points: pixels with noise and outliers, and the truth of everything.

World axes are those of a camera at rest: x right, y down, z forward.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorbus.proto.arrays import F64, I64
from factorbus.proto.camera import Camera
from factorbus.simulate.lens import seen_by
from factorbus.simulate.noise import conjugate, quaternion_product, rotated
from factorbus.simulate.parameters import BadParameter, checked_at_least, checked_run, checked_share, checked_sigma

# The wide lens of Civera's program, with its distortion.
CAMERA = Camera("radial", (2.1735, 0.0112, 0.0112, 160.2232142857143, 128.8660714285714, 0.06333, 0.0139), 320, 240)
_NEAR_M, _FAR_M = 1.5, 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What one image shows.

    time_s.  pose (7,): the true camera, x y z (metres), qx qy qz qw, camera to world.  velocity (6,): true, of the
    camera in the world (m/s) and about its own axes (rad/s).  points (k,): numbers of the points seen.  pixels (k, 2):
    measured, distorted, u v.  outlier (k,): whether the pixel has nothing to do with the point.
    """

    time_s: float
    pose: F64
    velocity: F64
    points: I64
    pixels: F64
    outlier: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class MonocularWorld:
    """A camera's drive: points (n, 3) in the world (metres), the camera, the noise, and the frames when iterated."""

    camera: Camera
    points: F64
    sigma_pixel: float
    outlier_share: float
    rate_hz: float
    frames: int
    seed: int

    def __iter__(self) -> Iterator[Frame]:
        """The frames: from the same seed always the same; a longer drive begins with the shorter one."""
        rng = np.random.default_rng([self.seed, 2])
        for number in range(self.frames):
            time_s = number / self.rate_hz
            pose, velocity = _camera_at(time_s)
            back = np.broadcast_to(conjugate(pose[None, 3:]), (len(self.points), 4))
            pixels, good = seen_by(self.camera, rotated(back, self.points - pose[:3]))
            points = np.flatnonzero(good)
            yield self._frame(time_s, pose, velocity, points, pixels[points], rng)

    def _frame(
        self, time_s: float, pose: F64, velocity: F64, points: I64, pixels: F64, rng: np.random.Generator
    ) -> Frame:
        size = np.array([self.camera.width, self.camera.height])
        noisy = pixels + self.sigma_pixel * rng.normal(size=pixels.shape)
        outlier = rng.random(len(points)) < self.outlier_share
        noisy[outlier] = rng.uniform(0, size - 1, (int(outlier.sum()), 2))
        inside = ((noisy >= 0) & (noisy <= size - 1)).all(axis=1)
        return Frame(time_s, pose, velocity, points[inside], noisy[inside], outlier[inside])


def monocular(
    frames: int = 200,
    seed: int = 1,
    *,
    points: int = 300,
    camera: Camera = CAMERA,
    sigma_pixel: float = 1.0,
    outlier_share: float = 0.05,
    rate_hz: float = 30.0,
) -> MonocularWorld:
    """A hand-held camera sways sideways and forwards through `points` points 1.5 to 12 m away.

    sigma_pixel: standard deviation of u and of v.  outlier_share: of pixels that are anywhere in the image.
    Raises BadParameter.
    """
    checked_run(frames, seed)
    checked_at_least("points", points, 1)
    checked_sigma("sigma_pixel", sigma_pixel)
    checked_share("outlier_share", outlier_share)
    checked_sigma("rate_hz", rate_hz)
    if not camera.width:
        raise BadParameter("camera", "without the size of its image", "a camera with width and height")
    return MonocularWorld(camera, _cloud(points, seed), sigma_pixel, outlier_share, rate_hz, frames, seed)


def _cloud(count: int, seed: int) -> F64:
    """Points around the way, as many near as far: their inverse distances are spread evenly."""
    rng = np.random.default_rng([seed, 1])
    distance = 1 / rng.uniform(1 / _FAR_M, 1 / _NEAR_M, count)
    across = rng.uniform([-1.3, -0.75], [1.3, 0.75], (count, 2))
    along = rng.uniform(0.0, 1.0, count)
    centres = np.stack([_place(8 * t)[0] for t in along])
    return centres + np.column_stack([across * distance[:, None], distance])


def _camera_at(time_s: float) -> tuple[F64, F64]:
    """(pose (7,), velocity (6,)) on a smooth way that starts at the origin, looking along z, in motion."""
    step = 1e-4
    (r, quat), (ahead, quat_ahead) = _place(time_s), _place(time_s + step)
    behind, quat_behind = _place(time_s - step)
    turn = quaternion_product(conjugate(quat_behind[None]), quat_ahead[None])[0]
    omega = 2 * turn[:3] / (2 * step) * np.sign(turn[3])
    return np.concatenate([r, quat]), np.concatenate([(ahead - behind) / (2 * step), omega])


def _place(time_s: float) -> tuple[F64, F64]:
    """Where the camera is and how it looks: x y z in metres, qx qy qz qw."""
    t = time_s
    r = np.array([0.9 * np.sin(1.1 * t), 0.15 * np.sin(1.7 * t), 0.12 * t + 0.05 * np.sin(0.8 * t)])
    yaw, pitch, roll = -0.22 * np.sin(1.1 * t), 0.06 * np.sin(1.3 * t), 0.05 * np.sin(0.9 * t)
    quat = quaternion_product(quaternion_product(_about(1, yaw), _about(0, pitch)), _about(2, roll))[0]
    return r, quat


def _about(axis: int, angle: float) -> F64:
    quat = np.zeros((1, 4))
    quat[0, axis], quat[0, 3] = np.sin(angle / 2), np.cos(angle / 2)
    return quat
