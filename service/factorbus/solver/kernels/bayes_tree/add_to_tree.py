"""Taking new variables and factors into the tree's arenas, and out again when their step fails.  MATH §9.2."""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.correct_inertial import (
    correct_inertial,
    is_inertial_and_plain,
    is_off_its_point,
)
from factorbus.solver.kernels.bayes_tree.factor_chi2 import chi2_of_factor, heading_of
from factorbus.solver.kernels.bayes_tree.hessian import linearize_factor, weigh_factor
from factorbus.solver.kernels.bayes_tree.hessian_room import jacobian_size, kept_samples, last_of_hessian
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, note_moved
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import is_member, loss_code, rows_of
from factorbus.solver.kernels.model.kinds import is_bounded
from factorbus.solver.kernels.model.linearize import make_scratch
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import MOST_SCALARS, size_of

SAVED = MOST_SCALARS + 2  # numbers that are saved of a variable: its diagonal sums, its lever, the step that saw it


@part
def add_variables(v1: int, var: I64, values: F64, node: I64, lin: F64, scalars: F64, turns: F64, state: I64) -> None:
    """Variables up to v1 get a row each; they are linearized at their first values."""
    for v in range(state[tl.S_VARIABLES], v1):
        node[v, tl.N_CLIQUE] = node[v, tl.N_OWN] = node[v, tl.N_ADJ] = -1
        node[v, tl.N_PLACE] = node[v, tl.N_LOCAL] = node[v, tl.N_FLAGS] = node[v, tl.N_LISTED] = 0
        node[v, tl.N_STAMP], node[v, tl.N_SEEN], node[v, tl.N_MOVED] = -1, state[tl.S_STEP], -1
        node[v, tl.N_LINEARIZED] = state[tl.S_STEP]
        x = var[v, at.V_AT]
        for a in range(size_of(var[v, at.V_KIND])):
            lin[0, x + a] = values[x + a]
        d = var[v, at.V_SCALAR]
        if d >= 0:
            for a in range(dim_of_variable(var, v)):
                scalars[0, d + a] = scalars[1, d + a] = 0.0
        turns[v, tl.U_LEVER] = 0.0
        node[v, tl.N_NEAR] = -1
        note_turn(v, var, lin, turns)
    state[tl.S_VARIABLES] = v1


@inline_kernel
def note_turn(v: int, var: I64, lin: F64, turns: F64) -> None:
    """Which way a plane pose looks where it is linearized."""
    if var[v, at.V_KIND] == at.SE2:
        angle = lin[0, var[v, at.V_AT] + 2]
        turns[v, tl.U_COS], turns[v, tl.U_SIN] = math.cos(angle), math.sin(angle)


@part
def add_factors(graph: Graph, tree: Tree, f1: int) -> bool:
    """Factors up to f1 are linearized, and join the incidences of their variables; gives whether all χ² are numbers.

    T_ADDED gets their χ² at the estimate.  Their first variables are listed: one may have moved since it was
    linearized, and the factor is then off its model from the start.

    saved (2 per factor, SAVED): what that changes of variables, for `remove_added`
    """
    var, fac, values = graph.var, graph.fac, graph.values
    node, link, hessian, scalars = tree.node, tree.link, tree.hessian, tree.scalars
    factor_errors, turns, moved, saved, state = tree.factor_errors, tree.turns, tree.moved, tree.saved, tree.state
    totals = tree.totals
    f0, finite = state[tl.S_FACTORS], True
    scratch = make_scratch()
    for f in range(f0, f1):
        i, j = fac[f, at.F_I], fac[f, at.F_J]
        link[f, tl.L_OWN] = link[f, tl.L_STAMP] = -1
        link[f, tl.L_KIND] = fac[f, at.F_KIND]
        if not is_bounded(fac[f, at.F_KIND]) or loss_code(f, fac) != at.NO_LOSS:
            link[f, tl.L_KIND] = tl.EXACT
            state[tl.S_EXACT] += 1
        if not is_member(f, fac):
            place_hessians(f, var, fac, tree)
        linearize_factor(graph, tree, f, scratch)
        _save(i, saved[2 * (f - f0)], var, node, scalars, turns)
        if j >= 0:
            _save(j, saved[2 * (f - f0) + 1], var, node, scalars, turns)
        weigh_factor(graph, tree, f, scratch)
        if is_inertial_and_plain(f, graph, tree) and is_off_its_point(f, graph, tree):
            correct_inertial(f, graph, tree)
        c, s = heading_of(i, var[i, at.V_KIND] == at.SE2, var, scalars[0], values, turns)
        totals[tl.T_LARGEST_DIAGONAL] = max(totals[tl.T_LARGEST_DIAGONAL], largest_diagonal_of(i, var, scalars))
        if j >= 0:
            totals[tl.T_LARGEST_DIAGONAL] = max(totals[tl.T_LARGEST_DIAGONAL], largest_diagonal_of(j, var, scalars))
        factor_errors[f, tl.E_CHI2] = 0.0
        if not is_member(f, fac):
            factor_errors[f, tl.E_CHI2] = chi2_of_factor(graph, tree, f, link[f, tl.L_KIND], c, s)
        factor_errors[f, tl.E_ERROR] = factor_errors[f, tl.E_LEAVES] = factor_errors[f, tl.E_COUNTED] = 0.0
        totals[tl.T_ADDED] += factor_errors[f, tl.E_CHI2]
        finite &= math.isfinite(hessian[last_of_hessian(f, var, fac, link)])
        finite &= math.isfinite(factor_errors[f, tl.E_CHI2])
        note_moved(MODEL, i, node, moved, state)
        link[f, tl.L_I], node[i, tl.N_ADJ] = node[i, tl.N_ADJ], 2 * f
        node[i, tl.N_SEEN] = state[tl.S_STEP]
        if j >= 0:
            link[f, tl.L_J], node[j, tl.N_ADJ] = node[j, tl.N_ADJ], 2 * f + 1
            node[j, tl.N_SEEN] = state[tl.S_STEP]
    state[tl.S_FACTORS] = f1
    return finite


@inline_kernel
def place_hessians(f: int, var: I64, fac: I64, tree: Tree) -> None:
    """Room for the Hessians of all rows of the factor that begins at row f, and for what is kept of its Jacobian."""
    link, state = tree.link, tree.state
    for row in range(f, f + rows_of(f, fac)):
        link[row, tl.L_AT] = state[tl.S_HESSIAN]
        state[tl.S_HESSIAN] = last_of_hessian(row, var, fac, link) + 1
    state[tl.S_HESSIAN] += jacobian_size(f, var, fac)
    kept_samples(f, var, fac, tree)[:] = 0.0  # none are yet


@inline_kernel
def largest_diagonal_of(v: int, var: I64, scalars: F64) -> float:
    """The largest sum of the diagonals of Hessians of variable v."""
    d, most = var[v, at.V_SCALAR], 0.0
    if d >= 0:
        for a in range(dim_of_variable(var, v)):
            most = max(most, scalars[1, d + a])
    return most


@part
def remove_added(graph: Graph, tree: Tree, v0: int, f0: int) -> None:
    """Forget the variables from v0 and the factors from f0 on, which came last; the others are as they were."""
    var, fac = graph.var, graph.fac
    node, link, scalars, turns, saved = tree.node, tree.link, tree.scalars, tree.turns, tree.saved
    state = tree.state
    for f in range(state[tl.S_FACTORS] - 1, f0 - 1, -1):
        i, j = fac[f, at.F_I], fac[f, at.F_J]
        if link[f, tl.L_KIND] >= tl.EXACT:
            state[tl.S_EXACT] -= 1
            state[tl.S_INACTIVE] -= link[f, tl.L_KIND] - tl.EXACT
        if j >= 0:
            node[j, tl.N_ADJ] = link[f, tl.L_J]
            _restore(j, saved[2 * (f - f0) + 1], var, node, scalars, turns)
        node[i, tl.N_ADJ] = link[f, tl.L_I]
        _restore(i, saved[2 * (f - f0)], var, node, scalars, turns)
        state[tl.S_HESSIAN] = link[f, tl.L_AT]
    state[tl.S_VARIABLES], state[tl.S_FACTORS] = v0, f0


@inline_kernel
def _save(v: int, out: F64, var: I64, node: I64, scalars: F64, turns: F64) -> None:
    """What a factor is about to change of variable v."""
    d = var[v, at.V_SCALAR]
    if d >= 0:
        for a in range(dim_of_variable(var, v)):
            out[a] = scalars[1, d + a]
    out[MOST_SCALARS], out[MOST_SCALARS + 1] = turns[v, tl.U_LEVER], node[v, tl.N_SEEN]


@inline_kernel
def _restore(v: int, kept: F64, var: I64, node: I64, scalars: F64, turns: F64) -> None:
    d = var[v, at.V_SCALAR]
    if d >= 0:
        for a in range(dim_of_variable(var, v)):
            scalars[1, d + a] = kept[a]
    turns[v, tl.U_LEVER], node[v, tl.N_SEEN] = kept[MOST_SCALARS], int(kept[MOST_SCALARS + 1])


@inline_kernel
def next_incidence(slot: int, link: I64) -> int:
    """The next incidence of the same variable."""
    return int(link[slot // 2, tl.L_I + slot % 2])
