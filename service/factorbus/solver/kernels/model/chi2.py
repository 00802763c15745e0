"""χ² of all factors.  MATH (4.1)"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import is_member, is_one_of_many
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import chi2_of_many
from factorbus.solver.kernels.model.sizes import information_at, residual_dim


@kernel("float64(int64, int64, int64[:,::1], int64[:,::1], float64[::1], float64[::1])")
def sum_chi2(first: int, last: int, var: I64, fac: I64, values: F64, payload: F64) -> float:
    """Σ rᵀ Ω r, or ρ of that, of the factors first .. last−1 at `values`, in the order of their ids."""
    r, A, B = np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    chi2 = 0.0
    for f in range(first, last):
        if is_one_of_many(f, fac):
            if not is_member(f, fac):
                chi2 += chi2_of_many(f, var, fac, values, payload, payload[:0])
            continue
        chi2 += evaluate_apart(f, var, fac, values, payload, r, A, B)
        kind = fac[f, at.F_KIND]
        dim, p = residual_dim(kind), fac[f, at.F_AT] + information_at(kind)
        for a in range(dim):
            chi2 += r[a] * payload[p] * r[a]
            p += 1
            for b in range(a + 1, dim):
                chi2 += 2.0 * r[a] * payload[p] * r[b]
                p += 1
    return chi2
