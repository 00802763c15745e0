"""A front end's IMU: samples cut at the poses, what standing still tells, what a draft makes of it, and merging."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naive.dense_factors import boxplus, residual
from naive.random_imu import keys_of, random_ends, random_imu
from scipy.spatial.transform import Rotation

from factorbus.client import Draft, ImplausibleSamples, ImuNoise, cut_samples, initial_from_standstill
from factorbus.client.merging import AbsoluteFactors, fit_into
from factorbus.proto import inertial as of
from factorbus.proto.kinds import imu_kind
from factorbus.proto.messages import Batch, Estimate, Factors, MapGraph, Variables
from factorbus.proto.problems import BadInformation, BadOption, BadShape, NotFiniteNumbers, Problem
from factorbus.proto.roles import AXES, keys_of_role

NOISE = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)
SAMPLES = np.array([[0.01, 0.1, 0, 0, 0.5, 0, 9.8], [0.02, 0.1, 0, 0, 0.5, 0, 9.8]])
A, B = ("x0", "v0", "b0"), ("x1", "v1", "b1")


def test_samples_hold_until_the_next_and_are_cut_at_the_poses() -> None:
    times, w, a = np.arange(10) / 10, np.arange(30.0).reshape(10, 3), np.ones((10, 3))
    found = cut_samples(times, w, a, 0.25, 0.55)
    np.testing.assert_allclose(found[:, 0], [0.05, 0.1, 0.1, 0.05], atol=1e-12)
    np.testing.assert_array_equal(found[:, 1:4], w[2:6])
    assert cut_samples(times, w, a, 0.9, 1.8)[:, 0] == pytest.approx([0.9])
    assert cut_samples(times, w, a, 0.9, 2.0, longest_s=1.2)[:, 0] == pytest.approx([1.1])
    assert cut_samples([0.9], w[:1], a[:1], 0.9, 2.0)[:, 0] == pytest.approx([1.1])
    whole = [cut_samples(times, w, a, k / 20, (k + 1) / 20)[:, 0].sum() for k in range(10)]
    np.testing.assert_allclose(whole, 0.05)


def test_samples_that_were_lost_are_not_bridged() -> None:
    """At 100 Hz, with none for 4 s in the middle, and none at the end."""
    times = np.concatenate([np.arange(0, 100), np.arange(500, 600)]) / 100
    three = np.ones((times.size, 3))
    assert len(cut_samples(times, three, three, 0.5, 0.99)) == 49
    assert len(cut_samples(times, three, three, 5.0, 5.5)) == 50
    for begin, end in ((0.9, 5.1), (0.9, 1.1), (2.0, 2.1), (4.9, 5.1)):
        with pytest.raises(
            BadOption, match=r"no sample for 4.01 s after 0.99 s; wanted one every 0.1 s \(longest_s, 10 times"
        ):
            cut_samples(times, three, three, begin, end)
    with pytest.raises(BadOption, match=r"no sample for 0.31 s after 5.99 s"):
        cut_samples(times, three, three, 5.5, 6.3)
    assert cut_samples(times, three, three, 0.9, 5.1, longest_s=5.0)[:, 0].sum() == pytest.approx(4.2)
    with pytest.raises(BadOption, match=r"no sample for 0.01 s .* wanted one every 0.005 s \(longest_s\)"):
        cut_samples(times, three, three, 0.5, 0.99, longest_s=0.005)
    for wrong in (0.0, float("nan")):
        with pytest.raises(BadOption, match="longest_s"):
            cut_samples(times, three, three, 0.5, 0.99, longest_s=wrong)


@pytest.mark.parametrize(
    ("factors", "said"),
    [
        ([1, 1, 1, 1, *[1 / 9.80665] * 3], "median of |accelerometer| is about 1 m/s²: is it in g? Multiply by 9.8"),
        ([1, 1, 1, 1, *[1000.0] * 3], "is it in mm/s²"),
        ([1, 1000, 1, 1, 1, 1, 1], "gyroscopes say 1e+02 rad/s, more than any measures: are they in degrees"),
    ],
)
def test_samples_in_other_units_are_warned_of(factors: list[float], said: str) -> None:
    with pytest.warns(ImplausibleSamples, match=re.escape(said)) as warned:
        Draft().imu(A, B, SAMPLES * factors, noise=NOISE)
    assert [Path(each.filename).name for each in warned] == ["test_imu.py"]


@pytest.mark.filterwarnings("error")
def test_free_fall_and_a_hard_turn_are_not() -> None:
    Draft().imu(A, B, SAMPLES * [1, 1, 1, 1, 0.01, 0, 0.01], noise=NOISE)
    Draft().imu(A, B, SAMPLES * [1, 300, 1, 1, 10, 1, 10], noise=NOISE)
    Draft().imu(A, B, SAMPLES * 0.1, noise=NOISE, gravity=(0, 0, 0))


ONES, SHAKEN = np.ones((3, 3)), np.array([[0.0] * 7, [0, 1, 1, 1, 0, 0, 0]])
REFUSED: dict[str, tuple[Callable[[], object], type[Problem], str]] = {
    "a sample before": (lambda: cut_samples([1, 2, 3], ONES, ONES, 0.5, 2), BadOption, "at begin_s"),
    "times back": (lambda: cut_samples([1, 3, 2], ONES, ONES, 1, 2), BadOption, "increasing"),
    "shapes": (lambda: cut_samples([1, 2], ONES, ONES, 1, 2), BadShape, r"gyroscope: .*\(m, 3\)"),
    "nothing between": (lambda: cut_samples([1, 2, 3], ONES, ONES, 2, 2), BadOption, "begin_s before end_s"),
    "a NaN": (lambda: cut_samples([1, 2, np.nan], ONES, ONES, 1, 2), NotFiniteNumbers, "times_s"),
    "noise of nothing": (lambda: ImuNoise(0.0, 1, 1, 1), BadOption, "ImuNoise: gyroscope"),
    "negative integration": (lambda: ImuNoise(1, 1, 1, 1, -1), BadOption, "0 or more"),
    "one key": (lambda: Draft().imu("x0", B, SAMPLES, noise=NOISE), BadShape, "imu: first"),  # type: ignore[arg-type]
    "two keys": (lambda: Draft().imu(A, B[:2], SAMPLES, noise=NOISE), BadShape, "imu: second.*a velocity"),
    "no noise": (lambda: Draft().imu(A, B, SAMPLES, noise=1), BadOption, "an ImuNoise"),  # type: ignore[arg-type]
    "six columns": (lambda: Draft().imu(A, B, SAMPLES[:, :6], noise=NOISE), BadShape, "duration"),
    "no samples": (lambda: Draft().imu(A, B, SAMPLES[:0], noise=NOISE), BadShape, "duration"),
    "too many": (lambda: Draft().imu(A, B, np.ones((2001, 7)), noise=NOISE), BadShape, "1 to 2000"),
    "no duration": (lambda: Draft().imu(A, B, 0 * SAMPLES, noise=NOISE), BadOption, "sample 0 lasts 0 s"),
    "gravity": (lambda: Draft().imu(A, B, SAMPLES, noise=NOISE, gravity=9.81), BadShape, "gravity"),
    "bias": (lambda: Draft().imu(A, B, SAMPLES, noise=NOISE, bias=(0, 0, 0)), BadShape, "bias"),
    "moves": (lambda: initial_from_standstill(SAMPLES + SHAKEN), BadOption, "at rest"),
    "in g": (lambda: initial_from_standstill(SAMPLES / [1, 1, 1, 1, 9.8, 9.8, 9.8]), BadOption, "is it in g. Multiply"),
    "a NaN sample": (
        lambda: Draft().imu(A, B, np.where(np.arange(14).reshape(2, 7) == 12, np.nan, SAMPLES), noise=NOISE),
        NotFiniteNumbers,
        "nan in sample 1, accelerometer y;",
    ),
    "NaN samples": (
        lambda: initial_from_standstill(SAMPLES * [[1, np.inf, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, np.nan, 1]]),
        NotFiniteNumbers,
        "inf in sample 0, gyroscope x, and in 1 more",
    ),
    "a NaN of many": (
        lambda: cut_samples(
            np.arange(99), np.where(np.arange(99 * 3).reshape(99, 3) == 200, np.nan, 1.0), np.ones((99, 3)), 1, 2
        ),
        NotFiniteNumbers,
        r"gyroscope: .*nan at \[66, 2\], of shape \(99, 3\)",
    ),
    "falls": (lambda: initial_from_standstill(SAMPLES * [1, 1, 1, 1, 1, 1, 0.1]), BadOption, "9.80665 ± 1"),
    "one sample": (lambda: initial_from_standstill(SAMPLES[:1]), BadShape, "2 or more"),
    "neither": (lambda: Draft().vector("v0"), BadOption, "neither a value nor a size"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused_and_named(name: str) -> None:
    made, error, said = REFUSED[name]
    with pytest.raises(error, match=said):
        made()


@pytest.mark.parametrize("seed", range(5))
def test_standing_still_tells_attitude_and_gyroscope_bias(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = Rotation.from_euler("ZYX", [0.0, rng.uniform(-1.4, 1.4), rng.uniform(-3, 3)])
    bias, count = rng.normal(0, 0.01, 3), 400
    w = bias + rng.normal(0, 0.01, (count, 3))
    a = R.inv().apply([0, 0, 9.80665]) + rng.normal(0, 0.05, (count, 3))
    found = initial_from_standstill(np.column_stack([np.full(count, 0.01), w, a]))
    off = (Rotation.from_quat(found.attitude) * R.inv()).as_rotvec()
    assert np.abs(off).max() < 5 * found.sigma_tilt < 0.005
    assert (np.abs(found.bias[:3] - bias) < 5 * found.sigma_gyroscope).all()
    assert found.sigma_gyroscope == pytest.approx(0.01 / np.sqrt(count), rel=0.2)
    np.testing.assert_array_equal(found.gravity, [0, 0, -9.80665])
    still = Rotation.from_quat(found.attitude).apply(a.mean(axis=0) - found.bias[3:])
    np.testing.assert_allclose(still, -found.gravity, atol=1e-9)


def test_a_draft_sends_the_samples_as_they_are() -> None:
    draft = Draft().imu(A, B, SAMPLES, noise=NOISE, gravity=(0, 0, -9.8), bias=[0.1] * 6, loss="huber")
    (group,) = draft.batch().factors
    kind = imu_kind(2)
    assert (group.kind, group.loss, group.measured.shape) == (kind.name, "huber", (1, kind.size))
    np.testing.assert_array_equal(group.measured[0, : of.GRAVITY], [1e-3, 1e-2, 1e-5, 1e-4, 0])
    np.testing.assert_array_equal(group.measured[0, of.GRAVITY : of.SAMPLES], [0, 0, -9.8, *[0.1] * 6])
    np.testing.assert_array_equal(group.measured[0, of.SAMPLES :], SAMPLES.ravel())
    np.testing.assert_array_equal(group.information[0], np.eye(15)[np.triu_indices(15)])
    (group,) = Draft().imu(A, B, SAMPLES, noise=NOISE, sigmas=[2.0] * 15).batch().factors
    np.testing.assert_array_equal(group.information[0], 0.25 * np.eye(15)[np.triu_indices(15)])


def test_an_imu_that_is_turned_measures_along_the_robots_axes() -> None:
    R = Rotation.from_euler("ZYX", [0.3, -0.2, 1.1])
    own = np.column_stack([SAMPLES[:, 0], R.inv().apply(SAMPLES[:, 1:4]), R.inv().apply(SAMPLES[:, 4:])])
    (group,) = Draft().imu(A, B, own, noise=NOISE, attitude=R.as_quat()).batch().factors
    np.testing.assert_allclose(group.measured[0, of.SAMPLES :], SAMPLES.ravel(), atol=1e-12)
    with pytest.raises(BadShape, match=r"attitude: .*length 2"):
        Draft().imu(A, B, own, noise=NOISE, attitude=[0, 0, 0, 2.0])


def moving(seed: int) -> tuple[MapGraph, Estimate]:
    """A map of two moments, whose velocity is known at the first, and one that it goes into."""
    rng = np.random.default_rng(seed)
    z = random_imu(4, rng)
    ends, keys = random_ends(z, rng, off=0.01), np.array(keys_of(0) + keys_of(1))
    kinds = ("se3", "vector3", "vector6") * 2
    variables = tuple(Variables(kind, keys[n : n + 1], ends[n][None], fixed=n == 0) for n, kind in enumerate(kinds))
    known = Draft().linear(
        ["v0"], [ends[1] + 0.1], [np.diag([1.0, 2, 3])], np.zeros(3), sigmas=(1, 1, 1), kinds=["vector3"]
    )
    imu = Factors(imu_kind(4).name, keys[None], z[None], np.eye(15)[np.triu_indices(15)][None])
    here = Variables("se3", np.array([1]), np.array([[0, 0, 0, 0, 0, 0, 1.0]]))
    return MapGraph(1, 1, Batch(variables, (imu, *known.batch().factors))), Estimate(2, 1, (here,))


def residuals(batch: Batch) -> dict[str, np.ndarray]:
    values = {int(key): row for g in batch.variables for key, row in zip(g.keys, g.values, strict=True)}
    return {
        g.kind: residual(g.kind, [values[key] for key in g.keys[0].tolist()], g.measured[0])
        for g in batch.factors
        if g.kind.startswith(("imu", "linear"))
    }


@pytest.mark.parametrize("seed", range(3))
def test_velocities_and_gravity_turn_with_a_map_that_is_merged(seed: int) -> None:
    other, here = moving(seed)
    frame = boxplus("se3", np.array([0, 0, 0, 0, 0, 0, 1.0]), np.random.default_rng(seed).normal(size=6))
    fitted = fit_into(here, other, frame=frame, sigmas=[0.1] * 6, letters={"x": "y"})
    assert keys_of_role(other.batch, AXES).tolist() == sorted([keys_of(0)[1], keys_of(1)[1]])
    before, after = residuals(other.batch), residuals(fitted.batch)
    assert set(before) == set(after)
    for kind, r in before.items():
        np.testing.assert_allclose(after[kind], r, atol=1e-6 * max(1.0, np.abs(r).max()))
    assert fitted.left_out == {"fixed": 1}


def test_what_is_known_of_a_pose_and_its_velocity_is_of_the_map() -> None:
    """A marginal says where down is, and so where the map is."""
    other, here = moving(1)
    rows = np.random.default_rng(1).normal(size=(3, 9))
    ends = [g.values[0] for g in other.batch.variables[3:5]]
    draft = Draft().linear(
        ["x1", "v1"], ends, [rows[:, :6], rows[:, 6:]], np.zeros(3), sigmas=(1, 1, 1), kinds=["se3", "vector3"]
    )
    more = other.batch._replace(factors=(*other.batch.factors, *draft.batch().factors))
    with pytest.raises(AbsoluteFactors, match="linear_3_se3_vector3"):
        fit_into(here, MapGraph(1, 1, more), frame=[0] * 6 + [1], sigmas=[0.1] * 6, letters={"x": "y"})


@pytest.mark.parametrize("wrong", ["los", "sigma", "covariance"])
def test_a_certainty_that_is_misspelt_is_refused(wrong: str) -> None:
    misspelt: Any = {wrong: 0.1}
    with pytest.raises(BadInformation, match=f"no keyword '{wrong}'"):
        Draft().imu(A, B, SAMPLES, noise=NOISE, **misspelt)
