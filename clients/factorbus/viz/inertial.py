"""The residual of inertial factors, whitened, by the formulas of `proto/README.md`, §3, in NumPy.  MATH §3.10."""

import numpy as np

from factorbus.proto import inertial as of
from factorbus.proto.arrays import F64
from factorbus.proto.inertial import ImuForm


def inertial_residual(form: ImuForm, *ends_and_z: F64) -> F64:
    """r (m, 15) of m factors of one kind: values (m, …) of their variables, and measurements (m, size)."""
    *ends, z = ends_and_z
    b, b2 = ends[2][:, : of.BIAS], ends[5][:, : of.BIAS]
    m = ends[of.MOMENTS] if form.mount else z[:, form.mount_at : form.mount_at + of.MOUNT]
    g = ends[-1][:, :3] if form.gravity else z[:, form.gravity_at : form.gravity_at + 3]
    R, p, dv, T = _corrected(z, form, b) if form.samples == 0 else _integrated(_samples(z, form), b)
    (A, t), (A2, t2) = (_sensor(ends[n], m) for n in (0, 3))
    back, v, v2 = A.transpose(0, 2, 1), ends[1][:, :3], ends[4][:, :3]
    r = np.column_stack(
        [
            _log(R.transpose(0, 2, 1) @ back @ A2),
            _times(back, t2 - t - T * v - 0.5 * T * T * g) - p,
            _times(back, v2 - v - T * g) - dv,
        ]
    )
    if form.samples == 0:
        return np.concatenate([r, b2 - b], axis=1, dtype=np.float64)
    sigma = _noise(z, form)
    white = np.asarray(np.linalg.solve(np.linalg.cholesky(sigma), r[:, :, None])[:, :, 0], np.float64)
    walk = np.repeat(z[:, [of.GYROSCOPE_WALK, of.ACCELEROMETER_WALK]], 3, axis=1) * np.sqrt(T)
    return np.concatenate([white, (b2 - b) / walk], axis=1, dtype=np.float64)


def _samples(z: F64, form: ImuForm) -> F64:
    """(m, n, 7)."""
    return z[:, form.start :].reshape(len(z), form.samples, of.SAMPLE)


def _sensor(pose: F64, mount: F64) -> tuple[F64, F64]:
    """Rotations (m, 3, 3) and places (m, 3) of a ∘ m."""
    R = _matrices(pose[:, 3:7])
    return R @ _matrices(mount[:, 3:7]), pose[:, :3] + _times(R, mount[:, :3])


def _corrected(z: F64, form: ImuForm, bias: F64) -> tuple[F64, F64, F64, F64]:
    """ΔR (m, 3, 3), Δp, Δv (m, 3) and T (m, 1) of what is integrated already, at biases (m, 6)."""
    T, q, p, v, R_b, p_b, v_b = np.split(z[:, form.start :], np.cumsum([1, 4, 3, 3, 9, 18]), axis=1)
    off = bias - z[:, : of.BIAS]
    R = _matrices(q) @ _exponential(_times(R_b.reshape(-1, 3, 3), off[:, :3]))[0]
    return R, p + _times(p_b.reshape(-1, 3, 6), off), v + _times(v_b.reshape(-1, 3, 6), off), T


def _integrated(samples: F64, bias: F64) -> tuple[F64, F64, F64, F64]:
    """The same of samples (m, n, 7)."""
    m = len(samples)
    R, p, v = np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 3)), np.zeros((m, 3))
    for row in samples.transpose(1, 0, 2):
        h, turn, push = row[:, :1], row[:, 1:4] - bias[:, :3], row[:, 4:] - bias[:, 3:]
        pushed = _times(R, push)
        p, v, R = p + h * v + 0.5 * h * h * pushed, v + h * pushed, R @ _exponential(h * turn)[0]
    return R, p, v, samples[:, :, 0].sum(axis=1)[:, None]


def _noise(z: F64, form: ImuForm) -> F64:
    """Σ (m, 9, 9) at the biases that are measured."""
    bias, m = z[:, form.bias_at : form.bias_at + of.BIAS], len(z)
    R, S = np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 9, 9))
    gyroscope, accelerometer, integration = (
        z[:, n, None, None] ** 2 for n in (of.GYROSCOPE, of.ACCELEROMETER, of.INTEGRATION)
    )
    for row in _samples(z, form).transpose(1, 0, 2):
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
        S, R = F @ S @ F.transpose(0, 2, 1) + t * N, R @ E
    return S


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
