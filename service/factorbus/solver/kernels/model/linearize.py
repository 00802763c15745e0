"""Factors to normal equations: residuals and Jacobians, and their sum into Λ and η.  MATH §3, §4.

    Λ = Σ Hᵀ Ω H,   η = −Σ Hᵀ Ω r,   χ² = Σ rᵀ Ω r          (4.1)

of a factor with a loss ρ with r and H times √ρ'(rᵀ Ω r), and ρ(rᵀ Ω r) in χ² (`losses`).

Factors are taken in the order of their ids, whatever their kinds.  So the sums over all factors have the same bits
whether they were made at once or as the factors arrived; taking back a refused insert rests on that.
"""

from typing import NamedTuple

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import end_of, is_member, is_one_of_many, loss_code, row_of_pair
from factorbus.solver.kernels.model.kinds import residual_of
from factorbus.solver.kernels.model.losses import soften
from factorbus.solver.kernels.model.many import linearize_many, square_of
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.kernels.model.sizes import end_dims, information_at, residual_dim


class Scratch(NamedTuple):
    """Room to linearize a factor in: r (7,); H (4, 6, 6), its Jacobians A and B, Ω A and Ω B; W (6, 6), Ω."""

    r: F64
    H: F64
    W: F64


@inline_kernel
def make_scratch() -> Scratch:
    """Room to linearize factors in, one after the other."""
    return Scratch(np.zeros(at.R_SIZE), np.zeros((4, 6, 6)), np.zeros((6, 6)))


class NormalEquations(NamedTuple):
    """Λ δ = η: the blocks of Λ, row by row, in `data`, and `eta` (scalars,)."""

    data: F64
    eta: F64


@kernel("float64(int64, int64, int64[:,::1], int64[:,::1], float64[::1], float64[::1], float64[::1], float64[::1])")
def linearize(first: int, last: int, var: I64, fac: I64, values: F64, payload: F64, data: F64, eta: F64) -> float:
    """Add the factors first .. last−1, linearized at `values`, to Λ's blocks in `data` and to `eta`; gives their χ²."""
    scratch, system = make_scratch(), NormalEquations(data, eta)
    r, H = scratch.r, scratch.H
    chi2 = 0.0
    for f in range(first, last):
        if is_one_of_many(f, fac):
            if not is_member(f, fac):
                chi2 += add_many(f, var, fac, values, payload, system)
            continue
        row = fac[f]
        kind, p = row[at.F_KIND], row[at.F_AT]
        chi2 += evaluate_apart(f, var, fac, values, payload, r, H[0], H[1])
        # Sizes as constants, so that each call becomes straight code.
        if kind == at.BETWEEN_SE2 or kind == at.PRIOR_SE2:
            chi2 += add_factor(3, 3, 3, row, var, payload[p + 3 :], scratch, system)
        elif kind == at.LANDMARK_SE2 or kind == at.BEARING_RANGE_SE2:
            chi2 += add_factor(2, 3, 2, row, var, payload[p + 2 :], scratch, system)
        elif kind == at.BETWEEN_SE3 or kind == at.PRIOR_SE3:
            chi2 += add_factor(6, 6, 6, row, var, payload[p + 7 :], scratch, system)
        elif kind == at.LANDMARK_SE3 or kind == at.PRIOR_POINT3:
            first_size = 6 if kind == at.LANDMARK_SE3 else 3
            chi2 += add_factor(3, first_size, 3, row, var, payload[p + 3 :], scratch, system)
        else:
            chi2 += add_other(kind, row, var, payload[p + information_at(kind) :], scratch, system)
    return chi2


@inline_kernel
def evaluate_apart(f: int, var: I64, fac: I64, x: F64, payload: F64, r: F64, A: F64, B: F64) -> float:
    """The residual kernel of the kind of factor `f`, and its loss; gives what χ² has beside rᵀ Ω r."""
    kind, p = fac[f, at.F_KIND], fac[f, at.F_AT]
    i = var[fac[f, at.F_I], at.V_AT]
    j = var[max(fac[f, at.F_J], 0), at.V_AT]
    more = residual_of(kind, x, Ends(i, j), payload, p, r, A, B)
    loss = loss_code(f, fac)
    if loss != at.NO_LOSS:
        more = soften(kind, loss, p, payload, more, r, A, B)
    return more


@part
def add_other(kind: int, row: I64, var: I64, info: F64, scratch: Scratch, system: NormalEquations) -> float:
    """`add_factor` of the kinds that are not worth straight code."""
    di, dj = end_dims(kind)
    return add_factor(residual_dim(kind), di, dj, row, var, info, scratch, system)


@part
def add_many(f: int, var: I64, fac: I64, values: F64, payload: F64, system: NormalEquations) -> float:
    """Add the blocks and the gradient of the factor that begins at row f; gives its χ²."""
    more, many = linearize_many(f, var, fac, values, payload)
    r, J, start = many
    dim, ends, data = len(J), start.size - 1, system.data
    for n in range(ends):
        v, d = end_of(f, n, fac), start[n + 1] - start[n]
        if var[v, at.V_COLUMN] < 0:
            continue
        block, scalar = var[v, at.V_DIAGONAL], var[v, at.V_SCALAR]
        for i in range(d):
            total = 0.0
            for a in range(dim):
                total += J[a, start[n] + i] * r[a]
            system.eta[scalar + i] -= total
            for j in range(i, d):
                total = 0.0
                for a in range(dim):
                    total += J[a, start[n] + i] * J[a, start[n] + j]
                data[block + i * d + j] += total
                if j > i:
                    data[block + j * d + i] = data[block + i * d + j]
        for m in range(n + 1, ends):
            row = row_of_pair(f, n, m, ends)
            block, e = fac[row, at.F_IJ], start[m + 1] - start[m]
            if block < 0:
                continue
            for i in range(d):
                for j in range(e):
                    total = 0.0
                    for a in range(dim):
                        total += J[a, start[n] + i] * J[a, start[m] + j]
                    data[block + (j * d + i if fac[row, at.F_FLAGS] & at.SWAPPED else i * e + j)] += total
    return more + square_of(many)


@inline_kernel
def add_factor(
    dr: int, di: int, dj: int, row: I64, var: I64, info: F64, scratch: Scratch, system: NormalEquations
) -> float:
    """Add Hᵀ Ω H and −Hᵀ Ω r of the factor with this row where they belong; gives rᵀ Ω r.

    scratch: has r, A and B, and gets Ω, Ω A and Ω B   info: starts with the upper triangle of Ω
    Ends without a block are fixed.
    """
    r, H, W, data, eta = scratch.r, scratch.H, scratch.W, system.data, system.eta
    A, B, WA, WB = H[0], H[1], H[2], H[3]
    k = 0
    for a in range(dr):
        for b in range(a, dr):
            W[a, b] = info[k]
            W[b, a] = info[k]
            k += 1
    chi2 = 0.0
    for a in range(dr):
        e = 0.0
        for b in range(dr):
            e += W[a, b] * r[b]
        chi2 += r[a] * e
    ii, jj, ij = row[at.F_II], row[at.F_JJ], row[at.F_IJ]
    if ii >= 0:
        multiply(dr, di, W, A, WA)
        add_diagonal_block(dr, di, A, WA, r, data[ii:], eta[var[row[at.F_I], at.V_SCALAR] :])
    if jj >= 0:
        multiply(dr, dj, W, B, WB)
        add_diagonal_block(dr, dj, B, WB, r, data[jj:], eta[var[row[at.F_J], at.V_SCALAR] :])
    if ij >= 0:
        if row[at.F_FLAGS] & at.SWAPPED:
            add_pair(dr, dj, di, B, WA, data[ij:])
        else:
            add_pair(dr, di, dj, A, WB, data[ij:])
    return chi2


@inline_kernel
def multiply(dr: int, d: int, W: F64, A: F64, out: F64) -> None:
    """out = Ω A."""
    for a in range(dr):
        for c in range(d):
            total = 0.0
            for b in range(dr):
                total += W[a, b] * A[b, c]
            out[a, c] = total


@inline_kernel
def add_diagonal_block(dr: int, d: int, A: F64, WA: F64, r: F64, block: F64, eta: F64) -> None:
    """block += Aᵀ Ω A, symmetric to the bit; eta −= (Ω A)ᵀ r."""
    for a in range(d):
        total = 0.0
        for k in range(dr):
            total += WA[k, a] * r[k]
        eta[a] -= total
        for b in range(a, d):
            total = 0.0
            for k in range(dr):
                total += A[k, a] * WA[k, b]
            block[a * d + b] += total
            if b > a:
                block[b * d + a] = block[a * d + b]


@inline_kernel
def add_pair(dr: int, d: int, e: int, A: F64, WB: F64, block: F64) -> None:
    """block += Aᵀ Ω B."""
    for a in range(d):
        for b in range(e):
            total = 0.0
            for k in range(dr):
                total += A[k, a] * WB[k, b]
            block[a * e + b] += total
