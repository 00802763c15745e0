"""Features of inverse depth that are as good Gaussians as points.  MATH §3.3."""

import math

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, kernel
from factorbus.solver.kernels.jit.small_cholesky import cholesky
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.sizes import information_at, residual_dim
from factorbus.solver.lenses.layout import GOOD


@kernel("void(int64, int64, int64[:,::1], int64[:,::1], float64[::1], float64[::1], float64[::1])")
def linearity(v1: int, f1: int, var: I64, fac: I64, values: F64, payload: F64, out: F64) -> None:
    """The linearity index (3.19) of each feature of the variables up to v1; infinite where there is none.

    σ_ρ is that of the feature by its own factors f < f1, the cameras held.
    """
    place, last, count = np.full(v1, -1), np.full(v1, -1), 0
    for v in range(v1):
        out[v] = math.inf
        if var[v, at.V_KIND] == at.IDP and var[v, at.V_COLUMN] >= 0:
            place[v] = count
            count += 1
    M, z = np.zeros((count, 6, 6)), np.zeros(6)
    r, A, B = np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    for f in range(f1):
        kind, j = fac[f, at.F_KIND], fac[f, at.F_J]
        if kind != at.IDP_FIRST and kind != at.IDP_SEEN:
            continue
        evaluate_apart(f, var, fac, values, payload, r, A, B)
        if place[j] < 0 or r[at.R_STATUS] != GOOD:
            continue
        last[j] = fac[f, at.F_I]
        dim, p, block = residual_dim(kind), fac[f, at.F_AT] + information_at(kind), M[place[j]]
        for a in range(dim):
            for b in range(a, dim):
                for c in range(6):
                    for e in range(c, 6):
                        both = B[a, c] * B[b, e]
                        if b > a:
                            both += B[b, c] * B[a, e]
                        block[c, e] += payload[p] * both
                p += 1
    for v in range(v1):
        if place[v] < 0 or last[v] < 0 or cholesky(6, M[place[v]], z) >= 0:
            continue
        # ρ is eliminated last, so its pivot is the root of its information given the rest is free.
        y, t, sigma = var[v, at.V_AT], var[last[v], at.V_AT], 1.0 / M[place[v], 5, 5]
        rho, theta, phi = values[y + 5], values[y + 3], values[y + 4]
        if not rho > 0.0:
            continue
        m0, m1, m2 = math.cos(phi) * math.sin(theta), -math.sin(phi), math.cos(phi) * math.cos(theta)
        d0, d1 = values[y] + m0 / rho - values[t], values[y + 1] + m1 / rho - values[t + 1]
        d2 = values[y + 2] + m2 / rho - values[t + 2]
        distance = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        cosine = abs(d0 * m0 + d1 * m1 + d2 * m2) / distance
        out[v] = 4.0 * sigma / (rho * rho) * cosine / distance
