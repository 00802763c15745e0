"""Samples of an IMU, integrated on the manifold in the frame of the pose they begin at.  MATH §3.10.

After C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza, On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry, 2017.  A sample holds for its duration; the acceleration is turned by the rotation at its beginning, as in
GTSAM's ManifoldPreintegration.

    ω = ω̃ − β_g,  α = α̃ − β_a                                                                           (3.43)
    Δp += Δv h + ½ ΔR α h²,   Δv += ΔR α h,   ΔR := ΔR exp(ω h)                                            (3.44)
"""

import math
from typing import NamedTuple

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model.imu_layout import ImuLayout
from factorbus.solver.kernels.model.se3 import SMALL_TURN, half_turn, quat_product, rotation_matrix


class Preintegrated(NamedTuple):
    """Δ of samples and its Jacobians by the bias (β_g, β_a), both in the frame where they begin.

    q (4,): ΔR as a quaternion x y z w.  p, v (3,): metres, m/s.  R_b (3, 3): by β_g, of the rotation's right increment.
    p_b, v_b (3, 6).
    """

    q: F64
    p: F64
    v: F64
    R_b: F64
    p_b: F64
    v_b: F64


class SampleTerms(NamedTuple):
    """What a sample does: R (3, 3) the rotation before it, RA = R ⌊α⌋, E (3, 3) = exp(ω h), Jr (3, 3) = Jr(ω h)."""

    R: F64
    RA: F64
    E: F64
    Jr: F64


# Δ in an array: the bias it was integrated at, T, and what `Preintegrated` has, each row by row.
ROOM_T = of.BIAS
ROOM_Q, ROOM_P, ROOM_V, ROOM_R_B = ROOM_T + 1, ROOM_T + 5, ROOM_T + 8, ROOM_T + 11
ROOM_P_B, ROOM_V_B = ROOM_R_B + 9, ROOM_R_B + 27
ROOM = of.BIAS + of.DELTA


@inline_kernel
def make_room() -> F64:
    """Room for Δ, (ROOM,): of no samples."""
    return np.zeros(ROOM)


@inline_kernel
def nothing_yet() -> Preintegrated:
    """Of no samples: arrays of their own, by which a walk over samples takes two thirds of the time of parts of one."""
    q = np.zeros(4)
    q[3] = 1.0
    return Preintegrated(q, np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 6)), np.zeros((3, 6)))


@inline_kernel
def preintegrated_in(room: F64) -> Preintegrated:
    """Δ in an array, or where one begins."""
    k = ROOM_T + 1
    return Preintegrated(
        room[k : k + 4],
        room[k + 4 : k + 7],
        room[k + 7 : k + 10],
        room[k + 10 : k + 19].reshape(3, 3),
        room[k + 19 : k + 37].reshape(3, 6),
        room[k + 37 : k + 55].reshape(3, 6),
    )


@inline_kernel
def scratch_of_sample() -> SampleTerms:
    """Room for a sample."""
    return SampleTerms(np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)))


@part
def preintegrate(form: ImuLayout, z: F64, bias: F64, room: F64, jacobians: bool) -> None:
    """All samples of the measurement that begins at z[0], at a bias (6,), into `room`.

    Where that has them at a bias of the same bits already, they are not looked at.  Without `jacobians` it has to be
    new, and R_b, p_b and v_b are zero.
    """
    if has_bits_of(bias, room):
        return
    delta, scratch, total = nothing_yet(), scratch_of_sample(), 0.0
    for n in range(form.samples):
        add_sample(z, form.start + of.SAMPLE * n, bias, delta, scratch, jacobians)
        total += z[form.start + of.SAMPLE * n]
    room[ROOM_T] = total
    for c in range(of.BIAS):
        room[c] = bias[c]
    keep(delta, room)


@inline_kernel
def keep(delta: Preintegrated, room: F64) -> None:
    """Δ into an array that has room for it."""
    q, p, v, R_b, p_b, v_b = preintegrated_in(room)
    for c in range(4):
        q[c] = delta.q[c]
    for a in range(3):
        p[a], v[a] = delta.p[a], delta.v[a]
        for c in range(3):
            R_b[a, c] = delta.R_b[a, c]
        for c in range(6):
            p_b[a, c], v_b[a, c] = delta.p_b[a, c], delta.v_b[a, c]


@inline_kernel
def has_bits_of(bias: F64, room: F64) -> bool:
    """Whether `room` has samples, integrated at this bias to the bit."""
    same, here, there = room[ROOM_T] > 0.0, bias.view(np.int64), room.view(np.int64)
    for c in range(of.BIAS):
        same &= here[c] == there[c]
    return same


@part
def correct_to_first_order(form: ImuLayout, z: F64, bias: F64, room: F64) -> None:
    """Δ of a measurement that is integrated already, which begins at z[0], at a bias (6,).  (3.65)

    ΔR := ΔR exp(J_R δ_g),  J_R := Jr(J_R δ_g) J_R,  Δp += J_p δ,  Δv += J_v δ,  δ the bias less that of the measurement
    """
    for c in range(of.BIAS):
        room[c] = bias[c]
    for c in range(of.DELTA):
        room[of.BIAS + c] = z[form.start + c]
    q, p, v, R_b, p_b, v_b = preintegrated_in(room)
    turn, Jr, k = np.zeros(3), np.empty((3, 3)), form.bias_at
    for a in range(3):
        for c in range(of.BIAS):
            step = bias[c] - z[k + c]
            if c < 3:
                turn[a] += R_b[a, c] * step
            p[a] += p_b[a, c] * step
            v[a] += v_b[a, c] * step
    x, y, w = turn[0], turn[1], turn[2]
    square = x * x + y * y + w * w
    half, ew = half_turn(square)
    q[0], q[1], q[2], q[3] = quat_product(q[0], q[1], q[2], q[3], half * x, half * y, half * w, ew)
    _, b, c2 = series_of(square)
    fill_series(-b, c2, x, y, w, Jr)
    for c in range(3):
        b0, b1, b2 = R_b[0, c], R_b[1, c], R_b[2, c]
        for a in range(3):
            R_b[a, c] = Jr[a, 0] * b0 + Jr[a, 1] * b1 + Jr[a, 2] * b2


@inline_kernel
def add_sample(z: F64, k: int, b: F64, delta: Preintegrated, sample: SampleTerms, jacobians: bool) -> None:
    """One more sample, at z[k].  (3.44), (3.45)"""
    q, p, v = delta.q, delta.p, delta.v
    R = sample.R
    h, ax, ay, az = z[k], z[k + 4] - b[3], z[k + 5] - b[4], z[k + 6] - b[5]
    wx, wy, wz = h * (z[k + 1] - b[0]), h * (z[k + 2] - b[1]), h * (z[k + 3] - b[2])
    fill_rotation(q, 0, R)
    half, ew = half_turn(wx * wx + wy * wy + wz * wz)
    ex, ey, ez = half * wx, half * wy, half * wz
    if jacobians:
        _describe(ax, ay, az, wx, wy, wz, sample)
        _add_jacobians(h, delta, sample)
    for c in range(3):
        turned = R[c, 0] * ax + R[c, 1] * ay + R[c, 2] * az
        p[c] += h * (v[c] + 0.5 * h * turned)
        v[c] += h * turned
    q[0], q[1], q[2], q[3] = quat_product(q[0], q[1], q[2], q[3], ex, ey, ez, ew)
    n = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])  # 1/|q|, next to 1
    q[0], q[1], q[2], q[3] = n * q[0], n * q[1], n * q[2], n * q[3]


@inline_kernel
def fill_rotation(q: F64, k: int, R: F64) -> None:
    """R (3, 3) := the rotation of the quaternion at q[k]."""
    R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2] = rotation_matrix(q, k)


@inline_kernel
def _describe(ax: float, ay: float, az: float, x: float, y: float, z: float, sample: SampleTerms) -> None:
    """RA, E and Jr of a sample that turns by φ = (x, y, z) radians.

    exp φ = I + a ⌊φ⌋ + b ⌊φ⌋²,   Jr(φ) = I − b ⌊φ⌋ + c ⌊φ⌋²
    """
    R, RA = sample.R, sample.RA
    for i in range(3):
        RA[i, 0] = R[i, 1] * az - R[i, 2] * ay
        RA[i, 1] = R[i, 2] * ax - R[i, 0] * az
        RA[i, 2] = R[i, 0] * ay - R[i, 1] * ax
    a, b, c = series_of(x * x + y * y + z * z)
    fill_series(a, b, x, y, z, sample.E)
    fill_series(-b, c, x, y, z, sample.Jr)


@inline_kernel
def series_of(q: float) -> tuple:
    """(sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³) of θ²."""
    if q < SMALL_TURN:
        return few_terms_of(q)
    angle = math.sqrt(q)
    a, sine = math.sin(angle) / angle, math.sin(0.5 * angle)
    return a, 2.0 * sine * sine / q, (1.0 - a) / q


@inline_kernel
def few_terms_of(q: float) -> tuple:
    """The same where θ² is less than SMALL_TURN."""
    a = 1.0 - q * (1 / 6 - q * (1 / 120 - q * (1 / 5040 - q * (1 / 362880 - q * (1 / 39916800)))))
    b = 0.5 - q * (1 / 24 - q * (1 / 720 - q * (1 / 40320 - q * (1 / 3628800 - q * (1 / 479001600)))))
    c = 1 / 6 - q * (1 / 120 - q * (1 / 5040 - q * (1 / 362880 - q * (1 / 39916800))))
    return a, b, c


@inline_kernel
def fill_series(a: float, b: float, x: float, y: float, z: float, M: F64) -> None:
    """M = I + a ⌊φ⌋ + b ⌊φ⌋², φ = (x, y, z)."""
    M[0, 0], M[1, 1], M[2, 2] = 1.0 - b * (y * y + z * z), 1.0 - b * (x * x + z * z), 1.0 - b * (x * x + y * y)
    M[0, 1], M[1, 0] = b * x * y - a * z, b * x * y + a * z
    M[0, 2], M[2, 0] = b * x * z + a * y, b * x * z - a * y
    M[1, 2], M[2, 1] = b * y * z - a * x, b * y * z + a * x


@inline_kernel
def _add_jacobians(h: float, delta: Preintegrated, sample: SampleTerms) -> None:
    """By the bias, over one more sample.  (3.45)

    p_b += v_b h − ½ h² (R ⌊α⌋ R_b | R),  v_b −= h (R ⌊α⌋ R_b | R),  R_b := exp(ω h)ᵀ R_b − Jr(ω h) h
    """
    R_b, p_b, v_b, R, RA, E, Jr = delta.R_b, delta.p_b, delta.v_b, sample.R, sample.RA, sample.E, sample.Jr
    for a in range(3):
        for c in range(3):
            turned = RA[a, 0] * R_b[0, c] + RA[a, 1] * R_b[1, c] + RA[a, 2] * R_b[2, c]
            p_b[a, c] += h * (v_b[a, c] - 0.5 * h * turned)
            v_b[a, c] -= h * turned
            p_b[a, 3 + c] += h * (v_b[a, 3 + c] - 0.5 * h * R[a, c])
            v_b[a, 3 + c] -= h * R[a, c]
    for c in range(3):
        b0, b1, b2 = R_b[0, c], R_b[1, c], R_b[2, c]
        for a in range(3):
            R_b[a, c] = E[0, a] * b0 + E[1, a] * b1 + E[2, a] * b2 - h * Jr[a, c]
