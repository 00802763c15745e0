"""Factors of any number of variables: residual, Jacobians and loss.  MATH §3.6, §3.8 to §3.11.

Their Jacobians stand side by side in J, in the order of the variables, each as wide as its variable has scalars; r and
J are times C with CᵀC = Ω, so that Ω is one from here on.  One kind is the linear model (3.26), of any variables, one
what an IMU says between two poses (`imu`), and one stands for all kinds that clients wrote themselves (`expressions`).
The others are kinds with a base (`composed`), and those of rotations and similarities (`similarity`).
"""

import math
from typing import NamedTuple

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part, shared_kernel, types
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.composed import composed
from factorbus.solver.kernels.model.expressions import BEHIND, chi2_of_own, evaluate_linear
from factorbus.solver.kernels.model.factor_rows import (
    count_ends,
    end_of,
    form_of_imu,
    information_start,
    loss_code,
    residual_size,
)
from factorbus.solver.kernels.model.imu import imu
from factorbus.solver.kernels.model.kinds import base_kind
from factorbus.solver.kernels.model.linear import linear
from factorbus.solver.kernels.model.losses import loss_of
from factorbus.solver.kernels.model.similarity import similar
from factorbus.solver.kernels.model.sizes import dim_of


class Many(NamedTuple):
    """A factor linearized: r (dim or R_SIZE,), J (dim, Σ d); start (ends + 1,): the first column of each variable."""

    r: F64
    J: F64
    start: I64


_FLOATS, _ROWS = types.float64[::1], types.int64[:, ::1]
_MANY = types.NamedTuple((_FLOATS, types.float64[:, ::1], types.int64[::1]), Many)
_LINEARIZED = types.Tuple((types.float64, _MANY))(types.int64, _ROWS, _ROWS, _FLOATS, _FLOATS, _FLOATS)


@shared_kernel(_LINEARIZED)
def evaluate_plain(f: int, var: I64, fac: I64, x: F64, payload: F64, kept: F64) -> tuple[float, Many]:
    """Residual and Jacobians of the factor that begins at row f; what χ² has beside rᵀ Ω r."""
    kind, ends, dim, more = fac[f, at.F_KIND], count_ends(f, fac), residual_size(f, fac), 0.0
    numbers = np.empty(3 * ends + 1, np.int64)
    start, kinds, places = numbers[: ends + 1], numbers[ends + 1 : 2 * ends + 1], numbers[2 * ends + 1 :]
    start[0] = 0
    for n in range(ends):
        v = end_of(f, n, fac)
        kinds[n], places[n] = var[v, at.V_KIND], var[v, at.V_AT]
        start[n + 1] = start[n] + dim_of(kinds[n])
    if kind == at.OWN:
        room = np.empty(dim * (start[ends] + 1) + BEHIND)
        many = Many(room[:dim], room[dim : dim * (start[ends] + 1)].reshape(dim, start[ends]), start)
        return evaluate_linear(f, var, fac, x, payload, room), many
    many = Many(np.zeros(max(dim, at.R_SIZE)), np.zeros((dim, start[ends])), start)
    if kind == at.LINEAR:
        linear(x, kinds, places, payload[fac[f, at.F_AT] :], many.r, many.J)
    elif kind == at.IMU or kind == at.PREINTEGRATED:
        imu(x, places, form_of_imu(f, fac), payload[fac[f, at.F_AT] :], kept, many.r, many.J)
    elif base_kind(kind) < 0:
        similar(kind, x, places, payload, fac[f, at.F_AT], many.r, many.J)
    else:
        more = composed(kind, x, places, payload, fac[f, at.F_AT], many.r, many.J, start)
    return more, many


@inline_kernel
def linearize_many(f: int, var: I64, fac: I64, x: F64, payload: F64) -> tuple[float, Many]:
    """The factor that begins at row f at the values x, whitened and with its loss; what χ² has beside rᵀ r."""
    return linearize_kept(f, var, fac, x, payload, payload[:0])


@shared_kernel(_LINEARIZED)
def linearize_kept(f: int, var: I64, fac: I64, x: F64, payload: F64, kept: F64) -> tuple[float, Many]:
    """The same, of an inertial factor by what is in `kept`, see `imu`."""
    more, many = evaluate_plain(f, var, fac, x, payload, kept)
    dim, start = len(many.J), information_start(f, var, fac, payload)
    whiten_in_place(dim, start, payload, many)
    loss = loss_code(f, fac)
    if loss != at.NO_LOSS:
        more = soften_many(loss, payload[start + dim * (dim + 1) // 2], more, many)
    return more, many


@part
def whiten_in_place(dim: int, p: int, payload: F64, many: Many) -> None:
    """r and J times C, upper triangular, with CᵀC = Ω, whose upper triangle begins at payload[p]."""
    r, J, k, is_diagonal = many.r, many.J, p, True
    for a in range(dim):
        for b in range(1, dim - a):
            is_diagonal &= payload[k + b] == 0.0
        k += dim - a
    if is_diagonal:
        k = p
        for a in range(dim):
            root = math.sqrt(payload[k])
            if root != 1.0:
                r[a] *= root
                for c in range(J.shape[1]):
                    J[a, c] *= root
            k += dim - a
        return
    C = np.empty((dim, dim))
    upper_factor(dim, p, payload, C)
    for a in range(dim):
        r[a] *= C[a, a]
        for c in range(J.shape[1]):
            J[a, c] *= C[a, a]
        for b in range(a + 1, dim):
            r[a] += C[a, b] * r[b]
            for c in range(J.shape[1]):
                J[a, c] += C[a, b] * J[b, c]


@inline_kernel
def upper_factor(dim: int, p: int, payload: F64, C: F64) -> None:
    """C upper triangular with CᵀC the matrix whose upper triangle starts at payload[p]."""
    for a in range(dim):
        for b in range(a, dim):
            C[a, b] = payload[p]
            p += 1
    for a in range(dim):
        for q in range(a):
            for b in range(a, dim):
                C[a, b] -= C[q, a] * C[q, b]
        pivot = 1.0 / math.sqrt(C[a, a])
        for b in range(a, dim):
            C[a, b] *= pivot


@inline_kernel
def width_of(n: int, many: Many) -> int:
    """Scalars of the n-th variable; 0 where there is none."""
    return many.start[n + 1] - many.start[n] if n + 1 < many.start.size else 0


@inline_kernel
def square_of(many: Many) -> float:
    """rᵀ r, of what is whitened."""
    total = 0.0
    for a in range(len(many.J)):
        total += many.r[a] * many.r[a]
    return total


@part
def add_normal_equations(n: int, many: Many, M: F64, z: F64) -> None:
    """M += J_nᵀ J_n, on and above the diagonal, and z −= J_nᵀ r, of the n-th variable."""
    first = many.start[n]
    for a in range(len(many.J)):
        for c in range(many.start[n + 1] - first):
            z[c] -= many.J[a, first + c] * many.r[a]
            for e in range(c + 1):
                M[e, c] += many.J[a, first + e] * many.J[a, first + c]


@part
def soften_many(loss: int, scale: float, more: float, many: Many) -> float:
    """As `losses.soften`, of what is whitened."""
    own = square_of(many)
    rho, w = loss_of(loss, own + more, scale)
    root = math.sqrt(w)
    for a in range(len(many.J)):
        many.r[a] *= root
        for c in range(many.J.shape[1]):
            many.J[a, c] *= root
    return rho - w * own


@part
def chi2_of_many(f: int, var: I64, fac: I64, x: F64, payload: F64, kept: F64) -> float:
    """χ² of the factor that begins at row f; kept: as for `linearize_kept`."""
    if fac[f, at.F_KIND] == at.OWN:
        return chi2_of_own(f, var, fac, x, payload)
    more, many = linearize_kept(f, var, fac, x, payload, kept)
    return more + square_of(many)
