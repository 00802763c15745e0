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
from factorbus.solver.kernels.jit.simd import at as load
from factorbus.solver.kernels.jit.simd import put
from factorbus.solver.kernels.model.imu_layout import ImuLayout
from factorbus.solver.kernels.model.preintegration import (
    ROOM,
    ROOM_P,
    ROOM_P_B,
    ROOM_Q,
    ROOM_R_B,
    ROOM_T,
    ROOM_V,
    ROOM_V_B,
    half_turn,
    make_room,
    preintegrate,
)
from factorbus.solver.kernels.model.se3 import quat_product

MOST_MISSED = 1e-5
_SLOPES = 45  # numbers of J
_STEP = 1e-5  # radians that the differences are over, of the rotation in all
# The share by which rounding of the bias may change such a step; where it changes more J′ is of no use, and not used.
_EXACT = 1e-3
_OF_NO_USE = -1.0  # in place of ∫ |α| dt


@inline_kernel
def expansion_at(form: ImuLayout) -> int:
    """Where Δ is, as it is at the bias of the measurement; behind it J′, and ∫ |α| dt."""
    return form.start + of.SAMPLE * form.samples + of.ROOT


@part
def write_expansion(form: ImuLayout, z: F64) -> None:
    """Write it behind the samples of the measurement that begins at z[0]."""
    room, bias, k = make_room(), z[form.bias_at : form.bias_at + of.BIAS].copy(), expansion_at(form)
    preintegrate(form, z, bias, room, True)
    for c in range(of.DELTA):
        z[k + c] = room[of.BIAS + c]
    step, is_seen = _STEP / z[k], True
    for g in range(3):
        shifted, off = make_room(), bias.copy()
        off[g] += step
        preintegrate(form, z, off, shifted, True)
        moved = off[g] - bias[g]
        is_seen &= abs(moved - step) <= _EXACT * step
        slope = 1.0 / moved if moved > 0.0 else 0.0
        for c in range(_SLOPES):
            z[k + of.DELTA + _SLOPES * g + c] = slope * (shifted[ROOM - _SLOPES + c] - room[ROOM - _SLOPES + c])
    way = 0.0
    for n in range(form.start, form.start + of.SAMPLE * form.samples, of.SAMPLE):
        x, y, w = z[n + 4] - bias[3], z[n + 5] - bias[4], z[n + 6] - bias[5]
        way += z[n] * math.sqrt(x * x + y * y + w * w)
    z[k + of.DELTA + 3 * _SLOPES] = way if is_seen else _OF_NO_USE


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
    turned, way = g * g * (g + 3.0 * g0) / 6.0, z[k + of.DELTA + 3 * _SLOPES]
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
    M = np.empty(_SLOPES + 3)
    d0, d1, d2 = bias[0] - base[b], bias[1] - base[b + 1], bias[2] - base[b + 2]
    a0, a1, a2 = bias[3] - base[b + 3], bias[4] - base[b + 4], bias[5] - base[b + 5]
    for c in range(of.BIAS):
        put(room, c, load(bias, c))
    for c in range(of.DELTA):
        put(room, ROOM_T + c, load(base, k + c))
    for c in range(_SLOPES):
        # M = J′[δ_g]
        slope = d0 * load(d, n + c) + d1 * load(d, n + _SLOPES + c) + d2 * load(d, n + 2 * _SLOPES + c)
        put(M, c, slope)
        put(room, ROOM_R_B + c, load(room, ROOM_R_B + c) + slope)
    for a in range(3):
        # By J + M less half of it.
        i, m = ROOM_R_B + 3 * a, 3 * a
        theta = (load(room, i) - 0.5 * load(M, m)) * d0 + (load(room, i + 1) - 0.5 * load(M, m + 1)) * d1
        put(M, _SLOPES + a, theta + (load(room, i + 2) - 0.5 * load(M, m + 2)) * d2)
        for to, i, m in ((ROOM_P + a, ROOM_P_B + 6 * a, 9 + 6 * a), (ROOM_V + a, ROOM_V_B + 6 * a, 27 + 6 * a)):
            turned = (load(room, i) - 0.5 * load(M, m)) * d0 + (load(room, i + 1) - 0.5 * load(M, m + 1)) * d1
            turned += (load(room, i + 2) - 0.5 * load(M, m + 2)) * d2
            pushed = load(room, i + 3) * a0 + load(room, i + 4) * a1 + load(room, i + 5) * a2
            put(room, to, load(room, to) + turned + pushed)
            for c in range(3):
                e = n + _SLOPES * c + m + 3
                slope = load(d, e) * a0 + load(d, e + 1) * a1 + load(d, e + 2) * a2
                put(room, i + c, load(room, i + c) + slope)
    x, y, w, q = M[_SLOPES], M[_SLOPES + 1], M[_SLOPES + 2], ROOM_Q
    half, ew = half_turn(x * x + y * y + w * w)
    room[q], room[q + 1], room[q + 2], room[q + 3] = quat_product(
        room[q], room[q + 1], room[q + 2], room[q + 3], half * x, half * y, half * w, ew
    )
