"""Random observations of cameras in a map: who sees what, and the measurement, from a seed."""

import numpy as np
from naive import dense_idp
from naive.dense_factors import boxplus
from naive.random_cameras import CAMERAS, random_pixels

from factorbus.proto.camera import Camera

CAMERA_KINDS = ("idp_first", "idp_seen", "point_seen")


def state_of(pose: np.ndarray) -> np.ndarray:
    """A camera state with the place and attitude of an se3 pose."""
    return np.concatenate([pose[:3], pose[[6, 3, 4, 5]], np.zeros(6)])


def measurement(kind: str, camera: Camera, pixel: np.ndarray, rho: float = 0.4) -> np.ndarray:
    """What a factor of a kind carries."""
    return np.concatenate([pixel, [rho] if kind == "idp_first" else [], camera.lens()])


def random_camera_factor(
    kind: str, rng: np.random.Generator, name: str | None = None
) -> tuple[Camera, list[np.ndarray], np.ndarray]:
    """(camera, [pose, feature or point], measurement): it looks from near where the feature was first seen."""
    camera = CAMERAS[name or sorted(CAMERAS)[int(rng.integers(len(CAMERAS)))]]
    while True:
        quat = rng.normal(size=4)
        pose = np.concatenate([rng.normal(size=3), quat / np.linalg.norm(quat)])
        pixel = random_pixels(rng, camera, 1, border=0.25)[0]
        y = dense_idp.feature(camera, state_of(pose), pixel, rng.uniform(0.2, 0.6))
        if abs(np.cos(y[4])) > 0.1:
            break
    near = boxplus("se3", pose, 0.03 * rng.normal(size=6))
    end = dense_idp.point(y) if kind == "point_seen" else boxplus("idp", y, 0.01 * rng.normal(size=6))
    return camera, [near, end], measurement(kind, camera, pixel + rng.normal(size=2))
