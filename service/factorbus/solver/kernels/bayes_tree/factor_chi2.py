"""χ² of one factor at the estimate of the tree, without its Jacobians.  MATH (4.1), §3.2

What a step moves, it measures: so this is called more often than all else that evaluates a factor, and the common kinds
have code of their own.  They are the residuals of `se2`, to rounding; every other kind but poses in space
(`seen_in_space`) is evaluated as when it is linearized.
"""

import math

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.hessian_room import kept_samples
from factorbus.solver.kernels.bayes_tree.imu_error import chi2_of_imu
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.seen_in_space import between_se3_chi2, is_isotropic_in_space
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import is_one_of_many
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import chi2_of_many
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.se2 import SMALL_ANGLE, small_turn, wrap
from factorbus.solver.kernels.model.sizes import information_at, residual_dim


@inline_kernel
def chi2_of_factor(graph: Graph, tree: Tree, f: int, kind: int, c: float, s: float) -> float:
    """rᵀΩr, or ρ of it, of factor f at `values`.

    kind: its `L_KIND`; c, s: cosine and sine of its first, plane pose
    """
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    if kind == at.BETWEEN_SE2:
        return between_se2_chi2(f, c, s, var, fac, values, payload, tree.factor_errors)[0]
    if kind == at.LANDMARK_SE2:
        return landmark_se2_chi2(f, c, s, var, fac, values, payload)
    if kind == at.BETWEEN_SE3:
        return between_se3_chi2(f, graph, tree)[0]
    return any_chi2(f, graph, tree)


@inline_kernel
def between_se2_chi2(
    f: int, c: float, s: float, var: I64, fac: I64, values: F64, payload: F64, factor_errors: F64
) -> tuple[float, float]:
    """(3.2), and the square of the translation in r.

    Where Ω is the same for a translation in all directions the frame of the measurement does not matter.
    """
    x, y, k = var[fac[f, at.F_I], at.V_AT], var[fac[f, at.F_J], at.V_AT], fac[f, at.F_AT]
    tx, ty = values[y] - values[x], values[y + 1] - values[x + 1]
    ex, ey = c * tx + s * ty - payload[k], c * ty - s * tx - payload[k + 1]
    turn = wrap(values[y + 2] - values[x + 2] - payload[k + 2])
    gap = ex * ex + ey * ey
    form = factor_errors[f, tl.E_FORM]
    if form == tl.ISOTROPIC or form == tl.ISOTROPIC + tl.CORRECTED:
        return float(payload[k + 3] * gap + payload[k + 8] * turn * turn), float(gap)
    cz, sz = math.cos(payload[k + 2]), math.sin(payload[k + 2])
    rx, ry = cz * ex + sz * ey, cz * ey - sz * ex
    cross = payload[k + 4] * rx * ry + (payload[k + 5] * rx + payload[k + 7] * ry) * turn
    square = payload[k + 3] * rx * rx + payload[k + 6] * ry * ry + payload[k + 8] * turn * turn
    return float(square + 2.0 * cross), float(gap)


@inline_kernel
def landmark_se2_chi2(f: int, c: float, s: float, var: I64, fac: I64, values: F64, payload: F64) -> float:
    """(3.3)"""
    x, y, k = var[fac[f, at.F_I], at.V_AT], var[fac[f, at.F_J], at.V_AT], fac[f, at.F_AT]
    tx, ty = values[y] - values[x], values[y + 1] - values[x + 1]
    ex, ey = c * tx + s * ty - payload[k], c * ty - s * tx - payload[k + 1]
    return float(payload[k + 2] * ex * ex + 2.0 * payload[k + 3] * ex * ey + payload[k + 4] * ey * ey)


@part
def any_chi2(f: int, graph: Graph, tree: Tree) -> float:
    """By the kernel of the kind, with the loss of the factor."""
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    if is_one_of_many(f, fac):
        if tree.factor_errors[f, tl.E_FORM] == tl.PLAIN_SAMPLES:
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
    angle = delta[d + 2] if d >= 0 else 0.0
    if not abs(angle) < SMALL_ANGLE:
        theta = values[var[v, at.V_AT] + 2]
        return math.cos(theta), math.sin(theta)
    c, s = small_turn(angle)
    c0, s0 = turns[v, tl.U_COS], turns[v, tl.U_SIN]
    return c * c0 - s * s0, s * c0 + c * s0


@inline_kernel
def is_isotropic(kind: int, k: int, p: F64) -> bool:
    """Whether the information of a relative pose, behind its measurement at k, is the same for a translation in all
    directions and has nothing to do with the rotation.
    """
    if kind == at.BETWEEN_SE2:
        return p[k + 3] == p[k + 6] and p[k + 4] == 0.0 and p[k + 5] == 0.0 and p[k + 7] == 0.0
    return kind == at.BETWEEN_SE3 and is_isotropic_in_space(k, p)
