"""A front end's IMU: samples cut at the poses, what standing still tells, what a draft makes of it, and merging."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naive.dense_factors import boxplus, residual
from naive.random_imu import GRAVITY_KEY, MOUNT_KEY, keys_of, random_ends, random_imu
from naive.random_imu import NOISE as NOISE_NUMBERS
from scipy.spatial.transform import Rotation

from factorbus.client import (
    Draft,
    ImplausibleSamples,
    ImuNoise,
    cut_samples,
    initial_from_standstill,
    preintegrate_samples,
)
from factorbus.client.key_numbers import key_number
from factorbus.client.merging import AbsoluteFactors, fit_into
from factorbus.proto import codec
from factorbus.proto import inertial as of
from factorbus.proto.kinds import imu_kind, inertial_kind
from factorbus.proto.messages import Batch, Estimate, Factors, Insert, MapGraph, Variables
from factorbus.proto.problems import BadInformation, BadOption, BadShape, NotFiniteNumbers, Problem
from factorbus.proto.roles import AXES, MOUNT, keys_of_role

NOISE = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)
SAMPLES = np.array([[0.01, 0.1, 0, 0, 0.5, 0, 9.8], [0.02, 0.1, 0, 0, 0.5, 0, 9.8]])
FORM = of.ImuForm(2)
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


MADE = preintegrate_samples(SAMPLES, NOISE)


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


def test_times_in_place_of_durations_are_warned_of() -> None:
    times = np.tile(SAMPLES[:1], (20, 1))
    for first in (0.01, 1.7e9):
        times[:, 0] = first + 0.01 * np.arange(len(times))
        with pytest.warns(ImplausibleSamples, match="are these times"):
            Draft().imu(A, B, times, noise=NOISE)


def test_what_is_implausible_is_warned_of_where_samples_are_integrated_before_they_are_sent() -> None:
    with pytest.warns(ImplausibleSamples, match="degrees per second") as warned:
        preintegrate_samples(SAMPLES * [1, 1e4, 1e4, 1e4, 1, 1, 1], NOISE)
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
    "gravity": (lambda: Draft().imu(A, B, SAMPLES, noise=NOISE, gravity=(9.81,)), BadShape, "gravity"),
    "mount": (lambda: Draft().imu(A, B, SAMPLES, noise=NOISE, mount=(0, 0, 1)), BadShape, "mount"),
    "no rotation": (lambda: Draft().imu(A, B, SAMPLES, noise=NOISE, mount=[0] * 6 + [2]), BadShape, "mount.*length 2"),
    "samples": (lambda: Draft().imu_preintegrated(A, B, SAMPLES), BadOption, "a PreintegratedImu"),  # type: ignore[arg-type]
    "certain": (
        lambda: Draft().imu_preintegrated(A, B, preintegrate_samples(SAMPLES[:1], NOISE)),
        BadInformation,
        "singular",
    ),
    "an instant": (lambda: replace(MADE, duration=0.0), BadOption, "more than 0 s"),
    "a long quaternion": (lambda: replace(MADE, attitude=2 * MADE.attitude), BadShape, "length 2"),
    "a small covariance": (lambda: replace(MADE, covariance=np.eye(9)), BadShape, r"covariance: .*\(15, 15\)"),
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


def test_what_standing_still_tells_is_as_certain_as_it_says() -> None:
    """Of 300 standstills: the errors over their standard deviations have the mean square of that number of numbers."""
    rng, gyroscope, tilt = np.random.default_rng(4), list[float](), list[float]()
    for _ in range(300):
        R = Rotation.random(random_state=int(rng.integers(1 << 30)))
        if abs(R.as_matrix()[2, 0]) > 0.98:  # its nose up or down: pitch and roll are no two angles
            continue
        bias, count = rng.normal(0, 0.01, 3), 200
        w = bias + rng.normal(0, 0.01, (count, 3))
        a = R.inv().apply([0, 0, 9.80665]) + rng.normal(0, 0.05, (count, 3))
        found = initial_from_standstill(np.column_stack([np.full(count, 0.01), w, a]))
        gyroscope.append(float((((found.bias[:3] - bias) / found.sigma_gyroscope) ** 2).sum()))
        up = Rotation.from_quat(found.attitude).inv().apply([0, 0, 1.0])
        tilt.append(float((np.cross(up, R.inv().apply([0, 0, 1.0])) ** 2).sum()) / found.sigma_tilt**2)
    assert np.mean(gyroscope) == pytest.approx(3.0, abs=0.5)
    assert 1.4 < np.mean(tilt) < 2.3, "sigma_tilt is of the noisiest axis"
    assert np.mean(np.array(tilt) < 11.8) > 0.99


def test_standing_still_with_a_mount_tells_how_the_robot_stands() -> None:
    rng, mount = (
        np.random.default_rng(2),
        np.array([0.5, 0, 0.2, *Rotation.from_euler("XYZ", [0.7, -0.4, 1.1]).as_quat()]),
    )
    robot, turn = Rotation.from_euler("ZYX", [0.0, 0.3, -0.2]), Rotation.from_quat(mount[3:])
    a = (robot * turn).inv().apply([0, 0, 9.80665]) + rng.normal(0, 0.02, (400, 3))
    rows = np.column_stack([np.full(400, 0.01), rng.normal(0, 0.01, (400, 3)), a])
    found = initial_from_standstill(rows, mount=mount)
    assert (Rotation.from_quat(found.attitude) * robot.inv()).magnitude() < 5 * found.sigma_tilt
    with pytest.raises(BadShape, match="mount: a quaternion of length 2"):
        initial_from_standstill(rows, mount=[0, 0, 0, 0, 0, 0, 2])


def test_a_draft_sends_the_samples_as_they_are() -> None:
    draft = Draft().imu(A, B, SAMPLES, noise=NOISE, gravity=(0, 0, -9.8), bias=[0.1] * 6, loss="huber")
    (group,) = draft.batch().factors
    kind = imu_kind(2)
    assert (group.kind, group.loss, group.measured.shape) == (kind.name, "huber", (1, kind.size))
    np.testing.assert_array_equal(group.measured[0, : of.NOISE], [1e-3, 1e-2, 1e-5, 1e-4, 0])
    known = [*[0.1] * 6, 0, 0, -9.8, 0, 0, 0, 0, 0, 0, 1]
    np.testing.assert_array_equal(group.measured[0, of.NOISE : FORM.start], known)
    np.testing.assert_array_equal(group.measured[0, FORM.start :], SAMPLES.ravel())
    np.testing.assert_array_equal(group.information[0], np.eye(15)[np.triu_indices(15)])
    (group,) = Draft().imu(A, B, SAMPLES, noise=NOISE, sigmas=[2.0] * 15).batch().factors
    np.testing.assert_array_equal(group.information[0], 0.25 * np.eye(15)[np.triu_indices(15)])


def test_a_mount_and_gravity_are_numbers_or_variables() -> None:
    there = [1.0, 2, 3, 0, 0, 0, 1]
    (group,) = Draft().imu(A, B, SAMPLES, noise=NOISE, mount=there).batch().factors
    assert group.measured[0, FORM.mount_at : FORM.start].tolist() == there
    for mount, gravity in ((there, "g0"), ("m0", (0, 0, -9.8)), ("m0", "g0")):
        further = [key_number(key) for key in (mount, gravity) if isinstance(key, str)]
        draft = Draft().imu(A, B, SAMPLES, noise=NOISE, mount=mount, gravity=gravity)
        draft.imu_preintegrated(A, B, MADE, mount=mount, gravity=gravity)
        for group, samples in zip(draft.batch().factors, (2, 0), strict=True):
            form = of.ImuForm(samples, mount == "m0", gravity == "g0")
            assert (group.kind, group.keys[0, 6:].tolist()) == (form.name, further)
            assert group.measured.shape == (1, form.size)


def test_what_is_integrated_already_says_what_its_samples_say() -> None:
    rng = np.random.default_rng(1)
    form, sampled = of.ImuForm(0), of.ImuForm(40)
    z = random_imu(sampled, rng, 0.5)
    rows, bias = z[sampled.start :].reshape(-1, 7), z[of.NOISE : of.NOISE + 6]
    made = preintegrate_samples(rows, ImuNoise(*NOISE_NUMBERS), bias)
    ends = random_ends(sampled, z, rng, 0.01)
    ends[2] = bias
    (group,) = (
        Draft()
        .imu_preintegrated(
            A, B, made, gravity=z[sampled.gravity_at : sampled.mount_at], mount=z[sampled.mount_at : sampled.start]
        )
        .batch()
        .factors
    )
    r, wanted = residual(form.name, ends, group.measured[0]), residual(sampled.name, ends, z)
    W = np.zeros((15, 15))
    W[np.triu_indices(15)] = group.information[0]
    W = W + np.triu(W, 1).T
    assert r @ W @ r == pytest.approx(wanted @ wanted, rel=1e-6)
    assert len(codec.encode_insert(Insert(1, Draft().imu_preintegrated(A, B, made).batch()))) < 2000
    (loose,) = Draft().imu_preintegrated(A, B, made, sigmas=[2.0] * 15).batch().factors
    np.testing.assert_array_equal(loose.information[0], 0.25 * np.eye(15)[np.triu_indices(15)])


FORMS = [of.ImuForm(n, mount, gravity) for n in (0, 4) for mount in (False, True) for gravity in (False, True)]


def moving(seed: int, form: of.ImuForm) -> tuple[MapGraph, Estimate]:
    """A map of two moments, whose velocity is known at the first, and one that it goes into."""
    rng = np.random.default_rng(seed)
    z, kind = random_imu(form, rng), inertial_kind(form)
    ends = random_ends(form, z, rng, off=0.01)
    keys = np.array([*keys_of(0), *keys_of(1), *[MOUNT_KEY] * form.mount, *[GRAVITY_KEY] * form.gravity])
    variables = tuple(
        Variables(end, keys[n : n + 1], ends[n][None], fixed=n == 0) for n, end in enumerate(kind.connects)
    )
    known = Draft().linear(
        ["v0"], [ends[1] + 0.1], [np.diag([1.0, 2, 3])], np.zeros(3), sigmas=(1, 1, 1), kinds=["vector3"]
    )
    imu = Factors(kind.name, keys[None], z[None], np.eye(15)[np.triu_indices(15)][None])
    here = Variables("se3", np.array([1]), np.array([[0, 0, 0, 0, 0, 0, 1.0]]))
    return MapGraph(1, 1, Batch(variables, (imu, *known.batch().factors))), Estimate(2, 1, (here,))


def residuals(batch: Batch) -> dict[str, np.ndarray]:
    values = {int(key): row for g in batch.variables for key, row in zip(g.keys, g.values, strict=True)}
    return {
        g.kind: residual(g.kind, [values[key] for key in g.keys[0].tolist()], g.measured[0])
        for g in batch.factors
        if g.kind.startswith(("imu", "linear"))
    }


@pytest.mark.parametrize("form", FORMS, ids=[form.name for form in FORMS])
@pytest.mark.parametrize("seed", range(2))
def test_velocities_and_gravity_turn_with_a_map_that_is_merged(seed: int, form: of.ImuForm) -> None:
    other, here = moving(seed, form)
    frame = boxplus("se3", np.array([0, 0, 0, 0, 0, 0, 1.0]), np.random.default_rng(seed).normal(size=6))
    fitted = fit_into(here, other, frame=frame, sigmas=[0.1] * 6, letters={"x": "y"})
    assert keys_of_role(other.batch, AXES).tolist() == sorted(
        [keys_of(0)[1], keys_of(1)[1], *[GRAVITY_KEY] * form.gravity]
    )
    assert keys_of_role(other.batch, MOUNT).tolist() == [MOUNT_KEY] * form.mount
    before, after = residuals(other.batch), residuals(fitted.batch)
    assert set(before) == set(after)
    for kind, r in before.items():
        np.testing.assert_allclose(after[kind], r, atol=1e-6 * max(1.0, np.abs(r).max()))
    assert fitted.left_out == {"fixed": 1}


def test_what_is_known_of_a_pose_and_its_velocity_is_of_the_map() -> None:
    """A marginal says where down is, and so where the map is."""
    other, here = moving(1, of.ImuForm(4))
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
