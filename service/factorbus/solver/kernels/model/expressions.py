"""Factors of one's own kinds: their formulas are machine code (`solver/formulas`), called here.  MATH §3.11."""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.machine_code import address_of_function, call, first_of
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import INACTIVE_CHI2
from factorbus.solver.kernels.model.expression_layout import X_BEFORE, X_NUMBER, X_WIDTH
from factorbus.solver.kernels.model.factor_rows import loss_code, residual_size
from factorbus.solver.kernels.model.losses import loss_of

# Numbers behind a Jacobian that may be written, and mean nothing: as many as the widest vector register of any
# processor has, for a state may be gone on from on another one.
BEHIND = 8
# What is of a factor: its residual; and its slopes, too.
NO_NUMBER, RESIDUAL, BOTH = 0, 1, 3


@part
def evaluate_own(slopes: bool, f: int, var: I64, fac: I64, x: F64, payload: F64, out: int) -> int:
    """Residual and Jacobian of the factor of an own kind that begins at row f, written where the address `out` is:
    r (dim,), then J (dim, Σ d), row by row, with room for BEHIND numbers after it; without `slopes` r alone.

    Gives BOTH; RESIDUAL where a slope is no number, or was not asked for; NO_NUMBER where r is none, or none that a
    square can be taken of.  What is no number means nothing.
    """
    p = fac[f, at.F_AT]
    address, row = address_of_function(int(payload[p + X_NUMBER])), f * at.F_WIDTH
    if address == 0:
        return NO_NUMBER
    z = first_of(payload, p + X_WIDTH)
    return call(address, first_of(x, 0), first_of(var, 0), first_of(fac, row), z, out, 1 if slopes else 0)


@part
def chi2_of_own(f: int, var: I64, fac: I64, x: F64, payload: F64) -> float:
    """χ² of the factor of an own kind that begins at row f."""
    dim, loss = residual_size(f, fac), loss_code(f, fac)
    r, p = np.empty(dim), fac[f, at.F_AT] + int(payload[fac[f, at.F_AT] + X_BEFORE])
    is_number = evaluate_own(False, f, var, fac, x, payload, first_of(r, 0)) != NO_NUMBER
    square = information_square(dim, p, payload, r) if is_number else INACTIVE_CHI2
    if loss != at.NO_LOSS:
        square, _ = loss_of(loss, square, payload[p + dim * (dim + 1) // 2])
    return square


@part
def evaluate_linear(f: int, var: I64, fac: I64, x: F64, payload: F64, out: F64) -> float:
    """As `evaluate_own` with slopes, into an array; where r is no number r and J are 0 and INACTIVE_CHI2 is given,
    which is added to χ², else 0.  Where only slopes are none, J is 0: χ² is a matter of r alone.
    """
    found = evaluate_own(True, f, var, fac, x, payload, first_of(out, 0))
    if found != BOTH:
        out[0 if found == NO_NUMBER else residual_size(f, fac) :] = 0.0
    return INACTIVE_CHI2 if found == NO_NUMBER else 0.0


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
