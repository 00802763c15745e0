"""What is integrated already: against GTSAM's ImuFactor and CombinedImuFactor, and against its samples."""

from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X
from naive.random_imu import GRAVITY, NOISE, keys_of, random_ends, random_samples
from scipy.spatial.transform import Rotation

from factorbus.client import Draft, ImuNoise, PreintegratedImu, preintegrate_samples
from factorbus.proto.inertial import ImuForm
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.problems import BadInformation
from factorbus.solver import errors
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.linearized import Linearized, linearized_factor

KINDS, FORM = ("se3", "vector3", "vector6") * 2, ImuForm(0)
A, AFTER = ("x0", "v0", "b0"), ("x1", "v1", "b1")
SENSOR = ImuNoise(*NOISE)


def batch_of(made: PreintegratedImu, ends: list[np.ndarray]) -> Batch:
    keys = np.array(keys_of(0) + keys_of(1))
    variables = tuple(Variables(kind, keys[n : n + 1], ends[n][None]) for n, kind in enumerate(KINDS))
    draft = Draft().imu_preintegrated(A, AFTER, made, gravity=GRAVITY)
    return Batch(variables, draft.batch().factors)


def linearized(made: PreintegratedImu, ends: list[np.ndarray]) -> Linearized:
    graph = FactorGraph()
    admit(graph, batch_of(made, ends))
    return linearized_factor(graph, 0)


def params() -> gtsam.PreintegrationCombinedParams:
    noise = gtsam.PreintegrationCombinedParams(GRAVITY)
    noise.setGyroscopeCovariance(np.eye(3) * SENSOR.gyroscope**2)
    noise.setAccelerometerCovariance(np.eye(3) * SENSOR.accelerometer**2)
    noise.setIntegrationCovariance(np.eye(3) * SENSOR.integration**2)
    noise.setBiasAccCovariance(np.eye(3) * SENSOR.accelerometer_walk**2)
    noise.setBiasOmegaCovariance(np.eye(3) * SENSOR.gyroscope_walk**2)
    return noise


def gtsam_bias(bias: np.ndarray) -> gtsam.imuBias.ConstantBias:
    return gtsam.imuBias.ConstantBias(bias[3:], bias[:3])


def gtsam_pose(x: np.ndarray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(Rotation.from_quat(x[3:]).as_matrix()), x[:3])


def as_theirs(r: np.ndarray, ends: list[np.ndarray]) -> np.ndarray:
    """Our residual as GTSAM has it: from the pose at the end, the other way round, accelerometers first; and of
    rotation, place and velocity together the logarithm in SE₂(3)."""
    turn = Rotation.from_quat(ends[3][3:]).inv() * Rotation.from_quat(ends[0][3:])
    return logarithm(np.concatenate([-r[:3], -turn.apply(r[3:6]), -turn.apply(r[6:9]), -r[12:], -r[9:12]]))


def logarithm(u: np.ndarray) -> np.ndarray:
    """Of (log R, p, v) that of (R, p, v): Jl⁻¹(φ) on p and v."""
    angle, X_ = np.linalg.norm(u[:3]), cross(u[:3])
    left = np.eye(3) + (1 - np.cos(angle)) / angle**2 * X_ + (angle - np.sin(angle)) / angle**3 * X_ @ X_
    return np.concatenate([u[:3], np.linalg.solve(left, u[3:6]), np.linalg.solve(left, u[6:9]), u[9:]])


def cross(u: np.ndarray) -> np.ndarray:
    """⌊u⌋."""
    return np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])


def jacobians_as_theirs(found: Linearized, ends: list[np.ndarray]) -> list[np.ndarray]:
    """Of these six variables, rotations before translations and accelerometers first."""
    C = (Rotation.from_quat(ends[3][3:]).inv() * Rotation.from_quat(ends[0][3:])).as_matrix()
    M, made, swap, h = np.zeros((15, 15)), list[np.ndarray](), [3, 4, 5, 0, 1, 2], 1e-5
    M[:3, :3], M[3:6, 3:6], M[6:9, 6:9] = -np.eye(3), -C, -C
    M[9:12, 12:], M[12:, 9:12] = -np.eye(3), -np.eye(3)
    u = M @ found.r
    L = np.column_stack([(logarithm(u + h * e) - logarithm(u - h * e)) / (2 * h) for e in np.eye(15)])
    for n in range(6):
        J = M @ found.jacobian_of(n)
        for rows in (slice(3, 6), slice(6, 9)):  # and C itself moves
            if n == 0:
                J[rows, 3:] += C @ cross(found.r[rows])
            if n == 3:
                J[rows, 3:] += -cross(C @ found.r[rows])
        J = L @ J
        made.append(J[:, swap] if n % 3 != 1 else J)
    return made


@pytest.mark.parametrize("seed", range(20))
def test_residual_and_jacobians_are_those_of_gtsams_imu_factor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, bias = random_samples(12, rng), rng.normal(0, 0.05, 6)
    theirs = gtsam.PreintegratedImuMeasurements(params(), gtsam_bias(bias))
    for row in rows:
        theirs.integrateMeasurement(row[4:], row[1:4], row[0])
    made = from_gtsam(theirs, bias, np.eye(15))
    z = np.concatenate([bias, GRAVITY, np.array([0, 0, 0, 0, 0, 0, 1.0]), made.numbers])
    ends = random_ends(FORM, z, rng, 0.1)
    ends[2] = bias  # further off its correction is to first order in other numbers
    ours = linearized(made, ends)
    factor = gtsam.ImuFactor(X(0), V(0), X(1), V(1), B(0), theirs)
    H = [np.zeros((9, d), order="F") for d in (6, 3, 6, 3, 6)]
    error = factor.evaluateError(gtsam_pose(ends[0]), ends[1], gtsam_pose(ends[3]), ends[4], gtsam_bias(bias), *H)
    np.testing.assert_allclose(as_theirs(ours.r, ends)[:9], error, atol=1e-9)
    J = jacobians_as_theirs(ours, ends)
    for n, wanted in zip((0, 1, 3, 4, 2), H, strict=True):
        np.testing.assert_allclose(J[n][:9], wanted, atol=1e-7 * np.abs(wanted).max(), err_msg=str(n))


@pytest.mark.parametrize("seed", range(5))
def test_with_its_covariance_chi2_is_that_of_gtsams_combined_imu_factor(seed: int) -> None:
    """All 15 × 15, with what the walk of the bias has to do with the rest."""
    rng = np.random.default_rng(seed)
    rows, bias = random_samples(12, rng), rng.normal(0, 0.05, 6)
    theirs = gtsam.PreintegratedCombinedMeasurements(params(), gtsam_bias(bias))
    for row in rows:
        theirs.integrateMeasurement(row[4:], row[1:4], row[0])
    M = turned(theirs)
    made = from_gtsam(theirs, bias, M @ theirs.residualCovariance() @ M.T)
    z = np.concatenate([bias, GRAVITY, np.array([0, 0, 0, 0, 0, 0, 1.0]), made.numbers])
    ends = random_ends(FORM, z, rng, 0.02)
    ends[2] = bias
    graph = FactorGraph()
    admit(graph, batch_of(made, ends))
    found = linearized_factor(graph, 0)
    values = gtsam.Values()
    for n in range(2):
        values.insert(X(n), gtsam_pose(ends[3 * n]))
        values.insert(V(n), ends[3 * n + 1])
        values.insert(B(n), gtsam_bias(ends[3 * n + 2]))
    factor = gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), theirs)
    error = M @ as_theirs(found.r, ends)
    assert error @ found.W @ error == pytest.approx(2.0 * factor.error(values), rel=1e-7)


def from_gtsam(theirs: Any, bias: np.ndarray, covariance: np.ndarray) -> PreintegratedImu:
    """What GTSAM has integrated at `bias`.  Derivatives by it are not among what its wrapper tells, but differences of
    what it predicts are; covariance: of our 15 numbers."""
    h, J = 1e-5, np.empty((9, 6))
    R, p, v = predicted(theirs, bias)
    for c in range(6):
        ahead, back = (predicted(theirs, bias + sign * h * np.eye(6)[c]) for sign in (1, -1))
        turn = Rotation.from_matrix(back[0].T @ ahead[0]).as_rotvec()
        J[:, c] = np.concatenate([turn, ahead[1] - back[1], ahead[2] - back[2]]) / (2 * h)
    q = Rotation.from_matrix(R).as_quat()
    return PreintegratedImu(theirs.deltaTij(), q, p, v, bias, J[:3, :3], J[3:6], J[6:], covariance)


def predicted(theirs: Any, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Δ, corrected to that bias."""
    T, state = theirs.deltaTij(), theirs.predict(gtsam.NavState(), gtsam_bias(bias))
    return state.attitude().matrix(), state.position() - 0.5 * T * T * GRAVITY, state.velocity() - T * GRAVITY


def turned(theirs: Any) -> np.ndarray:
    """(15, 15) from what their covariance is of to what ours is: from where the samples begin, gyroscopes first."""
    M, R = np.zeros((15, 15)), theirs.deltaRij().matrix()
    M[:3, :3], M[3:6, 3:6], M[6:9, 6:9] = np.eye(3), R, R
    M[9:12, 12:], M[12:, 9:12] = np.eye(3), np.eye(3)
    return M


def test_what_the_client_integrates_is_what_the_service_would() -> None:
    """At the bias it was integrated at χ², gradient and Λ are those of the samples; away from it nearly."""
    rng = np.random.default_rng(7)
    rows, bias = random_samples(30, rng, 0.3), rng.normal(0, 0.02, 6)
    made = preintegrate_samples(rows, SENSOR, bias)
    z = np.concatenate([bias, GRAVITY, np.array([0, 0, 0, 0, 0, 0, 1.0]), made.numbers])
    for off, share in ((0.0, 1e-9), (0.01, 1e-2)):
        ends = random_ends(FORM, z, np.random.default_rng(8), 0.01)
        ends[2] = bias + off
        batch, graph = batch_of(made, ends), FactorGraph()
        sampled = Draft().imu(A, AFTER, rows, noise=SENSOR, gravity=GRAVITY, bias=bias)
        admit(graph, Batch(batch.variables, sampled.batch().factors))
        ours, wanted = linearized(made, ends), linearized_factor(graph, 0)
        J, K = (np.hstack([each.jacobian_of(n) for n in range(6)]) for each in (ours, wanted))
        for found, known in (
            (ours.r @ ours.W @ ours.r, wanted.r @ wanted.W @ wanted.r),
            (J.T @ ours.W @ J, K.T @ wanted.W @ K),
        ):
            np.testing.assert_allclose(found, known, atol=share * np.abs(known).max())


def test_what_cannot_be_is_refused() -> None:
    rng = np.random.default_rng(1)
    made = preintegrate_samples(random_samples(5, rng), SENSOR)
    z = np.concatenate([made.bias, GRAVITY, np.array([0, 0, 0, 0, 0, 0, 1.0]), made.numbers])
    ends = random_ends(FORM, z, rng)
    good = batch_of(made, ends)
    for place, number, error, said in (
        (FORM.start, 0.0, errors.BadSamples, "a duration of 0 s"),
        (FORM.start + 4, 3.0, errors.BadQuaternion, "length"),
        (FORM.mount_at + 6, 0.5, errors.BadQuaternion, "length 0.5"),
        (FORM.start + 20, np.nan, errors.NotFinite, "NaN"),
    ):
        measured = good.factors[0].measured.copy()
        measured[0, place] = number
        with pytest.raises(error, match=said):
            admit(FactorGraph(), good._replace(factors=(good.factors[0]._replace(measured=measured),)))
    with pytest.raises(BadInformation, match="singular"):
        assert preintegrate_samples(random_samples(1, rng), ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)).information is None
