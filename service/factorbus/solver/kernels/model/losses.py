"""Robust losses: a factor that is far off counts for less.  MATH §3.2.

A factor with residual r counts ρ(s), s = rᵀ Ω r, instead of s.  Where it is linearized, r and its Jacobians are
multiplied by √w, w = ρ'(s): the normal equations of Σ w s have the gradient of Σ ρ(s), and Gauss-Newton on them is
iteratively reweighted least squares.  ρ is concave in s, so the model never promises less than it keeps.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.dispatch import check_same, returning
from factorbus.solver.kernels.model.sizes import information_at, residual_dim, scale_at


@part
def soften(kind: int, loss: int, p: int, payload: F64, more: float, r: F64, A: F64, B: F64) -> float:
    """Multiply r, A and B by √w; gives ρ(s) − w rᵀ Ω r, which is what they lack in χ².

    p: where the factor's payload starts; more: what s has beside rᵀ Ω r (an inactive observation)
    """
    dim, q = residual_dim(kind), p + information_at(kind)
    own = 0.0
    for a in range(dim):
        own += r[a] * payload[q] * r[a]
        q += 1
        for b in range(a + 1, dim):
            own += 2.0 * r[a] * payload[q] * r[b]
            q += 1
    rho, w = loss_of(loss, own + more, payload[p + scale_at(kind)])
    root = math.sqrt(w)
    for a in range(dim):
        r[a] *= root
        for c in range(6):
            A[a, c] *= root
            B[a, c] *= root
    return rho - w * own


@inline_kernel
def huber(s: float, k: float) -> tuple:
    """(ρ(s), ρ'(s)) of a loss with scale k, in standard deviations; likewise below.  (3.9)"""
    c = k * k
    if s <= c:
        return s, 1.0
    root = math.sqrt(s)
    return 2.0 * k * root - c, k / root


@inline_kernel
def cauchy(s: float, k: float) -> tuple:
    """(3.10)"""
    c = k * k
    return c * math.log1p(s / c), 1.0 / (1.0 + s / c)


@inline_kernel
def geman_mcclure(s: float, k: float) -> tuple:
    """(3.11)"""
    c = k * k
    w = c / (c + s)
    return s * w, w * w


@inline_kernel
def tukey(s: float, k: float) -> tuple:
    """(3.12)"""
    c = k * k
    if s >= c:
        return c / 3.0, 0.0
    u = s / c
    w = 1.0 - u
    return s * (1.0 - u + u * u / 3.0), w * w  # c (1 − w³)/3 in powers of u: what is far below c loses no digit


@inline_kernel
def dcs(s: float, k: float) -> tuple:
    """(3.13)"""
    c = k * k
    if s <= c:
        return s, 1.0
    w = 2.0 * c / (c + s)
    return c * (3.0 - 2.0 * w), w * w


@inline_kernel
def no_loss(s: float, _k: float) -> tuple:
    """ρ(s) = s."""
    return s, 1.0


# The function of every loss of the wire, `factorbus.proto.kinds.LOSSES`.
LOSS_MODELS = {"huber": huber, "cauchy": cauchy, "geman-mcclure": geman_mcclure, "tukey": tukey, "dcs": dcs}
check_same("loss", at.LOSS_CODES, LOSS_MODELS, __name__)
# (ρ(s), ρ'(s)) of a loss by its code: loss_of(loss, s, k).
loss_of = inline_kernel(returning("loss_of", "s, k", at.LOSS_CODES, LOSS_MODELS, no_loss))
