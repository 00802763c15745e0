"""A chord step's correction of an inertial factor.  MATH (9.35)

r and J are kept where it is linearized (`hessian_room`).  The r of the corrected model takes the place of the one that
is kept, so what the model misses is counted from there without a word more.
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.hessian_room import jacobian_at, kept_samples, last_of_hessian
from factorbus.solver.kernels.bayes_tree.imu_error import residual_of_imu
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, loss_code, residual_size
from factorbus.solver.kernels.model.many import linearize_kept
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import dim_of


@inline_kernel
def is_inertial_and_plain(f: int, graph: Graph, tree: Tree) -> bool:
    """Whether row f is the first of a factor of an IMU without a loss, of samples with an Ω of one."""
    if tree.factor_errors[f, tl.E_FORM] == tl.PLAIN_SAMPLES:
        return True
    return graph.fac[f, at.F_KIND] == at.PREINTEGRATED and loss_code(f, graph.fac) == at.NO_LOSS


@part
def is_off_its_point(f: int, graph: Graph, tree: Tree) -> bool:
    """Whether a variable of the factor that begins at row f has moved since it was linearized."""
    for n in range(count_ends(f, graph.fac)):
        v = end_of(f, n, graph.fac)
        s = graph.var[v, at.V_SCALAR]
        for e in range(dim_of(graph.var[v, at.V_KIND]) if s >= 0 else 0):
            if tree.scalars[0, s + e] != 0.0:
                return True
    return False


@part
def correct_inertial(f: int, graph: Graph, tree: Tree) -> None:
    """The gradient of the factor that begins at row f, −J₀ᵀ (r₀ + m), and its |r₀ + m|², with m as it is at the
    estimate: r₀ + m = r − J₀ δ, all of it whitened.
    """
    var, fac, hessian, link = graph.var, graph.fac, tree.hessian, tree.link
    ends, columns = count_ends(f, fac), 0
    for n in range(ends):
        columns += dim_of(var[end_of(f, n, fac), at.V_KIND])
    if fac[f, at.F_KIND] == at.IMU:
        r = residual_of_imu(f, graph, tree)
    else:
        _, many = linearize_kept(f, var, fac, graph.values, graph.payload, kept_samples(f, var, fac, tree))
        r = many.r
    moved, c = np.zeros(columns), 0
    for n in range(ends):
        v = end_of(f, n, fac)
        s, size = var[v, at.V_SCALAR], dim_of(var[v, at.V_KIND])
        for e in range(size if s >= 0 else 0):
            moved[c + e] = tree.scalars[0, s + e]
        c += size
    k, dim, chi2 = jacobian_at(f, var, fac, link), residual_size(f, fac), 0.0
    gradient = np.zeros(columns)
    for a in range(dim):
        row, left = k + dim + a * columns, r[a]
        for c in range(columns):
            left -= hessian[row + c] * moved[c]
        hessian[k + a] = left
        chi2 += left * left
        for c in range(columns):
            gradient[c] -= hessian[row + c] * left
    # The first row has the gradients of its two variables, each further one that of its second.
    c = 0
    for n in range(ends):
        row, size = f + max(n - 1, 0), dim_of(var[end_of(f, n, fac), at.V_KIND])
        g = last_of_hessian(row, var, fac, link) - size
        if n == 0:
            g -= dim_of(var[end_of(f, 1, fac), at.V_KIND])
        for e in range(size):
            hessian[g + e] = gradient[c + e]
        c += size
    hessian[last_of_hessian(f, var, fac, link)] = chi2
