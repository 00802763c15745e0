"""Whether a step goes on, and what is left to do after it.  MATH §9.6."""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.chord_step import error_left
from factorbus.solver.kernels.bayes_tree.decrement import HARDLY_LESS, decrement
from factorbus.solver.kernels.bayes_tree.linearization_error import mark_large_errors
from factorbus.solver.kernels.bayes_tree.own_error import is_own_pose
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.thresholds import LEAST_CHI2
from factorbus.solver.kernels.bayes_tree.work import RELINEARIZING, SCANNING, SOLVING, note_work
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph

MOST_ROUNDS = 10  # of a step that has not converged
FINISHED = 1e-8  # a step with nothing new goes on while Σ error² is more than this share of χ²
LARGE_GAIN = 0.05  # of χ², in one round or all,
AFTER_LARGE_GAIN = 0.02  # times as much error² is allowed after it
MOST_LEFT = 0.5  # of the Σ error² that is allowed: what a chord step may leave, as it counts as a round
SLOW = 0.1  # times as much error² is allowed after a step that had not converged
UNCHECKED = 0.02  # of `converged_share` χ²: where factors whose error is computed have more, the decrement is, too,
CHANGED = 0.2  # unless less than this share of the Σ error² of the last time has changed, all in all
SEEN = 1e-6  # of χ²: rounds that gain hardly less than those before, and no more than this, are no reason to go on
PASSED_OVER = 0.1  # of the Σ error² that is allowed: what may be left to factors none of whose variables moves


@inline_kernel
def goes_on(weighted_error: float, settings: F64, state: I64, totals: F64) -> bool:
    """Whether what waits is relinearized and solved for again in the same step.

    weighted_error: as `measure` gives it
    """
    rounds, continues = state[tl.S_ROUNDS], state[tl.S_CONTINUES] != 0
    if state[tl.S_ONCE] != 0:
        return False
    if left(totals) > allowed(settings, state, totals):
        return rounds < (settings[tl.P_MAX_ROUNDS] if continues else MOST_ROUNDS)
    return (
        state[tl.S_CONTINUES] == 0
        and weighted_error > settings[tl.P_SAME_STEP_SHARE]
        and rounds < settings[tl.P_MAX_ROUNDS]
    )


@inline_kernel
def left(totals: F64) -> float:
    """What a Gauss-Newton step may take off χ², by what is known: Σ error², or the decrement where that is more."""
    return totals[tl.T_ERROR] + totals[tl.T_EXCESS]


@inline_kernel
def is_slow(fell: float, fell_before: float, state: I64, totals: F64) -> bool:
    """Whether the step before had not converged, or rounds gain hardly less than the ones before.

    fell, fell_before: by how much the last round lowered χ², and the one before, if neither was the first
    """
    follows = fell > HARDLY_LESS * fell_before > 0.0 and fell > SEEN * (totals[tl.T_CHI2] + LEAST_CHI2)
    return state[tl.S_SLOW] != 0 or follows


@part
def check_decrement(slow: bool, graph: Graph, tree: Tree, settings: F64) -> None:
    """Compute the decrement where Σ error² is as small as is allowed: where factors whose error is computed, not
    bounded, have a part in it that has changed; or it is `slow`, where a budget has room for that.
    """
    state, totals = tree.state, tree.totals
    error, share = totals[tl.T_ERROR], settings[tl.P_CONVERGED] * (totals[tl.T_CHI2] + LEAST_CHI2)
    least, whole = UNCHECKED * share, fits_whole(settings, state, totals)
    slow = slow and whole
    is_nothing = state[tl.S_EXACT] == 0 or error <= least
    if state[tl.S_CONTINUES] != 0 or error > allowed(settings, state, totals) or (is_nothing and not slow):
        totals[tl.T_EXCESS] = 0.0
    elif slow or totals[tl.T_UNCHECKED] > max(least, CHANGED * totals[tl.T_CHECKED]):
        totals[tl.T_UNCHECKED], totals[tl.T_CHECKED], totals[tl.T_EXCESS] = 0.0, error, 0.0
        if slow or computed_error(graph, tree) > least:
            most = slowly_left(settings, state) * (totals[tl.T_CHI2] + LEAST_CHI2)
            of_one = least_of_sum(settings, state, totals) if whole else least_error(settings, state, totals)
            found = decrement(of_one, whole, most, graph, tree)
            totals[tl.T_EXCESS] = found - error if found > most else 0.0


@inline_kernel
def fits_whole(settings: F64, state: I64, totals: F64) -> bool:
    """Whether a budget has room for the gradient of all factors, and to try a step."""
    work = (SCANNING + 2.0 * RELINEARIZING) * state[tl.S_FACTORS] + SOLVING * state[tl.S_VARIABLES]
    return totals[tl.T_WORK] + work <= settings[tl.P_BUDGET]


@inline_kernel
def computed_error(graph: Graph, tree: Tree) -> float:
    """Σ error² of the factors whose error is computed, as (9.11) and (9.31) are: forces of one add up with those of
    others along what the map hardly holds."""
    total = 0.0
    for f in range(tree.state[tl.S_FACTORS]):
        if tree.link[f, tl.L_KIND] >= tl.EXACT or graph.fac[f, at.F_J] < 0:
            total += 0.0 if is_own_pose(f, graph.var, graph.fac) else tree.factor_errors[f, tl.E_ERROR]
    return total


@inline_kernel
def mark_unconverged(graph: Graph, tree: Tree, settings: F64) -> None:
    """Where Σ error² is more than is allowed, all variables that have a part in it are relinearized next."""
    state, totals = tree.state, tree.totals
    if left(totals) > allowed(settings, state, totals):
        note_work(SCANNING * state[tl.S_FACTORS], totals)
        adds_up = totals[tl.T_EXCESS] > 0.0
        least = least_of_sum(settings, state, totals) if adds_up else least_error(settings, state, totals)
        mark_large_errors(least, graph, tree)
        state[tl.S_DUE] = 1


@inline_kernel
def least_error(settings: F64, state: I64, totals: F64) -> float:
    """The error² of a factor from which on it has a part in Σ error²."""
    return PASSED_OVER * allowed(settings, state, totals) / state[tl.S_FACTORS]


@inline_kernel
def least_of_sum(settings: F64, state: I64, totals: F64) -> float:
    """The same where forces may add up: n of them along one direction come to n² times the square of one."""
    return least_error(settings, state, totals) / state[tl.S_FACTORS]


@inline_kernel
def may_keep_factor(tree: Tree, settings: F64) -> bool:
    """Whether a chord step may end the step: once, where R is that of Λ and what it corrects is most of Σ error²."""
    state, totals = tree.state, tree.totals
    return (
        state[tl.S_CHORDS] == 0
        and totals[tl.T_EXCESS] == 0.0
        and state[tl.S_CONTINUES] == 0
        and state[tl.S_RAISED] == 0
        and error_left(tree) <= MOST_LEFT * allowed(settings, state, totals)
    )


@inline_kernel
def allowed(settings: F64, state: I64, totals: F64) -> float:
    """The Σ error² with which a step ends: what its report calls converged; FINISHED of χ² with nothing new."""
    if state[tl.S_CONTINUES] != 0:
        return FINISHED * (totals[tl.T_CHI2] + LEAST_CHI2)
    return converged_error(settings, state, totals)


@inline_kernel
def converged_error(settings: F64, state: I64, totals: F64) -> float:
    """The Σ error² up to which the step has converged.  (9.32)"""
    chi2 = totals[tl.T_CHI2] + LEAST_CHI2
    return slowly_left(settings, state) * chi2 * (AFTER_LARGE_GAIN if totals[tl.T_GAINED] > LARGE_GAIN * chi2 else 1.0)


@inline_kernel
def slowly_left(settings: F64, state: I64) -> float:
    """The share of χ² that the next Gauss-Newton step may take off it after a step that has converged: less after
    several rounds, or a step that had not, since along a valley each takes off hardly less than the one before."""
    return once_slow(settings[tl.P_CONVERGED] / max(state[tl.S_ROUNDS] + state[tl.S_CHORDS], 1), state)


@inline_kernel
def once_slow(share: float, state: I64) -> float:
    """A share, or less of it where the step before had not converged."""
    return share * (SLOW if state[tl.S_SLOW] != 0 else 1.0)


@inline_kernel
def is_clear(state: I64, totals: F64) -> bool:
    """Whether a step that had something new has converged, and nothing speaks against it or is left behind."""
    return (
        state[tl.S_AFTER] == 0
        and state[tl.S_CONTINUES] == 0
        and state[tl.S_BEHIND] == 0
        and totals[tl.T_EXCESS] == 0.0
        and totals[tl.T_LEFT] < math.inf
        and totals[tl.T_ERROR] <= totals[tl.T_ALLOWED]
    )


@kernel("float64(int64[::1], float64[::1])")
def unsolved(state: I64, totals: F64) -> float:
    """What of the linear problem is not solved: where something was left behind, and where the estimate was put back to
    the linearization points, from where cliques are solved again only below what moves."""
    if state[tl.S_BEHIND] == 0 and totals[tl.T_LEFT] != math.inf:
        return 0.0
    return max(totals[tl.T_CHI2] - totals[tl.T_MODEL], 0.0)


@inline_kernel
def note_after(settings: F64, state: I64, totals: F64) -> None:
    """What is to be done after the step, and what the optimum is at least."""
    chi2 = totals[tl.T_CHI2]
    totals[tl.T_ALLOWED] = converged_error(settings, state, totals)
    # What a budget has put off, or has left behind, says nothing of how fast the others converge.
    put_off = state[tl.S_PENDING] != 0 and settings[tl.P_BUDGET] < math.inf
    unconverged = left(totals) > totals[tl.T_ALLOWED]
    most = once_slow(settings[tl.P_CONVERGED], state) * (chi2 + LEAST_CHI2)
    never_solved = state[tl.S_BEHIND] == 0 and unsolved(state, totals) > most
    state[tl.S_SLOW] = 1 if (unconverged or never_solved) and not put_off else 0
    if unconverged and put_off:
        state[tl.S_DUE] = 1
    state[tl.S_AFTER] = 0
    if not chi2 <= (1.0 + settings[tl.P_CONVERGED]) * totals[tl.T_WHOLE] + LEAST_CHI2:
        state[tl.S_AFTER] += tl.WORSE
    if state[tl.S_RISES] != 0:
        state[tl.S_AFTER] += tl.ROSE
    if state[tl.S_RAISED] != 0:
        state[tl.S_AFTER] += tl.RAISED
    # χ² of a torn estimate is above the optimum by more than what the errors of the factors come to.
    if state[tl.S_AFTER] == 0 and state[tl.S_BEHIND] == 0:
        totals[tl.T_LEAST] = max(chi2 - left(totals), 0.0)
