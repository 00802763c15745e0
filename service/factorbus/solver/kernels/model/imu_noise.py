"""How certain what an IMU says is: the covariance of Δ, and what whitens by it.  MATH §3.10.

Σ := F Σ Fᵀ + G Q Gᵀ,   the order (rotation, position, velocity)                                        (3.46)

F = [ exp(ω h)ᵀ 0 0 ; −½ h² R ⌊α⌋  I  h I ; −h R ⌊α⌋  0  I ],
G Q Gᵀ: of the gyroscopes σ_g² h Jr Jrᵀ, of the accelerometers σ_a² h (¼ h² I | ½ h I | I), of integration σ_i² h I
"""

import math

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model.imu_layout import ImuLayout
from factorbus.solver.kernels.model.preintegration import (
    SampleTerms,
    add_sample,
    nothing_yet,
    scratch_of_sample,
)

SIZE = 9  # numbers of Δ
# A pivot below this share of its diagonal entry is rounding: Σ is singular.
_PIVOT_TOLERANCE = 1e-14


@part
def write_root(form: ImuLayout, z: F64, k: int, out: F64) -> bool:
    """W lower triangular, row by row, to out[k:], with WᵀW = Σ⁻¹ of the measurement that begins at z[0]; False: Σ is
    singular, as of a single sample without noise of integration."""
    L = propagate_noise(form, z)
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
def propagate_noise(form: ImuLayout, z: F64) -> F64:
    """Σ (9, 9) of Δ, at the bias that the measurement names.  (3.46)"""
    delta, sample, S = nothing_yet(), scratch_of_sample(), np.zeros((SIZE, SIZE))
    M, bias = np.empty((4, 3, 3)), z[form.bias_at : form.bias_at + of.BIAS]
    gyroscope, accelerometer, integration = z[of.GYROSCOPE], z[of.ACCELEROMETER], z[of.INTEGRATION]
    for n in range(form.samples):
        k = form.start + of.SAMPLE * n
        add_sample(z, k, bias, delta, sample, True)
        h, Jr = z[k], sample.Jr
        _carry(h, sample, S, M)
        turned, pushed = gyroscope * gyroscope * h, accelerometer * accelerometer * h
        for a in range(3):
            for c in range(a + 1):
                S[a, c] += turned * (Jr[a, 0] * Jr[c, 0] + Jr[a, 1] * Jr[c, 1] + Jr[a, 2] * Jr[c, 2])
            S[3 + a, 3 + a] += 0.25 * h * h * pushed + integration * integration * h
            S[6 + a, 3 + a] += 0.5 * h * pushed
            S[6 + a, 6 + a] += pushed
    for a in range(SIZE):
        for c in range(a):
            S[c, a] = S[a, c]
    return S


@inline_kernel
def _carry(h: float, sample: SampleTerms, S: F64, M: F64) -> None:
    """Σ := F Σ Fᵀ, of which the lower triangle is kept, but whole blocks off the diagonal.

    With α = A r and A = −h R ⌊α⌋: v += α, p += h v + ½ h α with the v of before, then r := exp(ω h)ᵀ r.
    M (4, 3, 3): covariances of α with r, p and v, and of itself.
    """
    RA, E, ar, ap, av, aa = sample.RA, sample.E, M[0], M[1], M[2], M[3]
    for a in range(3):
        for c in range(a):
            S[c, a], S[3 + c, 3 + a], S[6 + c, 6 + a] = S[a, c], S[3 + a, 3 + c], S[6 + a, 6 + c]
    for a in range(3):
        A0, A1, A2 = -h * RA[a, 0], -h * RA[a, 1], -h * RA[a, 2]
        for c in range(3):
            ar[a, c] = A0 * S[0, c] + A1 * S[1, c] + A2 * S[2, c]
            ap[a, c] = A0 * S[3 + c, 0] + A1 * S[3 + c, 1] + A2 * S[3 + c, 2]
            av[a, c] = A0 * S[6 + c, 0] + A1 * S[6 + c, 1] + A2 * S[6 + c, 2]
    for a in range(3):
        for c in range(3):
            aa[a, c] = -h * (ar[a, 0] * RA[c, 0] + ar[a, 1] * RA[c, 1] + ar[a, 2] * RA[c, 2])
    for a in range(3):
        for c in range(a + 1):
            vp, pv = S[6 + a, 3 + c] + 0.5 * ap[a, c], S[6 + c, 3 + a] + 0.5 * ap[c, a]
            ww = S[6 + a, 6 + c] + 0.5 * (av[a, c] + av[c, a]) + 0.25 * aa[a, c]
            S[3 + a, 3 + c] += h * (vp + pv + h * ww)
    for a in range(3):
        for c in range(3):
            vv = S[6 + a, 6 + c] + av[a, c] + 0.5 * (av[c, a] + aa[a, c])
            S[6 + a, 3 + c] += ap[a, c] + h * vv
            S[3 + a, c] += h * (S[6 + a, c] + 0.5 * ar[a, c])
    for a in range(3):
        for c in range(3):
            S[6 + a, c] += ar[a, c]
        for c in range(a + 1):
            S[6 + a, 6 + c] += av[a, c] + av[c, a] + aa[a, c]
    _turn_columns(3, E, S)
    _turn_columns(6, E, S)
    _turn_columns(0, E, S)
    for c in range(3):
        s0, s1, s2 = S[0, c], S[1, c], S[2, c]
        for a in range(3):
            S[a, c] = E[0, a] * s0 + E[1, a] * s1 + E[2, a] * s2


@inline_kernel
def _turn_columns(row: int, E: F64, S: F64) -> None:
    """The block of a row with the rotation, times E."""
    for a in range(row, row + 3):
        s0, s1, s2 = S[a, 0], S[a, 1], S[a, 2]
        for c in range(3):
            S[a, c] = s0 * E[0, c] + s1 * E[1, c] + s2 * E[2, c]


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
