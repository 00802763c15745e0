"""Factors of one's own kinds: their formulas are machine code (`solver/formulas`), called here.  MATH §3.11."""

import math

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.machine_code import address_of_function, as_number, call, first_of
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import INACTIVE_CHI2
from factorbus.solver.kernels.model.expression_layout import X_BEFORE, X_NUMBER, X_WIDTH
from factorbus.solver.kernels.model.factor_rows import loss_code, residual_size
from factorbus.solver.kernels.model.losses import loss_of
from factorbus.solver.kernels.model.records import Graph

# Numbers behind a Jacobian that may be written, and mean nothing: as many as the widest vector register of any
# processor has, for a state may be gone on from on another one.
BEHIND = 8
# What is of a factor: its residual; and its slopes, too.
NO_NUMBER, RESIDUAL, BOTH = 0, 1, 3
# What is asked of a formula: residual and slopes; what the linear model that is kept of both misses; the square of the
# residual.
SLOPES, ERROR, SQUARE = range(3)
# Behind the residual where that is asked: √w of its loss, now and where it was linearized, which are known before;
# rᵀ Ω r, and the squares of (9.11) and (9.31).
ROOT, ROOT_WAS, CHI2, MISSED, FORCE, ERROR_SIZE = range(6)


@part
def evaluate_own(f: int, var: I64, fac: I64, x: F64, payload: F64, out: int) -> int:
    """Residual and Jacobian of the factor of an own kind that begins at row f, written where the address `out` is:
    r (dim,), then J (dim, Σ d), row by row, with room for BEHIND numbers after it.

    Gives BOTH; RESIDUAL where a slope is no number; NO_NUMBER where r is none, or none that a
    square can be taken of.  What is no number means nothing.
    """
    p = fac[f, at.F_AT]
    address, row = address_of_function(int(payload[p + X_NUMBER])), f * at.F_WIDTH
    if address == 0:
        return NO_NUMBER
    z = first_of(payload, p + X_WIDTH)
    return call(address, (first_of(x, 0), first_of(var, 0), first_of(fac, row), z, out, SLOPES, 0, 0, 0))


@part
def error_of_own(f: int, graph: Graph, linear: F64, delta: F64, out: F64) -> int:
    """How far the factor of an own kind that begins at row f is from its linear model: r (dim,), and behind it what
    ROOT and those after it say.

    linear: r and J where it was linearized; delta: δ of all scalars since; out (dim + ERROR_SIZE,): ROOT, ROOT_WAS are
    read.  Gives what `evaluate_own` gives; where r is no number it counts as 0, where a slope is none there is no force
    """
    p = graph.fac[f, at.F_AT]
    address, row = address_of_function(int(graph.payload[p + X_NUMBER])), f * at.F_WIDTH
    if address == 0:
        out[:] = 0.0
        return NO_NUMBER
    z, information = p + X_WIDTH, p + int(graph.payload[p + X_BEFORE])
    known = (first_of(graph.values, 0), first_of(graph.var, 0), first_of(graph.fac, row), first_of(graph.payload, z))
    kept = (first_of(linear, 0), first_of(graph.payload, information), first_of(delta, 0))
    return call(address, (*known, first_of(out, 0), ERROR, *kept))


@part
def chi2_of_own(f: int, var: I64, fac: I64, x: F64, payload: F64) -> float:
    """χ² of the factor of an own kind that begins at row f."""
    square, loss = square_of_own(f, var, fac, x, payload), loss_code(f, fac)
    if loss != at.NO_LOSS:
        dim, p = residual_size(f, fac), fac[f, at.F_AT] + int(payload[fac[f, at.F_AT] + X_BEFORE])
        square, _ = loss_of(loss, square, payload[p + dim * (dim + 1) // 2])
    return square


@part
def square_of_own(f: int, var: I64, fac: I64, x: F64, payload: F64) -> float:
    """rᵀ Ω r of the factor of an own kind that begins at row f; INACTIVE_CHI2 where r is no number."""
    p = fac[f, at.F_AT]
    address, row = address_of_function(int(payload[p + X_NUMBER])), f * at.F_WIDTH
    if address == 0:
        return INACTIVE_CHI2
    known = (first_of(x, 0), first_of(var, 0), first_of(fac, row), first_of(payload, p + X_WIDTH))
    square = as_number(call(address, (*known, 0, SQUARE, 0, first_of(payload, p + int(payload[p + X_BEFORE])), 0)))
    return square if square != -math.inf else INACTIVE_CHI2


@part
def evaluate_linear(f: int, var: I64, fac: I64, x: F64, payload: F64, out: F64) -> float:
    """As `evaluate_own` with slopes, into an array; where r is no number r and J are 0 and INACTIVE_CHI2 is given,
    which is added to χ², else 0.  Where only slopes are none, J is 0: χ² is a matter of r alone.
    """
    found = evaluate_own(f, var, fac, x, payload, first_of(out, 0))
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
