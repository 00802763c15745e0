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
from typing import NamedTuple

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model.composed import FIRST, INNER, SCRATCH, SECOND, carry_over, copy_pose, put_sensor
from factorbus.solver.kernels.model.imu_expansion import expand_delta, expand_near
from factorbus.solver.kernels.model.imu_layout import ImuLayout
from factorbus.solver.kernels.model.imu_noise import SIZE
from factorbus.solver.kernels.model.preintegration import (
    ROOM_P,
    ROOM_P_B,
    ROOM_Q,
    ROOM_R_B,
    ROOM_T,
    ROOM_V,
    ROOM_V_B,
    correct_to_first_order,
    fill_rotation,
    has_bits_of,
    make_room,
    preintegrate,
    preintegrated_in,
)
from factorbus.solver.kernels.model.se3 import compose_inverse_se3, quat_product, rotation_matrix

POSE_A, VELOCITY_A, BIAS_A, POSE_B, VELOCITY_B, BIAS_B = range(6)
# Columns of the Jacobians: pose (translation, rotation), velocity, bias, of a and of b; then of the mount, of gravity.
_B, _FURTHER = 15, 30
_T, _R, _V, _G = 0, 3, 6, 9
# In the scratch behind the poses: Rₐ, Rₐᵀ R_b, Jr⁻¹(r_R), row by row, and a quaternion.
_RA, _RAB, _SLOPE, _E = SCRATCH, SCRATCH + 9, SCRATCH + 18, SCRATCH + 27
IMU_SCRATCH = _E + 4
_SMALL = 1e-4


class ImuScratch(NamedTuple):
    """Δ, see `make_room`, and room of IMU_SCRATCH numbers."""

    room: F64
    y: F64


@part
def imu(x: F64, places: I64, form: ImuLayout, z: F64, kept: F64, r: F64, J: F64) -> None:
    """r (15,) and J (15, Σ d).

    places: where the values of the variables begin in x; z: the measurement, and what is kept behind samples.
    kept (ROOM,): samples that are integrated at the bias already are not again, else they are kept there; () nowhere.
    """
    imu_plain(x, places, form, z, kept, r, J)
    if form.samples > 0:
        _whiten(z, form.start + of.SAMPLE * form.samples, r, J)


@part
def imu_plain(x: F64, places: I64, form: ImuLayout, z: F64, kept: F64, r: F64, J: F64) -> None:
    """The same without W."""
    bias, room = x[places[BIAS_A] : places[BIAS_A] + of.BIAS], kept if kept.size > 0 else make_room()
    put_delta(form, z, bias, room, True)
    imu_of_delta(x, places, form, z, ImuScratch(room, np.empty(IMU_SCRATCH)), r, J)


@part
def imu_of_delta(x: F64, places: I64, form: ImuLayout, z: F64, scratch: ImuScratch, r: F64, J: F64) -> None:
    """The same with Δ as it is in `room`."""
    room, y = scratch
    T = room[ROOM_T]
    is_mounted = put_mount(form, x, places, z, y)
    put_sensor(is_mounted, False, x, places[POSE_A], y, FIRST)
    put_sensor(is_mounted, False, x, places[POSE_B], y, SECOND)
    J[:, :] = 0.0
    put_rotation(y, FIRST + 3, y, _RA)
    _rotation(y, room, r, J)
    _translations(x, places, y, gravity_of(form, x, places, z), room, r, J)
    if form.gravity >= 0:
        _gravity(T, y, _FURTHER if form.mount < 0 else _FURTHER + 6, J)
    if is_mounted:
        _carry_over_mount(form.mount >= 0, y, J)
    if form.samples == 0:
        _drift(x, places[BIAS_A], places[BIAS_B], r, J)
    else:
        _walk(x, places[BIAS_A], places[BIAS_B], T, z, r, J)


@inline_kernel
def put_delta(form: ImuLayout, z: F64, bias: F64, room: F64, jacobians: bool) -> None:
    """Δ at a bias to `room`; without `jacobians` the derivatives may be zero."""
    if form.samples == 0:
        correct_to_first_order(form, z, bias, room)
    elif not has_bits_of(bias, room) and not expand_delta(form, z, bias, room):
        preintegrate(form, z, bias, room, jacobians)


@part
def put_delta_near(form: ImuLayout, z: F64, kept: F64, bias: F64, room: F64) -> None:
    """The same, of samples; kept (ROOM,): what they come to at another bias, which may be nearer."""
    if not expand_delta(form, z, bias, room) and not expand_near(form, z, kept, bias, room):
        room[ROOM_T] = 0.0  # nothing yet
        preintegrate(form, z, bias, room, True)


@inline_kernel
def gravity_of(form: ImuLayout, x: F64, places: I64, z: F64) -> tuple:
    """g."""
    k = form.gravity_at if form.gravity < 0 else places[form.gravity]
    return (z[k], z[k + 1], z[k + 2]) if form.gravity < 0 else (x[k], x[k + 1], x[k + 2])


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


@inline_kernel
def put_rotation(q: F64, k: int, out: F64, to: int) -> None:
    """The rotation of the quaternion at q[k], row by row, to out[to]."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_matrix(q, k)
    out[to], out[to + 1], out[to + 2], out[to + 3], out[to + 4], out[to + 5] = r0, r1, r2, r3, r4, r5
    out[to + 6], out[to + 7], out[to + 8] = r6, r7, r8


@inline_kernel
def _rotation(y: F64, room: F64, r: F64, J: F64) -> None:
    """Rows of r_R, and Rₐᵀ R_b to y.

    ∂r_R/∂θₐ = −Jr⁻¹(r_R) R_bᵀ Rₐ,   ∂r_R/∂θ_b = Jr⁻¹(r_R),   ∂r_R/∂β_g = −Jr⁻¹(r_R) Eᵀ ∂ΔR/∂β_g,  E = ΔRᵀ Rₐᵀ R_b
    """
    a, b, q = FIRST + 3, SECOND + 3, ROOM_Q
    ax, ay, az, aw = quat_product(-y[a], -y[a + 1], -y[a + 2], y[a + 3], y[b], y[b + 1], y[b + 2], y[b + 3])
    y[_E], y[_E + 1], y[_E + 2], y[_E + 3] = ax, ay, az, aw
    put_rotation(y, _E, y, _RAB)
    ax, ay, az, aw = quat_product(-room[q], -room[q + 1], -room[q + 2], room[q + 3], ax, ay, az, aw)
    y[_E], y[_E + 1], y[_E + 2], y[_E + 3] = ax, ay, az, aw
    log_and_slope(y, r)
    for i in range(3):
        k0, k1, k2 = y[_SLOPE + 3 * i], y[_SLOPE + 3 * i + 1], y[_SLOPE + 3 * i + 2]
        J[i, _B + _R], J[i, _B + _R + 1], J[i, _B + _R + 2] = k0, k1, k2
        for c in range(3):
            J[i, _R + c] = -(k0 * y[_RAB + 3 * c] + k1 * y[_RAB + 3 * c + 1] + k2 * y[_RAB + 3 * c + 2])
    e0, e1, e2, e3, e4, e5, e6, e7, e8 = rotation_matrix(y, _E)
    for c in range(3):
        b0, b1, b2 = room[ROOM_R_B + c], room[ROOM_R_B + 3 + c], room[ROOM_R_B + 6 + c]
        t0, t1, t2 = e0 * b0 + e3 * b1 + e6 * b2, e1 * b0 + e4 * b1 + e7 * b2, e2 * b0 + e5 * b1 + e8 * b2
        for i in range(3):
            J[i, _G + c] = -(y[_SLOPE + 3 * i] * t0 + y[_SLOPE + 3 * i + 1] * t1 + y[_SLOPE + 3 * i + 2] * t2)


@inline_kernel
def log_and_slope(y: F64, r: F64) -> None:
    """r[:3] the rotation vector of the quaternion at y[_E], with the sign so that w ≥ 0, and Jr⁻¹(r) to y[_SLOPE].

    Jr⁻¹(r) = I + ½ ⌊r⌋ + (1 − (θ/2) cot(θ/2))/θ² ⌊r⌋²
    """
    x0, x1, x2 = y[_E], y[_E + 1], y[_E + 2]
    sign = -1.0 if y[_E + 3] < 0.0 else 1.0
    w, sine = sign * y[_E + 3], math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    angle = 2.0 * math.atan2(sine, w)
    scale = sign * (2.0 + angle * angle / 12.0 if sine < _SMALL else angle / sine)
    x0, x1, x2 = scale * x0, scale * x1, scale * x2
    r[0], r[1], r[2] = x0, x1, x2
    square, k = angle * angle, _SLOPE
    b = 1.0 / 12.0 + square / 720.0 if angle < 1e-3 else (1.0 - 0.5 * angle * w / sine) / square
    y[k], y[k + 4] = 1.0 - b * (x1 * x1 + x2 * x2), 1.0 - b * (x0 * x0 + x2 * x2)
    y[k + 8] = 1.0 - b * (x0 * x0 + x1 * x1)
    y[k + 1], y[k + 3] = b * x0 * x1 - 0.5 * x2, b * x0 * x1 + 0.5 * x2
    y[k + 2], y[k + 6] = b * x0 * x2 + 0.5 * x1, b * x0 * x2 - 0.5 * x1
    y[k + 5], y[k + 7] = b * x1 * x2 - 0.5 * x0, b * x1 * x2 + 0.5 * x0


@inline_kernel
def _translations(x: F64, places: I64, y: F64, g: tuple, room: F64, r: F64, J: F64) -> None:
    """Rows of r_p and r_v."""
    v, w, T = places[VELOCITY_A], places[VELOCITY_B], room[ROOM_T]
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(y, FIRST + 3)
    tx = y[SECOND] - y[FIRST] - T * (x[v] + 0.5 * T * g[0])
    ty = y[SECOND + 1] - y[FIRST + 1] - T * (x[v + 1] + 0.5 * T * g[1])
    tz = y[SECOND + 2] - y[FIRST + 2] - T * (x[v + 2] + 0.5 * T * g[2])
    gx, gy, gz = a0 * tx + a3 * ty + a6 * tz, a1 * tx + a4 * ty + a7 * tz, a2 * tx + a5 * ty + a8 * tz
    tx, ty, tz = x[w] - x[v] - T * g[0], x[w + 1] - x[v + 1] - T * g[1], x[w + 2] - x[v + 2] - T * g[2]
    ux, uy, uz = a0 * tx + a3 * ty + a6 * tz, a1 * tx + a4 * ty + a7 * tz, a2 * tx + a5 * ty + a8 * tz
    r[3], r[4], r[5] = gx - room[ROOM_P], gy - room[ROOM_P + 1], gz - room[ROOM_P + 2]
    r[6], r[7], r[8] = ux - room[ROOM_V], uy - room[ROOM_V + 1], uz - room[ROOM_V + 2]
    _cross(gx, gy, gz, J, 3)
    _cross(ux, uy, uz, J, 6)
    for i in range(3):
        J[3 + i, _T + i] = -1.0
        for c in range(3):
            turned = y[_RA + 3 * c + i]
            J[3 + i, _B + _T + c] = y[_RAB + 3 * i + c]
            J[3 + i, _V + c] = -T * turned
            J[6 + i, _V + c], J[6 + i, _B + _V + c] = -turned, turned
        for c in range(6):
            J[3 + i, _G + c], J[6 + i, _G + c] = -room[ROOM_P_B + 6 * i + c], -room[ROOM_V_B + 6 * i + c]


@inline_kernel
def _cross(x: float, y: float, z: float, J: F64, row: int) -> None:
    """⌊u⌋ of u = (x, y, z) into the columns of a's rotation."""
    J[row, _R + 1], J[row, _R + 2], J[row + 1, _R + 2] = -z, y, -x
    J[row + 1, _R], J[row + 2, _R], J[row + 2, _R + 1] = z, -y, x


@inline_kernel
def _gravity(T: float, y: F64, column: int, J: F64) -> None:
    """∂r_p/∂g = −½ T² Rₐᵀ,  ∂r_v/∂g = −T Rₐᵀ."""
    for i in range(3):
        for c in range(3):
            turned = y[_RA + 3 * c + i]
            J[3 + i, column + c], J[6 + i, column + c] = -0.5 * T * T * turned, -T * turned


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
    y, R, room = np.empty(SCRATCH), np.empty((3, 3)), make_room()
    g = np.array(gravity_of(form, x, places, z))
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
