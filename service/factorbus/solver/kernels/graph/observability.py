"""New variables that several factors determine: a point by two pixels, a camera by those of known points.  MATH §7.

A variable is determined where the Hessian of its own factors, with all that they join it to determined already, is
positive definite with room to spare.  What that does not show, the numbers of the whole system may.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, kernel, part
from factorbus.solver.kernels.jit.small_cholesky import cholesky
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, is_member, is_one_of_many
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import add_normal_equations, linearize_many
from factorbus.solver.kernels.model.sizes import MOST_SCALARS, dim_of, information_at, residual_dim

# The share of its diagonal entry that a pivot keeps: a point 1000 baselines away keeps 1e-6.
_ROOM = 1e-8


@kernel("int64(int64, int64, int64, int64[:,::1], int64[:,::1], float64[::1], float64[::1], int64[::1])")
def mark_determined(v0: int, f0: int, f1: int, var: I64, fac: I64, values: F64, payload: F64, determined: I64) -> int:
    """Set to 1 in `determined` (an entry a variable from v0 on) what factors f0 .. f1−1 determine; gives the count."""
    r, H, z = np.zeros(at.R_SIZE), np.zeros((2, 6, 6)), np.zeros(MOST_SCALARS)
    place, count = np.full(determined.size, -1), 0
    for k in range(determined.size):
        if determined[k] == 0:
            place[k] = count
            count += 1
    M, unused = np.zeros((count, MOST_SCALARS, MOST_SCALARS)), np.zeros(MOST_SCALARS)
    for f in range(f0, f1):
        if is_one_of_many(f, fac):
            n = only_loose(f, v0, fac, determined)
            if n >= 0:
                _, many = linearize_many(f, var, fac, values, payload)
                add_normal_equations(n, many, M[place[end_of(f, n, fac) - v0]], unused)
            continue
        i, j = fac[f, at.F_I] - v0, fac[f, at.F_J] - v0
        loose_i, loose_j = i >= 0 and determined[i] == 0, j >= 0 and determined[j] == 0
        if loose_i == loose_j:
            continue
        evaluate_apart(f, var, fac, values, payload, r, H[0], H[1])
        end, k = (0, i) if loose_i else (1, j)
        dim, width = residual_dim(fac[f, at.F_KIND]), dim_of(var[v0 + k, at.V_KIND])
        p = fac[f, at.F_AT] + information_at(fac[f, at.F_KIND])
        for a in range(dim):
            for b in range(a, dim):
                for c in range(width):
                    for e in range(c, width):
                        both = H[end, a, c] * H[end, b, e]
                        if b > a:
                            both += H[end, b, c] * H[end, a, e]
                        M[place[k], c, e] += payload[p] * both
                p += 1
    found, diagonal = 0, np.empty(MOST_SCALARS)
    for k in range(determined.size):
        if place[k] < 0:
            continue
        dim, good, block = dim_of(var[v0 + k, at.V_KIND]), True, M[place[k]]
        for a in range(dim):
            diagonal[a] = block[a, a]
            good &= block[a, a] > 0.0
        if good and cholesky(dim, block, z) < 0:
            for a in range(dim):
                good &= block[a, a] * block[a, a] > _ROOM * diagonal[a]
            if good:
                determined[k] = 1
                found += 1
    return found


@part
def only_loose(f: int, v0: int, fac: I64, determined: I64) -> int:
    """Which variable of a factor of more than two is the only one of them that is not determined; −1: there is none."""
    found = -1
    for n in range(0 if is_member(f, fac) else count_ends(f, fac)):
        k = end_of(f, n, fac) - v0
        if k >= 0 and determined[k] == 0:
            if found >= 0:
                return -1
            found = n
    return found
