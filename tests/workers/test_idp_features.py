"""Pixels to features and back: values and Jacobians against the dense twin, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import dense_idp
from naive.random_cameras import CAMERAS, random_observations, random_state

from factorbus import idp
from factorbus.idp import predict
from factorbus.idp.kernels import layout as at
from factorbus.proto.features import BadPixel, BadState, Observations
from factorbus.proto.problems import BadShape, Problem

seeds = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize("camera", CAMERAS)
def test_features_and_their_jacobians_are_those_of_the_dense_twin(camera: str) -> None:
    observations, _ = random_observations(1, 6, camera=camera)
    seen = idp.see(observations)
    A, B = idp.jacobians(observations, seen)
    for k, uv in enumerate(observations.pixels):

        def by_state(x: np.ndarray, uv: np.ndarray = uv) -> np.ndarray:
            return dense_idp.feature(observations.camera, x, uv, observations.rho)

        def by_pixel(h: np.ndarray) -> np.ndarray:
            return dense_idp.feature(observations.camera, observations.state, h[:2], h[2])

        np.testing.assert_allclose(seen.y[k], by_state(observations.state), atol=1e-12)
        np.testing.assert_allclose(A[k], dense_idp.slope(by_state, observations.state), atol=2e-10)
        np.testing.assert_allclose(
            B[k], dense_idp.slope(by_pixel, np.append(uv, observations.rho), h=0.05), rtol=1e-7, atol=1e-10
        )


@given(seed=seeds)
def test_azimuth_and_elevation_do_not_change_with_the_quaternion_s_length(seed: int) -> None:
    observations, _ = random_observations(seed, 1)
    seen = idp.see(observations)
    longer = observations.state.copy()
    longer[3:7] *= 3.0
    again = replace(observations, state=longer)
    np.testing.assert_allclose(idp.see(again).y[:, 3:5], seen.y[:, 3:5], atol=1e-13)
    A, _ = idp.jacobians(again, idp.see(again))
    np.testing.assert_allclose(A[0, 3:5, 3:7] @ longer[3:7], 0.0, atol=1e-12 * abs(A).max())


@pytest.mark.parametrize("camera", CAMERAS)
def test_predicted_pixels_and_their_jacobians_are_those_of_the_dense_twin(camera: str) -> None:
    """Features seen from one place, looked at from another near by."""
    rng = np.random.default_rng(2)
    observations, _ = random_observations(2, 6, camera=camera)
    y = idp.see(observations).y
    y[:, 5] = rng.uniform(0.2, 0.6, 6)
    state = observations.state + 0.03 * rng.normal(size=13)
    found = predict.predict(observations.camera, state, y)
    for k in np.flatnonzero(found.status == at.GOOD):
        np.testing.assert_allclose(
            found.pixels[k], dense_idp.observed(observations.camera, state, y[k]), rtol=1e-11, atol=1e-9
        )
        slope = dense_idp.slope(lambda x, k=k: dense_idp.observed(observations.camera, x, y[k]), state)
        np.testing.assert_allclose(found.by_state[k], slope, rtol=1e-7, atol=1e-5)
        slope = dense_idp.slope(lambda f: dense_idp.observed(observations.camera, state, f), y[k])
        np.testing.assert_allclose(found.by_feature[k], slope, rtol=1e-7, atol=1e-5)
    assert (found.status == at.GOOD).sum() >= 4


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_new_feature_is_predicted_at_its_own_pixel_whatever_its_depth(camera: str) -> None:
    observations, _ = random_observations(3, 50, camera=camera)
    y = idp.see(observations).y
    for rho in (1e-9, 0.0, 0.1, 10.0):
        y[:, 5] = rho
        np.testing.assert_allclose(
            predict.predict(observations.camera, observations.state, y).pixels, observations.pixels, atol=1e-9
        )


def test_a_feature_behind_the_camera_is_told() -> None:
    observations, _ = random_observations(4, 1, camera="pinhole")
    y = idp.see(observations).y
    y[0, 5] = 0.5
    passed = observations.state.copy()
    passed[:3] += 3 * (dense_idp.point(y[0]) - passed[:3])
    found = predict.predict(observations.camera, passed, y)
    assert found.status.tolist() == [at.BEHIND]
    assert set(found.status.tolist()) <= set(predict.REASONS)


def test_points_their_covariance_and_linearity_are_those_of_the_dense_twin() -> None:
    rng = np.random.default_rng(5)
    observations, _ = random_observations(5, 8)
    y = idp.see(observations).y
    y[:, 5] = rng.uniform(0.1, 2.0, 8)
    roots = 0.01 * rng.normal(size=(8, 6, 6))
    P = roots @ roots.transpose(0, 2, 1)
    state = random_state(rng)
    found = predict.to_points(state, y, P)
    for k in range(8):
        p = dense_idp.point(y[k])
        J = dense_idp.slope(dense_idp.point, y[k])
        np.testing.assert_allclose(found.p[k], p, rtol=1e-13)
        np.testing.assert_allclose(found.covariance[k], J @ P[k] @ J.T, rtol=1e-7, atol=1e-12)
        away = p - state[:3]
        cosine = abs(away @ dense_idp.direction(y[k])) / np.linalg.norm(away)
        wanted = 4 * np.sqrt(P[k, 5, 5]) / y[k, 5] ** 2 * cosine / np.linalg.norm(away)
        assert found.linearity[k] == pytest.approx(wanted, rel=1e-12)


def looking_down() -> Observations:
    """The camera's axis along the world's y: the ray of the principal point is vertical."""
    observations, _ = random_observations(6, 3, camera="pinhole")
    state = observations.state.copy()
    state[3:7] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    pixels = np.array([[10.0, 10.0], [320.0, 240.0], [30.0, 40.0]])
    return replace(observations, state=state, pixels=pixels)


@pytest.mark.parametrize(
    ("pixel", "reason"), [((np.nan, 1.0), "finite"), ((-5.0, 10.0), "outside the image"), ((10.0, 240.0), "image")]
)
def test_one_bad_pixel_refuses_the_whole_question(pixel: tuple[float, float], reason: str) -> None:
    observations, _ = random_observations(7, 4)
    pixels = observations.pixels.copy()
    pixels[2] = pixel
    with pytest.raises(BadPixel, match=reason) as refused:
        idp.see(replace(observations, pixels=pixels))
    assert refused.value.detail["index"] == 2


def test_a_vertical_ray_has_no_azimuth_and_is_refused() -> None:
    with pytest.raises(BadPixel, match="azimuth") as refused:
        idp.see(looking_down())
    assert refused.value.detail["index"] == 1


OBSERVATIONS, _P = random_observations(8, 2)


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"state": np.zeros(12)}, BadShape),
        ({"state": np.zeros(13)}, BadState),
        ({"state": np.full(13, np.inf)}, BadState),
        ({"covariance": np.zeros((12, 13))}, BadShape),
        ({"covariance": np.zeros((13, 12))}, BadShape),
        ({"covariance": np.full((13, 13), np.nan)}, BadState),
        ({"covariance": -np.eye(13)}, BadState),
        ({"covariance": np.eye(13) + np.eye(13, k=1)}, BadState),
        ({"pixels": np.zeros((2, 3))}, BadShape),
        ({"rho": np.nan}, BadState),
        ({"rho": -1.1e12}, BadState),
        ({"sigma_rho": 0.0}, BadState),
        ({"sigma_rho": 1.1e12}, BadState),
        ({"sigma_pixel": 1e200}, BadState),
        ({"sigma_pixel": 0.9e-12}, BadState),
        ({"state": np.array([1.1e12, *np.zeros(2), 1, *np.zeros(9)])}, BadState),
        ({"covariance": np.eye(13) * 1.1e24}, BadState),
        ({"sigma_pixel": -1.0}, BadState),
    ],
)
def test_observations_that_cannot_be_is_refused_at_the_door(change: dict, wanted: type[Problem]) -> None:
    with pytest.raises(wanted):
        idp.see(replace(OBSERVATIONS, **change))


def test_no_pixels_are_no_features() -> None:
    seen = idp.see(replace(OBSERVATIONS, pixels=np.empty((0, 2))))
    assert seen.y.shape == (0, 6)
