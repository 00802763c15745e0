"""A camera's numbers as the kernels want them, with the radius up to which its lens is one to one."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from factorbus.idp.kernels import layout as at
from factorbus.idp.kernels import pixels as kernels
from factorbus.idp.kernels.camera import CameraModel
from factorbus.idp.kernels.compile import F64, I64
from factorbus.proto.camera import Camera
from factorbus.solver.lenses.limits import limit_of


class Mapped(NamedTuple):
    """Rays of pixels, or pixels of rays: values (n, 3 or 2), slope (n, 3, 2) or (n, 2, 3), status (n,), 0 is good."""

    values: F64
    slope: F64
    status: I64


def rays(camera: Camera, pixels: F64) -> Mapped:
    """Rays (x right, y down, z forward; any length) of distorted pixels (n, 2), with ∂ray/∂(u, v).  MATH §2"""
    n = len(pixels)
    mapped = Mapped(np.empty((n, 3)), np.empty((n, 3, 2)), np.empty(n, np.int64))
    kernels.unproject_pixels(camera_model(camera), np.array(pixels, np.float64, order="C"), *mapped)
    return mapped


def pixels(camera: Camera, rays: F64) -> Mapped:
    """Distorted pixels of rays (n, 3), with ∂(u, v)/∂ray.  MATH §2"""
    n = len(rays)
    mapped = Mapped(np.empty((n, 2)), np.empty((n, 2, 3)), np.empty(n, np.int64))
    kernels.project_rays(camera_model(camera), np.array(rays, np.float64, order="C"), *mapped)
    return mapped


@lru_cache(maxsize=64)
def camera_model(camera: Camera) -> CameraModel:
    """A camera as the kernels have it; the same array each time."""
    lens = np.array(camera.lens())
    code, lens = int(lens[0]), lens[1:].copy()
    lens[at.LIMIT] = limit_of(code, lens[at.MORE :].tolist())
    return CameraModel(code, lens, float(camera.width), float(camera.height))
