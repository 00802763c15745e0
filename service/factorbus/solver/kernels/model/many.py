"""Factors of more than two variables: residual, Jacobians and loss.  MATH §3.9.

Their Jacobians stand side by side in J, in the order of the variables, each as wide as its variable has scalars.  All
of them are kinds of a sensor whose mount m on the robot is estimated: the residual of another kind with the sensor's
pose c = a ∘ m in place of the robot's pose a.  With A = ∂r/∂c, and Ad(m⁻¹) what a displacement of a is of c,

    ∂r/∂a = A Ad(m⁻¹),   ∂r/∂m = A,   Ad(m⁻¹) = [ R_mᵀ | −R_mᵀ ⌊t_m⌋ ; 0 | R_mᵀ ]                        (3.35)

and where the other end is a pose too, that of the sensor in its place, ∂r/∂m has both.
"""

import math
from typing import NamedTuple

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, loss_code
from factorbus.solver.kernels.model.kinds import base_kind, residual_of
from factorbus.solver.kernels.model.losses import loss_of
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.kernels.model.se2 import compose_se2
from factorbus.solver.kernels.model.se3 import compose_se3, rotation_matrix
from factorbus.solver.kernels.model.sizes import dim_of, information_at, kind_of_end, residual_dim, scale_at

POSE = 7  # numbers of a pose, at most
FIRST, SECOND, MOUNT = range(3)  # the variables of what a sensor measures


class Many(NamedTuple):
    """A factor of more than two variables, linearized: r (dim or R_SIZE,), J (dim, Σ d), information W (dim, dim);
    start (ends + 1,): the first column of each variable."""

    r: F64
    J: F64
    W: F64
    start: I64


@part
def linearize_many(f: int, var: I64, fac: I64, x: F64, payload: F64) -> tuple[float, Many]:
    """The factor that begins at row f at the values x, with its loss; what χ² has beside rᵀ Ω r."""
    kind, ends = fac[f, at.F_KIND], count_ends(f, fac)
    dim, start, k = residual_dim(kind), np.zeros(ends + 1, np.int64), fac[f, at.F_AT] + information_at(kind)
    for n in range(ends):
        start[n + 1] = start[n] + dim_of(var[end_of(f, n, fac), at.V_KIND])
    many = Many(np.zeros(max(dim, at.R_SIZE)), np.zeros((dim, start[ends])), np.empty((dim, dim)), start)
    for a in range(dim):
        for b in range(a, dim):
            many.W[a, b] = many.W[b, a] = payload[k]
            k += 1
    places = np.empty(ends, np.int64)
    for n in range(ends):
        places[n] = var[end_of(f, n, fac), at.V_AT]
    more = at_mount(kind, x, places, payload, fac[f, at.F_AT], many)
    loss = loss_code(f, fac)
    if loss != at.NO_LOSS:
        more = soften_many(loss, payload[fac[f, at.F_AT] + scale_at(kind)], more, many)
    return more, many


@inline_kernel
def width_of(n: int, many: Many) -> int:
    """Scalars of the n-th variable."""
    return many.start[n + 1] - many.start[n]


@inline_kernel
def square_of(many: Many) -> float:
    """rᵀ Ω r"""
    total, dim = 0.0, len(many.W)
    for a in range(dim):
        for b in range(dim):
            total += many.r[a] * many.W[a, b] * many.r[b]
    return total


@part
def add_normal_equations(n: int, many: Many, M: F64, z: F64) -> None:
    """M += J_nᵀ Ω J_n, on and above the diagonal, and z −= J_nᵀ Ω r, of the n-th variable."""
    first, dim = many.start[n], len(many.W)
    for c in range(many.start[n + 1] - first):
        for a in range(dim):
            along = 0.0
            for b in range(dim):
                along += many.W[a, b] * many.J[b, first + c]
            z[c] -= along * many.r[a]
            for e in range(c + 1):
                M[e, c] += many.J[a, first + e] * along


@part
def soften_many(loss: int, scale: float, more: float, many: Many) -> float:
    """As `losses.soften`."""
    own = square_of(many)
    rho, w = loss_of(loss, own + more, scale)
    root = math.sqrt(w)
    for a in range(len(many.W)):
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
