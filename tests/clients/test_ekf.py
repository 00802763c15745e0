"""The demonstration's filter, against the steps of a real one (Civera's program on its own sequence)."""

from pathlib import Path

import numpy as np
import pytest

from factorbus.cli.demo import ekf


@pytest.mark.parametrize("name", ["predict_1", "predict_2"])
def test_predictions_are_those_of_the_real_filter(datasets: Path, name: str) -> None:
    folder = datasets / "monocular" / "civera_ekf" / name
    before, after = (
        ekf.Filter(*(np.loadtxt(folder / f"{w}_{when}.txt") for w in "xP")) for when in ("before", "after")
    )
    before.predict(1.0, 0.007, 0.007)
    np.testing.assert_allclose(before.x, after.x, rtol=0, atol=1e-13)
    np.testing.assert_allclose(before.P, after.P, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", ["update_1", "update_2"])
def test_updates_are_those_of_the_real_filter(datasets: Path, name: str) -> None:
    folder = datasets / "monocular" / "civera_ekf" / name
    before, after = (
        ekf.Filter(*(np.loadtxt(folder / f"{w}_{when}.txt") for w in "xP")) for when in ("before", "after")
    )
    H, h, z = (np.loadtxt(folder / f"{what}.txt") for what in "Hhz")
    before.update(z - h, H, np.eye(len(z)))
    np.testing.assert_allclose(before.x, after.x, rtol=0, atol=1e-11)
    np.testing.assert_allclose(before.P, after.P, rtol=0, atol=1e-11)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 2e-4, 0.3, 3.0])
def test_the_jacobian_of_a_small_rotation(size: float) -> None:
    turn = size * np.array([0.6, -0.64, 0.48])
    _, by_turn = ekf.small_rotation(turn)
    for k, step in enumerate(1e-5 * np.eye(3)):
        slope = (ekf.small_rotation(turn + step)[0] - ekf.small_rotation(turn - step)[0]) / 2e-5
        np.testing.assert_allclose(by_turn[:, k], slope, atol=2e-9)


def test_products_of_quaternions_both_ways() -> None:
    p, q = np.random.default_rng(1).normal(size=(2, 4))
    np.testing.assert_allclose(ekf.product_matrix(p) @ q, ekf.right_matrix(q) @ p)


def test_dropping_features_keeps_the_others_as_they_were() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(31, 31))
    before = ekf.Filter(rng.normal(size=31), root @ root.T)
    after = ekf.Filter(before.x, before.P)
    after.drop([2, 0])
    np.testing.assert_array_equal(after.features, before.features[[2, 0]])
    np.testing.assert_array_equal(after.feature_covariance(0), before.feature_covariance(2))
    np.testing.assert_array_equal(after.P[:13, 19:], before.P[:13, 13:19])
