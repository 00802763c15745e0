"""What an IMU says, written with matrices and scipy's rotations: the twin of the inertial kernels.

Axes before the last one are of several at once, as in `dense_factors`.
"""

import numpy as np
from naive.dense_poses import joined, motion, pose_matrix, pose_vector, rotation, rotation_vector, times, turned

from factorbus.proto import inertial as of
from factorbus.proto.inertial import ImuForm

Delta = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
IDENTITY = np.array([0, 0, 0, 0, 0, 0, 1.0])


def samples(z: np.ndarray, form: ImuForm) -> np.ndarray:
    """(n, 7) of a measurement: duration, gyroscopes, accelerometers."""
    return z[..., form.start :].reshape(*z.shape[:-1], -1, of.SAMPLE)


def integrate(rows: np.ndarray, bias: np.ndarray) -> Delta:
    """ΔR (3, 3), Δp, Δv, T of samples (n, 7) at a bias."""
    durations, rates = rows[..., :1], rows[..., 1:] - bias[..., None, :]
    turns, R = turned(durations * rates[..., :3]), np.eye(3)
    p, v = np.zeros(3), np.zeros(3)
    for n in range(rows.shape[-2]):
        h, a = durations[..., n, :], times(R, rates[..., n, 3:])
        p = p + h * v + 0.5 * h * h * a
        v = v + h * a
        R = R @ turns[..., n, :, :]
    return R, p, v, durations[..., 0].sum(axis=-1)


def corrected(z: np.ndarray, form: ImuForm, bias: np.ndarray) -> Delta:
    """The same of what is integrated already, to first order in the bias."""
    T, q, p, v, R_b, p_b, v_b = np.split(z[..., form.start :], np.cumsum([1, 4, 3, 3, 9, 18]), axis=-1)
    off = bias - z[..., : of.BIAS]

    def by(J: np.ndarray, change: np.ndarray) -> np.ndarray:
        return times(J.reshape(*J.shape[:-1], 3, -1), change)

    R = rotation(q) @ turned(by(R_b, off[..., :3]))
    return R, p + by(p_b, off), v + by(v_b, off), T[..., 0]


def delta(z: np.ndarray, form: ImuForm, bias: np.ndarray) -> Delta:
    return integrate(samples(z, form), bias) if form.samples else corrected(z, form, bias)


def split(ends: list[np.ndarray], z: np.ndarray, form: ImuForm) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """The six variables of the moments, the mount as a matrix, and gravity."""
    further = list(ends[of.MOMENTS :])
    mount = further.pop(0) if form.mount else z[..., form.mount_at : form.mount_at + of.MOUNT]
    gravity = further.pop(0) if form.gravity else z[..., form.gravity_at : form.gravity_at + of.GRAVITY]
    return list(ends[: of.MOMENTS]), pose_matrix(mount), gravity


def follow(form: ImuForm, z: np.ndarray, ends: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The pose and the velocity that samples lead to; ends: of the first moment, and mount and gravity behind the
    second one's, which are not looked at."""
    (pose, velocity, bias, *_), mount, g = split(ends, z, form)
    R, p, v, T = delta(z, form, bias)
    at = pose_matrix(pose) @ mount
    after = motion(at[:3, :3] @ R, at[:3, 3] + T * velocity + 0.5 * T * T * g + at[:3, :3] @ p)
    return pose_vector(after @ np.linalg.inv(mount)), velocity + T * g + at[:3, :3] @ v


def covariance(form: ImuForm, z: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Σ (9, 9) of (rotation, position, velocity): what noise of each sample does to Δ, by central differences."""
    bias, rows = z[form.bias_at : form.bias_at + of.BIAS], samples(z, form)
    R0, n = integrate(rows, bias)[0], len(rows)

    def off(step: float) -> np.ndarray:
        """(n, 6, 9), with a step of each number of each sample."""
        moved = np.broadcast_to(rows, (n, 6, n, of.SAMPLE)).copy()
        moved[np.arange(n)[:, None], np.arange(6), np.arange(n)[:, None], 1 + np.arange(6)] += step
        R, p, v, _ = integrate(moved, bias)
        return joined(rotation_vector(R0.T @ R), p, v)

    J, sigmas = (off(h) - off(-h)) / (2 * h), np.repeat(z[[of.GYROSCOPE, of.ACCELEROMETER]], 3)
    total = np.einsum("nci,ncj,nc->ij", J, J, sigmas**2 / rows[:, :1])
    total[3:6, 3:6] += np.eye(3) * z[of.INTEGRATION] ** 2 * rows[:, 0].sum()  # a place that is off stays off
    return total


def residual(form: ImuForm, ends: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    """r (15,), of samples whitened."""
    (a, v, b, a2, v2, b2), mount, g = split(ends, z, form)
    R, p, dv, T = delta(z, form, b)
    A, A2, T = pose_matrix(a) @ mount, pose_matrix(a2) @ mount, T[..., None]
    back = np.swapaxes(A[..., :3, :3], -1, -2)
    r = joined(
        rotation_vector(np.swapaxes(R, -1, -2) @ back @ A2[..., :3, :3]),
        times(back, A2[..., :3, 3] - A[..., :3, 3] - v * T - 0.5 * g * T * T) - p,
        times(back, v2 - v - g * T) - dv,
    )
    if not form.samples:
        return joined(r, b2 - b)
    walk = np.repeat(z[..., [of.GYROSCOPE_WALK, of.ACCELEROMETER_WALK]], 3, axis=-1) * np.sqrt(T)
    roots = np.array([np.linalg.cholesky(whitening(form, row)) for row in z.reshape(-1, z.shape[-1])])
    return joined(np.linalg.solve(roots.reshape(*z.shape[:-1], 9, 9), r[..., None])[..., 0], (b2 - b) / walk)


_KNOWN: dict[bytes, np.ndarray] = {}


def whitening(form: ImuForm, z: np.ndarray) -> np.ndarray:
    """`covariance`, found once for each measurement."""
    key = z.tobytes()
    if key not in _KNOWN:
        _KNOWN[key] = covariance(form, z)
    return _KNOWN[key]
