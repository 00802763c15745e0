"""Which of the variables that are due are relinearized in a step with a budget.  MATH §9.10

A variable takes the cliques that eliminate the variables of its factors, and all above them.  So whole subtrees are
chosen, from the root down: those first in which most error is corrected for the work.

    1  consider   the variables that wait; where they do not fit, without those whose error is negligible
    2  want       the cliques that their relinearization takes, children first
    3  sum        work and error of each of these subtrees
    4  take       subtrees, as many as fit
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence
from factorbus.solver.kernels.bayes_tree.convergence import FINISHED, PASSED_OVER
from factorbus.solver.kernels.bayes_tree.linearization_error import moves_far
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.relinearize import MOVES
from factorbus.solver.kernels.bayes_tree.thresholds import LEAST_CHI2
from factorbus.solver.kernels.bayes_tree.work import (
    ORDERING,
    RELINEARIZING,
    SCANNING,
    SOLVING,
    note_work,
    work_of_clique,
    work_of_solving,
)
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, head_of
from factorbus.solver.kernels.model.records import Graph

# Of the budget: what is kept for back-substitution at the most, and what a relinearization may take at least.
KEPT, LEAST = 0.25, 0.125
HEADROOM = 1.1  # times as much as reckoned is what it takes to eliminate cliques again, which get another order
LOOKING = 20_000.0  # of each variable that is considered
FEWEST = 256  # that are considered
TRIES = 200  # cliques that are looked at from the root down, at most
ENOUGH = 0.75  # of the budget: where less of it is used there may be another round
# Times χ² of before, from which on it is found out in the same step whether what is behind is all there is to it, and
# Levenberg-Marquardt follows where it is not.
MOST_RISE = 10.0
# Steps without a try after one that left more than this share of all errors, or that took less than this share of its
# budget and found nothing to choose.
RETRY, USEFUL, ROOMY = 8, 0.9, 0.5
FEW = 5.0  # times what is allowed: where errors are more, every part counts
# What becomes of a clique: it is not wanted; wanted; taken; taken with all that is wanted below it.
UNWANTED, WANTED, TAKEN, WHOLE = 0, 1, 2, 3


@part
def choose_due(graph: Graph, tree: Tree, f1: int, settings: F64) -> I64:
    """The variables that wait and are relinearized now, in the order in which they wait; the factors up to f1 come
    first.  All of them, if they fit.
    """
    state = tree.state
    if not (may_try(state) or state[tl.S_CONTINUES] != 0) or state[tl.S_BEHIND] != 0:
        return tree.pending[:0].copy()
    budget = settings[tl.P_BUDGET]
    least = least_room(state, budget)
    room = max(budget - tree.totals[tl.T_WORK], least)
    # All of them, if they fit: more than this many do not.
    moving = tree.pending[:0].copy()
    if state[tl.S_PENDING] * (RELINEARIZING + ORDERING) <= room:
        considered = list_considered(graph, tree, -1.0, room)
        moving = choose_among(considered, graph, tree, f1, max(budget - tree.totals[tl.T_WORK], least), least)
    if moving.size == state[tl.S_PENDING] or room <= 0.0:
        return moving
    # A step that gained much has all relinearized that has a part in a much smaller sum than what keeps the map from
    # having converged: what does not fit of that is not worth the steps that follow.
    # What is left alone has all relinearized in time.
    share = FINISHED if state[tl.S_CONTINUES] != 0 else settings[tl.P_CONVERGED]
    error = PASSED_OVER * share * (tree.totals[tl.T_CHI2] + LEAST_CHI2) / state[tl.S_FACTORS]
    considered = list_considered(graph, tree, error, room)
    return choose_among(considered, graph, tree, f1, max(budget - tree.totals[tl.T_WORK], least), least)


@inline_kernel
def least_room(state: I64, budget: float) -> float:
    """What a step has for it at least: one with nothing new, and every RETRY-th, so that something is done however
    tight the budget is.
    """
    return LEAST * budget if state[tl.S_CONTINUES] != 0 or state[tl.S_STEP] % RETRY == 0 else 0.0


@part
def list_considered(graph: Graph, tree: Tree, least: float, room: float) -> I64:
    """The variables that wait and have a factor with an error² of more than `least`, of as many as may be looked at."""
    node, pending, state = tree.node, tree.pending, tree.state
    count = state[tl.S_PENDING]
    most = min(count, max(FEWEST, int(KEPT * room / LOOKING)))
    # Where there are more, those of another part of the list in each step.
    first, n, found = (state[tl.S_STEP] * most) % count if most < count else 0, 0, np.empty(most, np.int64)
    for k in range(first, first + most):
        v = pending[k % count]
        slot, matters = node[v, tl.N_ADJ], least < 0.0
        while slot >= 0 and not matters:
            f = head_of(slot // 2, graph.fac)
            matters = tree.factor_errors[f, tl.E_ERROR] > least or moves_far(f, least, graph, tree)
            slot = next_incidence(slot, tree.link)
        if matters:
            found[n] = v
            n += 1
    note_work(LOOKING * most, tree.totals)
    return found[:n].copy()


@part
def choose_among(considered: I64, graph: Graph, tree: Tree, f1: int, room: float, least: float) -> I64:
    """Those of the variables that fit into `room`, with all else that the step does, or by themselves into `least`."""
    clique, state = tree.clique, tree.state
    fate, listed = np.zeros(len(clique), np.int64), np.empty(len(clique), np.int64)
    # 2
    end = want_changed(graph, tree, f1, fate, listed)
    used = 0.0
    for k in range(end, listed.size):
        fate[listed[k]] = TAKEN
        used += work_of_both(clique[listed[k]])
    work, gain = np.zeros(len(clique)), np.zeros(len(clique))
    for k in range(considered.size):
        end = want_factors_of(considered[k], graph, tree, fate, gain, listed, end)
        work[tree.node[considered[k], tl.N_CLIQUE]] += RELINEARIZING
    # 3
    wanted = listed[end:]
    for k in range(wanted.size):
        c, above = wanted[k], clique[wanted[k], tl.C_PARENT]
        work[c] += work_of_both(clique[c]) if fate[c] == WANTED else 0.0
        if above >= 0:
            work[above], gain[above] = work[above] + work[c], gain[above] + gain[c]
    # 4
    kept = min(KEPT * room, SOLVING * state[tl.S_VARIABLES])
    take_subtrees(max((room - kept - used) / HEADROOM, least), work, gain, fate, clique, wanted)
    return list_covered(graph, tree, considered, fate)


@inline_kernel
def work_of_both(row: I64) -> float:
    """To eliminate a clique again and to solve it, which it always is then."""
    return work_of_clique(row) + work_of_solving(row)


@part
def want_changed(graph: Graph, tree: Tree, f1: int, fate: I64, listed: I64) -> int:
    """Want the cliques that new and edited factors change; gives where they begin in `listed`."""
    fac, node, state, end = graph.fac, tree.node, tree.state, listed.size
    for k in range(state[tl.S_EDITED]):
        end = want_above(node[tree.moved[k], tl.N_CLIQUE], tree.clique, fate, listed, end)
    for f in range(state[tl.S_TAKEN], f1):
        for n in range(2):
            v = fac[f, at.F_I + n]
            if v >= 0:
                end = want_above(node[v, tl.N_CLIQUE], tree.clique, fate, listed, end)
    return end


@part
def want_factors_of(v: int, graph: Graph, tree: Tree, fate: I64, gain: F64, listed: I64, end: int) -> int:
    """Want the cliques of all variables that variable v has factors with; these gain the errors of the factors."""
    fac, node, slot = graph.fac, tree.node, tree.node[v, tl.N_ADJ]
    while slot >= 0:
        f = head_of(slot // 2, fac)
        for n in range(count_ends(f, fac)):
            c = node[end_of(f, n, fac), tl.N_CLIQUE]
            if c >= 0:
                gain[c] += tree.factor_errors[f, tl.E_ERROR]
                end = want_above(c, tree.clique, fate, listed, end)
        slot = next_incidence(slot, tree.link)
    return end


@inline_kernel
def want_above(c: int, clique: I64, fate: I64, listed: I64, end: int) -> int:
    """Want clique c and those above it, before what `listed` has from `end` on; gives the new end."""
    low, count = c, 0
    while c >= 0 and fate[c] == UNWANTED:
        fate[c], c, count = WANTED, clique[c, tl.C_PARENT], count + 1
    for k in range(end - count, end):
        listed[k], low = low, clique[low, tl.C_PARENT]
    return end - count


@part
def take_subtrees(left: float, work: F64, gain: F64, fate: I64, clique: I64, wanted: I64) -> None:
    """Take the wanted subtrees in which the most is gained for the work, from the roots down, while there is work left.

    Of one that takes too much its root is taken, and what is below it is looked at.  wanted: children first
    """
    edge, n = np.empty(wanted.size, np.int64), 0
    for k in range(wanted.size):
        if clique[wanted[k], tl.C_PARENT] < 0:
            edge[n] = wanted[k]
            n += 1
    for _ in range(TRIES):
        best, most = -1, -1.0
        for k in range(n):
            worth = gain[edge[k]] / (work[edge[k]] + 1.0)
            if worth > most:
                best, most = k, worth
        if best < 0:
            break
        c, n = edge[best], n - 1
        edge[best] = edge[n]
        if work[c] <= left:
            left -= float(work[c])
            fate[c] = WHOLE
            continue
        own = work_of_both(clique[c]) if fate[c] == WANTED else 0.0
        if own > left:
            continue
        left -= own
        fate[c] = TAKEN
        child = clique[c, tl.C_CHILD]
        while child >= 0:
            if fate[child] != UNWANTED:
                edge[n] = child
                n += 1
            child = clique[child, tl.C_NEXT]
    for k in range(wanted.size - 1, -1, -1):
        above = clique[wanted[k], tl.C_PARENT]
        if above >= 0 and fate[above] == WHOLE:
            fate[wanted[k]] = WHOLE


@part
def list_covered(graph: Graph, tree: Tree, considered: I64, fate: I64) -> I64:
    """The variables all of whose factors are eliminated in cliques that are taken."""
    fac, node, moving, count = graph.fac, tree.node, np.empty(considered.size, np.int64), 0
    for k in range(considered.size):
        slot, covered = node[considered[k], tl.N_ADJ], True
        while slot >= 0 and covered:
            f = head_of(slot // 2, fac)
            for n in range(count_ends(f, fac)):
                c = node[end_of(f, n, fac), tl.N_CLIQUE]
                covered &= c < 0 or fate[c] >= TAKEN
            slot = next_incidence(slot, tree.link)
        if covered:
            moving[count] = considered[k]
            count += 1
    return moving[:count].copy()


@inline_kernel
def may_try(state: I64) -> bool:
    """Whether relinearizations are looked for: not where there was nothing to choose a few steps ago."""
    return state[tl.S_STEP] >= state[tl.S_TRY_AT]


@inline_kernel
def may_go_on(tree: Tree, budget: float) -> bool:
    """Whether a step has enough of its budget left for another round."""
    return tree.totals[tl.T_WORK] + SCANNING * tree.state[tl.S_FACTORS] < ENOUGH * budget


@inline_kernel
def is_in_vain(settings: F64, state: I64, totals: F64) -> bool:
    """Whether a part of what was due already was relinearized, and all errors are hardly less than before: where one
    part meets the next both have errors; or there was room for it, and nothing to choose.
    """
    if state[tl.S_RELINEARIZED] > 0:
        was = totals[tl.T_ERROR_BEFORE]
        few = FEW * settings[tl.P_CONVERGED] * (totals[tl.T_CHI2] + LEAST_CHI2)
        hardly_less = few > was > totals[tl.T_ALLOWED] and totals[tl.T_ERROR] > USEFUL * was
        return state[tl.S_BEHIND] == 0 and hardly_less
    return state[tl.S_WAS_BEHIND] == 0 and may_try(state) and totals[tl.T_WORK] < ROOMY * settings[tl.P_BUDGET]


@inline_kernel
def is_torn_apart(state: I64, totals: F64) -> bool:
    """Whether a part of the map is behind, and χ² so large that the others may not be where they should be."""
    return state[tl.S_BEHIND] != 0 and not is_tolerable(totals)


@inline_kernel
def is_tolerable(totals: F64) -> bool:
    """Whether χ² may be above what it was while a step has a budget."""
    return totals[tl.T_CHI2] <= MOST_RISE * (totals[tl.T_WHOLE] + LEAST_CHI2)


@inline_kernel
def list_moving(pending: I64, node: I64) -> I64:
    """The waiting variables whose linearization points a step under way has moved."""
    moving, n = np.empty(pending.size, np.int64), 0
    for k in range(pending.size):
        if node[pending[k], tl.N_FLAGS] == MOVES:
            moving[n] = pending[k]
            n += 1
    return moving[:n].copy()
