"""The linearization error of a factor, computed: of observations, of factors with a loss, and of kinds that no closed
form bounds.  MATH (9.11), (9.31)
"""

import math

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import end_of, is_one_of_many
from factorbus.solver.kernels.model.kinds import is_camera
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import linearize_many, square_of
from factorbus.solver.kernels.model.sizes import dim_of, information_at, residual_dim
from factorbus.solver.lenses.layout import GOOD

# The error of an observation that has lost its pixel or found it again: √INACTIVE_CHI2.
SWITCHED = 30.0


@part
def exact_error(
    f: int, var: I64, fac: I64, lin: F64, values: F64, payload: F64, delta: F64
) -> tuple[float, float, float]:  # fmt: skip
    """What the model of factor f, linearized at `lin`, misses at `values` = lin ⊞ δ, in standard deviations: of the
    residual, (9.11), and of the force, as its Jacobian is another one there, (9.31); and its χ² there.
    """
    if is_one_of_many(f, fac):
        return exact_error_of_many(f, var, fac, lin, values, payload, delta)
    r, now, A, B = np.zeros(at.R_SIZE), np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    A_now, B_now = np.zeros((6, 6)), np.zeros((6, 6))
    chi2 = evaluate_apart(f, var, fac, values, payload, now, A_now, B_now)
    evaluate_apart(f, var, fac, lin, payload, r, A, B)
    kind = fac[f, at.F_KIND]
    dim, p = residual_dim(kind), fac[f, at.F_AT] + information_at(kind)
    # It has become inactive, or active again.
    switched = is_camera(kind) and (r[at.R_STATUS] != GOOD) != (now[at.R_STATUS] != GOOD)
    add_slope(fac[f, at.F_I], dim, var, delta, A, r)
    if fac[f, at.F_J] >= 0:
        add_slope(fac[f, at.F_J], dim, var, delta, B, r)
    force = force_of(fac[f, at.F_I], dim, p, var, payload, now, A, A_now)
    if fac[f, at.F_J] >= 0:
        force += force_of(fac[f, at.F_J], dim, p, var, payload, now, B, B_now)
    total = 0.0
    for a in range(dim):
        gap = now[a] - r[a]
        total += gap * payload[p] * gap
        chi2 += now[a] * payload[p] * now[a]
        p += 1
        for b in range(a + 1, dim):
            total += 2.0 * gap * payload[p] * (now[b] - r[b])
            chi2 += 2.0 * now[a] * payload[p] * now[b]
            p += 1
    return SWITCHED if switched else math.sqrt(max(total, 0.0)), math.sqrt(force), chi2


@part
def exact_error_of_many(
    f: int, var: I64, fac: I64, lin: F64, values: F64, payload: F64, delta: F64
) -> tuple[float, float, float]:  # fmt: skip
    """The same of a factor that `many` evaluates."""
    more, now = linearize_many(f, var, fac, values, payload)
    _, was = linearize_many(f, var, fac, lin, payload)
    dim, kind, start = len(now.J), fac[f, at.F_KIND], now.start
    chi2, force, total = more + square_of(now), 0.0, 0.0
    switched = is_camera(kind) and (was.r[at.R_STATUS] != GOOD) != (now.r[at.R_STATUS] != GOOD)
    for n in range(start.size - 1):
        d = var[end_of(f, n, fac), at.V_SCALAR]
        if d < 0:
            continue
        for c in range(start[n], start[n + 1]):
            turned = diagonal = 0.0
            for a in range(dim):
                was.r[a] += was.J[a, c] * delta[d + c - start[n]]
                turned += (now.J[a, c] - was.J[a, c]) * now.r[a]
                diagonal += now.J[a, c] * now.J[a, c]
            if diagonal > 0.0:
                force += turned * turned / diagonal
    for a in range(dim):
        total += (now.r[a] - was.r[a]) * (now.r[a] - was.r[a])
    return SWITCHED if switched else math.sqrt(max(total, 0.0)), math.sqrt(force), chi2


@part
def force_of(v: int, dim: int, p: int, var: I64, payload: F64, r: F64, J: F64, J_now: F64) -> float:
    """The square of (9.31), the share of variable v: Σ ((J_now − J)ᵀ Ω r)² / (J_nowᵀ Ω J_now) over its scalars."""
    if var[v, at.V_SCALAR] < 0:
        return 0.0
    total = 0.0
    for c in range(dim_of(var[v, at.V_KIND])):
        turned = diagonal = 0.0
        q = p
        for a in range(dim):
            for b in range(a, dim):
                w = payload[q]
                q += 1
                turned += (J_now[a, c] - J[a, c]) * w * r[b]
                diagonal += J_now[a, c] * w * J_now[b, c]
                if b > a:
                    turned += (J_now[b, c] - J[b, c]) * w * r[a]
                    diagonal += J_now[a, c] * w * J_now[b, c]
        if diagonal > 0.0:
            total += turned * turned / diagonal
    return total


@part
def add_slope(v: int, dim: int, var: I64, delta: F64, J: F64, r: F64) -> None:
    """r += J δ of variable v."""
    d = var[v, at.V_SCALAR]
    if d >= 0:
        for a in range(dim):
            for c in range(dim_of(var[v, at.V_KIND])):
                r[a] += J[a, c] * delta[d + c]
