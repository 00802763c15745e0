"""Agreement with the numbers of a real filter: Civera's 1-point RANSAC EKF on its own sequence."""

from pathlib import Path

import numpy as np
import pytest

from factorbus import idp
from factorbus.idp import classical, independent, lenses, minimal, predict
from factorbus.proto.camera import Camera
from factorbus.proto.features import Observations


@pytest.fixture(scope="module")
def folder(datasets: Path) -> Path:
    return datasets / "monocular" / "civera_ekf"


@pytest.fixture(scope="module")
def camera(folder: Path) -> Camera:
    lines = (line.split() for line in (folder / "camera.txt").read_text().splitlines() if line[0] != "#")
    numbers = {name: float(number) for name, number in lines}
    names = ("f", "dx", "dy", "cx", "cy", "k1", "k2")
    return Camera("radial", tuple(numbers[n] for n in names), int(numbers["ncols"]), int(numbers["nrows"]))


def observations_of(folder: Path, camera: Camera, name: str) -> tuple[Observations, np.ndarray]:
    """(what was seen, P before) of one of the steps that add a feature."""
    lines = (line.split() for line in (folder / name / "input.txt").read_text().splitlines() if line[0] != "#")
    given = {name: list(map(float, numbers)) for name, *numbers in lines}
    P = np.loadtxt(folder / name / "P_before.txt")
    state = np.loadtxt(folder / name / ("xv.txt" if name.endswith("2") else "x_before.txt"))[:13]
    rho = given.get("rho0", [1.0])[0]
    return Observations(
        camera, state, P[:13], np.array([given["uvd"]]), rho, given["std_rho"][0], given["std_pixel"][0]
    ), P


@pytest.mark.parametrize("name", ["add_feature_1", "add_feature_2"])
def test_a_feature_is_added_as_the_filter_adds_it(folder: Path, camera: Camera, name: str) -> None:
    observations, P = observations_of(folder, camera, name)
    wanted = np.loadtxt(folder / name / "P_after.txt")
    seen = idp.see(observations)
    A, B = idp.jacobians(observations, seen)
    for found in (
        classical.covariance(P, A, B, idp.padd(observations)).P,
        independent.covariance(P, A, B, idp.padd(observations)).P,
        minimal.covariance(P, observations, seen).P,
    ):
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
    if name == "add_feature_1":
        np.testing.assert_allclose(seen.y[0], np.loadtxt(folder / name / "x_after.txt")[-6:], rtol=0, atol=1e-13)


def test_undistortion_and_distortion(folder: Path, camera: Camera) -> None:
    focal = camera.number("f") / camera.number("dx")
    centre = np.array([camera.number("cx"), camera.number("cy")])
    table = np.loadtxt(folder / "distortion" / "undistort.txt")
    found = centre + focal * lenses.rays(camera, table[:, :2]).values[:, :2]
    np.testing.assert_allclose(found, table[:, 2:], rtol=0, atol=1e-12)
    table = np.loadtxt(folder / "distortion" / "distort.txt")
    rays = np.column_stack([(table[:, :2] - centre) / focal, np.ones(len(table))])
    np.testing.assert_allclose(lenses.pixels(camera, rays).values, table[:, 2:], rtol=0, atol=1e-12)
    table = np.loadtxt(folder / "distortion" / "undistort_jacobian.txt")
    slope = focal * lenses.rays(camera, table[:, :2]).slope[:, :2]
    np.testing.assert_allclose(slope.reshape(-1, 4), table[:, 2:], rtol=0, atol=1e-12)


def test_predicted_pixels(folder: Path, camera: Camera) -> None:
    x = np.loadtxt(folder / "predict_pixels" / "x.txt")
    table = np.loadtxt(folder / "predict_pixels" / "h.txt")
    found = predict.predict(camera, x[:13], x[13:].reshape(-1, 6))
    rows = table[:, 0].astype(int)
    assert not found.status[rows].any()
    np.testing.assert_allclose(found.pixels[rows], table[:, 1:], rtol=0, atol=1e-10)


def test_measurement_jacobian(folder: Path, camera: Camera) -> None:
    H = np.loadtxt(folder / "jacobian" / "H.txt")
    found = predict.predict(
        camera, np.loadtxt(folder / "jacobian" / "xv.txt"), np.loadtxt(folder / "jacobian" / "y.txt")[None]
    )
    np.testing.assert_allclose(found.by_state[0], H[:, :13], rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.by_feature[0], H[:, 115:121], rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["update_1", "update_2"])
def test_the_jacobians_of_an_update(folder: Path, camera: Camera, name: str) -> None:
    x, H, h = (np.loadtxt(folder / name / f"{what}.txt") for what in ("x_before", "H", "h"))
    found = predict.predict(camera, x[:13], x[13:].reshape(-1, 6))
    pixels = h.reshape(-1, 2)
    for row, uv in enumerate(pixels):
        feature = int(np.argmin(np.linalg.norm(found.pixels - uv, axis=1)))
        np.testing.assert_allclose(found.pixels[feature], uv, rtol=0, atol=1e-10)
        ours = np.zeros((2, len(x)))
        ours[:, :13] = found.by_state[feature]
        ours[:, 13 + 6 * feature : 19 + 6 * feature] = found.by_feature[feature]
        np.testing.assert_allclose(ours, H[2 * row : 2 * row + 2], rtol=0, atol=1e-10)
