"""Graduated non-convexity in the plane, dense: Gauss-Newton on all poses, closures weighed anew in each iteration.

    min Σ_odometry rᵀ Ω r + Σ_closures c² s / (c² + s^μ),   s = rᵀ Ω r,   μ from 0 to 1

Residuals are those of `between_se2`; Jacobians are central differences of them.  The first pose is fixed.
"""

import numpy as np

_STEP = 1e-6
_ITERATIONS = 60


def residual(a: np.ndarray, b: np.ndarray, z: np.ndarray) -> np.ndarray:
    """z⁻¹ (a⁻¹ b): translation as it stands, and the angle."""
    seen = _turned(-a[2], b[:2] - a[:2])
    angle = b[2] - a[2] - z[2]
    return np.append(_turned(-z[2], seen - z[:2]), np.arctan2(np.sin(angle), np.cos(angle)))


def weight(s: float, mu: float, c2: float) -> float:
    """The derivative of c² s / (c² + s^μ) by s, by central differences."""
    h = max(s, 1.0) * 1e-6
    return (_loss(s + h, mu, c2) - _loss(s - h, mu, c2)) / (2.0 * h)


def graduated(
    poses: np.ndarray,
    edges: list[tuple[int, int, np.ndarray, np.ndarray, bool]],
    c2: float,
    schedule: tuple[float, ...],
    least: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 3), and the weights of closures, at the end of the schedule.  edges: from, to, z, Ω, whether it is a
    closure.  least: closures with less weight have none at the end."""
    x = poses.copy()
    for mu in schedule:
        for _ in range(_ITERATIONS):
            H, g = np.zeros((x.size, x.size)), np.zeros(x.size)
            for i, j, z, omega, closes in edges:
                r = residual(x[i], x[j], z)
                w = weight(float(r @ omega @ r), mu, c2) if closes else 1.0
                w = 0.0 if mu == schedule[-1] and w < least else w
                J = np.zeros((3, x.size))
                for end, k in np.ndindex(2, 3):
                    step = np.zeros((2, 3))
                    step[end, k] = _STEP
                    there, back = (residual(x[i] + s * step[0], x[j] + s * step[1], z) for s in (1.0, -1.0))
                    J[:, 3 * (i, j)[end] + k] = (there - back) / (2.0 * _STEP)
                H += w * J.T @ omega @ J
                g += w * J.T @ omega @ r
            moved = np.zeros(x.size)
            moved[3:] = -np.linalg.solve(H[3:, 3:], g[3:])
            x = x + moved.reshape(-1, 3)
            if np.abs(moved).max() < 1e-11:
                break
    own = [residual(x[i], x[j], z) @ omega @ residual(x[i], x[j], z) for i, j, z, omega, closes in edges if closes]
    return x, np.array([weight(float(s), schedule[-1], c2) for s in own])


def _loss(s: float, mu: float, c2: float) -> float:
    return c2 * s / (c2 + abs(s) ** mu)


def _turned(angle: float, v: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])
