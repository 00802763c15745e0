"""χ² of one factor at the estimate, and how far it is from its linear model.  MATH §9.6

What a step moves, it measures: so this is called more often than all else that evaluates a factor, and kinds that are
most common are asked for first.
"""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.correct_inertial import is_inertial_and_plain
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
from factorbus.solver.kernels.bayes_tree.factor_chi2 import (
    any_chi2,
    between_se2_chi2,
    chi2_of_factor,
    landmark_se2_chi2,
)
from factorbus.solver.kernels.bayes_tree.missed_residual import missed_error_se2, missed_error_se3
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL
from factorbus.solver.kernels.bayes_tree.pending import mark_ends_pending, mark_first_pending
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.seen_in_space import between_se3_chi2
from factorbus.solver.kernels.jit.compile import inline_kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import loss_code
from factorbus.solver.kernels.model.kinds import is_bounded
from factorbus.solver.kernels.model.records import Graph

ROBUST = 2.0  # times the error of a factor with a loss in the bound: Gauss-Newton with weights converges slowly
MOST_ERROR = 1e100  # of a factor: its square is still a number


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
    kind, second, plain = fac[f, at.F_KIND], fac[f, at.F_J], loss_code(f, fac) == at.NO_LOSS
    if plain and kind == at.BETWEEN_SE2:
        chi2, gap = between_se2_chi2(f, c, s, var, fac, graph.values, graph.payload, factor_errors)
        if how == MODEL:
            error, full, leaves = error_between_se2(graph, tree, f, threshold, gap, chi2)
    elif plain and kind == at.BETWEEN_SE3:
        chi2, gap, seen = between_se3_chi2(f, graph, tree)
        if how == MODEL:
            error, full, leaves = error_between_se3(graph, tree, f, threshold, gap, chi2, seen)
    elif plain and kind == at.LANDMARK_SE2:
        chi2 = landmark_se2_chi2(f, c, s, var, fac, graph.values, graph.payload)
        if how == MODEL:
            error = full = leaves = error_of_landmark(graph, tree, f, v, threshold)
    elif not plain or not is_bounded(kind) or kind == at.PRIOR_SE3:
        if how < MODEL:
            chi2 = any_chi2(f, graph, tree)
        else:
            error, force, chi2 = exact_error(f, graph, tree)
            error = min(error, MOST_ERROR)
            full = min(error + force, MOST_ERROR)
            leaves = full = full if plain else ROBUST * full
            if is_inertial_and_plain(f, graph, tree):
                leaves = min(force, MOST_ERROR)
            if error > threshold:
                mark_ends_pending(f, fac, var, node, pending, state)
    else:
        chi2 = chi2_of_factor(graph, tree, f, kind, c, s)
        if second >= 0 and how == MODEL:
            error = full = leaves = error_of_observation(graph, tree, f, v, threshold)
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
def error_of_observation(graph: Graph, tree: Tree, f: int, v: int, threshold: float) -> float:
    """How far factor f, by which the pose v sees a landmark, is from its linear model.  Where that is more than
    `relinearize_threshold` v waits, or both do."""
    var, kind, row = graph.var, graph.fac[f, at.F_KIND], tree.factor_errors[f]
    d, root, moved = lever_and_shift(graph, tree, f, v)
    phi = turn_of(var[v, at.V_KIND], tree.scalars[0], var[v, at.V_SCALAR]) if var[v, at.V_COLUMN] >= 0 else 0.0
    lever_error, shift_error = add_observation(
        kind, lever_error_of(root, d, phi, moved), root, d, moved, row[tl.E_SHIFT]
    )
    error = min(SEEN * (lever_error + shift_error), MOST_ERROR)
    if error > threshold:
        mark_first_pending(f, kind == at.BEARING_RANGE_SE2 or shift_error > lever_error, graph, tree)
    return error


@inline_kernel
def error_of_landmark(graph: Graph, tree: Tree, f: int, v: int, threshold: float) -> float:
    """The same where v is a plane pose and measures where the landmark is, which is most common."""
    row, scalar = tree.factor_errors[f], graph.var[v, at.V_SCALAR]
    d, root, moved = lever_and_shift(graph, tree, f, v)
    lever_error = lever_error_of(root, d, turn_of(at.SE2, tree.scalars[0], scalar) if scalar >= 0 else 0.0, moved)
    shift_error = (row[tl.E_SHIFT] / root + root * moved) * moved / d if d > 0.0 else 0.0
    error = min(SEEN * (lever_error + shift_error), MOST_ERROR)
    if error > threshold:
        mark_first_pending(f, shift_error > lever_error, graph, tree)
    return error


@inline_kernel
def lever_and_shift(graph: Graph, tree: Tree, f: int, v: int) -> tuple[float, float, float]:
    """d and √ω of factor f, whose first variable is v, and |sⱼ − sᵢ|."""
    var, row, planar = graph.var, tree.factor_errors[f], graph.var[v, at.V_KIND] == at.SE2
    x, y = var[v, at.V_AT], var[graph.fac[f, at.F_J], at.V_AT]
    return row[tl.E_LEVER], row[tl.E_ROOT], shift_between(planar, x, y, graph.values, tree.lin[0])


@inline_kernel
def error_between_se2(
    graph: Graph, tree: Tree, f: int, threshold: float, gap: float, chi2: float
) -> tuple[float, float, float]:
    """How far factor f between plane poses is from its linear model: as it counts, in full, and what of that a chord
    step leaves.  The first pose waits where (9.4) is more than `relinearize_threshold`, or both do.

    Most factors are far below the threshold, for which squares do: (a + b + c)² ≤ 3 (a² + b² + c²).
    """
    row = tree.factor_errors[f]
    missed, moved, shift, phi, psi = missed_error_se2(graph, tree, f)
    d, root, weight, phi = row[tl.E_LEVER], row[tl.E_ROOT], row[tl.E_SHIFT], abs(phi)
    seen, lever = weight * math.sqrt(gap * shift), root * 0.5 * d * phi * phi
    turned, linked = root * root * phi * phi * moved, LINKS * LINKS * weight * weight * gap * moved
    if 3.0 * (lever * lever + turned + linked) > threshold * threshold:
        lever, link = lever + math.sqrt(turned), math.sqrt(linked)
        if lever + link > threshold:
            mark_first_pending(f, link > lever, graph, tree)
    leaves = min(seen + psi * math.sqrt(chi2), MOST_ERROR)
    return min(missed + LINKS * seen, MOST_ERROR), min(missed + leaves, MOST_ERROR), leaves


@inline_kernel
def error_between_se3(
    graph: Graph, tree: Tree, f: int, threshold: float, gap: float, chi2: float, seen: tuple
) -> tuple[float, float, float]:
    """The same between poses in space, of which f sees `seen` (`seen_se3`).

    (9.4) and (9.26) stand for (9.33) and (9.34) where they are below that threshold.
    """
    var, row, delta = graph.var, tree.factor_errors[f], tree.scalars[0]
    v, second = graph.fac[f, at.F_I], graph.fac[f, at.F_J]
    d, root, moved = lever_and_shift(graph, tree, f, v)
    phi = turn_of(at.SE3, delta, var[v, at.V_SCALAR]) if var[v, at.V_COLUMN] >= 0 else 0.0
    turn = phi + (turn_of(at.SE3, delta, var[second, at.V_SCALAR]) if var[second, at.V_COLUMN] >= 0 else 0.0)
    lever_error, shift_error = lever_error_of(root, d, phi, moved), row[tl.E_SHIFT] * math.sqrt(gap)
    link = LINKS * shift_error * moved
    marks = lever_error + link > threshold
    missed, shift, psi = lever_error + turn_error(phi, turn, row[tl.E_TURN]), moved, turn
    if marks:
        mark_first_pending(f, link > lever_error, graph, tree)
    if marks or missed > threshold or row[tl.E_FORM] >= tl.CORRECTED:
        missed, shift, psi = missed_error_se3(graph, tree, f, seen)
    leaves = min(shift_error * shift + psi * math.sqrt(chi2), MOST_ERROR)
    error = min(missed + LINKS * shift_error * shift, MOST_ERROR)
    return error, min(missed + leaves, MOST_ERROR), leaves
