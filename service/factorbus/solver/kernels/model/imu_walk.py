"""One walk over the samples of a new measurement, for all that is kept of them.  MATH §3.10.

Δ and its derivatives are wanted at the bias that the measurement names, and at three more beside it, one for each of
the gyroscopes; and for the covariance of Δ what each sample does.  All four are carried side by side, a lane each, so
that they take little more than one.  In place of (3.45) the derivatives are in the frame where the samples begin: with
S what the rotation turns by there, u = R ω h, and a = R α,

    R := R + a₁ ⌊u⌋ R + b₁ ⌊u⌋² R,   S −= h (R + b₁ ⌊u⌋ R + c₁ ⌊u⌋² R),   v_g −= h ⌊a⌋ S,   v_a −= h R
    p_g += h v_g − ½ h² ⌊a⌋ S,   p_a += h v_a − ½ h² R,   with S, R and v as they were before the sample

a₁ = sin θ/θ, b₁ = (1 − cos θ)/θ², c₁ = (θ − sin θ)/θ³ of θ = |ω h|.  At the end J_R = Rᵀ S.
"""

import math
from typing import NamedTuple

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model.imu_layout import ImuLayout
from factorbus.solver.kernels.model.preintegration import few_terms_of, series_of
from factorbus.solver.kernels.model.se3 import SMALL_TURN

LANES = 4  # the bias of the measurement, and one beside it for each gyroscope
STEP = 1e-5  # radians that the lanes beside it are off, of the rotation in all
# Rows of a walk, a number of each lane: R, S, the derivatives of v and p by gyroscopes and by accelerometers, v and p;
# the bias of the gyroscopes; of the sample at hand u, θ² and the three series.
R, S, V_G, P_G, V_A, P_A, V, P = 0, 9, 18, 27, 36, 45, 54, 57
BIAS, _U, _SQUARE, _A, _B, _C, _ROWS = 60, 63, 66, 67, 68, 69, 70
# Of each sample in lane 0: p and v behind it, u, how long it is to the end from behind it, h, b₁.
T_P, T_V, T_U, T_LEFT, T_H, T_B, T_WIDTH = 0, 3, 6, 9, 10, 11, 12


class Walk(NamedTuple):
    """What a walk comes to.  lanes (rows · LANES,): see R and so on; trace (samples · T_WIDTH,): see T_P; duration,
    way = ∫ |α| dt; step: by how much the lanes beside the first are off, rad/s."""

    lanes: F64
    trace: F64
    duration: float
    way: float
    step: float


@part
def walk_samples(form: ImuLayout, z: F64) -> Walk:
    """Over the samples of the measurement that begins at z[0]."""
    w, trace, k, total = np.zeros(_ROWS * LANES), np.empty(form.samples * T_WIDTH), form.start, 0.0
    for n in range(form.samples):
        total += z[k + of.SAMPLE * n]
    step = STEP / total
    for m in range(LANES):
        w[R * LANES + m] = w[(R + 4) * LANES + m] = w[(R + 8) * LANES + m] = 1.0
        for c in range(3):
            w[(BIAS + c) * LANES + m] = z[form.bias_at + c] + (step if m == c + 1 else 0.0)
    left, way = total, 0.0
    for n in range(form.samples):
        k = form.start + of.SAMPLE * n
        h = z[k]
        ax, ay, az = z[k + 4] - z[form.bias_at + 3], z[k + 5] - z[form.bias_at + 4], z[k + 6] - z[form.bias_at + 5]
        turn_lanes(h, z, k, w)
        if n + 1 == form.samples:
            left = 0.0
        else:
            left -= h
        t = n * T_WIDTH
        for c in range(3):
            trace[t + T_U + c] = w[(_U + c) * LANES]
        trace[t + T_LEFT], trace[t + T_H], trace[t + T_B] = left, h, w[_B * LANES]
        add_to_lanes(h, ax, ay, az, w)
        for c in range(3):
            trace[t + T_P + c], trace[t + T_V + c] = w[(P + c) * LANES], w[(V + c) * LANES]
        way += h * math.sqrt(ax * ax + ay * ay + az * az)
    return Walk(w, trace, total, way, step)


@inline_kernel
def turn_lanes(h: float, z: F64, k: int, w: F64) -> None:
    """By how much the sample at z[k] turns, and the series of it."""
    gx, gy, gz = z[k + 1], z[k + 2], z[k + 3]
    for m in range(LANES):
        x, y = h * (gx - w[BIAS * LANES + m]), h * (gy - w[(BIAS + 1) * LANES + m])
        v = h * (gz - w[(BIAS + 2) * LANES + m])
        q = x * x + y * y + v * v
        w[_SQUARE * LANES + m] = q
        put_turned(R * LANES + m, x, y, v, _U * LANES + m, w)
        put_turned((R + 3) * LANES + m, x, y, v, (_U + 1) * LANES + m, w)
        put_turned((R + 6) * LANES + m, x, y, v, (_U + 2) * LANES + m, w)
        a, b, c = few_terms_of(q)
        w[_A * LANES + m] = a
        w[_B * LANES + m] = b
        w[_C * LANES + m] = c
    for m in range(LANES):
        if w[_SQUARE * LANES + m] >= SMALL_TURN:
            w[_A * LANES + m], w[_B * LANES + m], w[_C * LANES + m] = series_of(w[_SQUARE * LANES + m])


@inline_kernel
def put_turned(row: int, x: float, y: float, z: float, to: int, w: F64) -> None:
    """A row of R times (x, y, z)."""
    w[to] = w[row] * x + w[row + LANES] * y + w[row + 2 * LANES] * z


@inline_kernel
def add_to_lanes(h: float, ax: float, ay: float, az: float, w: F64) -> None:
    """One more sample, of the acceleration (ax, ay, az) less its bias."""
    for m in range(LANES):
        i = R * LANES + m
        r0, r1, r2 = w[i], w[i + LANES], w[i + 2 * LANES]
        r3, r4, r5 = w[i + 3 * LANES], w[i + 4 * LANES], w[i + 5 * LANES]
        r6, r7, r8 = w[i + 6 * LANES], w[i + 7 * LANES], w[i + 8 * LANES]
        f0, f1, f2 = r0 * ax + r1 * ay + r2 * az, r3 * ax + r4 * ay + r5 * az, r6 * ax + r7 * ay + r8 * az
        put_pushed(LANES, V * LANES + m, P * LANES + m, h, (f0, f1, f2), w)
        u = w[_U * LANES + m], w[(_U + 1) * LANES + m], w[(_U + 2) * LANES + m]
        add_to_column(0, m, h, (f0, f1, f2), u, w)
        add_to_column(1, m, h, (f0, f1, f2), u, w)
        add_to_column(2, m, h, (f0, f1, f2), u, w)


@inline_kernel
def add_to_column(c: int, m: int, h: float, f: tuple, u: tuple, w: F64) -> None:
    """The same of column c of R, of S, and of the derivatives, in lane m; f = a."""
    g, a = c * LANES + m, w[_A * LANES + m]
    b, d = w[_B * LANES + m], w[_C * LANES + m]
    i, j = R * LANES + g, S * LANES + g
    s0, s1, s2 = w[j], w[j + 3 * LANES], w[j + 6 * LANES]
    # −⌊a⌋ s = s × a
    pushed = s1 * f[2] - s2 * f[1], s2 * f[0] - s0 * f[2], s0 * f[1] - s1 * f[0]
    put_pushed(3 * LANES, V_G * LANES + g, P_G * LANES + g, h, pushed, w)
    x0, x1, x2 = w[i], w[i + 3 * LANES], w[i + 6 * LANES]
    put_pushed(3 * LANES, V_A * LANES + g, P_A * LANES + g, h, (-x0, -x1, -x2), w)
    # ⌊u⌋ x and ⌊u⌋² x
    y0, y1, y2 = u[1] * x2 - u[2] * x1, u[2] * x0 - u[0] * x2, u[0] * x1 - u[1] * x0
    t0, t1, t2 = u[1] * y2 - u[2] * y1, u[2] * y0 - u[0] * y2, u[0] * y1 - u[1] * y0
    w[j] = s0 - h * (x0 + b * y0 + d * t0)
    w[j + 3 * LANES] = s1 - h * (x1 + b * y1 + d * t1)
    w[j + 6 * LANES] = s2 - h * (x2 + b * y2 + d * t2)
    w[i] = x0 + a * y0 + b * t0
    w[i + 3 * LANES] = x1 + a * y1 + b * t1
    w[i + 6 * LANES] = x2 + a * y2 + b * t2


@inline_kernel
def put_pushed(row: int, v: int, p: int, h: float, a: tuple, w: F64) -> None:
    """p += h v + ½ h² a, v += h a, of three numbers that are `row` apart."""
    put_one_pushed(v, p, h * a[0], h, w)
    put_one_pushed(v + row, p + row, h * a[1], h, w)
    put_one_pushed(v + 2 * row, p + 2 * row, h * a[2], h, w)


@inline_kernel
def put_one_pushed(v: int, p: int, more: float, h: float, w: F64) -> None:
    before = w[v]
    w[p] += h * (before + 0.5 * more)
    w[v] = before + more
