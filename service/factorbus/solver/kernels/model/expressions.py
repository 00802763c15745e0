"""Factors of one's own kinds: their formulas are machine code (`solver/formulas`), called here.  MATH §3.11."""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part, vector_lanes
from factorbus.solver.kernels.jit.machine_code import address_of_function, call, first_of
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import INACTIVE_CHI2
from factorbus.solver.kernels.model.expression_layout import X_BEFORE, X_NUMBER, X_WIDTH
from factorbus.solver.kernels.model.factor_rows import loss_code, residual_size
from factorbus.solver.kernels.model.losses import loss_of

# Numbers behind a Jacobian that are written, and mean nothing.
BEHIND = vector_lanes()


@part
def evaluate_own(slopes: bool, f: int, var: I64, fac: I64, x: F64, payload: F64, out: int) -> float:
    """Residual and Jacobian of the factor of an own kind that begins at row f, written where the address `out` is:
    r (dim,), then J (dim, Σ d), row by row, with room for BEHIND numbers after it; without `slopes` r alone.

    Where the residual is no number, or none that a square can be taken of, INACTIVE_CHI2 is given, which stands for
    χ², and what is written means nothing; else 0.
    """
    p = fac[f, at.F_AT]
    address, good, row = address_of_function(int(payload[p + X_NUMBER])), 0, f * at.F_WIDTH
    if address != 0:
        z = first_of(payload, p + X_WIDTH)
        good = call(address, first_of(x, 0), first_of(var, 0), first_of(fac, row), z, out, 1 if slopes else 0)
    return 0.0 if good != 0 else INACTIVE_CHI2


@part
def chi2_of_own(f: int, var: I64, fac: I64, x: F64, payload: F64) -> float:
    """χ² of the factor of an own kind that begins at row f."""
    dim, loss = residual_size(f, fac), loss_code(f, fac)
    r, p = np.empty(dim), fac[f, at.F_AT] + int(payload[fac[f, at.F_AT] + X_BEFORE])
    square = evaluate_own(False, f, var, fac, x, payload, first_of(r, 0))
    if square == 0.0:
        square = information_square(dim, p, payload, r)
    if loss != at.NO_LOSS:
        square, _ = loss_of(loss, square, payload[p + dim * (dim + 1) // 2])
    return square


@inline_kernel
def information_square(dim: int, p: int, payload: F64, r: F64) -> float:
    """rᵀ Ω r, the upper triangle of Ω from payload[p] on."""
    total = 0.0
    for a in range(dim):
        row = 0.5 * payload[p] * r[a]
        for b in range(1, dim - a):
            row += payload[p + b] * r[a + b]
        total += 2.0 * row * r[a]
        p += dim - a
    return total
