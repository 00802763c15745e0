"""Random cameras, states and observations for tests, from a seed."""

import numpy as np

from factorbus.proto.camera import Camera
from factorbus.proto.features import Observations

CAMERAS = {
    "radial": Camera("radial", (2.1735, 0.0112, 0.0112, 160.22, 128.87, 0.06333, 0.0139), 320, 240),
    "oblong": Camera("radial", (2.1735, 0.0112, 0.0124, 160.22, 128.87, 0.06333, 0.0139), 320, 240),
    "radtan": Camera(
        "radtan", (458.654, 457.296, 367.215, 248.375, -0.2834, 0.07396, 1.9e-4, 1.8e-5, 0.0123), 752, 480
    ),
    "fisheye": Camera("fisheye", (190.97, 191.2, 254.93, 256.9, -0.0137, 0.0207, -0.0128, 0.0025), 512, 512),
    "pinhole": Camera("pinhole", (500.0, 510.0, 320.0, 240.0), 640, 480),
}


def random_state(rng: np.random.Generator) -> np.ndarray:
    """x_v (13,): any place and attitude, the quaternion not quite of unit length, as between a filter's updates."""
    q = rng.normal(size=4)
    q *= (1 + 1e-3 * rng.normal()) / np.linalg.norm(q)
    return np.concatenate([rng.normal(size=3), q, 0.1 * rng.normal(size=6)])


def random_covariance(rng: np.random.Generator, m: int) -> np.ndarray:
    """P (m, m), positive definite, with scales from 1e-3 to 1."""
    root = rng.normal(size=(m, m)) * 10 ** rng.uniform(-3, 0, size=(m, 1)) / np.sqrt(m)
    P = root @ root.T
    return (P + P.T) / 2


def random_pixels(rng: np.random.Generator, camera: Camera, n: int, border: float = 0.1) -> np.ndarray:
    """(n, 2), inside the image."""
    size = np.array([camera.width, camera.height])
    return rng.uniform(border * size, (1 - border) * size, (n, 2))


def random_observations(
    seed: int, n: int, existing: int = 0, camera: str = "radial"
) -> tuple[Observations, np.ndarray]:
    """(observations, P) of n pixels, with a filter that has `existing` features."""
    rng = np.random.default_rng(seed)
    P = random_covariance(rng, 13 + 6 * existing)
    seen = CAMERAS[camera]
    sigmas = rng.uniform(0.3, 2.0, 3).tolist()
    return Observations(seen, random_state(rng), P[:13], random_pixels(rng, seen, n), *sigmas), P
