"""Factors taken out of the tree, or linearized anew with another weight or loss, ahead of a step.  MATH §11.5.

The tree keeps its cliques: what is changed is what their variables own.  The step that follows touches the variables of
these factors, as if the factors were new there, and eliminates their cliques from what is left.

    1  detach   a factor that goes leaves the lists of its variables, and χ²
    2  renew    one that stays has another Hessian, and another χ²
    3  sum      what the variables have of their factors: the diagonals, the largest lever
    4  list     the variables, so that the step touches and measures them
"""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import largest_diagonal_of, next_incidence
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable, has_free
from factorbus.solver.kernels.bayes_tree.factor_chi2 import chi2_of_factor, heading_of
from factorbus.solver.kernels.bayes_tree.hessian import linearize_factor, weigh_factor
from factorbus.solver.kernels.bayes_tree.hessian_room import hessian_size
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, note_moved
from factorbus.solver.kernels.bayes_tree.records import Tree, tree_at
from factorbus.solver.kernels.jit.compile import I64, inline_kernel, kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import is_member, is_one_of_many, loss_code, rows_of
from factorbus.solver.kernels.model.kinds import is_bounded
from factorbus.solver.kernels.model.linearize import make_scratch
from factorbus.solver.kernels.model.records import Graph, graph_at

# Columns of the log of links that were changed: which one, of what, and the factor or incidence that it was.
LOG_WHAT, LOG_OF, LOG_WAS, LOG_WIDTH = 0, 1, 2, 3
FIRST_INCIDENCE, NEXT_INCIDENCE, FIRST_OWN, NEXT_OWN = 0, 1, 2, 3
MOST_LINKS = 3  # that a factor is taken out of


@kernel("int64(int64[::1], int64[::1], int64[::1], int64[::1], int64[:,::1])")
def edit_factors(gone: I64, renewed: I64, graph_table: I64, tree_table: I64, log: I64) -> int:
    """Take the factors `gone` out of the tree, and linearize those `renewed` as the graph has them now (rows).

    graph, tree: tables of their arenas (`array_table`)   log (3 per factor gone, 3): links as they were, for `relink`
    Gives how many rows of the log were written; −1 less that where any χ² is not a number.
    """
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    var, fac = graph.var, graph.fac
    node = tree.node
    scalars = tree.scalars
    moved, state, totals = tree.moved, tree.state, tree.totals
    largest_diagonal = 0.0
    for k in range(gone.size + renewed.size):
        f = gone[k] if k < gone.size else renewed[k - gone.size]
        for end in range(2):
            v = fac[f, at.F_I + end]
            if v >= 0:
                largest_diagonal = max(largest_diagonal, largest_diagonal_of(v, var, scalars))
    # 1
    count = 0
    for k in range(gone.size):
        count = detach_factor(graph, tree, gone[k], log, count)
    # 2
    finite = renew_factors(renewed, graph, tree)
    # 3, 4
    for k in range(gone.size + renewed.size):
        f = gone[k] if k < gone.size else renewed[k - gone.size]
        for end in range(2):
            v = fac[f, at.F_I + end]
            if v >= 0:
                sum_factors(graph, tree, v)
                totals[tl.T_LARGEST_DIAGONAL] = max(totals[tl.T_LARGEST_DIAGONAL], largest_diagonal_of(v, var, scalars))
                note_moved(MODEL, v, node, moved, state)
    if gone.size + renewed.size > 0 and largest_diagonal >= totals[tl.T_LARGEST_DIAGONAL]:
        totals[tl.T_LARGEST_DIAGONAL] = 0.0
        for v in range(state[tl.S_VARIABLES]):
            totals[tl.T_LARGEST_DIAGONAL] = max(totals[tl.T_LARGEST_DIAGONAL], largest_diagonal_of(v, var, scalars))
    totals[tl.T_LEAST] = 0.0  # without a factor the optimum may be lower
    state[tl.S_EDITED], state[tl.S_EDITED_AT] = state[tl.S_MOVED], state[tl.S_STEP] + 1
    return count if finite else -1 - count


@part
def detach_factor(graph: Graph, tree: Tree, f: int, log: I64, count: int) -> int:
    """Factor f counts no more; gives how many rows of the log are written then."""
    var, fac = graph.var, graph.fac
    node, link, hessian, factor_errors, state = tree.node, tree.link, tree.hessian, tree.factor_errors, tree.state
    totals = tree.totals
    i, j = fac[f, at.F_I], fac[f, at.F_J]
    size = hessian_size(dim_of_variable(var, i), dim_of_variable(var, j) if j >= 0 else 0)
    state[tl.S_HOLES] += size
    if link[f, tl.L_KIND] >= tl.EXACT:
        state[tl.S_EXACT] -= 1
        state[tl.S_INACTIVE] -= link[f, tl.L_KIND] - tl.EXACT
    totals[tl.T_CHI2] -= factor_errors[f, tl.E_CHI2]
    totals[tl.T_ERROR] -= factor_errors[f, tl.E_ERROR]
    totals[tl.T_COUNTED] -= factor_errors[f, tl.E_COUNTED]
    totals[tl.T_ADDED_UP] += factor_errors[f, tl.E_CHI2] + factor_errors[f, tl.E_ERROR]
    count = unlink_incidence(2 * f, i, node, link, log, count)
    if j >= 0:
        count = unlink_incidence(2 * f + 1, j, node, link, log, count)
    if has_free(f, var, fac):
        done = unlink_own(f, i, node, link, log, count)
        return done if done > count or j < 0 else unlink_own(f, j, node, link, log, count)
    chi2 = hessian[link[f, tl.L_AT] + size - 1]
    totals[tl.T_CONSTANT] -= chi2
    totals[tl.T_MODEL] -= chi2
    return count


@inline_kernel
def unlink_incidence(slot: int, v: int, node: I64, link: I64, log: I64, count: int) -> int:
    """Take an incidence out of the list of variable v."""
    before, following = node[v, tl.N_ADJ], next_incidence(slot, link)
    if before == slot:
        log_link(FIRST_INCIDENCE, v, slot, log, count)
        node[v, tl.N_ADJ] = following
        return count + 1
    while next_incidence(before, link) != slot:
        before = next_incidence(before, link)
    log_link(NEXT_INCIDENCE, before, slot, log, count)
    link[before // 2, tl.L_I + before % 2] = following
    return count + 1


@inline_kernel
def unlink_own(f: int, v: int, node: I64, link: I64, log: I64, count: int) -> int:
    """Take factor f out of those that variable v owns, if it is among them."""
    before, following = node[v, tl.N_OWN], link[f, tl.L_OWN]
    if before == f:
        log_link(FIRST_OWN, v, f, log, count)
        node[v, tl.N_OWN] = following
        return count + 1
    while before >= 0 and link[before, tl.L_OWN] != f:
        before = link[before, tl.L_OWN]
    if before < 0:
        return count
    log_link(NEXT_OWN, before, f, log, count)
    link[before, tl.L_OWN] = following
    return count + 1


@inline_kernel
def log_link(what: int, of: int, was: int, log: I64, count: int) -> None:
    """One more row of the log."""
    log[count, LOG_WHAT], log[count, LOG_OF], log[count, LOG_WAS] = what, of, was


@kernel("void(int64, int64[:,::1], int64[::1])")
def relink(count: int, log: I64, tree_table: I64) -> None:
    """All links as they were: the log read backwards."""
    tree = tree_at(tree_table)
    node, link = tree.node, tree.link
    for k in range(count - 1, -1, -1):
        what, of, was = log[k, LOG_WHAT], log[k, LOG_OF], log[k, LOG_WAS]
        if what == FIRST_INCIDENCE:
            node[of, tl.N_ADJ] = was
        elif what == NEXT_INCIDENCE:
            link[of // 2, tl.L_I + of % 2] = was
        elif what == FIRST_OWN:
            node[of, tl.N_OWN] = was
        else:
            link[of, tl.L_OWN] = was


@part
def renew_factors(renewed: I64, graph: Graph, tree: Tree) -> bool:
    """Linearize factors with the weight and loss that they have now; gives whether all χ² are numbers."""
    var, fac = graph.var, graph.fac
    values = graph.values
    link, hessian = tree.link, tree.hessian
    scalars, factor_errors, turns = tree.scalars, tree.factor_errors, tree.turns
    state, totals = tree.state, tree.totals
    scratch, finite = make_scratch(), True
    for k in range(renewed.size):
        f = renewed[k]
        i, j = fac[f, at.F_I], fac[f, at.F_J]
        di, dj = dim_of_variable(var, i), dim_of_variable(var, j) if j >= 0 else 0
        last = link[f, tl.L_AT] + hessian_size(di, dj) - 1
        if is_member(f, fac):  # linearized with the first row of its factor
            continue
        was, linear_was = factor_errors[f, tl.E_CHI2], hessian[last]
        if is_bounded(fac[f, at.F_KIND]):
            note_loss(f, fac, link, state)
        linearize_factor(graph, tree, f, scratch)
        for row in range(f, f + rows_of(f, fac)):
            weigh_factor(graph, tree, row, scratch)
        c, s = heading_of(i, var[i, at.V_KIND] == at.SE2, var, scalars[0], values, turns)
        factor_errors[f, tl.E_CHI2] = chi2_of_factor(graph, tree, f, link[f, tl.L_KIND], c, s)
        totals[tl.T_CHI2] += factor_errors[f, tl.E_CHI2] - was
        totals[tl.T_ADDED_UP] += factor_errors[f, tl.E_CHI2] + was
        if not has_free(f, var, fac) and not is_one_of_many(f, fac):
            totals[tl.T_CONSTANT] += hessian[last] - linear_was
            totals[tl.T_MODEL] += hessian[last] - linear_was
        finite &= math.isfinite(hessian[last]) and math.isfinite(factor_errors[f, tl.E_CHI2])
    return finite


@inline_kernel
def note_loss(f: int, fac: I64, link: I64, state: I64) -> None:
    """How far a factor with a loss is from its linear model is computed, (9.11)."""
    was = link[f, tl.L_KIND] >= tl.EXACT
    robust = loss_code(f, fac) != at.NO_LOSS
    state[tl.S_EXACT] += int(robust) - int(was)
    link[f, tl.L_KIND] = tl.EXACT if robust else fac[f, at.F_KIND]


@part
def sum_factors(graph: Graph, tree: Tree, v: int) -> None:
    """What variable v has of its factors: the sum of the diagonals of their Hessians, and the largest lever."""
    var, fac = graph.var, graph.fac
    node, link, hessian, scalars, factor_errors = tree.node, tree.link, tree.hessian, tree.scalars, tree.factor_errors
    turns = tree.turns
    d, dim, lever = var[v, at.V_SCALAR], dim_of_variable(var, v), 0.0
    if d >= 0:
        for a in range(dim):
            scalars[1, d + a] = 0.0
    slot = node[v, tl.N_ADJ]
    while slot >= 0:
        f = slot // 2
        h = link[f, tl.L_AT]
        if slot % 2 == 0:
            lever = max(lever, factor_errors[f, tl.E_LEVER] * factor_errors[f, tl.E_ROOT])
        else:
            di = dim_of_variable(var, fac[f, at.F_I])
            h += di * di + di * dim
        if d >= 0:
            for a in range(dim):
                scalars[1, d + a] += hessian[h + a * dim + a]
        slot = next_incidence(slot, link)
    turns[v, tl.U_LEVER] = lever
