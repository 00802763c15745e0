"""A chord step: residuals are taken anew at the estimate, and R is kept.  MATH §9.6

A Newton step with the factorization of an earlier point converges as fast as that point is near (Kelley, Iterative
Methods for Linear and Nonlinear Equations, ch. 5).  Here its equations are those of the tree, in which the model of a
factor, r₀ + J₀ δ, is corrected by what it misses of the residual at the estimate,

    r₀ + J₀ δ + m,   m = r(x̂) − r₀ − J₀ δ̂                                                               (9.35)

with J₀ as it is in R.  So only right-hand sides change:

1  list, mark     the factors whose model misses much, their cliques and those above: does it fit into the budget?
   correct        the gradients of these factors
2  forward_solve  d = R⁻ᵀ η in their cliques and those above, children first
3  substitute     back down, as in any step
4  measure        what is left to miss is counted from there
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import last_of_hessian
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.back_substitute import QUIET, substitute
from factorbus.solver.kernels.bayes_tree.correct_inertial import correct_inertial, is_inertial_and_plain
from factorbus.solver.kernels.bayes_tree.eliminate_again import lap
from factorbus.solver.kernels.bayes_tree.linearization_error import measure
from factorbus.solver.kernels.bayes_tree.missed_residual import missed_se2, missed_se3, turn_since_linearized
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, note_moved
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.refactor_in_place import mark_above
from factorbus.solver.kernels.bayes_tree.seen_in_space import seen_se3
from factorbus.solver.kernels.bayes_tree.work import SCANNING, note_work, work_of_solving_all
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.cycle_counter import cycles
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, is_one_of_many
from factorbus.solver.kernels.model.linearize import Scratch, evaluate_apart, make_scratch
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.se3 import rotation_matrix, turn_slope
from factorbus.solver.kernels.sparse import fronts as fr

TOO_MUCH = -1.0
FORWARD = 2.0  # times what back-substitution takes: the gradients are gathered as well


@inline_kernel
def is_correctable(f: int, graph: Graph, tree: Tree) -> bool:
    """Whether what the model of factor f misses is known as a vector: between poses, or of an IMU, without a loss."""
    kind = tree.link[f, tl.L_KIND]
    return kind == at.BETWEEN_SE2 or kind == at.BETWEEN_SE3 or is_inertial_and_plain(f, graph, tree)


@part
def error_left(tree: Tree) -> float:
    """Σ error² as it will be after a chord step, at least."""
    total = 0.0
    for f in range(tree.state[tl.S_FACTORS]):
        total += tree.factor_errors[f, tl.E_LEAVES]
    return total


@part
def chord_step(least: float, graph: Graph, tree: Tree, settings: F64) -> float:
    """Correct the factors whose error² is more than `least`, and solve with R as it is; gives Σ error² as `measure`, or
    TOO_MUCH: that does not fit into the budget, and nothing is done.
    """
    node, clique, state = tree.node, tree.clique, tree.state
    now = cycles()
    # 1
    note_work(SCANNING * state[tl.S_FACTORS], tree.totals)
    state[tl.S_STAMP] += 1
    corrected, count, end = np.empty(state[tl.S_FACTORS], np.int64), 0, tree.marked.size
    for f in range(state[tl.S_FACTORS]):
        if tree.factor_errors[f, tl.E_ERROR] > least and is_correctable(f, graph, tree):
            corrected[count] = f
            count += 1
            for n in range(count_ends(f, graph.fac)):
                end = mark_above(end_of(f, n, graph.fac), node, clique, state, tree.marked, end)
    marked = tree.marked[end:].copy()
    work = work_of_solving_all(marked, clique)
    if tree.totals[tl.T_WORK] + (FORWARD + 1.0) * work > settings[tl.P_BUDGET]:
        lap(now, tl.LINEARIZE, state)
        return TOO_MUCH
    scratch = make_scratch()
    for k in range(count):
        correct_factor(graph, tree, corrected[k], scratch)
        for n in range(count_ends(corrected[k], graph.fac)):
            note_moved(MODEL, end_of(corrected[k], n, graph.fac), node, tree.moved, state)
    now = lap(now, tl.LINEARIZE, state)
    # 2
    note_work(FORWARD * work, tree.totals)
    roots = forward_solve(graph, tree, marked)
    now = lap(now, tl.ELIMINATE, state)
    # 3
    quiet = QUIET * settings[tl.P_RELINEARIZE_THRESHOLD]
    substitute(graph, tree, roots, settings[tl.P_WILDFIRE_THRESHOLD], quiet, tree.marked, settings[tl.P_BUDGET])
    # 4
    state[tl.S_DUE], state[tl.S_WAITING], state[tl.S_CHORDS] = 0, state[tl.S_STEP], state[tl.S_CHORDS] + 1
    weighted_error = measure(graph, tree, settings)
    lap(now, tl.SUBSTITUTE, state)
    return weighted_error


@inline_kernel
def correct_factor(graph: Graph, tree: Tree, f: int, scratch: Scratch) -> None:
    """The gradient of factor f, −J₀ᵀ Ω (r₀ + m), and its (r₀ + m)ᵀ Ω (r₀ + m), with m as it is at the estimate."""
    row = tree.factor_errors[f]
    if is_one_of_many(f, graph.fac):
        correct_inertial(f, graph, tree)
        return
    if graph.fac[f, at.F_KIND] == at.BETWEEN_SE2:
        correct_se2(graph, tree, f, scratch)
    else:
        correct_se3(graph, tree, f, scratch)
    if row[tl.E_FORM] < tl.CORRECTED:
        row[tl.E_FORM] += tl.CORRECTED


@part
def correct_se2(graph: Graph, tree: Tree, f: int, scratch: Scratch) -> None:
    """`correct_factor` between plane poses."""
    var, fac, row, hessian, p = graph.var, graph.fac, tree.factor_errors[f], tree.hessian, graph.payload
    i, j, r, A, B = fac[f, at.F_I], fac[f, at.F_J], scratch.r, scratch.H[0], scratch.H[1]
    evaluate_apart(f, var, fac, tree.lin[0], p, r, A, B)
    phi = turn_since_linearized(i, var, tree.scalars[0])
    x, y, _, _ = missed_se2(var[i, at.V_AT], var[j, at.V_AT], phi, graph.values, tree.lin[0])
    row[tl.E_MISSED], row[tl.E_MISSED + 1] = x, y
    # In the frame of the residual, to which A takes translations of the first pose, turned about.
    c, s = tree.turns[i, tl.U_COS], tree.turns[i, tl.U_SIN]
    x, y = c * x + s * y, c * y - s * x
    r[0] -= A[0, 0] * x + A[0, 1] * y
    r[1] -= A[1, 0] * x + A[1, 1] * y
    k = fac[f, at.F_AT] + 3
    ex = p[k] * r[0] + p[k + 1] * r[1] + p[k + 2] * r[2]
    ey = p[k + 1] * r[0] + p[k + 3] * r[1] + p[k + 4] * r[2]
    et = p[k + 2] * r[0] + p[k + 4] * r[1] + p[k + 5] * r[2]
    last = last_of_hessian(f, var, fac, tree.link)
    for a in range(3):
        hessian[last - 6 + a] = -(A[0, a] * ex + A[1, a] * ey + A[2, a] * et)
        hessian[last - 3 + a] = -(B[0, a] * ex + B[1, a] * ey + B[2, a] * et)
    hessian[last] = r[0] * ex + r[1] * ey + r[2] * et


@part
def correct_se3(graph: Graph, tree: Tree, f: int, scratch: Scratch) -> None:
    """`correct_factor` between poses in space, whose Jacobians (3.6) are made of five rotations."""
    var, fac, p, lin = graph.var, graph.fac, graph.payload, tree.lin[0]
    row, hessian, r, W = tree.factor_errors[f], tree.hessian, scratch.r, scratch.W
    i, j, k = var[fac[f, at.F_I], at.V_AT], var[fac[f, at.F_J], at.V_AT], fac[f, at.F_AT]
    m0, m1, m2, m3, m4, m5, _, _ = missed_se3(graph, tree, f, seen_se3(i, j, k, p, graph.values))
    row[tl.E_MISSED], row[tl.E_MISSED + 1], row[tl.E_MISSED + 2] = m0, m1, m2
    row[tl.E_MISSED + 3], row[tl.E_MISSED + 4], row[tl.E_MISSED + 5] = m3, m4, m5
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(lin, i + 3)
    z0, z1, z2, z3, z4, z5, z6, z7, z8 = rotation_matrix(p, k + 3)
    dx, dy, dz, v0, v1, v2, w = seen_se3(i, j, k, p, lin)
    tx, ty, tz = dx - p[k], dy - p[k + 1], dz - p[k + 2]
    r[0], r[1] = z0 * tx + z3 * ty + z6 * tz + m0, z1 * tx + z4 * ty + z7 * tz + m1
    r[2], r[3], r[4], r[5] = z2 * tx + z5 * ty + z8 * tz + m2, v0 + m3, v1 + m4, v2 + m5
    q, chi2, e = k + 7, 0.0, W[0]
    for a in range(6):
        e[a] = 0.0
    for a in range(6):
        e[a] += p[q] * r[a]
        q += 1
        for b in range(a + 1, 6):
            e[a] += p[q] * r[b]
            e[b] += p[q] * r[a]
            q += 1
    for a in range(6):
        chi2 += e[a] * r[a]
    # R_z times the force and the torque on the first pose.
    fx, fy, fz = z0 * e[0] + z1 * e[1] + z2 * e[2], z3 * e[0] + z4 * e[1] + z5 * e[2], z6 * e[0] + z7 * e[1] + z8 * e[2]
    w = turn_slope(w)
    sx, sy, sz = v1 * e[5] - v2 * e[4], v2 * e[3] - v0 * e[5], v0 * e[4] - v1 * e[3]
    nx, ny, nz = 0.5 * (w * e[3] + sx), 0.5 * (w * e[4] + sy), 0.5 * (w * e[5] + sz)
    last = last_of_hessian(f, var, fac, tree.link)
    g = last - 12
    hessian[g] = fx
    hessian[g + 1] = fy
    hessian[g + 2] = fz
    hessian[g + 3] = dy * fz - dz * fy + z0 * nx + z1 * ny + z2 * nz
    hessian[g + 4] = dz * fx - dx * fz + z3 * nx + z4 * ny + z5 * nz
    hessian[g + 5] = dx * fy - dy * fx + z6 * nx + z7 * ny + z8 * nz
    # Rᵢ, then Rⱼᵀ, take the force to the second pose.
    tx, ty, tz = a0 * fx + a1 * fy + a2 * fz, a3 * fx + a4 * fy + a5 * fz, a6 * fx + a7 * fy + a8 * fz
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(lin, j + 3)
    hessian[g + 6] = -(a0 * tx + a3 * ty + a6 * tz)
    hessian[g + 7] = -(a1 * tx + a4 * ty + a7 * tz)
    hessian[g + 8] = -(a2 * tx + a5 * ty + a8 * tz)
    hessian[g + 9] = -0.5 * (w * e[3] - sx)
    hessian[g + 10] = -0.5 * (w * e[4] - sy)
    hessian[g + 11] = -0.5 * (w * e[5] - sz)
    hessian[last] = chi2


@part
def forward_solve(graph: Graph, tree: Tree, cliques: I64) -> I64:
    """d and the right-hand sides of update matrices anew, in `cliques`, children first; gives those that are roots."""
    var, clique, lists, numbers = graph.var, tree.clique, tree.lists, tree.numbers
    state, totals = tree.state, tree.totals
    widest, count = 0, 0
    for k in range(cliques.size):
        widest = max(widest, clique[cliques[k], tl.C_PIVOTS] + clique[cliques[k], tl.C_SEPARATOR_SCALARS] + 1)
    eta, roots = np.empty(widest), np.empty(cliques.size, np.int64)
    for k in range(cliques.size):
        row = clique[cliques[k]]
        width = 0
        for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]):
            tree.node[lists[s], tl.N_COLUMN] = width
            width += dim_of_variable(var, lists[s])
        gather_right_side(graph, tree, row, eta)
        was = numbers[row[tl.C_UPDATE]]
        solve_right_side(row, numbers, eta)
        row[tl.C_FIRST], row[tl.C_MARK] = -1, state[tl.S_STAMP]
        if row[tl.C_PARENT] < 0:
            roots[count] = cliques[k]
            count += 1
            totals[tl.T_MODEL] += numbers[row[tl.C_UPDATE]] - was
    if count == state[tl.S_ROOTS]:  # running sums lose digits
        totals[tl.T_MODEL] = totals[tl.T_CONSTANT]
        for k in range(count):
            totals[tl.T_MODEL] += numbers[clique[roots[k], tl.C_UPDATE]]
    return roots[:count]


@part
def gather_right_side(graph: Graph, tree: Tree, row: I64, eta: F64) -> None:
    """eta = Σ −J₀ᵀ Ω (r₀ + m) of the factors and η' of the children of a clique, by its columns, and χ² behind them."""
    var, fac, node, link, clique = graph.var, graph.fac, tree.node, tree.link, tree.clique
    lists, numbers, hessian = tree.lists, tree.numbers, tree.hessian
    last = row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS]
    for a in range(last + 1):
        eta[a] = 0.0
    for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
        f = node[lists[s], tl.N_OWN]
        while f >= 0:
            i, j = fac[f, at.F_I], fac[f, at.F_J]
            di, dj = dim_of_variable(var, i), dim_of_variable(var, j) if j >= 0 else 0
            g = last_of_hessian(f, var, fac, link) - di - dj
            if var[i, at.V_COLUMN] >= 0:
                add_to(eta, node[i, tl.N_COLUMN], hessian, g, di)
            if j >= 0 and var[j, at.V_COLUMN] >= 0:
                add_to(eta, node[j, tl.N_COLUMN], hessian, g + di, dj)
            eta[last] += hessian[g + di + dj]
            f = link[f, tl.L_OWN]
    child = row[tl.C_CHILD]
    while child >= 0:
        other = clique[child]
        start, m = other[tl.C_LIST] + other[tl.C_FRONTALS], other[tl.C_SEPARATOR_SCALARS]
        source, wide, x = other[tl.C_UPDATE] + m, other[tl.C_WIDTH_UPDATE], 0
        for s in range(start, start + other[tl.C_SEPARATORS]):
            into = node[lists[s], tl.N_COLUMN]
            for a in range(dim_of_variable(var, lists[s])):
                eta[into + a] += numbers[source + fr.update_row(x, wide)]
                x += 1
        eta[last] += numbers[source + fr.update_row(m, wide)]
        child = other[tl.C_NEXT]


@inline_kernel
def add_to(eta: F64, into: int, hessian: F64, g: int, count: int) -> None:
    """eta[into : into+count] += hessian[g : g+count]"""
    for a in range(count):
        eta[into + a] += hessian[g + a]


@part
def solve_right_side(row: I64, numbers: F64, eta: F64) -> None:
    """d = R_F⁻ᵀ η_F into the rows of a clique, and η_S − R_Sᵀ d and χ² − dᵀd into its update matrix."""
    p, m, ld = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS], row[tl.C_LD]
    last = p + m
    for k in range(p):
        line = row[tl.C_ROWS] + k * ld
        d = eta[k] / numbers[line + k]
        for c in range(k + 1, last):
            eta[c] -= numbers[line + c] * d
        eta[last] -= d * d
        numbers[line + last] = d
    into, wide = row[tl.C_UPDATE] + m, row[tl.C_WIDTH_UPDATE]
    for a in range(m + 1):
        numbers[into + fr.update_row(a, wide)] = eta[p + a]
