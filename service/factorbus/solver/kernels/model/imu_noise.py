"""How certain what an IMU says is: the covariance of Δ, and what whitens by it.  MATH §3.10.

What sample n does to Δ, in the frame where the samples begin, with p and v behind it and t from there to the end:

    D = [ I ; −⌊c⌋ ; −⌊d⌋ ],   c = Δp − p − v t,   d = Δv − v,   Q = R Jr Jrᵀ Rᵀ = s I + κ u uᵀ
    Σ = Σₙ σ_g² h D Q Dᵀ + σ_a² h [ 0 ; τ I ; I ] [ 0 ; τ I ; I ]ᵀ + σ_i² h [ 0 ; I ; 0 ] [ 0 ; I ; 0 ]ᵀ          (3.66)

the order (rotation, position, velocity), u = R ω h, s = 2 (1 − cos θ)/θ², κ = (1 − s)/θ², τ = t + ½ h.  Then the
rotation is turned to where the samples end.
"""

import math

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model.imu_walk import (
    LANES,
    T_B,
    T_H,
    T_LEFT,
    T_P,
    T_U,
    T_V,
    T_WIDTH,
    P,
    R,
    V,
    Walk,
)
from factorbus.solver.kernels.model.se3 import SMALL_TURN

SIZE = 9  # numbers of Δ
# A pivot below this share of its diagonal entry is rounding: Σ is singular.
_PIVOT_TOLERANCE = 1e-14


@part
def write_root(z: F64, walk: Walk, k: int, out: F64) -> bool:
    """W lower triangular, row by row, to out[k:], with WᵀW = Σ⁻¹ of the measurement that begins at z[0]; False: Σ is
    singular, as of a single sample without noise of integration."""
    L = propagate_noise(z, walk)
    if not _factorize(L):
        return False
    # W = L⁻¹, column by column.
    W = np.zeros((SIZE, SIZE))
    for c in range(SIZE):
        W[c, c] = 1.0 / L[c, c]
        for a in range(c + 1, SIZE):
            total = 0.0
            for q in range(c, a):
                total += L[a, q] * W[q, c]
            W[a, c] = -total / L[a, a]
    for a in range(SIZE):
        for c in range(a + 1):
            out[k] = W[a, c]
            k += 1
    return True


@part
def propagate_noise(z: F64, walk: Walk) -> F64:
    """Σ (9, 9) of Δ, at the bias that the measurement names.  (3.46), as (3.66) has it"""
    S, trace, w = np.zeros(SIZE * SIZE), walk.trace, walk.lanes
    p = w[P * LANES], w[(P + 1) * LANES], w[(P + 2) * LANES]
    v = w[V * LANES], w[(V + 1) * LANES], w[(V + 2) * LANES]
    isotropic = drifts = spreads = steps = 0.0  # Σ s h, and what accelerometers and integration add
    for k in range(0, trace.size, T_WIDTH):
        left, h = trace[k + T_LEFT], trace[k + T_H]
        reach = left + 0.5 * h
        steps, drifts, spreads = steps + h, drifts + h * reach, spreads + h * reach * reach
        d = _less(v, trace, k + T_V, 1.0, (0.0, 0.0, 0.0))
        c = _less(p, trace, k + T_V, left, _three(trace, k + T_P))
        u = _three(trace, k + T_U)
        share, square = 2.0 * trace[k + T_B], u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
        # 1 − s is as small as θ² is.
        if square < SMALL_TURN:
            axial = 1 / 12 - square * (1 / 360 - square * (1 / 20160 - square * (1 / 1814400 - square / 239500800)))
        else:
            axial = (1.0 - share) / square
        isotropic += share * h
        _add_sample(share * h, axial * h, c, d, u, S)
    out, turned = np.zeros((SIZE, SIZE)), z[of.GYROSCOPE] * z[of.GYROSCOPE]
    _turn_to_end(S, isotropic, turned, w, out)
    pushed, integration = z[of.ACCELEROMETER] * z[of.ACCELEROMETER], z[of.INTEGRATION] * z[of.INTEGRATION]
    for a in range(3):
        out[3 + a, 3 + a] += pushed * spreads + integration * steps
        out[6 + a, 3 + a] += pushed * drifts
        out[6 + a, 6 + a] += pushed * steps
    for a in range(SIZE):
        for c in range(a):
            out[c, a] = out[a, c]
    return out


@inline_kernel
def _three(a: F64, k: int) -> tuple:
    return a[k], a[k + 1], a[k + 2]


@inline_kernel
def _less(x: tuple, a: F64, k: int, scale: float, y: tuple) -> tuple:
    """x − y − scale a[k : k+3]."""
    return (
        x[0] - y[0] - scale * a[k],
        x[1] - y[1] - scale * a[k + 1],
        x[2] - y[2] - scale * a[k + 2],
    )


@inline_kernel
def _cross(x: tuple, y: tuple) -> tuple:
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@inline_kernel
def _add_sample(isotropic: float, axial: float, c: tuple, d: tuple, u: tuple, S: F64) -> None:
    """S += D (s I + κ u uᵀ) Dᵀ on and below the diagonal, but for s I of the rotation; isotropic = s h, axial = κ h."""
    e, f = _cross(u, c), _cross(u, d)
    bu, be, bf = _times(axial, u), _times(axial, e), _times(axial, f)
    pc, pd = _times(isotropic, c), _times(isotropic, d)
    cc, cd, dd = _dot(pc, c), _dot(pc, d), _dot(pd, d)
    _add(S, 0, bu[0] * u[0])
    _add(S, 9, bu[1] * u[0])
    _add(S, 10, bu[1] * u[1])
    _add(S, 18, bu[2] * u[0])
    _add(S, 19, bu[2] * u[1])
    _add(S, 20, bu[2] * u[2])
    _add_row(S, 27, be[0], u, (0.0, pc[2], -pc[1]))
    _add_row(S, 36, be[1], u, (-pc[2], 0.0, pc[0]))
    _add_row(S, 45, be[2], u, (pc[1], -pc[0], 0.0))
    _add_row(S, 54, bf[0], u, (0.0, pd[2], -pd[1]))
    _add_row(S, 63, bf[1], u, (-pd[2], 0.0, pd[0]))
    _add_row(S, 72, bf[2], u, (pd[1], -pd[0], 0.0))
    _add(S, 30, be[0] * e[0] + cc - pc[0] * c[0])
    _add(S, 39, be[1] * e[0] - pc[1] * c[0])
    _add(S, 40, be[1] * e[1] + cc - pc[1] * c[1])
    _add(S, 48, be[2] * e[0] - pc[2] * c[0])
    _add(S, 49, be[2] * e[1] - pc[2] * c[1])
    _add(S, 50, be[2] * e[2] + cc - pc[2] * c[2])
    _add_row(S, 57, bf[0], e, (cd - pc[0] * d[0], -pc[0] * d[1], -pc[0] * d[2]))
    _add_row(S, 66, bf[1], e, (-pc[1] * d[0], cd - pc[1] * d[1], -pc[1] * d[2]))
    _add_row(S, 75, bf[2], e, (-pc[2] * d[0], -pc[2] * d[1], cd - pc[2] * d[2]))
    _add(S, 60, bf[0] * f[0] + dd - pd[0] * d[0])
    _add(S, 69, bf[1] * f[0] - pd[1] * d[0])
    _add(S, 70, bf[1] * f[1] + dd - pd[1] * d[1])
    _add(S, 78, bf[2] * f[0] - pd[2] * d[0])
    _add(S, 79, bf[2] * f[1] - pd[2] * d[1])
    _add(S, 80, bf[2] * f[2] + dd - pd[2] * d[2])


@inline_kernel
def _times(x: float, y: tuple) -> tuple:
    return x * y[0], x * y[1], x * y[2]


@inline_kernel
def _dot(x: tuple, y: tuple) -> float:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@inline_kernel
def _add(S: F64, k: int, x: float) -> None:
    S[k] += x


@inline_kernel
def _add_row(S: F64, k: int, x: float, y: tuple, more: tuple) -> None:
    """S[k : k+3] += x y + more."""
    _add(S, k, x * y[0] + more[0])
    _add(S, k + 1, x * y[1] + more[1])
    _add(S, k + 2, x * y[2] + more[2])


@inline_kernel
def _turn_to_end(S: F64, isotropic: float, scale: float, w: F64, out: F64) -> None:
    """The sum times `scale`, with the rotation as seen where the samples end: its rows and columns times R."""
    for a in range(SIZE):
        for c in range(a + 1):
            out[a, c] = scale * S[SIZE * a + c]
    for a in range(3):
        out[a, a] += scale * isotropic
        for c in range(a):
            out[c, a] = out[a, c]
    for a in range(SIZE):
        s0, s1, s2 = out[a, 0], out[a, 1], out[a, 2]
        for c in range(3):
            k = (R + c) * LANES
            out[a, c] = s0 * w[k] + s1 * w[k + 3 * LANES] + s2 * w[k + 6 * LANES]
    for c in range(3):
        s0, s1, s2 = out[0, c], out[1, c], out[2, c]
        for a in range(3):
            k = (R + a) * LANES
            out[a, c] = w[k] * s0 + w[k + 3 * LANES] * s1 + w[k + 6 * LANES] * s2


@inline_kernel
def _factorize(S: F64) -> bool:
    """L with L Lᵀ = S, in its lower triangle; False: a pivot is rounding."""
    for a in range(SIZE):
        diagonal = S[a, a]
        for q in range(a):
            S[a, a] -= S[a, q] * S[a, q]
        if not (diagonal > 0.0 and S[a, a] > _PIVOT_TOLERANCE * diagonal):
            return False
        S[a, a] = math.sqrt(S[a, a])
        for c in range(a + 1, SIZE):
            for q in range(a):
                S[c, a] -= S[c, q] * S[a, q]
            S[c, a] /= S[a, a]
    return True
