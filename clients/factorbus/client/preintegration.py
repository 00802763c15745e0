"""Samples of an IMU integrated by the client: what `Draft.imu_preintegrated` sends, in a fifth of the bytes.

    made = preintegrate_samples(samples, noise, bias)
    Draft().imu_preintegrated(("x0", "v0", "b0"), ("x1", "v1", "b1"), made)

By the equations of MATH §3.10, in NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import all_finite, as_numbers, checked_row, of_type, seen
from factorbus.client.imu import STANDARD_GRAVITY, ImuNoise, Moments, checked_samples
from factorbus.client.imu_samples import warn_implausible
from factorbus.proto.arrays import F64
from factorbus.proto.inertial import BIAS, RESIDUAL
from factorbus.proto.problems import BadInformation, BadOption, BadShape

_SHAPES = {
    "attitude": (4,),
    "position": (3,),
    "velocity": (3,),
    "bias": (BIAS,),
    "attitude_by_bias": (3, 3),
    "position_by_bias": (3, BIAS),
    "velocity_by_bias": (3, BIAS),
    "covariance": (RESIDUAL, RESIDUAL),
}
_TOLERANCE = 1e-3  # how far a quaternion may be from unit length


@dataclass(frozen=True, slots=True, eq=False)
class PreintegratedImu:
    """What an IMU measured between two moments, integrated at a bias, in the frame where it begins.

    duration: T, seconds.  attitude (4,): Delta R, qx qy qz qw.  position, velocity (3,): Delta p, Delta v, metres, m/s.
    bias (6,): at which it was integrated, gyroscopes (rad/s), then accelerometers (m/s²).
    attitude_by_bias (3, 3): what Delta R turns by, about its own axes, by that of the gyroscopes.  position_by_bias,
    velocity_by_bias (3, 6).
    covariance (15, 15): of the rotation (of Delta R about its own axes), position, velocity, and of how the bias
    wanders in that time.
    Raises BadShape, NotFiniteNumbers, BadOption, BadInformation.
    """

    duration: float
    attitude: F64
    position: F64
    velocity: F64
    bias: F64
    attitude_by_bias: F64
    position_by_bias: F64
    velocity_by_bias: F64
    covariance: F64

    def __post_init__(self) -> None:
        for name, shape in _SHAPES.items():
            given = all_finite(
                f"PreintegratedImu: {name}", as_numbers(f"PreintegratedImu: {name}", getattr(self, name))
            )
            if given.shape != shape:
                raise BadShape(f"PreintegratedImu: {name}", f"shape {given.shape}", f"shape {shape}")
            object.__setattr__(self, name, given)
        if not (np.isfinite(self.duration) and self.duration > 0.0):
            raise BadOption("PreintegratedImu: duration", seen(self.duration), "more than 0 s")
        if not abs(np.linalg.norm(self.attitude) - 1.0) <= _TOLERANCE:
            raise BadShape("PreintegratedImu: attitude", f"length {np.linalg.norm(self.attitude):g}", "1: qx qy qz qw")

    @property
    def numbers(self) -> F64:
        """As a measurement has them, but for the bias."""
        derivatives = self.attitude_by_bias, self.position_by_bias, self.velocity_by_bias
        rows = [self.attitude, self.position, self.velocity, *(each.ravel() for each in derivatives)]
        return np.concatenate([[self.duration], *rows])

    @property
    def information(self) -> F64:
        """(15, 15) of the residual.  Raises BadInformation: the covariance is singular, as of a single sample."""
        scale = np.sqrt(np.maximum(self.covariance.diagonal(), 0.0))
        if (scale > 0.0).all():
            correlation = self.covariance / scale / scale[:, None]
            least = float(np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0])
        else:
            correlation, least = np.eye(RESIDUAL), 0.0
        if least < 1e-13:
            wanted = "a positive definite one: more samples, or noise of integration, 1e-4 m/√s say"
            raise BadInformation("PreintegratedImu: covariance", f"singular (least eigenvalue {least:.2g})", wanted)
        inverse = np.linalg.inv(correlation) / scale / scale[:, None]
        return 0.5 * (inverse + inverse.T)


def preintegrate_samples(samples: ArrayLike, noise: ImuNoise, bias: ArrayLike = (0.0,) * BIAS) -> PreintegratedImu:
    """The samples (n, 7) of `cut_samples` as one measurement, integrated at `bias`, the best guess of it.

    Good while the bias stays near that: the map corrects what was integrated to first order.
    ImplausibleSamples warns as of `Draft.imu`.  Raises BadShape, BadOption, NotFiniteNumbers.
    """
    rows, sensor = checked_samples("samples", samples), of_type("noise", noise, ImuNoise, "an ImuNoise")
    warn_implausible(rows, np.array([0.0, 0.0, -STANDARD_GRAVITY]), stacklevel=3)
    b = checked_row("bias", bias, BIAS)
    R, p, v, S = np.eye(3), np.zeros(3), np.zeros(3), np.zeros((9, 9))
    R_b, p_b, v_b = np.zeros((3, 3)), np.zeros((3, 6)), np.zeros((3, 6))
    for row in rows:
        h, turn, push = row[0], row[0] * (row[1:4] - b[:3]), row[4:] - b[3:]
        E, Jr = _exponential(turn)
        RA = R @ _cross(push)
        by_bias = np.hstack([RA @ R_b, R])
        S = _carried(S, h, E, RA) + _added(h, R, Jr, sensor)
        p_b, v_b = p_b + h * v_b - 0.5 * h * h * by_bias, v_b - h * by_bias
        R_b = E.T @ R_b - h * Jr
        p, v = p + h * v + 0.5 * h * h * (R @ push), v + h * (R @ push)
        R = R @ E
    T, covariance = float(rows[:, 0].sum()), np.zeros((RESIDUAL, RESIDUAL))
    covariance[:9, :9] = S
    walk = np.repeat([sensor.gyroscope_walk, sensor.accelerometer_walk], 3)
    covariance[range(9, RESIDUAL), range(9, RESIDUAL)] = walk**2 * T
    return PreintegratedImu(T, _quaternion(R), p, v, b, R_b, p_b, v_b, covariance)


def preintegrated_factor(of: Moments, made: PreintegratedImu) -> tuple[str, F64]:
    """(kind, measurement) of a factor; see `Draft.imu_preintegrated`."""
    return of.form.name, np.concatenate([made.bias, of.gravity, of.mount, made.numbers])


def _carried(S: F64, h: float, E: F64, RA: F64) -> F64:
    """F S Fᵀ.  (3.46)"""
    F = np.eye(9)
    F[:3, :3], F[3:6, :3], F[6:, :3], F[3:6, 6:] = E.T, -0.5 * h * h * RA, -h * RA, h * np.eye(3)
    return F @ S @ F.T


def _added(h: float, R: F64, Jr: F64, noise: ImuNoise) -> F64:
    """N (9, 9) of a sample."""
    N, one = np.zeros((9, 9)), np.eye(3)
    pushed = noise.accelerometer**2 * h
    N[:3, :3] = noise.gyroscope**2 * h * Jr @ Jr.T
    N[3:6, 3:6] = (0.25 * h * h * pushed + noise.integration**2 * h) * one
    N[3:6, 6:] = N[6:, 3:6] = 0.5 * h * pushed * one
    N[6:, 6:] = pushed * one
    return N


def _cross(u: F64) -> F64:
    """⌊u⌋."""
    return np.array([[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]])


def _exponential(turn: F64) -> tuple[F64, F64]:
    """exp ⌊φ⌋ and the right Jacobian Jr(φ) (3, 3)."""
    square, X = float(turn @ turn), _cross(turn)
    angle = square**0.5
    if square < 1e-4:
        a, b = 1.0 - square / 6.0 * (1.0 - square / 20.0), 0.5 - square / 24.0 * (1.0 - square / 30.0)
        c = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0)
    else:
        a, b = np.sin(angle) / angle, 2.0 * np.sin(0.5 * angle) ** 2 / square
        c = (1.0 - a) / square
    return np.eye(3) + a * X + b * (X @ X), np.eye(3) - b * X + c * (X @ X)


def _quaternion(R: F64) -> F64:
    """qx qy qz qw of a rotation: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    K = np.empty((4, 4))
    K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    K[:3, 3] = K[3, :3] = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
    K[3, 3] = np.trace(R)
    q = np.linalg.eigh(K)[1][:, -1]
    return -q if q[3] < 0.0 else q
