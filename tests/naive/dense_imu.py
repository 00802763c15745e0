"""What an IMU says, written with matrices and scipy's rotations: the twin of the inertial kernels."""

import numpy as np
from naive.dense_poses import pose_matrix, pose_vector
from scipy.spatial.transform import Rotation

from factorbus.proto import inertial as of
from factorbus.proto.inertial import ImuForm

Delta = tuple[np.ndarray, np.ndarray, np.ndarray, float]
IDENTITY = np.array([0, 0, 0, 0, 0, 0, 1.0])


def samples(z: np.ndarray, form: ImuForm) -> np.ndarray:
    """(n, 7) of a measurement: duration, gyroscopes, accelerometers."""
    return z[form.start :].reshape(-1, of.SAMPLE)


def integrate(rows: np.ndarray, bias: np.ndarray) -> Delta:
    """ΔR (3, 3), Δp, Δv, T of samples (n, 7) at a bias."""
    R, p, v, total = np.eye(3), np.zeros(3), np.zeros(3), 0.0
    for h, *rates in rows.tolist():
        w, a = np.split(np.array(rates) - bias, 2)
        p = p + h * v + 0.5 * h * h * R @ a
        v = v + h * R @ a
        R = R @ Rotation.from_rotvec(h * w).as_matrix()
        total += h
    return R, p, v, total


def corrected(z: np.ndarray, form: ImuForm, bias: np.ndarray) -> Delta:
    """The same of what is integrated already, to first order in the bias."""
    T, q, p, v, R_b, p_b, v_b = np.split(z[form.start :], np.cumsum([1, 4, 3, 3, 9, 18]))
    off = bias - z[: of.BIAS]
    turn = Rotation.from_rotvec(R_b.reshape(3, 3) @ off[:3])
    R = (Rotation.from_quat(q) * turn).as_matrix()
    return R, p + p_b.reshape(3, 6) @ off, v + v_b.reshape(3, 6) @ off, float(T[0])


def delta(z: np.ndarray, form: ImuForm, bias: np.ndarray) -> Delta:
    return integrate(samples(z, form), bias) if form.samples else corrected(z, form, bias)


def split(ends: list[np.ndarray], z: np.ndarray, form: ImuForm) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """The six variables of the moments, the mount as a matrix, and gravity."""
    further = list(ends[of.MOMENTS :])
    mount = further.pop(0) if form.mount else z[form.mount_at : form.mount_at + of.MOUNT]
    gravity = further.pop(0) if form.gravity else z[form.gravity_at : form.gravity_at + of.GRAVITY]
    return list(ends[: of.MOMENTS]), pose_matrix(mount), gravity


def follow(form: ImuForm, z: np.ndarray, ends: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The pose and the velocity that samples lead to; ends: of the first moment, and mount and gravity behind the
    second one's, which are not looked at."""
    (pose, velocity, bias, *_), mount, g = split(ends, z, form)
    R, p, v, T = delta(z, form, bias)
    at = pose_matrix(pose) @ mount
    after = np.eye(4)
    after[:3, :3] = at[:3, :3] @ R
    after[:3, 3] = at[:3, 3] + T * velocity + 0.5 * T * T * g + at[:3, :3] @ p
    return pose_vector(after @ np.linalg.inv(mount)), velocity + T * g + at[:3, :3] @ v


def covariance(form: ImuForm, z: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Σ (9, 9) of (rotation, position, velocity): what noise of each sample does to Δ, by central differences."""
    bias, rows, total = z[form.bias_at : form.bias_at + of.BIAS], samples(z, form), np.zeros((9, 9))
    R0 = integrate(rows, bias)[0]

    def off(n: int, c: int, step: float) -> np.ndarray:
        moved = rows.copy()
        moved[n, 1 + c] += step
        R, p, v, _ = integrate(moved, bias)
        return np.concatenate([Rotation.from_matrix(R0.T @ R).as_rotvec(), p, v])

    for n, duration in enumerate(rows[:, 0].tolist()):
        for c in range(6):
            J = (off(n, c, h) - off(n, c, -h)) / (2 * h)
            total += np.outer(J, J) * z[of.GYROSCOPE if c < 3 else of.ACCELEROMETER] ** 2 / duration
    total[3:6, 3:6] += np.eye(3) * z[of.INTEGRATION] ** 2 * rows[:, 0].sum()  # a place that is off stays off
    return total


def residual(form: ImuForm, ends: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    """r (15,), of samples whitened."""
    (a, v, b, a2, v2, b2), mount, g = split(ends, z, form)
    R, p, dv, T = delta(z, form, b)
    A, A2 = pose_matrix(a) @ mount, pose_matrix(a2) @ mount
    back = A[:3, :3].T
    r = np.concatenate(
        [
            Rotation.from_matrix(R.T @ back @ A2[:3, :3]).as_rotvec(),
            back @ (A2[:3, 3] - A[:3, 3] - v * T - 0.5 * g * T * T) - p,
            back @ (v2 - v - g * T) - dv,
        ]
    )
    if not form.samples:
        return np.concatenate([r, b2 - b])
    walk = np.repeat(z[[of.GYROSCOPE_WALK, of.ACCELEROMETER_WALK]], 3) * np.sqrt(T)
    return np.concatenate([np.linalg.solve(np.linalg.cholesky(whitening(form, z)), r), (b2 - b) / walk])


_KNOWN: dict[bytes, np.ndarray] = {}


def whitening(form: ImuForm, z: np.ndarray) -> np.ndarray:
    """`covariance`, found once for each measurement."""
    key = z.tobytes()
    if key not in _KNOWN:
        _KNOWN[key] = covariance(form, z)
    return _KNOWN[key]
