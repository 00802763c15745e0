"""Lenses: against OpenCV's numbers, against their own definitions, there and back, and up to where they end."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from naive import dense_idp
from naive.random_cameras import CAMERAS, random_pixels

from factorbus.idp import lenses
from factorbus.idp.kernels import layout as at
from factorbus.proto.camera import BadCamera, Camera

# What OpenCV 5.0.0 makes of these points: cv2.projectPoints and cv2.fisheye.projectPoints.
POINTS = np.array(
    [[0.1, -0.2, 1.0], [0.55, 0.31, 1.0], [-0.8, 0.45, 1.3], [0.02, 0.01, 0.4], [1.2, -0.9, 2.5],
     [2.5, 1.0, 0.8], [-3.0, -2.0, 0.5]]
)  # fmt: skip
RADTAN = Camera(
    "radtan", (458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0123)
)
RADTAN_PIXELS = [
    [412.4360336368134, 158.2059490913415], [594.1769439007941, 375.9537196552569],
    [119.19815418313138, 387.5178031985703], [390.12769385258355, 259.79769060454805],
    [567.1197761985774, 98.92437746823754],
]  # fmt: skip
FISHEYE = Camera("fisheye", (190.97, 190.97, 254.93, 256.90, -0.0137, 0.0207, -0.0128, 0.0025))
FISHEYE_PIXELS = [
    [273.70636419337103, 219.34727161325793], [348.37013054418503, 309.5662553976315],
    [152.89559189903093, 314.29435455679504], [264.4681666488338, 261.6690833244169],
    [337.2837338025821, 195.13469964806342], [481.06247687869416, 347.35299075147765],
    [28.876995507209784, 106.19799700480647],
]  # fmt: skip


@pytest.mark.parametrize(("camera", "wanted"), [(RADTAN, RADTAN_PIXELS), (FISHEYE, FISHEYE_PIXELS)])
def test_pixels_are_those_of_opencv(camera: Camera, wanted: list[list[float]]) -> None:
    found = lenses.pixels(camera, POINTS[: len(wanted)])
    assert not found.status.any()
    np.testing.assert_allclose(found.values, wanted, rtol=1e-14, atol=1e-12)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_pixel_s_ray_has_that_pixel_and_the_jacobians_are_each_other_s_inverses(name: str) -> None:
    camera = CAMERAS[name]
    uv = random_pixels(np.random.default_rng(3), camera, 200, border=0.02)
    rays = lenses.rays(camera, uv)
    back = lenses.pixels(camera, rays.values)
    assert not rays.status.any()
    assert not back.status.any()
    np.testing.assert_allclose(back.values, uv, rtol=0, atol=2e-11)
    both = back.slope @ rays.slope
    np.testing.assert_allclose(both, np.broadcast_to(np.eye(2), both.shape), atol=1e-11)


@pytest.mark.parametrize("name", CAMERAS)
def test_rays_pixels_and_jacobians_are_those_of_the_dense_twin(name: str) -> None:
    camera = CAMERAS[name]
    uv = random_pixels(np.random.default_rng(4), camera, 12)
    rays = lenses.rays(camera, uv)
    places = np.random.default_rng(5).normal(size=(12, 3)) * [0.3, 0.3, 0.1] + [0, 0, 1]
    pixels = lenses.pixels(camera, places)
    for k in range(12):
        ray = dense_idp.ray(camera, uv[k])
        np.testing.assert_allclose(np.cross(rays.values[k], ray), 0.0, atol=1e-12)
        slope = dense_idp.slope(lambda x: lenses.rays(camera, x[None]).values[0], uv[k], h=1e-2)
        np.testing.assert_allclose(rays.slope[k], slope, atol=3e-11)
        np.testing.assert_allclose(pixels.values[k], dense_idp.pixel(camera, places[k]), rtol=1e-12)
        slope = dense_idp.slope(lambda x: dense_idp.pixel(camera, x), places[k])
        np.testing.assert_allclose(pixels.slope[k], slope, rtol=1e-8, atol=1e-6)


@pytest.mark.parametrize("name", CAMERAS)
def test_the_centre_of_the_lens_is_no_special_case(name: str) -> None:
    camera = CAMERAS[name]
    centre = np.array([[camera.number("cx"), camera.number("cy")]])
    rays = lenses.rays(camera, np.concatenate([centre, centre + 1e-9]))
    np.testing.assert_allclose(rays.values / rays.values[:, 2:], [[0, 0, 1]] * 2, atol=1e-10)
    np.testing.assert_allclose(rays.slope[0], rays.slope[1], rtol=1e-6, atol=1e-9)
    back = lenses.pixels(camera, np.array([[0.0, 0.0, 2.0], [1e-12, 0.0, 2.0]]))
    np.testing.assert_allclose(back.values, np.repeat(centre, 2, axis=0), atol=1e-8)
    np.testing.assert_allclose(back.slope[0], back.slope[1], rtol=1e-6, atol=1e-9)


def test_a_fisheye_sees_behind_itself() -> None:
    ray = np.array([[math.sin(1.9), 0.0, math.cos(1.9)]])
    seen = lenses.pixels(FISHEYE, ray)
    assert not seen.status.any()
    np.testing.assert_allclose(lenses.rays(FISHEYE, seen.values).values, ray, atol=1e-13)


def test_where_a_lens_folds_over_there_is_no_ray_and_no_pixel() -> None:
    """k1 < 0 alone: θ or r can be so large that the image turns back on itself."""
    folding = {
        "radtan": (Camera("radtan", (400.0, 400, 320, 240, -0.3, 0, 0, 0)), math.sqrt(1 / 0.9)),
        "fisheye": (Camera("fisheye", (200.0, 200, 320, 240, -0.2, 0, 0, 0)), math.sqrt(1 / 0.6)),
        "radial": (Camera("radial", (2.0, 0.01, 0.01, 160, 120, -0.1, 0)), math.sqrt(1 / 0.3)),
    }
    for model, (camera, edge) in folding.items():
        seen = lenses.pixels(camera, np.array([direction(model, camera, edge * f) for f in (0.98, 1.02)]))
        assert seen.status.tolist() == [at.GOOD, at.OUTSIDE_LENS], model
        centre = np.array([camera.number("cx"), camera.number("cy")])
        outwards = centre + (seen.values[:1] - centre) * [[1.0], [1.2]]
        assert lenses.rays(camera, outwards).status.tolist() == [at.GOOD, at.OUTSIDE_LENS], model


def direction(model: str, camera: Camera, radius: float) -> list[float]:
    """A ray at this radius, in the model's own measure of it."""
    if model == "fisheye":
        return [math.sin(radius), 0.0, math.cos(radius)]
    if model == "radtan":
        return [radius, 0.0, 1.0]
    top = math.sqrt(1 / 0.3)
    undistorted = min(radius, top) * (1 - 0.1 * min(radius, top) ** 2) * (1.0 if radius < top else radius / top)
    return [undistorted / camera.number("f"), 0.0, 1.0]


def test_what_is_behind_or_outside_the_image_is_told() -> None:
    behind = np.array([[0.1, 0.1, -1.0]])
    for name in ("radial", "radtan", "pinhole"):
        assert lenses.pixels(CAMERAS[name], behind).status.tolist() == [at.BEHIND]
    aside = np.array([[1.2, 0.0, 1.0]])
    assert lenses.pixels(CAMERAS["pinhole"], aside).status.tolist() == [at.OUTSIDE_IMAGE]
    assert lenses.rays(CAMERAS["pinhole"], np.array([[np.nan, 1.0]])).status.tolist() == [at.NOT_FINITE]


@pytest.mark.parametrize(
    ("model", "numbers", "size"),
    [
        ("fish", (1.0, 1.0, 0.0, 0.0), (0, 0)),
        ("pinhole", (1.0, 1.0, 0.0), (0, 0)),
        ("radtan", (1.0, 1.0, 0.0, 0.0, 0.1), (0, 0)),
        ("pinhole", (0.0, 1.0, 0.0, 0.0), (0, 0)),
        ("pinhole", (1.0, math.nan, 0.0, 0.0), (0, 0)),
        ("pinhole", (1.0, 1.1e12, 0.0, 0.0), (0, 0)),
        ("radial", (5.0, 0.01, 5e-324, 320.0, 240.0, 0.0, 0.0), (0, 0)),
        ("pinhole", (1.0, 1.0, 0.0, 0.0), (640, 0)),
        ("pinhole", (1.0, 1.0, 0.0, 0.0), (-1, 1)),
    ],
)
def test_a_camera_that_cannot_be_is_refused(model: str, numbers: tuple[float, ...], size: tuple[int, int]) -> None:
    with pytest.raises(BadCamera) as refused:
        Camera(model, numbers, *size)
    assert refused.value.code == "bad_camera"


WILD = st.floats(-1e6, 1e6) | st.sampled_from([0.0, -0.0, 1e-300, 1e300, -1e300, math.inf, -math.inf, math.nan])


@settings(max_examples=400)
@example("fisheye", (1.3e-168, -1.6e-162, -1.2e-163), (0.0, 0.0))  # squares of these are 0
@example("fisheye", (2e200, -1e200, 1e200), (0.0, 0.0))
@given(st.sampled_from(sorted(CAMERAS)), st.tuples(WILD, WILD, WILD), st.tuples(WILD, WILD))
def test_whatever_comes_in_what_is_good_can_be_undone(name: str, ray: tuple, pixel: tuple) -> None:
    camera = CAMERAS[name]
    with np.errstate(all="ignore"):
        seen = lenses.pixels(camera, np.array([ray]))
        if seen.status[0] == at.GOOD:
            assert np.isfinite(seen.values).all()
            assert np.isfinite(seen.slope).all() or not 1e-60 < max(map(abs, ray)) < 1e60
            back = lenses.rays(camera, seen.values)
            assert back.status[0] == at.GOOD
            direction_ = np.array(ray) / max(map(abs, ray))
            off = np.cross(back.values[0] / np.linalg.norm(back.values[0]), direction_ / np.linalg.norm(direction_))
            # Subnormal numbers have fewer digits: at 5e-324 there are three directions in a quadrant.
            np.testing.assert_allclose(off, 0.0, atol=1e-9 if max(map(abs, ray)) > 1e-305 else 2.0)
        found = lenses.rays(camera, np.array([pixel]))
        if found.status[0] == at.GOOD:
            assert np.isfinite(found.values).all()
            again = lenses.pixels(camera, found.values)
            assert again.status[0] in (at.GOOD, at.OUTSIDE_IMAGE)
            np.testing.assert_allclose(again.values[0], pixel, rtol=0, atol=1e-8 * (1 + max(map(abs, pixel))))


_COMPILED_FIRST_BY_A_QUICK_KERNEL = """
import re
import numba, numpy as np
from factorbus.solver.lenses.models import project_radtan

@numba.njit(fastmath=True)
def kernel(lens, x):
    return project_radtan(lens, x, x, 1.0)[0]

kernel(np.ones(16), 0.1)
codes = project_radtan.inspect_llvm().values()
print(len(codes), sum(len(re.findall(r"= f(?:add|sub|mul|div) (?!double)", code)) for code in codes))
"""


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")
def test_lenses_are_exact_whatever_kernel_has_them_compiled_first() -> None:
    """Else two workers that had compiled in another order would differ in the last bits of the same features."""
    command = [sys.executable, "-P", "-c", _COMPILED_FIRST_BY_A_QUICK_KERNEL]
    environment = os.environ | {"FACTORBUS_STOCK_NUMBA": "1"}  # a kernel that is not ours
    made = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200, check=True)
    assert made.stdout == "1 0\n"
