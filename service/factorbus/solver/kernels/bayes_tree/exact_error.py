"""The linearization error of a factor, computed: of observations, of factors with a loss, and of kinds that no closed
form bounds.  MATH (9.11), (9.31)
"""

import math

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.hessian_room import copy_linear, jacobian_at, jacobian_size, kept_samples
from factorbus.solver.kernels.bayes_tree.imu_error import exact_error_of_imu
from factorbus.solver.kernels.bayes_tree.own_error import exact_error_of_own
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import end_of, is_one_of_many
from factorbus.solver.kernels.model.kinds import is_camera
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import linearize_kept, linearize_many, square_of
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import dim_of, information_at, residual_dim
from factorbus.solver.lenses.layout import GOOD

# The error of an observation that has lost its pixel or found it again: √INACTIVE_CHI2.
SWITCHED = 30.0


@part
def exact_error(f: int, graph: Graph, tree: Tree) -> tuple[float, float, float]:
    """What the model of factor f, linearized where its variables are, misses at their values, δ further, in standard
    deviations: of the residual, (9.11), and of the force, as its Jacobian is another one there, (9.31); and its χ²
    there.
    """
    if is_one_of_many(f, graph.fac):
        if graph.fac[f, at.F_KIND] == at.OWN and jacobian_size(f, graph.var, graph.fac) != 0:
            return exact_error_of_own(f, graph, tree)
        if tree.factor_errors[f, tl.E_FORM] == tl.PLAIN_SAMPLES and jacobian_size(f, graph.var, graph.fac) != 0:
            return exact_error_of_imu(f, graph, tree)
        return exact_error_of_many(f, graph, tree)
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    lin, delta = tree.lin[0], tree.scalars[0]
    r, now, A, B = np.zeros(at.R_SIZE), np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    A_now, B_now = np.zeros((6, 6)), np.zeros((6, 6))
    chi2 = evaluate_apart(f, var, fac, values, payload, now, A_now, B_now)
    evaluate_apart(f, var, fac, lin, payload, r, A, B)
    kind = fac[f, at.F_KIND]
    dim, p = residual_dim(kind), fac[f, at.F_AT] + information_at(kind)
    # It has become inactive, or active again.
    switched = is_camera(kind) and (r[at.R_STATUS] != GOOD) != (now[at.R_STATUS] != GOOD)
    add_slope(fac[f, at.F_I], dim, var, delta, A, r)
    if fac[f, at.F_J] >= 0:
        add_slope(fac[f, at.F_J], dim, var, delta, B, r)
    force = force_of(fac[f, at.F_I], dim, p, var, payload, now, A, A_now)
    if fac[f, at.F_J] >= 0:
        force += force_of(fac[f, at.F_J], dim, p, var, payload, now, B, B_now)
    total = 0.0
    for a in range(dim):
        gap = now[a] - r[a]
        total += gap * payload[p] * gap
        chi2 += now[a] * payload[p] * now[a]
        p += 1
        for b in range(a + 1, dim):
            total += 2.0 * gap * payload[p] * (now[b] - r[b])
            chi2 += 2.0 * now[a] * payload[p] * now[b]
            p += 1
    return SWITCHED if switched else math.sqrt(max(total, 0.0)), math.sqrt(force), chi2


@part
def exact_error_of_many(f: int, graph: Graph, tree: Tree) -> tuple[float, float, float]:
    """The same of a factor that `many` evaluates."""
    var, fac, payload, kind = graph.var, graph.fac, graph.payload, graph.fac[f, at.F_KIND]
    more, now = linearize_kept(f, var, fac, graph.values, payload, kept_samples(f, var, fac, tree))
    dim, columns = now.J.shape
    chi2, switched = more + square_of(now), False
    if jacobian_size(f, var, fac) != 0:
        linear, k = tree.hessian, jacobian_at(f, var, fac, tree.link)
    else:
        _, was = linearize_many(f, var, fac, tree.lin[0], payload)
        switched = is_camera(kind) and (was.r[at.R_STATUS] != GOOD) != (now.r[at.R_STATUS] != GOOD)
        linear, k = np.empty(dim * (columns + 1)), 0
        copy_linear(was, linear)
    # Of each scalar: δ, (J_now − J)ᵀ r, and the square of its column of J_now.
    moved, turned, diagonal = np.zeros(columns), np.zeros(columns), np.zeros(columns)
    for n in range(now.start.size - 1):
        d = var[end_of(f, n, fac), at.V_SCALAR]
        for c in range(now.start[n], now.start[n + 1] if d >= 0 else now.start[n]):
            moved[c] = tree.scalars[0, d + c - now.start[n]]
    total = 0.0
    for a in range(dim):
        row, r = k + dim + a * columns, now.r[a]
        gap = r - linear[k + a]
        for c in range(columns):
            slope, slope_was = now.J[a, c], linear[row + c]
            gap -= slope_was * moved[c]
            turned[c] += (slope - slope_was) * r
            diagonal[c] += slope * slope
        total += gap * gap
    force = 0.0
    for n in range(now.start.size - 1):
        d = var[end_of(f, n, fac), at.V_SCALAR]
        for c in range(now.start[n], now.start[n + 1] if d >= 0 else now.start[n]):
            if diagonal[c] > 0.0:
                force += turned[c] * turned[c] / diagonal[c]
    return SWITCHED if switched else math.sqrt(max(total, 0.0)), math.sqrt(force), chi2


@part
def force_of(v: int, dim: int, p: int, var: I64, payload: F64, r: F64, J: F64, J_now: F64) -> float:
    """The square of (9.31), the share of variable v: Σ ((J_now − J)ᵀ Ω r)² / (J_nowᵀ Ω J_now) over its scalars."""
    if var[v, at.V_SCALAR] < 0:
        return 0.0
    total = 0.0
    for c in range(dim_of(var[v, at.V_KIND])):
        turned = diagonal = 0.0
        q = p
        for a in range(dim):
            for b in range(a, dim):
                w = payload[q]
                q += 1
                turned += (J_now[a, c] - J[a, c]) * w * r[b]
                diagonal += J_now[a, c] * w * J_now[b, c]
                if b > a:
                    turned += (J_now[b, c] - J[b, c]) * w * r[a]
                    diagonal += J_now[a, c] * w * J_now[b, c]
        if diagonal > 0.0:
            total += turned * turned / diagonal
    return total


@part
def add_slope(v: int, dim: int, var: I64, delta: F64, J: F64, r: F64) -> None:
    """r += J δ of variable v."""
    d = var[v, at.V_SCALAR]
    if d >= 0:
        for a in range(dim):
            for c in range(dim_of(var[v, at.V_KIND])):
                r[a] += J[a, c] * delta[d + c]
