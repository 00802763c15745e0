"""The residual of inertial factors, whitened, by the formulas of `proto/README.md`, §3, in NumPy.  MATH §3.10."""

import numpy as np

from factorbus.proto import inertial as of
from factorbus.proto.arrays import F64


def inertial_residual(*ends_and_z: F64) -> F64:
    """r (m, 15) of m factors of one kind: values (m, …) of the six variables, and measurements (m, size)."""
    a, v, b, a2, v2, b2, z = ends_and_z
    samples = z[:, of.SAMPLES :].reshape(len(z), -1, of.SAMPLE)
    T, g = samples[:, :, 0].sum(axis=1)[:, None], z[:, of.GRAVITY : of.BIAS]
    R, p, dv, _ = _integrated(samples, b[:, :6], z)
    sigma = _integrated(samples, z[:, of.BIAS : of.SAMPLES], z)[3]
    A, A2 = _matrices(a[:, 3:7]), _matrices(a2[:, 3:7])
    back = A.transpose(0, 2, 1)
    r = np.column_stack(
        [
            _log(R.transpose(0, 2, 1) @ back @ A2),
            _times(back, a2[:, :3] - a[:, :3] - T * v[:, :3] - 0.5 * T * T * g) - p,
            _times(back, v2[:, :3] - v[:, :3] - T * g) - dv,
        ]
    )
    white = np.asarray(np.linalg.solve(np.linalg.cholesky(sigma), r[:, :, None])[:, :, 0], np.float64)
    walk = np.repeat(z[:, [of.GYROSCOPE_WALK, of.ACCELEROMETER_WALK]], 3, axis=1) * np.sqrt(T)
    return np.concatenate([white, (b2[:, :6] - b[:, :6]) / walk], axis=1, dtype=np.float64)


def _integrated(samples: F64, bias: F64, z: F64) -> tuple[F64, F64, F64, F64]:
    """ΔR (m, 3, 3), Δp, Δv (m, 3) and Σ (m, 9, 9) at biases (m, 6)."""
    m = len(samples)
    R, p, v, S = np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 3)), np.zeros((m, 3)), np.zeros((m, 9, 9))
    gyroscope, accelerometer, integration = (
        z[:, n, None, None] ** 2 for n in (of.GYROSCOPE, of.ACCELEROMETER, of.INTEGRATION)
    )
    for row in samples.transpose(1, 0, 2):
        h, turn, push = row[:, :1], row[:, 1:4] - bias[:, :3], row[:, 4:] - bias[:, 3:]
        t, (E, Jr) = h[:, :, None], _exponential(h * turn)
        F, N = np.tile(np.eye(9), (m, 1, 1)), np.zeros((m, 9, 9))
        RA = R @ _cross(push)
        F[:, :3, :3], F[:, 3:6, :3], F[:, 6:, :3] = E.transpose(0, 2, 1), -0.5 * t * t * RA, -t * RA
        F[:, 3:6, 6:] = t * np.eye(3)
        N[:, :3, :3] = gyroscope * Jr @ Jr.transpose(0, 2, 1)
        N[:, 3:6, 3:6] = (0.25 * t * t * accelerometer + integration) * np.eye(3)
        N[:, 3:6, 6:] = N[:, 6:, 3:6] = 0.5 * t * accelerometer * np.eye(3)
        N[:, 6:, 6:] = accelerometer * np.eye(3)
        S = F @ S @ F.transpose(0, 2, 1) + t * N
        pushed = _times(R, push)
        p, v, R = p + h * v + 0.5 * h * h * pushed, v + h * pushed, R @ E
    return R, p, v, S


def _times(M: F64, x: F64) -> F64:
    """M x of each row."""
    return np.einsum("mij,mj->mi", M, x)


def _cross(v: F64) -> F64:
    """⌊v⌋ of each row."""
    M = np.zeros((len(v), 3, 3))
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return M - M.transpose(0, 2, 1)


def _exponential(turn: F64) -> tuple[F64, F64]:
    """exp and right Jacobian (m, 3, 3) of rotation vectors."""
    angle = np.linalg.norm(turn, axis=1)[:, None, None]
    small = angle < 1e-4
    safe, X = np.where(small, 1.0, angle), _cross(turn)
    a = np.where(small, 1.0 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + a * X + b * (X @ X), np.eye(3) - b * X + c * (X @ X)


def _matrices(quat: F64) -> F64:
    """(m, 3, 3) of quaternions qx qy qz qw."""
    X = _cross(quat[:, :3])
    return np.eye(3) + 2 * quat[:, 3, None, None] * X + 2 * X @ X


def _log(R: F64) -> F64:
    """Rotation vectors (m, 3).  Half a turn has one of the two that there are."""
    sine = 0.5 * np.column_stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]])
    cosine = 0.5 * (np.trace(R, axis1=1, axis2=2) - 1)
    length = np.linalg.norm(sine, axis=1)
    angle = np.arctan2(length, cosine)
    # Near half a turn the axis is in the symmetric part, R + Rᵀ = 2 cos θ + 2 (1 − cos θ) n nᵀ.
    square = np.clip((np.diagonal(R, axis1=1, axis2=2) - cosine[:, None]) / (1 - cosine + 1e-300)[:, None], 0, None)
    signs = np.where(sine < 0, -1.0, 1.0)
    usual = sine * np.where(length > 1e-12, angle / np.maximum(length, 1e-300), 1.0)[:, None]
    return np.where((cosine < -0.99)[:, None], angle[:, None] * signs * np.sqrt(square), usual)
