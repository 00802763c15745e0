"""The linearization error of a factor, computed: sights, and factors with a loss.  MATH (9.11)."""

import math

import numpy as np

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import F64, I64, part
from factorbus.solver.kernels.linearise import evaluate_apart
from factorbus.solver.kernels.sizes import dim_of, information_at, residual_dim
from factorbus.solver.lenses.layout import GOOD

SWITCHED = 30.0  # of a sight that has lost its pixel or found it again: by which that counts in χ², see `sights`


@part
def exact_error(
    f: int, var: I64, fac: I64, lin: F64, values: F64, payload: F64, delta: F64
) -> tuple[float, float]:  # fmt: skip
    """What the model of factor f, linearised at `lin`, misses at `values` = lin ⊞ δ, in standard deviations; and its χ²
    there.
    """
    r, now, A, B = np.zeros(at.R_SIZE), np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    chi2 = evaluate_apart(f, var, fac, values, payload, now, A, B)
    evaluate_apart(f, var, fac, lin, payload, r, A, B)
    kind = fac[f, at.F_KIND]
    dim, p = residual_dim(kind), fac[f, at.F_AT] + information_at(kind)
    # It has fallen asleep, or woken.
    switched = kind >= at.IDP_FIRST and (r[at.R_STATUS] != GOOD) != (now[at.R_STATUS] != GOOD)
    add_slope(fac[f, at.F_I], dim, var, delta, A, r)
    if fac[f, at.F_J] >= 0:
        add_slope(fac[f, at.F_J], dim, var, delta, B, r)
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
    return SWITCHED if switched else math.sqrt(max(total, 0.0)), chi2


@part
def add_slope(v: int, dim: int, var: I64, delta: F64, J: F64, r: F64) -> None:
    """r += J δ of variable v."""
    d = var[v, at.V_SCALAR]
    if d >= 0:
        for a in range(dim):
            for c in range(dim_of(var[v, at.V_KIND])):
                r[a] += J[a, c] * delta[d + c]
