"""Inertial factors: residual, noise and Jacobians against a dense twin, integration at a high rate, and GTSAM."""

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_factors import boxplus, jacobians, residual
from naive.dense_imu import covariance, follow, integrate, samples
from naive.random_imu import GRAVITY, KINDS, keys_of, random_ends, random_imu
from scipy.spatial.transform import Rotation

from examples import examples
from factorbus.proto import inertial as of
from factorbus.proto.inertial import ImuForm
from factorbus.proto.kinds import FACTOR_KINDS, inertial_kind
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.linearized import Linearized, linearized_factor
from factorbus.solver.kernels.model.imu_layout import ImuLayout, imu_layout
from factorbus.solver.kernels.model.imu_noise import propagate_noise
from factorbus.solver.kernels.model.imu_walk import walk_samples
from factorbus.solver.kernels.model.preintegration import (
    ROOM_T,
    Preintegrated,
    make_room,
    preintegrate,
    preintegrated_in,
)

seeds = st.integers(0, 2**32 - 1)
ENDS, START = KINDS + KINDS, ImuForm(1).start


FORMS = {
    form.name: form
    for samples in (0, 1, 4)
    for form in (ImuForm(samples, mount, gravity) for mount in (False, True) for gravity in (False, True))
}


def graph_of(
    z: np.ndarray, ends: list[np.ndarray], form: ImuForm | None = None, without: Sequence[int] = ()
) -> FactorGraph:
    """One factor, of samples alone without a form; the variables `without` come without values."""
    graph, kind = FactorGraph(), inertial_kind(form or sampled(z))
    keys = np.array([*keys_of(0), *keys_of(1), symbol("m", 0), symbol("g", 0)])[: len(ends)]
    variables = tuple(
        Variables(of, keys[n : n + 1], ends[n][None] if n not in without else None)
        for n, of in enumerate(kind.connects)
    )
    admit(graph, Batch(variables, (Factors(kind.name, keys[None], z[None], np.eye(15)[np.triu_indices(15)][None]),)))
    return graph


def sampled(z: np.ndarray) -> ImuForm:
    """The form of a measurement of samples, with nothing but the moments for variables."""
    return ImuForm((len(z) - ImuForm(1).start) // of.SAMPLE)


def linearized(z: np.ndarray, ends: list[np.ndarray], form: ImuForm | None = None) -> Linearized:
    return linearized_factor(graph_of(z, ends, form), 0)


@pytest.mark.parametrize("name", FORMS)
@examples(5)
@given(seed=seeds, mounted=st.booleans())
def test_residual_and_jacobians_are_those_of_the_dense_twin(name: str, seed: int, mounted: bool) -> None:
    rng, form = np.random.default_rng(seed), FORMS[name]
    z = random_imu(form, rng, mounted=mounted)
    ends = random_ends(form, z, rng)
    found, twin = linearized(z, ends, form), residual(name, ends, z)
    scale = np.abs(twin).max()
    np.testing.assert_allclose(found.r, twin, atol=1e-7 * scale)
    for n, J in enumerate(jacobians(name, list(form.ends), ends, z, 1e-4)):
        np.testing.assert_allclose(found.jacobian_of(n), J, atol=5e-7 * max(np.abs(J).max(), scale))


@given(seed=seeds)
def test_half_a_turn_off_has_finite_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    z = random_imu(ImuForm(3), rng)
    ends = random_ends(sampled(z), z, rng, off=0.0)
    axis = rng.normal(size=3)
    ends[3] = boxplus("se3", ends[3], np.array([0, 0, 0, *np.pi * axis / np.linalg.norm(axis)]))
    found = linearized(z, ends)
    assert np.isfinite(found.J).all()
    assert np.isfinite(found.r).all()


def ours(z: np.ndarray, bias: np.ndarray) -> tuple[Preintegrated, float]:
    room, form = make_room(), sampled(z)
    preintegrate(layout_of(form), z, bias, room, True)
    return preintegrated_in(room), float(room[ROOM_T])


def layout_of(form: ImuForm) -> ImuLayout:
    return imu_layout(form.samples, form.mount, len(form.ends))


def bias_of(z: np.ndarray) -> np.ndarray:
    return z[of.NOISE : of.NOISE + of.BIAS]


def gtsams(z: np.ndarray, bias: np.ndarray) -> gtsam.PreintegratedImuMeasurementsManifold:
    """Its way to integrate on the manifold, at that bias."""
    noise = gtsam.PreintegrationParams(GRAVITY)
    noise.setGyroscopeCovariance(np.eye(3) * z[of.GYROSCOPE] ** 2)
    noise.setAccelerometerCovariance(np.eye(3) * z[of.ACCELEROMETER] ** 2)
    noise.setIntegrationCovariance(np.eye(3) * z[of.INTEGRATION] ** 2)
    made = gtsam.PreintegratedImuMeasurementsManifold(noise, gtsam.imuBias.ConstantBias(bias[3:], bias[:3]))
    for h, *rates in samples(z, sampled(z)).tolist():
        made.integrateMeasurement(np.array(rates[3:]), np.array(rates[:3]), h)
    return made


def test_what_is_integrated_is_gtsams_on_a_thousand_sequences() -> None:
    rng = np.random.default_rng(38)
    for _ in range(1000):
        z = random_imu(ImuForm(int(rng.integers(2, 40))), rng)
        bias = bias_of(z)
        (delta, T), theirs = ours(z, bias), gtsams(z, bias)
        R = Rotation.from_quat(delta.q).as_matrix()
        assert pytest.approx(theirs.deltaTij(), rel=1e-12) == T
        np.testing.assert_allclose(R, theirs.deltaRij().matrix(), atol=1e-12)
        np.testing.assert_allclose(delta.p, theirs.deltaPij(), atol=1e-12)
        np.testing.assert_allclose(delta.v, theirs.deltaVij(), atol=1e-12)
        turned = np.eye(9)  # GTSAM's errors of position and velocity are in the frame where the samples end
        turned[3:6, 3:6] = turned[6:, 6:] = R.T
        wanted = theirs.preintMeasCov()
        found = turned @ propagate_noise(z, walk_samples(layout_of(sampled(z)), z)) @ turned.T
        np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())


def test_derivatives_by_the_bias_are_differences_of_gtsams_integrations() -> None:
    rng, h = np.random.default_rng(5), 1e-6
    for _ in range(50):
        z = random_imu(ImuForm(10), rng, 0.5)
        bias = bias_of(z)
        delta, _ = ours(z, bias)
        for c in range(6):
            plus, minus = (gtsams(z, bias + sign * h * np.eye(6)[c]) for sign in (1, -1))
            turn = Rotation.from_matrix(minus.deltaRij().matrix().T @ plus.deltaRij().matrix()).as_rotvec()
            wanted = delta.R_b[:, c] if c < 3 else np.zeros(3)
            np.testing.assert_allclose(turn / (2 * h), wanted, atol=1e-8)
            np.testing.assert_allclose(delta.p_b[:, c], (plus.deltaPij() - minus.deltaPij()) / (2 * h), atol=1e-8)
            np.testing.assert_allclose(delta.v_b[:, c], (plus.deltaVij() - minus.deltaVij()) / (2 * h), atol=1e-8)


def test_integrated_at_a_hundred_times_the_rate_it_is_the_same_to_the_order_of_a_sample() -> None:
    """A sample holds the acceleration in the frame it begins in; the error falls with its duration."""
    rng, worst = np.random.default_rng(2), []
    for parts in (1, 10):
        off = []
        for _ in range(4):
            z = random_imu(ImuForm(10), rng, 0.5, mounted=False)
            z = at_rate(z, parts)
            _, p, v, T = integrate(at_rate(z, 100)[START:].reshape(-1, of.SAMPLE), np.zeros(6))
            (delta, total) = ours(z, np.zeros(6))
            assert total == pytest.approx(T, rel=1e-12)
            off.append([np.abs(delta.p - p).max(), np.abs(delta.v - v).max()])
        worst.append(np.max(off, axis=0))
    assert (worst[0] < 0.5).all()
    assert (worst[1] < 0.2 * worst[0]).all()


def at_rate(z: np.ndarray, parts: int) -> np.ndarray:
    """The same with every sample cut into equal parts."""
    finer = np.repeat(samples(z, sampled(z)), parts, axis=0)
    finer[:, 0] /= parts
    return np.concatenate([z[:START], finer.ravel()])


def test_after_a_change_of_the_bias_nothing_is_left_to_first_order() -> None:
    """0.5 m/s² and 0.05 rad/s further ours is what integration anew is; the first-order form is off by much more."""
    rng, exact, first_order = np.random.default_rng(3), [], []
    for _ in range(50):
        z = random_imu(ImuForm(100), rng, 0.5)
        z[START :: of.SAMPLE] = 0.01
        bias = bias_of(z)
        step = np.concatenate([0.05 * direction(rng), 0.5 * direction(rng)])
        before, wanted = ours(z, bias)[0], gtsams(z, bias + step)
        ends = random_ends(sampled(z), z, rng, off=0.0)
        ends[2], ends[5] = bias + step, bias + step
        ends[3], ends[4] = follow(sampled(z), z, ends)
        exact.append(np.abs(ours(z, bias + step)[0].p - wanted.deltaPij()).max())
        first_order.append(np.abs(before.p + before.p_b @ step - wanted.deltaPij()).max())
        assert np.abs(linearized(z, ends).r).max() < 1e-6
    assert max(exact) < 1e-12
    assert min(first_order) > 1e-5


def direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def test_the_noise_is_what_noise_of_each_sample_does() -> None:
    z = random_imu(ImuForm(6), np.random.default_rng(1))
    wanted = covariance(sampled(z), z)
    np.testing.assert_allclose(
        propagate_noise(z, walk_samples(layout_of(sampled(z)), z)), wanted, atol=1e-8 * np.abs(wanted).max()
    )


@pytest.mark.parametrize("given", [3, 4, 5])
def test_what_has_no_value_follows_from_the_samples(given: int) -> None:
    rng = np.random.default_rng(given)
    z = random_imu(ImuForm(5), rng)
    ends = random_ends(sampled(z), z, rng, off=0.0)
    graph = graph_of(z, ends, without=range(given, 6))
    np.testing.assert_allclose(linearized_factor(graph, 0).r, 0.0, atol=1e-9)


def test_nothing_follows_backwards() -> None:
    rng = np.random.default_rng(1)
    z = random_imu(ImuForm(5), rng)
    ends, keys = random_ends(sampled(z), z, rng), np.array(keys_of(0) + keys_of(1))
    variables = [Variables(kind, keys[n : n + 1], ends[n][None] if n != 1 else None) for n, kind in enumerate(ENDS)]
    factor = Factors("imu_5", keys[None], z[None], np.eye(15)[np.triu_indices(15)][None])
    with pytest.raises(errors.Uninitialized, match="v0"):
        Solver(Options()).stage(Batch(tuple(variables), (factor,)))


BAD = {
    "a sample without duration": (START + of.SAMPLE, 0.0, "sample 1 lasts 0 s"),
    "gyroscopes without noise": (of.GYROSCOPE, 0.0, "above 0"),
    "a bias that stays": (of.ACCELEROMETER_WALK, -1.0, "above 0"),
    "negative noise of integration": (of.INTEGRATION, -1.0, "0 or more"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_is_refused(name: str) -> None:
    place, number, said = BAD[name]
    rng = np.random.default_rng(1)
    z = random_imu(ImuForm(3), rng)
    ends = random_ends(sampled(z), z, rng)
    z[place] = number
    with pytest.raises(errors.BadSamples, match=said):
        graph_of(z, ends)


def test_one_sample_without_noise_of_integration_leaves_something_certain() -> None:
    rng = np.random.default_rng(1)
    z = random_imu(ImuForm(1), rng)
    ends = random_ends(sampled(z), z, rng)
    z[of.INTEGRATION] = 0.0
    with pytest.raises(errors.BadSamples, match="singular"):
        graph_of(z, ends)
    z[START + 2] = np.nan
    with pytest.raises(errors.NotFinite):
        graph_of(z, ends)


@pytest.mark.parametrize(
    "name", ["imu_0", "imu_2001", "imu_", "imu_x", "imu_01", "imu_3_gravity_mount", "imu_preintegrated_arm"]
)
def test_there_is_no_kind_of_such_a_number_of_samples(name: str) -> None:
    assert name not in FACTOR_KINDS
    assert FACTOR_KINDS.get(name) is None
    assert any("1 to 2000" in each or "from 1 on" in each for each in FACTOR_KINDS.names(name))


def test_the_most_samples_there_may_be() -> None:
    rng = np.random.default_rng(1)
    z = random_imu(ImuForm(of.MOST_SAMPLES), rng, 0.1)
    ends = random_ends(sampled(z), z, rng, off=0.0)
    graph = graph_of(z, ends)
    assert graph.kind_of(0).name == "imu_2000"
    np.testing.assert_allclose(linearized_factor(graph, 0).r, 0.0, atol=1e-5)
