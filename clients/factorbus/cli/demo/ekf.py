"""A monocular filter for demonstrations: constant velocity, inverse-depth features.  `workers/MATH.md` §6, §7.

State x = (r, q, v, ω, y₁, y₂, …): position (metres, world), attitude (scalar first, camera to world), velocity
(m/s, world), angular velocity (rad/s, camera), then six numbers a feature.  It is an extended Kalman filter as Civera,
Davison and Montiel have it (2008); new features come from the bus.
"""

from dataclasses import dataclass

import numpy as np

from factorbus.proto.arrays import F64

CAMERA, FEATURE = 13, 6
_R, _Q, _V, _W = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)


@dataclass(slots=True)
class Filter:
    """x (m,) and P (m, m), replaced by every step."""

    x: F64
    P: F64

    @property
    def features(self) -> F64:
        """y (n, 6)."""
        return self.x[CAMERA:].reshape(-1, FEATURE)

    def feature_covariance(self, i: int) -> F64:
        """P of feature i, (6, 6)."""
        at = CAMERA + FEATURE * i
        return self.P[at : at + FEATURE, at : at + FEATURE]

    def predict(self, dt_s: float, sigma_velocity: float, sigma_turn: float) -> None:
        """One step of time: the velocities change by impulses of these standard deviations (m/s, rad/s).  MATH (7.1)"""
        x, turn = self.x.copy(), self.x[_W] * dt_s
        small, by_turn = small_rotation(turn)
        x[_R] += x[_V] * dt_s
        x[_Q] = product_matrix(self.x[_Q]) @ small
        F = np.eye(CAMERA)
        F[_R, _V] = dt_s * np.eye(3)
        F[_Q, _Q] = right_matrix(small)
        F[_Q, _W] = product_matrix(self.x[_Q]) @ by_turn * dt_s
        G = np.zeros((CAMERA, 6))
        G[_R, :3], G[_V, :3], G[_Q, 3:], G[_W, 3:] = dt_s * np.eye(3), np.eye(3), F[_Q, _W], np.eye(3)
        Q = G @ np.diag([sigma_velocity**2] * 3 + [sigma_turn**2] * 3) @ G.T
        P = self.P.copy()
        P[:CAMERA, CAMERA:] = F @ P[:CAMERA, CAMERA:]
        P[CAMERA:, :CAMERA] = P[:CAMERA, CAMERA:].T
        P[:CAMERA, :CAMERA] = F @ P[:CAMERA, :CAMERA] @ F.T + Q
        self.x, self.P = x, P

    def update(self, innovation: F64, H: F64, R: F64) -> None:
        """A measurement with z − h (k,), Jacobian H (k, m) and covariance R (k, k).  MATH (7.2)"""
        HP = H @ self.P
        S = HP @ H.T + R
        K = np.linalg.solve(S, HP).T
        P = self.P - K @ S @ K.T
        self.x, self.P = self.x + K @ innovation, (P + P.T) / 2
        self._normalize()

    def drop(self, kept: list[int]) -> None:
        """Keep these features only."""
        rows = [*range(CAMERA), *(CAMERA + FEATURE * i + j for i in kept for j in range(FEATURE))]
        self.x, self.P = self.x[rows], self.P[np.ix_(rows, rows)]

    def _normalize(self) -> None:
        """The quaternion to unit length, with what that does to P.  MATH (7.3)"""
        q = self.x[_Q]
        length = np.linalg.norm(q)
        N = (length**2 * np.eye(4) - np.outer(q, q)) / length**3
        self.x[_Q] = q / length
        self.P[_Q] = N @ self.P[_Q]
        self.P[:, _Q] = self.P[:, _Q] @ N.T


def small_rotation(turn: F64) -> tuple[F64, F64]:
    """The quaternion (cos ½|t|, sin ½|t| t/|t|) of a rotation vector t (3,), and its Jacobian (4, 3)."""
    angle = float(np.linalg.norm(turn))
    half = angle / 2
    sinc = np.sin(half) / angle if angle > 1e-8 else 0.5 - angle**2 / 48
    slope = (np.cos(half) / 2 - sinc) / angle**2 if angle > 1e-4 else -1 / 24 + angle**2 / 960
    return np.append(np.cos(half), sinc * turn), np.vstack(
        [-sinc * turn / 2, sinc * np.eye(3) + slope * np.outer(turn, turn)]
    )


def product_matrix(q: F64) -> F64:
    """q ⊗ · as a matrix, scalar first."""
    a, b, c, d = q
    return np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])


def right_matrix(q: F64) -> F64:
    """· ⊗ q as a matrix, scalar first."""
    a, b, c, d = q
    return np.array([[a, -b, -c, -d], [b, a, d, -c], [c, -d, a, b], [d, c, -b, a]])
