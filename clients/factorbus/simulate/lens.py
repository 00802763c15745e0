"""Where a camera sees points: the lens models of `factorbus.proto.camera`, forwards, for many points at a time.

The formulas are those of `workers/MATH.md` §2, written with arrays so that a simulated world needs no compiler.
"""

import numpy as np
from numpy.typing import NDArray

from factorbus.proto.arrays import F64
from factorbus.proto.camera import Camera

_STEPS = 30


def seen_by(camera: Camera, rays: F64) -> tuple[F64, NDArray[np.bool_]]:
    """(pixels (n, 2), which of them are pixels: in front, where the lens is one to one, and inside the image).

    in   rays (n, 3): in camera axes, x right, y down, z forward
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels, good = _MODELS[camera.model](camera, rays)
    good &= np.isfinite(pixels).all(axis=1)
    if camera.width:
        size = np.array([camera.width, camera.height])
        good &= ((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1)
    return pixels, good


def _pinhole(camera: Camera, rays: F64) -> tuple[F64, NDArray[np.bool_]]:
    return _centre(camera) + _focal(camera) * rays[:, :2] / rays[:, 2:], rays[:, 2] > 0


def _radtan(camera: Camera, rays: F64) -> tuple[F64, NDArray[np.bool_]]:
    k1, k2, p1, p2, k3 = (camera.number(name) for name in ("k1", "k2", "p1", "p2", "k3"))
    x, y = (rays[:, :2] / rays[:, 2:]).T
    r2 = x * x + y * y
    scale = 1 + (k1 + (k2 + k3 * r2) * r2) * r2
    slope = 1 + (3 * k1 + (5 * k2 + 7 * k3 * r2) * r2) * r2
    across = np.stack(
        [x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=1
    )
    return _centre(camera) + _focal(camera) * across, (rays[:, 2] > 0) & (slope > 0) & (scale > 0)


def _fisheye(camera: Camera, rays: F64) -> tuple[F64, NDArray[np.bool_]]:
    k1, k2, k3, k4 = (camera.number(name) for name in ("k1", "k2", "k3", "k4"))
    radius = np.linalg.norm(rays[:, :2], axis=1)
    theta = np.arctan2(radius, rays[:, 2])
    t = theta * theta
    seen = theta * (1 + (k1 + (k2 + (k3 + k4 * t) * t) * t) * t)
    slope = 1 + (3 * k1 + (5 * k2 + (7 * k3 + 9 * k4 * t) * t) * t) * t
    scale = np.where(radius > 0, seen / radius, 1 / rays[:, 2])
    return _centre(camera) + _focal(camera) * scale[:, None] * rays[:, :2], slope > 0


def _radial(camera: Camera, rays: F64) -> tuple[F64, NDArray[np.bool_]]:
    k1, k2 = camera.number("k1"), camera.number("k2")
    pixel_mm = np.array([camera.number("dx"), camera.number("dy")])
    undistorted = camera.number("f") * rays[:, :2] / rays[:, 2:]
    wanted = np.linalg.norm(undistorted, axis=1)
    radius = wanted / (1 + k1 * wanted**2 + k2 * wanted**4)
    for _ in range(_STEPS):
        slope = 1 + 3 * k1 * radius**2 + 5 * k2 * radius**4
        radius = radius - (radius * (1 + k1 * radius**2 + k2 * radius**4) - wanted) / slope
    good = (rays[:, 2] > 0) & (slope > 0) & (radius >= 0)
    return _centre(camera) + undistorted / (1 + k1 * radius**2 + k2 * radius**4)[:, None] / pixel_mm, good


def _centre(camera: Camera) -> F64:
    return np.array([camera.number("cx"), camera.number("cy")])


def _focal(camera: Camera) -> F64:
    return np.array([camera.number("fx"), camera.number("fy")])


_MODELS = {"pinhole": _pinhole, "radtan": _radtan, "fisheye": _fisheye, "radial": _radial}
