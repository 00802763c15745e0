"""Δ of samples near the bias that their measurement names, without a look at them.  MATH §3.10.

When a factor is admitted Δ and its derivatives J are kept as they are there, and what J changes by with each of the
gyroscopes' biases.  With δ the bias less that of the measurement, δ_g of gyroscopes and δ_a of accelerometers,

    θ = (J_R + ½ J_R′[δ_g]) δ_g,   Δp += J_p δ + ½ J_p′[δ_g] δ_g + J_p′[δ_g] δ_a,   Δv the same                (3.63)

Of accelerometers alone Δp and Δv are linear.  What is of third order is bounded, (3.64); where the bound is more than
MOST_MISSED standard deviations of the noise, the samples are integrated.  All of it follows from the measurement and
the bias, so it is the same wherever it is evaluated.  Where a factor is linearized, what its samples were integrated to
serves in place of what was kept, for biases that are nearer to that one.
"""

import math

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model.imu_layout import ImuLayout
from factorbus.solver.kernels.model.imu_walk import BIAS, LANES, P_A, P_G, V_A, V_G, P, R, S, V, Walk
from factorbus.solver.kernels.model.preintegration import (
    ROOM_P,
    ROOM_P_B,
    ROOM_Q,
    ROOM_R_B,
    ROOM_T,
    ROOM_V,
    ROOM_V_B,
)
from factorbus.solver.kernels.model.se3 import half_turn, quat_product

MOST_MISSED = 1e-5
SLOPES = 45  # numbers of J
# The share by which rounding of the bias may change such a step; where it changes more J′ is of no use, and not used.
_EXACT = 1e-3
_OF_NO_USE = -1.0  # in place of ∫ |α| dt


@inline_kernel
def expansion_at(form: ImuLayout) -> int:
    """Where Δ is, as it is at the bias of the measurement; behind it J′, and ∫ |α| dt."""
    return form.start + of.SAMPLE * form.samples + of.ROOT


@part
def write_expansion(form: ImuLayout, z: F64, walk: Walk) -> None:
    """Write it behind the samples of the measurement that begins at z[0]."""
    k, n, w = expansion_at(form), expansion_at(form) + of.DELTA, walk.lanes
    z[k] = walk.duration
    z[k + 1], z[k + 2], z[k + 3], z[k + 4] = quaternion_of_lanes(w, R * LANES, LANES)
    for c in range(3):
        z[k + 5 + c], z[k + 8 + c] = w[(P + c) * LANES], w[(V + c) * LANES]
    J = np.empty((LANES, SLOPES))
    for m in range(LANES):
        put_slopes(w, m, J)
    for c in range(SLOPES):
        z[n - SLOPES + c] = J[0, c]
    is_seen = True
    for g in range(3):
        # By how much it really is off, as the bias is rounded.
        moved = w[(BIAS + g) * LANES + g + 1] - w[(BIAS + g) * LANES]
        is_seen &= abs(moved - walk.step) <= _EXACT * walk.step
        slope = 1.0 / moved if moved > 0.0 else 0.0
        for c in range(SLOPES):
            z[n + SLOPES * g + c] = slope * (J[g + 1, c] - J[0, c])
    z[n + 3 * SLOPES] = walk.way if is_seen else _OF_NO_USE


@inline_kernel
def put_slopes(w: F64, m: int, J: F64) -> None:
    """J of lane m, as `Preintegrated` has it: J_R = Rᵀ S, and those of p and v by gyroscopes and accelerometers."""
    for a in range(3):
        for c in range(3):
            r, s, k = (R + a) * LANES + m, (S + c) * LANES + m, (3 * a + c) * LANES + m
            J[m, 3 * a + c] = w[r] * w[s] + w[r + 3 * LANES] * w[s + 3 * LANES] + w[r + 6 * LANES] * w[s + 6 * LANES]
            J[m, 9 + 6 * a + c], J[m, 12 + 6 * a + c] = w[P_G * LANES + k], w[P_A * LANES + k]
            J[m, 27 + 6 * a + c], J[m, 30 + 6 * a + c] = w[V_G * LANES + k], w[V_A * LANES + k]


@inline_kernel
def quaternion_of_lanes(w: F64, k: int, step: int) -> tuple:
    """Of the rotation whose numbers are at w[k], w[k + step], …, row by row; the largest of the four is above zero."""
    r0, r1, r2, r3 = w[k], w[k + step], w[k + 2 * step], w[k + 3 * step]
    r4, r5, r6, r7, r8 = w[k + 4 * step], w[k + 5 * step], w[k + 6 * step], w[k + 7 * step], w[k + 8 * step]
    if r0 + r4 + r8 > 0.0:
        x, y, z, v = r7 - r5, r2 - r6, r3 - r1, 1.0 + r0 + r4 + r8
    elif r0 >= r4 and r0 >= r8:
        x, y, z, v = 1.0 + r0 - r4 - r8, r1 + r3, r2 + r6, r7 - r5
    elif r4 >= r8:
        x, y, z, v = r1 + r3, 1.0 + r4 - r0 - r8, r5 + r7, r2 - r6
    else:
        x, y, z, v = r2 + r6, r5 + r7, 1.0 + r8 - r0 - r4, r3 - r1
    n = 1.0 / math.sqrt(x * x + y * y + z * z + v * v)
    return n * x, n * y, n * z, n * v


@inline_kernel
def bias_distances(b: int, base: F64, bias: F64, T: float) -> tuple[float, float]:
    """(|δ_g| T, |δ_a| T), δ = bias − base[b : b+6]."""
    x, y, w = bias[0] - base[b], bias[1] - base[b + 1], bias[2] - base[b + 2]
    g = x * x + y * y + w * w
    x, y, w = bias[3] - base[b + 3], bias[4] - base[b + 4], bias[5] - base[b + 5]
    return T * math.sqrt(g), T * math.sqrt(x * x + y * y + w * w)


@inline_kernel
def missed(form: ImuLayout, z: F64, g: float, a: float, g0: float, a0: float) -> float:
    """What (3.63) misses, at most, in standard deviations: g = |δ_g| T and a = |δ_a| T from where Δ is known, g₀ and a₀
    from there to the bias of the measurement, where J′ is; V = ∫ |α| dt

        e_g = g² (g + 3 g₀) / 6,   e_a = V e_g + (g² (a + a₀) + 2 g₀ g a) / 6,   (e_g / σ_g + 2 e_a / σ_a) / √T  (3.64)
    """
    k = expansion_at(form)
    turned, way = g * g * (g + 3.0 * g0) / 6.0, z[k + of.DELTA + 3 * SLOPES]
    if way < 0.0:
        return np.inf
    pushed = way * turned + (g * g * (a + a0) + 2.0 * g0 * g * a) / 6.0
    return (turned / z[of.GYROSCOPE] + 2.0 * pushed / z[of.ACCELEROMETER]) / math.sqrt(z[k])


@part
def expand_delta(form: ImuLayout, z: F64, bias: F64, room: F64) -> bool:
    """Δ and J of the measurement that begins at z[0] at a bias (6,) into `room`, (3.63); False: it is too far."""
    k = expansion_at(form)
    g, a = bias_distances(form.bias_at, z, bias, z[k])
    if not missed(form, z, g, a, 0.0, 0.0) <= MOST_MISSED:
        return False
    _expand(z, form.bias_at, k, z, k + of.DELTA, bias, room)
    return True


@part
def expand_near(form: ImuLayout, z: F64, kept: F64, bias: F64, room: F64) -> bool:
    """The same from what the samples were integrated to at another bias, in `kept`; False: it is too far."""
    T = kept[ROOM_T]
    if not T > 0.0:
        return False
    g, a = bias_distances(0, kept, bias, T)
    g0, a0 = bias_distances(form.bias_at, z, kept, T)
    if not missed(form, z, g, a, g0, a0) <= MOST_MISSED:
        return False
    _expand(kept, 0, ROOM_T, z, expansion_at(form) + of.DELTA, bias, room)
    return True


@part
def _expand(base: F64, b: int, k: int, d: F64, n: int, bias: F64, room: F64) -> None:
    """(3.63): the bias where Δ is known is at base[b], Δ at base[k], J′ at d[n]."""
    M = np.empty(SLOPES + 3)
    d0, d1, d2 = bias[0] - base[b], bias[1] - base[b + 1], bias[2] - base[b + 2]
    a0, a1, a2 = bias[3] - base[b + 3], bias[4] - base[b + 4], bias[5] - base[b + 5]
    for c in range(of.BIAS):
        room[c] = bias[c]
    for c in range(of.DELTA):
        room[ROOM_T + c] = base[k + c]
    for c in range(SLOPES):
        # M = J′[δ_g]
        slope = d0 * d[n + c] + d1 * d[n + SLOPES + c] + d2 * d[n + 2 * SLOPES + c]
        M[c] = slope
        room[ROOM_R_B + c] += slope
    for a in range(3):
        # By J + M less half of it.
        i, m = ROOM_R_B + 3 * a, 3 * a
        theta = (room[i] - 0.5 * M[m]) * d0 + (room[i + 1] - 0.5 * M[m + 1]) * d1
        M[SLOPES + a] = theta + (room[i + 2] - 0.5 * M[m + 2]) * d2
        for to, i, m in ((ROOM_P + a, ROOM_P_B + 6 * a, 9 + 6 * a), (ROOM_V + a, ROOM_V_B + 6 * a, 27 + 6 * a)):
            turned = (room[i] - 0.5 * M[m]) * d0 + (room[i + 1] - 0.5 * M[m + 1]) * d1
            turned += (room[i + 2] - 0.5 * M[m + 2]) * d2
            pushed = room[i + 3] * a0 + room[i + 4] * a1 + room[i + 5] * a2
            room[to] += turned + pushed
            for c in range(3):
                e = n + SLOPES * c + m + 3
                slope = d[e] * a0 + d[e + 1] * a1 + d[e + 2] * a2
                room[i + c] += slope
    x, y, w, q = M[SLOPES], M[SLOPES + 1], M[SLOPES + 2], ROOM_Q
    half, ew = half_turn(x * x + y * y + w * w)
    room[q], room[q + 1], room[q + 2], room[q + 3] = quat_product(
        room[q], room[q + 1], room[q + 2], room[q + 3], half * x, half * y, half * w, ew
    )
