"""What a step moved is measured: χ² of its factors, and how far each is from its linear model.  MATH §9.6

Every factor with a variable that moved, in its value or in its linearization point, is evaluated.  So after every step
χ² is that of the estimate, and the sum of squared linearization errors is known of all factors: nothing waits for a
later look.  Variables with a factor whose error is above the threshold wait to be relinearized, together.
"""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.error_terms import (
    LINKS,
    SEEN,
    add_observation,
    lever_error_of,
    shift_between,
    turn_error,
    turn_of,
)
from factorbus.solver.kernels.bayes_tree.exact_error import exact_error
from factorbus.solver.kernels.bayes_tree.factor_chi2 import any_chi2, chi2_of_factor, heading_of
from factorbus.solver.kernels.bayes_tree.missed_residual import missed_error_se2, missed_error_se3
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, STAYED
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.relinearize import WAITS
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.sorting import put_in_order
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import (
    count_ends,
    end_of,
    head_of,
    is_member,
    is_one_of_many,
    loss_code,
)
from factorbus.solver.kernels.model.kinds import is_bounded
from factorbus.solver.kernels.model.records import Graph

LEAST_REQUIRED_SHARE = 0.02
IN_SPACE, WITH_LANDMARKS = 8.0, 24.0
MUCH = 8  # where more than one variable in this number has moved, all factors are gone through
# The running sums are computed anew once the magnitudes added to them exceed this multiple of χ².
CANCELLED = 1e5
NOTHING = 1e-6  # χ²
ROBUST = 2.0  # times the error of a factor with a loss in the bound: Gauss-Newton with weights converges slowly
MOST_ERROR = 1e100  # of a factor: its square is still a number


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


@inline_kernel
def evaluate_factor(
    graph: Graph, tree: Tree, f: int, v: int, c: float, s: float, how: int, threshold: float
) -> tuple[float, float, float, float, float]:
    """χ² of factor f, whose first variable is v, and its linearization error, where more of it than its place moved.

    Gives the error; by what χ² is more than before; the sum of both, and of error² now and before; by what error² in
    full and as it counts is more.
    """
    var, fac = graph.var, graph.fac
    node, factor_errors, pending, state = tree.node, tree.factor_errors, tree.pending, tree.state
    error, full, leaves = 0.0, 0.0, 0.0
    kind, second = fac[f, at.F_KIND], fac[f, at.F_J]
    if not is_bounded(kind) or kind == at.PRIOR_SE3 or loss_code(f, fac) != at.NO_LOSS:
        if how < MODEL:
            chi2 = any_chi2(f, graph, tree)
        else:
            error, force, chi2 = exact_error(f, graph, tree)
            error = min(error, MOST_ERROR)
            full = min(error + force, MOST_ERROR)
            leaves = full = ROBUST * full if loss_code(f, fac) != at.NO_LOSS else full
            if error > threshold:
                mark_ends_pending(f, fac, var, node, pending, state)
    else:
        chi2, gap, _ = chi2_of_factor(graph, tree, f, kind, c, s)
        if second >= 0 and how == MODEL:
            error, full, leaves = error_of(graph, tree, f, v, threshold, gap, chi2)
    was = factor_errors[f, tl.E_CHI2]
    factor_errors[f, tl.E_CHI2] = chi2
    if how < MODEL:
        return error, chi2 - was, chi2 + was, 0.0, 0.0
    full, counted = full * full, error * error if error > threshold else 0.0
    full_before, counted_before = factor_errors[f, tl.E_ERROR], factor_errors[f, tl.E_COUNTED]
    factor_errors[f, tl.E_ERROR], factor_errors[f, tl.E_COUNTED] = full, counted
    factor_errors[f, tl.E_LEAVES] = leaves * leaves
    size = chi2 + was + full + full_before
    return error, chi2 - was, size, full - full_before, counted - counted_before


@inline_kernel
def error_of(
    graph: Graph, tree: Tree, f: int, v: int, threshold: float, gap: float, chi2: float
) -> tuple[float, float, float]:
    """How far factor f, whose first variable is v, is from its linear model: as it counts, in full, and what of that a
    chord step leaves.  Between poses v waits where (9.4) is more than `relinearize_threshold`, else where the error is.

    Between poses in space (9.4) and (9.26) stand for (9.33) and (9.34) where they are below that threshold.
    """
    var, kind, second = graph.var, graph.fac[f, at.F_KIND], graph.fac[f, at.F_J]
    free = var[v, at.V_COLUMN] >= 0
    if kind == at.BETWEEN_SE2:
        error, full, leaves, marks, both = error_between_se2(graph, tree, f, threshold, gap, chi2)
    elif kind == at.BETWEEN_SE3:
        error, full, leaves, marks, both = error_between_se3(graph, tree, f, threshold, gap, chi2)
    else:
        d, root, moved = lever_and_shift(graph, tree, f, v)
        phi = turn_of(var[v, at.V_KIND], tree.scalars[0], var[v, at.V_SCALAR]) if free else 0.0
        lever_error, shift_error = add_observation(
            kind, lever_error_of(root, d, phi, moved), root, d, moved, tree.factor_errors[f, tl.E_SHIFT]
        )
        full = error = leaves = min(SEEN * (lever_error + shift_error), MOST_ERROR)
        both, marks = kind == at.BEARING_RANGE_SE2 or shift_error > lever_error, error > threshold
    if marks:
        if free:
            mark_pending(v, tree.node, tree.pending, tree.state)
        if (both or not free) and var[second, at.V_COLUMN] >= 0:
            mark_pending(second, tree.node, tree.pending, tree.state)
    return error, full, leaves


@inline_kernel
def lever_and_shift(graph: Graph, tree: Tree, f: int, v: int) -> tuple[float, float, float]:
    """d and √ω of factor f, whose first variable is v, and |sⱼ − sᵢ|."""
    var, row, planar = graph.var, tree.factor_errors[f], graph.var[v, at.V_KIND] == at.SE2
    x, y = var[v, at.V_AT], var[graph.fac[f, at.F_J], at.V_AT]
    return row[tl.E_LEVER], row[tl.E_ROOT], shift_between(planar, x, y, graph.values, tree.lin[0])


@inline_kernel
def error_between_se2(
    graph: Graph, tree: Tree, f: int, threshold: float, gap: float, chi2: float
) -> tuple[float, float, float, bool, bool]:
    """Of a factor between plane poses what `error_of` gives, whether a pose waits, and whether both do.

    Most factors are far below the threshold, for which squares do: (a + b + c)² ≤ 3 (a² + b² + c²).
    """
    row = tree.factor_errors[f]
    missed, moved, shift, phi, psi = missed_error_se2(graph, tree, f)
    d, root, weight, phi = row[tl.E_LEVER], row[tl.E_ROOT], row[tl.E_SHIFT], abs(phi)
    seen, lever = weight * math.sqrt(gap * shift), root * 0.5 * d * phi * phi
    turned, linked = root * root * phi * phi * moved, LINKS * LINKS * weight * weight * gap * moved
    marks = both = False
    if 3.0 * (lever * lever + turned + linked) > threshold * threshold:
        lever, link = lever + math.sqrt(turned), math.sqrt(linked)
        marks, both = lever + link > threshold, link > lever
    leaves = min(seen + psi * math.sqrt(chi2), MOST_ERROR)
    return min(missed + LINKS * seen, MOST_ERROR), min(missed + leaves, MOST_ERROR), leaves, marks, both


@inline_kernel
def error_between_se3(
    graph: Graph, tree: Tree, f: int, threshold: float, gap: float, chi2: float
) -> tuple[float, float, float, bool, bool]:
    """The same of a factor between poses in space."""
    var, row, delta = graph.var, tree.factor_errors[f], tree.scalars[0]
    v, second = graph.fac[f, at.F_I], graph.fac[f, at.F_J]
    d, root, moved = lever_and_shift(graph, tree, f, v)
    phi = turn_of(at.SE3, delta, var[v, at.V_SCALAR]) if var[v, at.V_COLUMN] >= 0 else 0.0
    turn = phi + (turn_of(at.SE3, delta, var[second, at.V_SCALAR]) if var[second, at.V_COLUMN] >= 0 else 0.0)
    lever_error, shift_error = lever_error_of(root, d, phi, moved), row[tl.E_SHIFT] * math.sqrt(gap)
    link = LINKS * shift_error * moved
    marks, both = lever_error + link > threshold, link > lever_error
    missed, shift, psi = lever_error + turn_error(phi, turn, row[tl.E_TURN]), moved, turn
    if marks or missed > threshold or row[tl.E_FORM] >= tl.CORRECTED:
        missed, shift, psi = missed_error_se3(graph, tree, f)
    leaves = min(shift_error * shift + psi * math.sqrt(chi2), MOST_ERROR)
    error = min(missed + LINKS * shift_error * shift, MOST_ERROR)
    return error, min(missed + leaves, MOST_ERROR), leaves, marks, both


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
def mark_ends_pending(f: int, fac: I64, var: I64, node: I64, pending: I64, state: I64) -> None:
    """The variables of factor f that are free are to be relinearized."""
    for n in range(count_ends(f, fac)):
        v = end_of(f, n, fac)
        if var[v, at.V_COLUMN] >= 0:
            mark_pending(v, node, pending, state)


@inline_kernel
def mark_pending(v: int, node: I64, pending: I64, state: I64) -> None:
    """Variable v is to be relinearized."""
    if node[v, tl.N_FLAGS] == 0:
        node[v, tl.N_FLAGS] = WAITS
        pending[state[tl.S_PENDING]] = v
        state[tl.S_PENDING] += 1


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
