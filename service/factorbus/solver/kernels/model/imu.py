"""What an IMU says between two poses: residual and Jacobians.  MATH §3.10.

Variables a: pose, velocity of the IMU in the map (m/s), bias (gyroscopes, rad/s, accelerometers, m/s²), and the same of
b; then the mount m of the IMU, then gravity g, where these are variables.  With Δ = (ΔR, Δp, Δv) at the bias βₐ, its
duration T, and (t, R) the poses of the IMU, a ∘ m and b ∘ m,

    r_R = log(ΔRᵀ Rₐᵀ R_b)                                                                               (3.47)
    r_p = Rₐᵀ (t_b − tₐ − vₐ T − ½ g T²) − Δp,   r_v = Rₐᵀ (v_b − vₐ − g T) − Δv,   r_β = β_b − βₐ         (3.48)

Of samples the residual is W (r_R, r_p, r_v) and r_β / (σ √T), so that its Ω is one: W of `imu_noise`, kept behind the
measurement.  Of what is integrated already it is (r_R, r_p, r_v, r_β).
"""

import math

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model.composed import FIRST, INNER, SCRATCH, SECOND, carry_over, copy_pose, put_sensor
from factorbus.solver.kernels.model.imu_layout import ImuLayout
from factorbus.solver.kernels.model.imu_noise import SIZE
from factorbus.solver.kernels.model.preintegration import (
    ROOM_T,
    Preintegrated,
    correct_to_first_order,
    fill_rotation,
    fill_series,
    make_room,
    preintegrate,
    preintegrated_in,
)
from factorbus.solver.kernels.model.se3 import compose_inverse_se3, quat_product

POSE_A, VELOCITY_A, BIAS_A, POSE_B, VELOCITY_B, BIAS_B = range(6)
# Columns of the Jacobians: pose (translation, rotation), velocity, bias, of a and of b; then of the mount, of gravity.
_B, _FURTHER = 15, 30
_T, _R, _V, _G = 0, 3, 6, 9
_SMALL = 1e-4


@part
def imu(x: F64, places: I64, form: ImuLayout, z: F64, kept: F64, r: F64, J: F64) -> None:
    """r (15,) and J (15, Σ d).

    places: where the values of the variables begin in x; z: the measurement, and of samples W behind it.
    kept (ROOM,): samples that are integrated at the bias already are not again, else they are kept there; () nowhere.
    """
    bias, room = x[places[BIAS_A] : places[BIAS_A] + of.BIAS], kept if kept.size > 0 else make_room()
    y = np.empty(SCRATCH)
    put_delta(form, z, bias, room, True)
    delta, T, g = preintegrated_in(room), room[ROOM_T], gravity_of(form, x, places, z)
    is_mounted = put_mount(form, x, places, z, y)
    put_sensor(is_mounted, False, x, places[POSE_A], y, FIRST)
    put_sensor(is_mounted, False, x, places[POSE_B], y, SECOND)
    J[:, :] = 0.0
    _rotation(y, FIRST + 3, SECOND + 3, delta, r, J)
    _translations(x, places, y, T, g, delta, r, J)
    if form.gravity >= 0:
        _gravity(T, y, _FURTHER if form.mount < 0 else _FURTHER + 6, J)
    if is_mounted:
        _carry_over_mount(form.mount >= 0, y, J)
    if form.samples == 0:
        _drift(x, places[BIAS_A], places[BIAS_B], r, J)
    else:
        _walk(x, places[BIAS_A], places[BIAS_B], T, z, r, J)
        _whiten(z, form.start + of.SAMPLE * form.samples, r, J)


@inline_kernel
def put_delta(form: ImuLayout, z: F64, bias: F64, room: F64, jacobians: bool) -> None:
    """Δ at a bias to `room`."""
    if form.samples == 0:
        correct_to_first_order(form, z, bias, room)
    else:
        preintegrate(form, z, bias, room, jacobians)


@inline_kernel
def gravity_of(form: ImuLayout, x: F64, places: I64, z: F64) -> F64:
    """g (3,)."""
    return z[form.gravity_at : form.gravity_at + 3] if form.gravity < 0 else x[places[form.gravity] :][:3]


@inline_kernel
def put_mount(form: ImuLayout, x: F64, places: I64, z: F64, y: F64) -> bool:
    """m to y[INNER]; False: the IMU is where the pose is."""
    if form.mount >= 0:
        copy_pose(False, x, places[form.mount], y, INNER)
        return True
    copy_pose(False, z, form.mount_at, y, INNER)
    is_mounted = y[INNER + 6] != 1.0
    for c in range(6):
        is_mounted |= y[INNER + c] != 0.0
    return is_mounted


@part
def _carry_over_mount(is_variable: bool, y: F64, J: F64) -> None:
    """The columns of both poses, from those of the IMU's to the robot's, as in (3.35); and those of the mount."""
    B = np.empty((SIZE, 6))
    for a in range(SIZE):
        for c in range(6):
            B[a, c] = J[a, _B + c]
            if is_variable:
                J[a, _FURTHER + c] = J[a, c] + B[a, c]
    carry_over(True, SIZE, False, y, INNER, B, J, _B)
    for a in range(SIZE):
        for c in range(6):
            B[a, c] = J[a, c]
    carry_over(True, SIZE, False, y, INNER, B, J, 0)


@part
def _rotation(y: F64, a: int, b: int, delta: Preintegrated, r: F64, J: F64) -> None:
    """Rows of r_R; quaternions at y[a] and y[b].

    ∂r_R/∂θₐ = −Jr⁻¹(r_R) R_bᵀ Rₐ,   ∂r_R/∂θ_b = Jr⁻¹(r_R),   ∂r_R/∂β_g = −Jr⁻¹(r_R) Eᵀ ∂ΔR/∂β_g,  E = ΔRᵀ Rₐᵀ R_b
    """
    q, e, C, K = delta.q, np.empty(4), np.empty((3, 3)), np.empty((3, 3))
    # Rₐᵀ R_b, then E.
    rx, ry, rz, rw = quat_product(-y[a], -y[a + 1], -y[a + 2], y[a + 3], y[b], y[b + 1], y[b + 2], y[b + 3])
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
def _translations(x: F64, places: I64, y: F64, T: float, g: F64, delta: Preintegrated, r: F64, J: F64) -> None:
    """Rows of r_p and r_v."""
    v, w = places[VELOCITY_A], places[VELOCITY_B]
    gap, rush, R, C = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    fill_rotation(y, FIRST + 3, R)
    fill_rotation(y, SECOND + 3, C)
    for i in range(3):
        gap[i] = rush[i] = 0.0
        for m in range(3):
            gap[i] += R[m, i] * (y[SECOND + m] - y[FIRST + m] - T * (x[v + m] + 0.5 * T * g[m]))
            rush[i] += R[m, i] * (x[w + m] - x[v + m] - T * g[m])
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
def _gravity(T: float, y: F64, column: int, J: F64) -> None:
    """∂r_p/∂g = −½ T² Rₐᵀ,  ∂r_v/∂g = −T Rₐᵀ."""
    R = np.empty((3, 3))
    fill_rotation(y, FIRST + 3, R)
    for i in range(3):
        for c in range(3):
            J[3 + i, column + c], J[6 + i, column + c] = -0.5 * T * T * R[c, i], -T * R[c, i]


@inline_kernel
def _drift(x: F64, a: int, b: int, r: F64, J: F64) -> None:
    """Rows of r_β."""
    for c in range(of.BIAS):
        r[9 + c] = x[b + c] - x[a + c]
        J[9 + c, _G + c], J[9 + c, _B + _G + c] = -1.0, 1.0


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
def place_by_imu(end: int, x: F64, places: I64, form: ImuLayout, z: F64) -> None:
    """Give the pose, the velocity or the bias of b (`end`: which) what follows from those of a: a residual of zero."""
    v, b, out = places[VELOCITY_A], places[BIAS_A], places[end]
    if end == BIAS_B:
        for c in range(of.BIAS):
            x[out + c] = x[b + c]
        return
    y, R, room, g = np.empty(SCRATCH), np.empty((3, 3)), make_room(), gravity_of(form, x, places, z)
    put_delta(form, z, x[b : b + of.BIAS], room, False)
    (q, p, rise, _, _, _), T = preintegrated_in(room), room[ROOM_T]
    is_mounted = put_mount(form, x, places, z, y)
    put_sensor(is_mounted, False, x, places[POSE_A], y, FIRST)
    fill_rotation(y, FIRST + 3, R)
    for i in range(3):
        if end == VELOCITY_B:
            x[out + i] = x[v + i] + T * g[i] + R[i, 0] * rise[0] + R[i, 1] * rise[1] + R[i, 2] * rise[2]
        turned = R[i, 0] * p[0] + R[i, 1] * p[1] + R[i, 2] * p[2]
        y[SECOND + i] = y[FIRST + i] + T * (x[v + i] + 0.5 * T * g[i]) + turned
    if end == VELOCITY_B:
        return
    a = FIRST + 3
    y[SECOND + 3], y[SECOND + 4], y[SECOND + 5], y[SECOND + 6] = quat_product(
        y[a], y[a + 1], y[a + 2], y[a + 3], q[0], q[1], q[2], q[3]
    )
    if is_mounted:
        compose_inverse_se3(y, SECOND, y, INNER, SECOND)
    for c in range(of.MOUNT):
        x[out + c] = y[SECOND + c]
