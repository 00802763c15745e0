"""The simulated camera: pixels where the kernels see them, noise and outliers as asked for, the same from one seed."""

from itertools import islice, pairwise

import numpy as np
import pytest
from naive.random_cameras import CAMERAS

from factorbus.cli.demo.evaluate_filter import FilterEvaluator, verdict
from factorbus.client.filter_state import FilterState
from factorbus.idp import lenses, minimal, see
from factorbus.proto.camera import Camera
from factorbus.proto.features import Observations
from factorbus.simulate import BadParameter, MonocularWorld, monocular
from factorbus.simulate.lens import seen_by


@pytest.mark.parametrize("name", CAMERAS)
def test_its_lens_is_the_kernels(name: str) -> None:
    rays = np.random.default_rng(1).normal(size=(500, 3)) * [0.5, 0.5, 0.6] + [0, 0, 0.6]
    rays[0] = [0.0, 0.0, 2.0]
    pixels, good = seen_by(CAMERAS[name], rays)
    found = lenses.pixels(CAMERAS[name], rays)
    assert good.tolist() == (found.status == 0).tolist()
    np.testing.assert_allclose(pixels[good], found.values[good], rtol=0, atol=1e-9)
    assert 20 < good.sum() < 480


def test_pixels_are_those_of_the_points_with_the_noise_asked_for() -> None:
    world = monocular(60, 3, sigma_pixel=0.7, outlier_share=0.1)
    off, outliers, count = [], 0, 0
    for frame in world:
        R = rotation(frame.pose[3:])
        pixels, good = seen_by(world.camera, (world.points[frame.points] - frame.pose[:3]) @ R)
        assert good.all()
        off.append((frame.pixels - pixels)[~frame.outlier])
        outliers, count = outliers + int(frame.outlier.sum()), count + len(frame.points)
    errors = np.concatenate(off).reshape(-1)
    assert errors.std() == pytest.approx(0.7, rel=0.02)
    assert abs(errors.mean()) < 4 * 0.7 / np.sqrt(errors.size)
    assert outliers / count == pytest.approx(0.1, abs=0.01)


def test_velocities_are_those_of_the_way() -> None:
    frames = list(monocular(40, 1, rate_hz=1000.0))
    for before, after in pairwise(frames):
        moved = (after.pose[:3] - before.pose[:3]) * 1000.0
        np.testing.assert_allclose(moved, before.velocity[:3], atol=2e-3)
        turn = rotation(before.pose[3:]).T @ rotation(after.pose[3:])
        turned = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) * 1000.0
        np.testing.assert_allclose(turned, before.velocity[3:], atol=2e-3)


def test_the_same_seed_is_the_same_world_and_a_longer_one_begins_with_it() -> None:
    short, long, other = (list(monocular(n, seed)) for n, seed in ((5, 2), (9, 2), (5, 3)))
    for a, b in zip(short, islice(long, 5), strict=True):
        assert a.pixels.tobytes() == b.pixels.tobytes()
        assert a.pose.tobytes() == b.pose.tobytes()
    assert short[0].pixels.tobytes() != other[0].pixels.tobytes()


@pytest.mark.parametrize(
    "wrong",
    [{"frames": 0}, {"seed": -1}, {"points": 0}, {"sigma_pixel": 0.0}, {"outlier_share": 1.5},
     {"camera": Camera("pinhole", (100.0, 100, 50, 50))}],
)  # fmt: skip
def test_a_world_that_cannot_be_is_refused(wrong: dict) -> None:
    with pytest.raises(BadParameter):
        monocular(**{"frames": 3, "seed": 1, **wrong})


class Near:
    """Features made in this process."""

    def __init__(self, camera: Camera, **prior: float) -> None:
        self.camera, self._prior = camera, prior

    def grow(self, x: np.ndarray, P: np.ndarray, pixels: np.ndarray) -> FilterState:
        observations = Observations(self.camera, x[:13], P[:13], pixels, **self._prior)
        seen = see(observations)
        after = minimal.covariance(P, observations, seen).P
        return FilterState(np.concatenate([x, seen.y.reshape(-1)]), after, seen.y, ("here",), 0.0)


@pytest.mark.parametrize("camera", ["radial", "radtan"])
def test_rays_become_points_and_the_filter_knows_how_well(camera: str) -> None:
    """200 frames, 300 points, 1 pixel of noise, 5 % outliers."""
    world: MonocularWorld = monocular(200, 4, camera=CAMERAS[camera])
    evaluator = FilterEvaluator(world, Near(world.camera, rho=0.28, sigma_rho=0.2, sigma_pixel=1.0), 40)  # type: ignore[arg-type]
    frames = list(evaluator.run())
    result = verdict(frames, evaluator)
    assert result["relative_depth"]["first"] > 0.5
    assert result["relative_depth"]["last"] < 0.02
    assert result["inverse_depth_within_3_sigma"] >= 0.99
    assert result["nees"]["within_3_sigma"] >= 0.99
    assert result["error_m"]["rms"] < 0.05
    assert result["dropped_as_wrong"] > 0, "outliers were among the new features, and were found"


def rotation(quat: np.ndarray) -> np.ndarray:
    x, y, z, w = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
