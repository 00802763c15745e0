"""χ² of one factor at the estimate of the tree, without its Jacobians.  MATH (4.1), §3.2

What a step moves, it measures: so this is called more often than all else that evaluates a factor, and the common kinds
have code of their own.  They are the residuals of `se2` and `se3`, to rounding; every other kind is evaluated there.
"""

import math

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.hessian_room import kept_samples
from factorbus.solver.kernels.bayes_tree.imu_error import chi2_of_imu, is_plain_imu
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.simd import at as load
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import is_one_of_many
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import chi2_of_many
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.se3 import quat_product, rotation_matrix
from factorbus.solver.kernels.model.sizes import information_at, residual_dim

SMALL_ANGLE = 0.1  # radians: below it the series of sine and cosine are exact to rounding


@inline_kernel
def chi2_of_factor(graph: Graph, tree: Tree, f: int, kind: int, c: float, s: float) -> tuple[float, float, float]:
    """rᵀΩr, or ρ of it, of factor f at `values`; between poses the square of the translation in r; and between those in
    space the rotation's share of χ².  kind: its `L_KIND`; c, s: cosine and sine of its first, plane pose.
    """
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    factor_errors = tree.factor_errors
    if kind == at.BETWEEN_SE2:
        return between_se2_chi2(f, c, s, var, fac, values, payload, factor_errors)
    if kind == at.LANDMARK_SE2:
        return landmark_se2_chi2(f, c, s, var, fac, values, payload), 0.0, 0.0
    if kind == at.BETWEEN_SE3:
        return between_se3_chi2(f, var, fac, values, payload)
    return any_chi2(f, graph, tree), 0.0, 0.0


@inline_kernel
def between_se2_chi2(
    f: int, c: float, s: float, var: I64, fac: I64, values: F64, payload: F64, factor_errors: F64
) -> tuple[float, float, float]:
    """(3.2).  Where Ω is that of a disc and of an angle apart, the frame of the measurement does not matter."""
    x, y, k = var[fac[f, at.F_I], at.V_AT], var[fac[f, at.F_J], at.V_AT], fac[f, at.F_AT]
    tx, ty = load(values, y) - load(values, x), load(values, y + 1) - load(values, x + 1)
    ex, ey = c * tx + s * ty - load(payload, k), c * ty - s * tx - load(payload, k + 1)
    turn = wrap(load(values, y + 2) - load(values, x + 2) - load(payload, k + 2))
    gap = ex * ex + ey * ey
    form = factor_errors[f, tl.E_FORM]
    if form == tl.ISOTROPIC or form == tl.ISOTROPIC + tl.CORRECTED:
        return load(payload, k + 3) * gap + load(payload, k + 8) * turn * turn, gap, 0.0
    cz, sz = math.cos(load(payload, k + 2)), math.sin(load(payload, k + 2))
    rx, ry = cz * ex + sz * ey, cz * ey - sz * ex
    cross = load(payload, k + 4) * rx * ry + (load(payload, k + 5) * rx + load(payload, k + 7) * ry) * turn
    square = load(payload, k + 3) * rx * rx + load(payload, k + 6) * ry * ry + load(payload, k + 8) * turn * turn
    return square + 2.0 * cross, gap, 0.0


@inline_kernel
def landmark_se2_chi2(f: int, c: float, s: float, var: I64, fac: I64, values: F64, payload: F64) -> float:
    """(3.3)"""
    x, y, k = var[fac[f, at.F_I], at.V_AT], var[fac[f, at.F_J], at.V_AT], fac[f, at.F_AT]
    tx, ty = load(values, y) - load(values, x), load(values, y + 1) - load(values, x + 1)
    ex, ey = c * tx + s * ty - load(payload, k), c * ty - s * tx - load(payload, k + 1)
    return load(payload, k + 2) * ex * ex + 2.0 * load(payload, k + 3) * ex * ey + load(payload, k + 4) * ey * ey


@part
def between_se3_chi2(f: int, var: I64, fac: I64, x: F64, p: F64) -> tuple[float, float, float]:
    """(3.6)"""
    i, j, k = var[fac[f, at.F_I], at.V_AT], var[fac[f, at.F_J], at.V_AT], fac[f, at.F_AT]
    z0, z1, z2, z3, z4, z5, z6, z7, z8 = rotation_matrix(p, k + 3)
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    tx, ty, tz = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    ex = a0 * tx + a3 * ty + a6 * tz - p[k]
    ey = a1 * tx + a4 * ty + a7 * tz - p[k + 1]
    ez = a2 * tx + a5 * ty + a8 * tz - p[k + 2]
    r0, r1, r2 = z0 * ex + z3 * ey + z6 * ez, z1 * ex + z4 * ey + z7 * ez, z2 * ex + z5 * ey + z8 * ez
    qx, qy, qz, qw = quat_product(-x[i + 3], -x[i + 4], -x[i + 5], x[i + 6], x[j + 3], x[j + 4], x[j + 5], x[j + 6])
    r3, r4, r5, w = quat_product(-p[k + 3], -p[k + 4], -p[k + 5], p[k + 6], qx, qy, qz, qw)
    if w < 0.0:
        r3, r4, r5 = -r3, -r4, -r5
    k += 7
    gap = r0 * r0 + r1 * r1 + r2 * r2
    total = r0 * (p[k] * r0 + 2.0 * (p[k + 1] * r1 + p[k + 2] * r2 + p[k + 3] * r3 + p[k + 4] * r4 + p[k + 5] * r5))
    total += r1 * (p[k + 6] * r1 + 2.0 * (p[k + 7] * r2 + p[k + 8] * r3 + p[k + 9] * r4 + p[k + 10] * r5))
    total += r2 * (p[k + 11] * r2 + 2.0 * (p[k + 12] * r3 + p[k + 13] * r4 + p[k + 14] * r5))
    turned = r3 * (p[k + 15] * r3 + 2.0 * (p[k + 16] * r4 + p[k + 17] * r5))
    turned += r4 * (p[k + 18] * r4 + 2.0 * p[k + 19] * r5) + r5 * p[k + 20] * r5
    return total + turned, gap, turned


@part
def any_chi2(f: int, graph: Graph, tree: Tree) -> float:
    """By the kernel of the kind, with the loss of the factor."""
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    if is_one_of_many(f, fac):
        if is_plain_imu(f, fac, payload):
            return chi2_of_imu(f, graph, tree)
        return chi2_of_many(f, var, fac, values, payload, kept_samples(f, var, fac, tree))
    r, A, B = np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    total, kind = evaluate_apart(f, var, fac, values, payload, r, A, B), fac[f, at.F_KIND]
    dim, p = residual_dim(kind), fac[f, at.F_AT] + information_at(kind)
    for a in range(dim):
        total += r[a] * payload[p] * r[a]
        p += 1
        for b in range(a + 1, dim):
            total += 2.0 * r[a] * payload[p] * r[b]
            p += 1
    return total


@inline_kernel
def heading_of(v: int, planar: bool, var: I64, delta: F64, values: F64, turns: F64) -> tuple[float, float]:
    """Cosine and sine of a plane pose at the estimate, from those where it is linearized; 1, 0 of all else."""
    if not planar:
        return 1.0, 0.0
    d = var[v, at.V_SCALAR]
    angle = load(delta, d + 2) if d >= 0 else 0.0
    if not abs(angle) < SMALL_ANGLE:
        theta = load(values, var[v, at.V_AT] + 2)
        return math.cos(theta), math.sin(theta)
    q = angle * angle
    c = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0 - q * (1.0 / 40320.0))))
    s = angle * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5040.0 - q * (1.0 / 362880.0)))))
    c0, s0 = turns[v, tl.U_COS], turns[v, tl.U_SIN]
    return c * c0 - s * s0, s * c0 + c * s0


@inline_kernel
def is_isotropic(kind: int, k: int, p: F64) -> bool:
    """Whether the information of a relative plane pose, behind its measurement at k, is that of a disc and an angle."""
    return kind == at.BETWEEN_SE2 and p[k + 3] == p[k + 6] and p[k + 4] == 0.0 and p[k + 5] == 0.0 and p[k + 7] == 0.0
