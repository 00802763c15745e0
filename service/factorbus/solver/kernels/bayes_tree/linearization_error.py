"""What a step moved is measured: χ² of its factors, and how far each is from its linear model.  MATH §9.6

Every factor with a variable that moved, in its value or in its linearization point, is evaluated.  So after every step
χ² is that of the estimate, and the sum of squared linearization errors is known of all factors: nothing waits for a
later look.  Variables with a factor whose error is above the threshold wait to be relinearized, together.
"""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.error_terms import lever_error_of, shift_between, turn_of
from factorbus.solver.kernels.bayes_tree.evaluate_factor import evaluate_factor
from factorbus.solver.kernels.bayes_tree.factor_chi2 import heading_of
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, STAYED
from factorbus.solver.kernels.bayes_tree.pending import mark_ends_pending
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.sorting import put_in_order
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, head_of, is_member, is_one_of_many
from factorbus.solver.kernels.model.records import Graph

LEAST_REQUIRED_SHARE = 0.02
IN_SPACE, WITH_LANDMARKS = 8.0, 24.0
MUCH = 8  # where more than one variable in this number has moved, all factors are gone through
# The running sums are computed anew once the magnitudes added to them exceed this multiple of χ².
CANCELLED = 1e5
NOTHING = 1e-6  # χ²


@part
def measure(graph: Graph, tree: Tree, settings: F64) -> float:
    """Evaluate the factors of what `moved`, which empties that, and see whether what waits is due.

    Gives Σ error² of what waits, as a multiple of (9.22).
    """
    var = graph.var
    factor_errors, pending, state, totals = tree.factor_errors, tree.pending, tree.state, tree.totals
    if state[tl.S_PENDING] == 0:
        state[tl.S_WAITING] = state[tl.S_STEP]
    most = 0.0
    if state[tl.S_MOVED] > 0:
        most = evaluate_moved(graph, tree, settings[tl.P_RELINEARIZE_THRESHOLD])
        if not totals[tl.T_ADDED_UP] <= CANCELLED * (totals[tl.T_CHI2] + NOTHING):
            sum_anew(factor_errors, state, totals)
    weighted_error = weigh_error(totals[tl.T_COUNTED], settings, var, pending, state)
    waited = state[tl.S_STEP] - state[tl.S_WAITING]
    if (
        weighted_error > settings[tl.P_NEXT_STEP_SHARE]
        or most > settings[tl.P_MAX_ERROR]
        or waited >= settings[tl.P_MAX_WAIT]
    ):
        state[tl.S_DUE] = 1
    return weighted_error


@part
def evaluate_moved(graph: Graph, tree: Tree, threshold: float) -> float:
    """χ² and linearization error of every factor of what `moved`, which is empty then; gives the largest error.

    Factors are gone through in the order of their ids where many variables moved, else variable by variable.
    """
    var, fac, values = graph.var, graph.fac, graph.values
    node, link, scalars, turns, moved = tree.node, tree.link, tree.scalars, tree.turns, tree.moved
    state, totals = tree.state, tree.totals
    delta, most = scalars[0], 0.0
    chi2, sizes, full, counted = totals[tl.T_CHI2], totals[tl.T_ADDED_UP], totals[tl.T_ERROR], totals[tl.T_COUNTED]
    unchecked = totals[tl.T_UNCHECKED]
    if state[tl.S_MOVED] * MUCH > state[tl.S_VARIABLES]:
        last, c, s = -1, 1.0, 0.0
        for f in range(state[tl.S_FACTORS]):
            v = fac[f, at.F_I]
            how = how_moved(f, fac, node)
            if how != STAYED:
                if v != last:
                    c, s = heading_of(v, var[v, at.V_KIND] == at.SE2, var, delta, values, turns)
                    last = v
                error, more, size, more_full, more_counted = evaluate_factor(graph, tree, f, v, c, s, how, threshold)
                most, chi2, sizes = max(most, error), chi2 + more, sizes + size
                full, counted = full + more_full, counted + more_counted
                unchecked += abs(more_full)
    else:
        put_in_order(moved[: state[tl.S_MOVED]], state[tl.S_VARIABLES])
        for k in range(state[tl.S_MOVED]):
            u, slot = moved[k], node[moved[k], tl.N_ADJ]
            cu, su = heading_of(u, var[u, at.V_KIND] == at.SE2, var, delta, values, turns)
            while slot >= 0:
                f = head_of(slot // 2, fac)
                v = fac[f, at.F_I]
                if slot // 2 == first_moved_row(f, u, fac, node):
                    c, s = cu, su
                    if v != u:
                        c, s = heading_of(v, var[v, at.V_KIND] == at.SE2, var, delta, values, turns)
                    how = how_moved(f, fac, node)
                    error, more, size, more_full, more_counted = evaluate_factor(
                        graph, tree, f, v, c, s, how, threshold
                    )
                    most, chi2, sizes = max(most, error), chi2 + more, sizes + size
                    full, counted = full + more_full, counted + more_counted
                    unchecked += abs(more_full)
                slot = next_incidence(slot, link)
    totals[tl.T_CHI2], totals[tl.T_ADDED_UP] = chi2, sizes
    totals[tl.T_ERROR], totals[tl.T_COUNTED] = max(full, 0.0), max(counted, 0.0)
    totals[tl.T_UNCHECKED] = unchecked
    for k in range(state[tl.S_MOVED]):
        node[moved[k], tl.N_LISTED] = STAYED
    state[tl.S_MOVED] = 0
    return most


@inline_kernel
def how_moved(f: int, fac: I64, node: I64) -> int:
    """How the variables of factor f moved: not at all, both as one body, or so that its linear model is evaluated.

    Of a row that is not the first of its factor: not at all.
    """
    first, second = node[fac[f, at.F_I], tl.N_LISTED], fac[f, at.F_J]
    if is_one_of_many(f, fac):
        return how_many_moved(f, fac, node)
    if second < 0:
        return first
    also = node[second, tl.N_LISTED]
    return first if first == also else MODEL


@part
def how_many_moved(f: int, fac: I64, node: I64) -> int:
    """The same of a factor of more than two variables."""
    if is_member(f, fac):
        return STAYED
    how = node[fac[f, at.F_I], tl.N_LISTED]
    for n in range(1, count_ends(f, fac)):
        if node[end_of(f, n, fac), tl.N_LISTED] != how:
            return MODEL
    return how


@inline_kernel
def first_moved_row(f: int, u: int, fac: I64, node: I64) -> int:
    """The row by which factor f is found from its first variable that moved, where that is u; else −1."""
    if node[fac[f, at.F_I], tl.N_LISTED] != STAYED:
        return f if fac[f, at.F_I] == u else -1
    for n in range(1, count_ends(f, fac)):
        v = end_of(f, n, fac)
        if node[v, tl.N_LISTED] != STAYED:
            return f + n - 1 if v == u else -1
    return -1


@part
def mark_large_errors(least: float, graph: Graph, tree: Tree) -> None:
    """The variables of all factors whose error² in full is more than `least` wait."""
    var, fac = graph.var, graph.fac
    for f in range(tree.state[tl.S_FACTORS]):
        if tree.factor_errors[f, tl.E_ERROR] > least or moves_far(f, least, graph, tree):
            mark_ends_pending(f, fac, var, tree.node, tree.pending, tree.state)


@inline_kernel
def moves_far(f: int, least: float, graph: Graph, tree: Tree) -> bool:
    """Whether (9.4) and (9.13) of a factor between poses come to more than `least`, squared, though its model may miss
    less: one that is left behind where its neighbours are relinearized misses as much as they have shifted.
    """
    var, row, kind, second = graph.var, tree.factor_errors[f], tree.link[f, tl.L_KIND], graph.fac[f, at.F_J]
    if kind != at.BETWEEN_SE2 and kind != at.BETWEEN_SE3:
        return False
    v, root = graph.fac[f, at.F_I], row[tl.E_ROOT]
    d = var[v, at.V_SCALAR]
    phi = turn_of(var[v, at.V_KIND], tree.scalars[0], d) if d >= 0 else 0.0
    shift = shift_between(kind == at.BETWEEN_SE2, var[v, at.V_AT], var[second, at.V_AT], graph.values, tree.lin[0])
    gap = math.sqrt(max(row[tl.E_CHI2], 0.0)) / root if root > 0.0 else 0.0
    error = lever_error_of(root, row[tl.E_LEVER], phi, shift) + row[tl.E_SHIFT] * gap * shift
    return error * error > least


@inline_kernel
def weigh_error(total: float, settings: F64, var: I64, pending: I64, state: I64) -> float:
    """Σ error² as a multiple of what it has to be worth, (9.22)."""
    if total <= LEAST_REQUIRED_SHARE * min(settings[tl.P_NEXT_STEP_SHARE], settings[tl.P_SAME_STEP_SHARE]):
        return 0.0
    scalars, highest_cost = 0, 1.0
    for k in range(state[tl.S_PENDING]):
        scalars += dim_of_variable(var, pending[k])
        highest_cost = max(highest_cost, relinearize_cost(var[pending[k], at.V_KIND]))
    return total / (highest_cost * required_share(scalars, settings))


@part
def sum_anew(factor_errors: F64, state: I64, totals: F64) -> None:
    """χ² and Σ error² from what is kept of each factor: running sums lose digits."""
    chi2 = full = counted = 0.0
    for f in range(state[tl.S_FACTORS]):
        chi2 += factor_errors[f, tl.E_CHI2]
        full += factor_errors[f, tl.E_ERROR]
        counted += factor_errors[f, tl.E_COUNTED]
    totals[tl.T_CHI2], totals[tl.T_ADDED_UP] = chi2, 0.0
    totals[tl.T_ERROR], totals[tl.T_COUNTED] = full, counted


@inline_kernel
def required_share(count: int, settings: F64) -> float:
    """The share of the error of a full batch that `count` scalars must have to be relinearized.  (9.22)"""
    share = count / settings[tl.P_FULL_BATCH]
    return min(max(share * share * share, LEAST_REQUIRED_SHARE), 1.0)


@inline_kernel
def relinearize_cost(kind: int) -> float:
    """How many times the error of planar poses must be reached where a variable of this kind waits.  (9.22)"""
    if kind == at.SE2:
        return 1.0
    return IN_SPACE if kind == at.SE3 or kind == at.SO3 or kind == at.SIM3 else WITH_LANDMARKS
