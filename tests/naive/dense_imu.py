"""What an IMU says, written with matrices and scipy's rotations: the twin of the inertial kernels."""

import numpy as np
from scipy.spatial.transform import Rotation

from factorbus.proto import inertial as of


def samples(z: np.ndarray) -> np.ndarray:
    """(n, 7) of a measurement: duration, gyroscopes, accelerometers."""
    return z[of.SAMPLES :].reshape(-1, of.SAMPLE)


def integrate(z: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """ΔR (3, 3), Δp, Δv, T of the samples at a bias."""
    R, p, v, total = np.eye(3), np.zeros(3), np.zeros(3), 0.0
    for h, *rates in samples(z).tolist():
        w, a = np.split(np.array(rates) - bias, 2)
        p = p + h * v + 0.5 * h * h * R @ a
        v = v + h * R @ a
        R = R @ Rotation.from_rotvec(h * w).as_matrix()
        total += h
    return R, p, v, total


def follow(z: np.ndarray, pose: np.ndarray, velocity: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pose and the velocity that samples lead to."""
    R, p, v, T = integrate(z, bias)
    g, A = z[of.GRAVITY : of.BIAS], Rotation.from_quat(pose[3:]).as_matrix()
    place = pose[:3] + T * velocity + 0.5 * T * T * g + A @ p
    return np.concatenate([place, Rotation.from_matrix(A @ R).as_quat(canonical=True)]), velocity + T * g + A @ v


def covariance(z: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Σ (9, 9) of (rotation, position, velocity): what noise of each sample does to Δ, by central differences."""
    bias, total = z[of.BIAS : of.SAMPLES], np.zeros((9, 9))
    R0 = integrate(z, bias)[0]

    def off(n: int, c: int, step: float) -> np.ndarray:
        moved = z.copy()
        moved[of.SAMPLES + of.SAMPLE * n + 1 + c] += step
        R, p, v, _ = integrate(moved, bias)
        return np.concatenate([Rotation.from_matrix(R0.T @ R).as_rotvec(), p, v])

    durations = samples(z)[:, 0]
    for n, duration in enumerate(durations.tolist()):
        for c in range(6):
            J = (off(n, c, h) - off(n, c, -h)) / (2 * h)
            total += np.outer(J, J) * z[of.GYROSCOPE if c < 3 else of.ACCELEROMETER] ** 2 / duration
    total[3:6, 3:6] += np.eye(3) * z[of.INTEGRATION] ** 2 * durations.sum()  # a place that is off stays off
    return total


def residual(ends: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    """r (15,), whitened."""
    a, v, b, a2, v2, b2 = ends
    R, p, dv, T = integrate(z, b)
    g = z[of.GRAVITY : of.BIAS]
    A, A2 = (Rotation.from_quat(pose[3:]).as_matrix() for pose in (a, a2))
    r = np.concatenate(
        [
            Rotation.from_matrix(R.T @ A.T @ A2).as_rotvec(),
            A.T @ (a2[:3] - a[:3] - v * T - 0.5 * g * T * T) - p,
            A.T @ (v2 - v - g * T) - dv,
        ]
    )
    walk = np.repeat(z[[of.GYROSCOPE_WALK, of.ACCELEROMETER_WALK]], 3) * np.sqrt(T)
    return np.concatenate([np.linalg.solve(np.linalg.cholesky(whitening(z)), r), (b2 - b) / walk])


_KNOWN: dict[bytes, np.ndarray] = {}


def whitening(z: np.ndarray) -> np.ndarray:
    """`covariance`, found once for each measurement."""
    key = z.tobytes()
    if key not in _KNOWN:
        _KNOWN[key] = covariance(z)
    return _KNOWN[key]
