"""Factors of any number of variables: residual, Jacobians and loss.  MATH §3.6, §3.8.

Their Jacobians stand side by side in J, in the order of the variables, each as wide as its variable has scalars; r and
J are times C with CᵀC = Ω, so that Ω is one from here on.  One kind is the linear model (3.26), of any variables, one
what an IMU says between two poses (`imu`).  The others are kinds of a sensor whose mount m on the robot is estimated:
the residual of another kind with the sensor's pose c = a ∘ m in place of the robot's pose a.  With A = ∂r/∂c, and
Ad(m⁻¹) what a displacement of a is of c,

    ∂r/∂a = A Ad(m⁻¹),   ∂r/∂m = A,   Ad(m⁻¹) = [ R_mᵀ | −R_mᵀ ⌊t_m⌋ ; 0 | R_mᵀ ]                        (3.35)

and where the other end is a pose too, that of the sensor in its place, ∂r/∂m has both.
"""

import math
from typing import NamedTuple

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import (
    count_ends,
    end_of,
    information_start,
    loss_code,
    residual_size,
    sample_count,
)
from factorbus.solver.kernels.model.imu import imu
from factorbus.solver.kernels.model.kinds import base_kind, residual_of
from factorbus.solver.kernels.model.linear import linear
from factorbus.solver.kernels.model.losses import loss_of
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.kernels.model.se2 import compose_se2
from factorbus.solver.kernels.model.se3 import compose_se3, rotation_matrix
from factorbus.solver.kernels.model.sizes import dim_of, kind_of_end, residual_dim

POSE = 7  # numbers of a pose, at most
FIRST, SECOND, MOUNT = range(3)  # the variables of what a sensor measures


class Many(NamedTuple):
    """A factor linearized: r (dim or R_SIZE,), J (dim, Σ d); start (ends + 1,): the first column of each variable."""

    r: F64
    J: F64
    start: I64


@part
def linearize_many(f: int, var: I64, fac: I64, x: F64, payload: F64) -> tuple[float, Many]:
    """The factor that begins at row f at the values x, whitened and with its loss; what χ² has beside rᵀ r."""
    more, many = evaluate_plain(f, var, fac, x, payload)
    dim, start = len(many.J), information_start(f, var, fac)
    whiten_in_place(dim, start, payload, many)
    loss = loss_code(f, fac)
    if loss != at.NO_LOSS:
        more = soften_many(loss, payload[start + dim * (dim + 1) // 2], more, many)
    return more, many


@part
def evaluate_plain(f: int, var: I64, fac: I64, x: F64, payload: F64) -> tuple[float, Many]:
    """Residual and Jacobians of the factor that begins at row f; what χ² has beside rᵀ Ω r."""
    kind, ends, dim, more = fac[f, at.F_KIND], count_ends(f, fac), residual_size(f, fac), 0.0
    start, kinds, places = np.zeros(ends + 1, np.int64), np.empty(ends, np.int64), np.empty(ends, np.int64)
    for n in range(ends):
        v = end_of(f, n, fac)
        kinds[n], places[n] = var[v, at.V_KIND], var[v, at.V_AT]
        start[n + 1] = start[n] + dim_of(kinds[n])
    many = Many(np.zeros(max(dim, at.R_SIZE)), np.zeros((dim, start[ends])), start)
    if kind == at.LINEAR:
        linear(x, kinds, places, payload[fac[f, at.F_AT] :], many.r, many.J)
    elif kind == at.IMU:
        imu(x, places, sample_count(f, fac), payload[fac[f, at.F_AT] :], many.r, many.J)
    else:
        more = at_mount(kind, x, places, payload, fac[f, at.F_AT], many)
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
def at_mount(kind: int, x: F64, places: I64, p: F64, k: int, many: Many) -> float:
    """r and J of the kind that a sensor has whose mount is the last variable; gives what χ² has beside rᵀ Ω r.

    places: where the values of the variables begin in x; the measurement is at p[k].
    """
    of, m, dim = base_kind(kind), places[MOUNT], residual_dim(kind)
    planar = kind_of_end(kind, 0) == at.SE2
    joins_poses = kind_of_end(kind, 1) == kind_of_end(kind, 0)
    A, B, y = np.zeros((6, 6)), np.zeros((6, 6)), np.empty(3 * POSE)
    copy_pose(planar, x, m, y, 0)
    put_sensor(planar, x, places[FIRST], y, POSE)
    if joins_poses:
        put_sensor(planar, x, places[SECOND], y, 2 * POSE)
    else:
        for c in range(2 if planar else 3):
            y[2 * POSE + c] = x[places[SECOND] + c]
    more = residual_of(of, y, Ends(POSE, 2 * POSE), p, k, many.r, A, B)
    _carry_over(dim, planar, y, A, many.J, many.start[FIRST])
    if joins_poses:
        _carry_over(dim, planar, y, B, many.J, many.start[SECOND])
    for a in range(dim):
        for c in range(width_of(MOUNT, many)):
            many.J[a, many.start[MOUNT] + c] = A[a, c] + (B[a, c] if joins_poses else 0.0)
        if not joins_poses:
            for c in range(width_of(SECOND, many)):
                many.J[a, many.start[SECOND] + c] = B[a, c]
    return more


@inline_kernel
def copy_pose(planar: bool, x: F64, i: int, y: F64, to: int) -> None:
    """The pose at x[i] to y[to]."""
    for c in range(3 if planar else 7):
        y[to + c] = x[i + c]


@inline_kernel
def put_sensor(planar: bool, x: F64, i: int, y: F64, to: int) -> None:
    """The sensor's pose, xᵢ ∘ m with the mount m at y[0], to y[to]."""
    copy_pose(planar, x, i, y, to)
    if planar:
        compose_se2(y, to, y, 0, to)
    else:
        compose_se3(y, to, y, 0, to)


@inline_kernel
def _carry_over(dim: int, planar: bool, m: F64, A: F64, J: F64, start: int) -> None:
    """A Ad(m⁻¹), into J from column `start` on; the mount is at m[0].  (3.35)"""
    if planar:
        c, s = math.cos(m[2]), math.sin(m[2])
        for a in range(dim):
            n0, n1 = A[a, 0] * c - A[a, 1] * s, A[a, 0] * s + A[a, 1] * c
            J[a, start], J[a, start + 1] = n0, n1
            J[a, start + 2] = A[a, 2] + n1 * m[0] - n0 * m[1]
        return
    q = rotation_matrix(m, 3)
    for a in range(dim):
        n0 = A[a, 0] * q[0] + A[a, 1] * q[1] + A[a, 2] * q[2]
        n1 = A[a, 0] * q[3] + A[a, 1] * q[4] + A[a, 2] * q[5]
        n2 = A[a, 0] * q[6] + A[a, 1] * q[7] + A[a, 2] * q[8]
        J[a, start], J[a, start + 1], J[a, start + 2] = n0, n1, n2
        h0 = A[a, 3] * q[0] + A[a, 4] * q[1] + A[a, 5] * q[2]
        h1 = A[a, 3] * q[3] + A[a, 4] * q[4] + A[a, 5] * q[5]
        h2 = A[a, 3] * q[6] + A[a, 4] * q[7] + A[a, 5] * q[8]
        J[a, start + 3] = h0 + m[1] * n2 - m[2] * n1
        J[a, start + 4] = h1 + m[2] * n0 - m[0] * n2
        J[a, start + 5] = h2 + m[0] * n1 - m[1] * n0


@part
def chi2_of_many(f: int, var: I64, fac: I64, x: F64, payload: F64) -> float:
    """χ² of the factor that begins at row f."""
    more, many = linearize_many(f, var, fac, x, payload)
    return more + square_of(many)
