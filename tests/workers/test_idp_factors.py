"""What cameras in a map see: residuals, Jacobians by increments, first values, and what cannot be seen."""

import numpy as np
import pytest
from naive import dense_idp
from naive.dense_factors import boxplus
from naive.random_sightings import CAMERAS, random_pixels

from factorbus.idp.kernels import evaluate as kernels
from factorbus.idp.kernels import layout as at
from factorbus.idp.kernels.factors import FIRST_SIZE, SEEN_SIZE
from factorbus.idp.lenses import lens_of
from factorbus.proto.camera import Camera

KINDS = {kernels.IDP_FIRST: (6, 6), kernels.IDP_SEEN: (2, 6), kernels.POINT_SEEN: (2, 3)}


def state_of(pose: np.ndarray) -> np.ndarray:
    """A camera state with the place and attitude of an se3 pose."""
    return np.concatenate([pose[:3], pose[[6, 3, 4, 5]], np.zeros(6)])


def measured(kind: int, camera: Camera, pixel: np.ndarray, rho: float = 0.4) -> np.ndarray:
    code, lens = lens_of(camera)
    return np.concatenate([pixel, [rho] if kind == kernels.IDP_FIRST else [], [float(code)], lens])


def dense_residual(kind: int, camera: Camera, pose: np.ndarray, end: np.ndarray, z: np.ndarray) -> np.ndarray:
    if kind == kernels.POINT_SEEN:
        return dense_idp.pixel(camera, dense_idp.matrix(pose[[6, 3, 4, 5]]).T @ (end - pose[:3])) - z[:2]
    off = dense_idp.observed(camera, state_of(pose), end) - z[:2]
    return np.concatenate([end[:3] - pose[:3], off, [end[5] - z[2]]]) if kind == kernels.IDP_FIRST else off


def random_case(kind: int, name: str, seed: int) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """(camera, pose, feature or point, measurement): the camera looks at it from near where it was first seen."""
    rng = np.random.default_rng(seed)
    camera = CAMERAS[name]
    quat = rng.normal(size=4)
    pose = np.concatenate([rng.normal(size=3), quat / np.linalg.norm(quat)])
    pixel = random_pixels(rng, camera, 1)[0]
    y = dense_idp.feature(camera, state_of(pose), pixel, rng.uniform(0.2, 0.6))
    near = boxplus("se3", pose, 0.05 * rng.normal(size=6))
    end = dense_idp.point(y) if kind == kernels.POINT_SEEN else y + 0.01 * rng.normal(size=6)
    return camera, near, end, measured(kind, camera, pixel + rng.normal(size=2))


def evaluated(kind: int, pose: np.ndarray, end: np.ndarray, z: np.ndarray) -> tuple[int, np.ndarray, list[np.ndarray]]:
    """(status, r, [A, B])."""
    r, A, B = np.full(6, np.nan), np.full((6, 6), np.nan), np.full((6, 6), np.nan)
    status = kernels.evaluate(kind, np.concatenate([pose, end]), 0, 7, z, r, A, B)
    rows, columns = KINDS[kind]
    return status, r[:rows], [A[:rows, :6].copy(), B[:rows, :columns].copy()]


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("kind", KINDS)
def test_residuals_and_jacobians_are_those_of_the_dense_twin(kind: int, name: str) -> None:
    for seed in range(6):
        camera, pose, end, z = random_case(kind, name, seed)
        status, r, jacobians = evaluated(kind, pose, end, z)
        assert status == at.GOOD
        np.testing.assert_allclose(r, dense_residual(kind, camera, pose, end, z), rtol=1e-9, atol=1e-9)
        by_pose = dense_idp.slope(
            lambda d, c=camera, x=pose, e=end, z=z: dense_residual(kind, c, boxplus("se3", x, d), e, z), np.zeros(6)
        )
        by_end = dense_idp.slope(lambda d, c=camera, x=pose, e=end, z=z: dense_residual(kind, c, x, e + d, z), 0 * end)
        np.testing.assert_allclose(jacobians[0], by_pose, rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(jacobians[1], by_end, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("name", CAMERAS)
def test_the_first_value_has_no_residual(name: str) -> None:
    for seed in range(5):
        _, pose, _, z = random_case(kernels.IDP_FIRST, name, seed)
        y = np.empty(6)
        assert kernels.first(pose, 0, z, y) == at.GOOD
        _, r, _ = evaluated(kernels.IDP_FIRST, pose, y, z)
        np.testing.assert_allclose(r, 0.0, atol=2e-11)


def test_a_vertical_ray_and_a_pixel_beyond_the_lens_have_no_first_value() -> None:
    down = np.array([0.0, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    y = np.empty(6)
    z = measured(kernels.IDP_FIRST, CAMERAS["pinhole"], np.array([320.0, 240.0]))
    assert kernels.first(down, 0, z, y) == at.VERTICAL
    folding = Camera("radtan", (400.0, 400, 320, 240, -0.3, 0, 0, 0))
    level = np.array([0.0, 0, 0, 0, 0, 0, 1])
    assert kernels.first(level, 0, measured(kernels.IDP_FIRST, folding, np.array([700.0, 240.0])), y) == at.OUTSIDE_LENS


@pytest.mark.parametrize("kind", [kernels.IDP_SEEN, kernels.POINT_SEEN])
def test_what_is_behind_the_camera_counts_for_nothing_and_says_so(kind: int) -> None:
    _, pose, end, z = random_case(kind, "pinhole", 3)
    place = end[:3] if kind == kernels.POINT_SEEN else dense_idp.point(end)
    passed = pose.copy()
    passed[:3] += 3 * (place - pose[:3])
    status, r, jacobians = evaluated(kind, passed, end, z)
    assert status == at.BEHIND
    assert not r.any()
    assert not any(J.any() for J in jacobians)


def test_a_first_sight_keeps_its_anchor_and_prior_when_its_pixel_is_lost() -> None:
    _, pose, end, z = random_case(kernels.IDP_FIRST, "pinhole", 4)
    turned = pose.copy()
    turned[3:] = boxplus("se3", pose, np.array([0, 0, 0, 0, 3.0, 0]))[3:]
    status, r, (A, B) = evaluated(kernels.IDP_FIRST, turned, end, z)
    assert status == at.BEHIND
    np.testing.assert_allclose(r, [*(end[:3] - pose[:3]), 0, 0, end[5] - z[2]])
    assert not A[3:].any()
    assert not B[3:5].any()
    assert B[5, 5] == 1.0


def test_moving_a_feature_wraps_its_azimuth() -> None:
    out = np.empty(6)
    kernels.moved(np.array([1.0, 2, 3, 3.1, 0.2, 0.5]), np.array([0.1, 0.1, 0.1, 0.1, -0.1, -0.1]), out)
    np.testing.assert_allclose(out, [1.1, 2.1, 3.1, 3.2 - 2 * np.pi, 0.1, 0.4], atol=1e-15)


def test_sizes_of_measurements() -> None:
    assert measured(kernels.IDP_FIRST, CAMERAS["radial"], np.zeros(2)).size == FIRST_SIZE
    assert measured(kernels.IDP_SEEN, CAMERAS["radial"], np.zeros(2)).size == SEEN_SIZE


def test_gauss_newton_on_these_factors_finds_the_truth() -> None:
    """Two cameras of known pose and a baseline, one feature: noiseless pixels give its depth."""
    camera = CAMERAS["radtan"]
    first = np.array([0.0, 0, 0, 0, 0, 0, 1])
    second = boxplus("se3", first, np.array([0.4, 0.05, 0.1, 0.02, -0.05, 0.01]))
    truth = dense_idp.feature(camera, state_of(first), np.array([400.0, 200.0]), 0.25)
    pixels = [dense_idp.observed(camera, state_of(pose), truth) for pose in (first, second)]
    z_first, z_seen = measured(kernels.IDP_FIRST, camera, pixels[0], 0.5), measured(kernels.IDP_SEEN, camera, pixels[1])
    y = np.empty(6)
    kernels.first(first, 0, z_first, y)
    weight = np.diag([1e10, 1e10, 1e10, 1, 1, 1e-6])
    for _ in range(8):
        _, r1, (_, B1) = evaluated(kernels.IDP_FIRST, first, y, z_first)
        _, r2, (_, B2) = evaluated(kernels.IDP_SEEN, second, y, z_seen)
        step = -np.linalg.solve(B1.T @ weight @ B1 + B2.T @ B2, B1.T @ weight @ r1 + B2.T @ r2)
        kernels.moved(y, step, y)
    np.testing.assert_allclose(y, truth, atol=1e-7)
