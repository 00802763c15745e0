"""A camera's numbers as the kernels want them, with the radius up to which its lens is one to one."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from factorbus.idp.kernels import layout as at
from factorbus.idp.kernels import pixels as kernels
from factorbus.idp.kernels.compile import F64, I64
from factorbus.proto.camera import Camera

_CODES = {"pinhole": at.RADTAN, "radtan": at.RADTAN, "fisheye": at.FISHEYE, "radial": at.RADIAL}


class Mapped(NamedTuple):
    """Rays of pixels, or pixels of rays: values (n, 3 or 2), slope (n, 3, 2) or (n, 2, 3), status (n,), 0 is good."""

    values: F64
    slope: F64
    status: I64


def rays(camera: Camera, pixels: F64) -> Mapped:
    """Rays (x right, y down, z forward; any length) of distorted pixels (n, 2), with ∂ray/∂(u, v).  MATH §2"""
    n = len(pixels)
    mapped = Mapped(np.empty((n, 3)), np.empty((n, 3, 2)), np.empty(n, np.int64))
    kernels.rays_of(*lens_of(camera), np.array(pixels, np.float64, order="C"), *mapped)
    return mapped


def pixels(camera: Camera, rays: F64) -> Mapped:
    """Distorted pixels of rays (n, 3), with ∂(u, v)/∂ray.  MATH §2"""
    n = len(rays)
    mapped = Mapped(np.empty((n, 2)), np.empty((n, 2, 3)), np.empty(n, np.int64))
    size = float(camera.width), float(camera.height)
    kernels.project_rays(*lens_of(camera), *size, np.array(rays, np.float64, order="C"), *mapped)
    return mapped


@lru_cache(maxsize=64)
def lens_of(camera: Camera) -> tuple[int, F64]:
    """(code, numbers) of a camera's lens, as `kernels/layout.py` lays them out; the same array again each time."""
    lens = np.zeros(at.LENS_SIZE)
    code = _CODES[camera.model]
    lens[at.CX], lens[at.CY] = camera.number("cx"), camera.number("cy")
    if code == at.RADIAL:
        f, dx, dy = (camera.number(name) for name in ("f", "dx", "dy"))
        lens[at.FU], lens[at.FV] = f / dx, f / dy
        more = (dx, dy, camera.number("k1"), camera.number("k2"))
        lens[at.LIMIT] = _limit((1.0, 3.0 * more[2], 5.0 * more[3]))
    else:
        lens[at.FU], lens[at.FV] = camera.number("fx"), camera.number("fy")
        more = camera.numbers[4:]
        lens[at.LIMIT] = _limit_of(code, more)
    lens[at.MORE : at.MORE + len(more)] = more
    return code, lens


def _limit_of(code: int, more: tuple[float, ...]) -> float:
    if code == at.FISHEYE:
        return min(_limit((1.0, *(k * (2 * i + 3) for i, k in enumerate(more)))), math.pi)
    k1, k2, _, _, k3 = (*more, *[0.0] * (5 - len(more)))
    return _limit((1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3))


def _limit(slope: tuple[float, ...]) -> float:
    """The smallest r > 0 where the slope 1 + s₁ r² + s₂ r⁴ + … of the radial function is 0; infinite if nowhere."""
    roots = np.roots(np.trim_zeros(slope[::-1], "f"))
    real = roots.real[(abs(roots.imag) <= 1e-9 * abs(roots)) & (roots.real > 0.0)]
    return math.sqrt(real.min()) if real.size else math.inf
