"""The linearization error of a factor of a kind that a client wrote itself.  MATH (9.11), (9.31)

As `exact_error_of_many`, of r and J as the formula has them, not whitened: a step asks it of every such factor that
moved, so there is one array of all that is computed,

    r (dim), J (dim × columns), what the formula writes behind it, δ, Δᵀ Ω r, diag(Jᵀ Ω J) (columns each), Ω r (dim)
"""

import math

import numpy as np

from factorbus.solver.kernels.bayes_tree.hessian_room import jacobian_at
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expression_layout import X_BEFORE
from factorbus.solver.kernels.model.expressions import BEHIND, evaluate_linear, information_square
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, loss_code, residual_size
from factorbus.solver.kernels.model.losses import loss_of
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import dim_of


@part
def exact_error_of_own(f: int, graph: Graph, tree: Tree) -> tuple[float, float, float]:
    """The error of the residual and of the force, and χ², of the factor that begins at row f."""
    var, fac, payload, linear = graph.var, graph.fac, graph.payload, tree.hessian
    dim, columns = residual_size(f, fac), 0
    for n in range(count_ends(f, fac)):
        columns += dim_of(var[end_of(f, n, fac), at.V_KIND])
    k, p = jacobian_at(f, var, fac, tree.link), fac[f, at.F_AT] + int(payload[fac[f, at.F_AT] + X_BEFORE])
    delta = dim * (columns + 1) + BEHIND
    turned, diagonal, forces = delta + columns, delta + 2 * columns, delta + 3 * columns
    w = np.empty(forces + dim)

    # 1. The residual, its Jacobian, and χ², now; the weights of its loss, now and where it is linearized.
    chi2 = evaluate_linear(f, var, fac, graph.values, payload, w[:delta])
    root = root_was = 1.0
    loss = loss_code(f, fac)
    if loss == at.NO_LOSS:
        chi2 += information_square(dim, p, payload, w)
    else:
        scale = payload[p + dim * (dim + 1) // 2]
        chi2, weight = loss_of(loss, chi2 + information_square(dim, p, payload, w), scale)
        _, weight_was = loss_of(loss, information_square(dim, p, payload, linear[k : k + dim]), scale)
        root, root_was = math.sqrt(weight), math.sqrt(weight_was)

    # 2. How far its variables are from where it is linearized.
    c = 0
    for n in range(count_ends(f, fac)):
        v = end_of(f, n, fac)
        s = var[v, at.V_SCALAR]
        for e in range(dim_of(var[v, at.V_KIND])):
            w[delta + c] = tree.scalars[0, s + e] if s >= 0 else 0.0
            w[turned + c] = w[diagonal + c] = 0.0
            c += 1

    # 3. What the model misses of the residual goes where r has been; Δ = J − J where it is linearized.
    apply_information(dim, p, payload, w, 0, forces)
    for a in range(dim):
        row, row_was = dim + a * columns, k + dim + a * columns
        missed, force = root_was * linear[k + a], root * w[forces + a]
        for c in range(columns):
            missed += root_was * linear[row_was + c] * w[delta + c]
            w[turned + c] += (root * w[row + c] - root_was * linear[row_was + c]) * force
        w[a] = root * w[a] - missed
    add_diagonal(dim, columns, p, payload, w, diagonal)

    # 4. The shares of all scalars that move.
    total, c = 0.0, 0
    for n in range(count_ends(f, fac)):
        v = end_of(f, n, fac)
        for _ in range(dim_of(var[v, at.V_KIND])):
            # Nothing where its loss has set the factor aside.
            if root * root * w[diagonal + c] > 0.0 and var[v, at.V_SCALAR] >= 0:
                total += w[turned + c] * w[turned + c] / (root * root * w[diagonal + c])
            c += 1
    return math.sqrt(max(information_square(dim, p, payload, w), 0.0)), math.sqrt(total), chi2


@part
def apply_information(dim: int, p: int, payload: F64, w: F64, r: int, out: int) -> None:
    """w[out:] = Ω w[r:], the upper triangle of Ω from payload[p] on."""
    for a in range(dim):
        w[out + a] = 0.0
    for a in range(dim):
        w[out + a] += payload[p] * w[r + a]
        for b in range(a + 1, dim):
            w[out + a] += payload[p + b - a] * w[r + b]
            w[out + b] += payload[p + b - a] * w[r + a]
        p += dim - a


@part
def add_diagonal(dim: int, columns: int, p: int, payload: F64, w: F64, out: int) -> None:
    """w[out:] += diag(Jᵀ Ω J), J (dim, columns) from w[dim] on."""
    for a in range(dim):
        row = dim + a * columns
        for b in range(a, dim):
            weight, other = payload[p + b - a] if b == a else 2.0 * payload[p + b - a], dim + b * columns
            for c in range(columns if weight != 0.0 else 0):
                w[out + c] += weight * w[row + c] * w[other + c]
        p += dim - a
