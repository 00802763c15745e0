"""What an IMU says between two poses: residual and Jacobians.  MATH §3.10.

Variables a: pose, velocity in the map (m/s), bias (gyroscopes, rad/s, accelerometers, m/s²), and the same of b.  With
Δ = (ΔR, Δp, Δv) of the samples at the bias βₐ, their duration T and gravity g,

    r_R = log(ΔRᵀ Rₐᵀ R_b)                                                                               (3.47)
    r_p = Rₐᵀ (t_b − tₐ − vₐ T − ½ g T²) − Δp,   r_v = Rₐᵀ (v_b − vₐ − g T) − Δv,   r_β = β_b − βₐ         (3.48)

The residual is W (r_R, r_p, r_v) and r_β / (σ √T), so that its Ω is one: W of `imu_noise`, kept behind the measurement.
"""

import math

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model.imu_noise import SIZE
from factorbus.solver.kernels.model.preintegration import (
    Preintegrated,
    fill_rotation,
    fill_series,
    nothing_yet,
    preintegrate,
)
from factorbus.solver.kernels.model.se3 import quat_product

POSE_A, VELOCITY_A, BIAS_A, POSE_B, VELOCITY_B, BIAS_B = range(6)
# Columns of the Jacobians: pose (translation, rotation), velocity, bias, of a and of b.
_B = 15
_T, _R, _V, _G = 0, 3, 6, 9
_SMALL = 1e-4


@part
def imu(x: F64, places: I64, samples: int, z: F64, r: F64, J: F64) -> None:
    """r (15,) and J (15, 30), whitened.

    places (6,): where the values of the variables begin in x; z: the measurement, W behind it.
    """
    a, b = places[POSE_A], places[BIAS_A]
    delta = nothing_yet()
    T = preintegrate(samples, z, x[b : b + 6], delta, True)
    R = np.empty((3, 3))
    fill_rotation(x, a + 3, R)
    J[:, :] = 0.0
    _rotation(x, a + 3, places[POSE_B] + 3, delta, r, J)
    _translations(x, places, T, z, R, delta, r, J)
    _walk(x, b, places[BIAS_B], T, z, r, J)
    _whiten(z, of.SAMPLES + of.SAMPLE * samples, r, J)


@part
def _rotation(x: F64, a: int, b: int, delta: Preintegrated, r: F64, J: F64) -> None:
    """Rows of r_R; quaternions at x[a] and x[b].

    ∂r_R/∂θₐ = −Jr⁻¹(r_R) R_bᵀ Rₐ,   ∂r_R/∂θ_b = Jr⁻¹(r_R),   ∂r_R/∂β_g = −Jr⁻¹(r_R) Eᵀ ∂ΔR/∂β_g,  E = ΔRᵀ Rₐᵀ R_b
    """
    q, e, C, K = delta.q, np.empty(4), np.empty((3, 3)), np.empty((3, 3))
    # Rₐᵀ R_b, then E.
    rx, ry, rz, rw = quat_product(-x[a], -x[a + 1], -x[a + 2], x[a + 3], x[b], x[b + 1], x[b + 2], x[b + 3])
    e[0], e[1], e[2], e[3] = rx, ry, rz, rw
    fill_rotation(e, 0, C)
    e[0], e[1], e[2], e[3] = quat_product(-q[0], -q[1], -q[2], q[3], rx, ry, rz, rw)
    log_and_slope(e, r, K)
    for i in range(3):
        for c in range(3):
            J[i, _B + _R + c] = K[i, c]
            # K Cᵀ
            J[i, _R + c] = -(K[i, 0] * C[c, 0] + K[i, 1] * C[c, 1] + K[i, 2] * C[c, 2])
    fill_rotation(e, 0, C)
    for i in range(3):
        for c in range(3):
            total = 0.0
            for m in range(3):
                total += K[i, m] * (C[0, m] * delta.R_b[0, c] + C[1, m] * delta.R_b[1, c] + C[2, m] * delta.R_b[2, c])
            J[i, _G + c] = -total


@inline_kernel
def log_and_slope(e: F64, r: F64, K: F64) -> None:
    """r[:3] the rotation vector of the quaternion e (4,), and K (3, 3) = Jr⁻¹(r), with e's sign so that w ≥ 0."""
    sign = -1.0 if e[3] < 0.0 else 1.0
    w, sine = sign * e[3], math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    angle = 2.0 * math.atan2(sine, w)
    scale = sign * (2.0 + angle * angle / 12.0 if sine < _SMALL else angle / sine)
    for c in range(3):
        r[c] = scale * e[c]
    # (1 − (θ/2) cot(θ/2))/θ²
    square = angle * angle
    curve = 1.0 / 12.0 + square / 720.0 if angle < 1e-3 else (1.0 - 0.5 * angle * w / sine) / square
    fill_series(0.5, curve, r[0], r[1], r[2], K)


@part
def _translations(x: F64, places: I64, T: float, z: F64, R: F64, delta: Preintegrated, r: F64, J: F64) -> None:
    """Rows of r_p and r_v, R (3, 3) the rotation of a."""
    a, b, v, w = places[POSE_A], places[POSE_B], places[VELOCITY_A], places[VELOCITY_B]
    gap, rush, C = np.empty(3), np.empty(3), np.empty((3, 3))
    fill_rotation(x, b + 3, C)
    for i in range(3):
        gap[i] = rush[i] = 0.0
        for m in range(3):
            g = z[of.GRAVITY + m]
            gap[i] += R[m, i] * (x[b + m] - x[a + m] - T * (x[v + m] + 0.5 * T * g))
            rush[i] += R[m, i] * (x[w + m] - x[v + m] - T * g)
        r[3 + i], r[6 + i] = gap[i] - delta.p[i], rush[i] - delta.v[i]
    _cross(gap, J, 3)
    _cross(rush, J, 6)
    for i in range(3):
        J[3 + i, _T + i] = -1.0
        for c in range(3):
            J[3 + i, _B + _T + c] = R[0, i] * C[0, c] + R[1, i] * C[1, c] + R[2, i] * C[2, c]
            J[3 + i, _V + c] = -T * R[c, i]
            J[6 + i, _V + c], J[6 + i, _B + _V + c] = -R[c, i], R[c, i]
        for c in range(6):
            J[3 + i, _G + c], J[6 + i, _G + c] = -delta.p_b[i, c], -delta.v_b[i, c]


@inline_kernel
def _cross(u: F64, J: F64, row: int) -> None:
    """⌊u⌋ into the columns of a's rotation."""
    J[row, _R + 1], J[row, _R + 2], J[row + 1, _R + 2] = -u[2], u[1], -u[0]
    J[row + 1, _R], J[row + 2, _R], J[row + 2, _R + 1] = u[2], -u[1], u[0]


@inline_kernel
def _walk(x: F64, a: int, b: int, T: float, z: F64, r: F64, J: F64) -> None:
    """Rows of r_β / (σ √T)."""
    root = 1.0 / math.sqrt(T)
    for c in range(6):
        scale = root / z[of.GYROSCOPE_WALK if c < 3 else of.ACCELEROMETER_WALK]
        r[9 + c] = scale * (x[b + c] - x[a + c])
        J[9 + c, _G + c], J[9 + c, _B + _G + c] = -scale, scale


@inline_kernel
def _whiten(z: F64, w: int, r: F64, J: F64) -> None:
    """The first nine rows times W, lower triangular, at z[w]: from the last row on, each from those above it."""
    for i in range(SIZE - 1, -1, -1):
        row = w + i * (i + 1) // 2
        r[i] *= z[row + i]
        for c in range(J.shape[1]):
            J[i, c] *= z[row + i]
        for m in range(i):
            r[i] += z[row + m] * r[m]
            for c in range(J.shape[1]):
                J[i, c] += z[row + m] * J[m, c]


@part
def place_by_imu(end: int, x: F64, places: I64, samples: int, z: F64) -> None:
    """Give the pose, the velocity or the bias of b (`end`: which) what follows from those of a: a residual of zero."""
    a, v, b, out = places[POSE_A], places[VELOCITY_A], places[BIAS_A], places[end]
    if end == BIAS_B:
        for c in range(6):
            x[out + c] = x[b + c]
        return
    delta = nothing_yet()
    T = preintegrate(samples, z, x[b : b + 6], delta, False)
    q, R = delta.q, np.empty((3, 3))
    fill_rotation(x, a + 3, R)
    for i in range(3):
        g = z[of.GRAVITY + i]
        if end == POSE_B:
            turned = R[i, 0] * delta.p[0] + R[i, 1] * delta.p[1] + R[i, 2] * delta.p[2]
            x[out + i] = x[a + i] + T * (x[v + i] + 0.5 * T * g) + turned
        else:
            x[out + i] = x[v + i] + T * g + R[i, 0] * delta.v[0] + R[i, 1] * delta.v[1] + R[i, 2] * delta.v[2]
    if end == POSE_B:
        x[out + 3], x[out + 4], x[out + 5], x[out + 6] = quat_product(
            x[a + 3], x[a + 4], x[a + 5], x[a + 6], q[0], q[1], q[2], q[3]
        )
