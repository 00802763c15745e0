"""Which of the variables that are due are relinearized in a step with a budget.  MATH §9.10

A variable takes the cliques of its factors and all above them, each of them once however many variables need it.  Those
whose cliques are near the root, where the robot is, come first.
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.relinearize import MOVES
from factorbus.solver.kernels.bayes_tree.work import RELINEARIZING, SCANNING, SOLVING, work_of_clique
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, head_of
from factorbus.solver.kernels.model.records import Graph

# Of the budget: what is kept for back-substitution at the most, and what a relinearization may take at least.
KEPT, LEAST = 0.5, 0.125
LOOKING = 10_000.0  # of each variable that is considered
FEWEST = 256  # that are considered
# First come variables whose way to the root takes no more than these shares of what may be used, then all others.
NEAR, LESS_NEAR = 1.0 / 64.0, 1.0 / 8.0
FAILURES = 64  # variables that do not fit, after which no more are tried
ENOUGH = 0.75  # of the budget: where less of it is used there may be another round
RETRY = 16  # steps without a try after one in which none fitted


@part
def choose_due(graph: Graph, tree: Tree, f1: int, budget: float) -> I64:
    """The variables that wait and are relinearized now, in the order in which they wait; the factors up to f1 come
    first.
    """
    node, clique, pending, state = tree.node, tree.clique, tree.pending, tree.state
    count = state[tl.S_PENDING]
    if not may_try(state):
        return pending[:0].copy()
    way, taken, log = np.zeros(len(clique)), np.zeros(len(clique), np.int64), np.empty(len(clique), np.int64)
    used = tree.totals[tl.T_WORK] + take_changed(graph, tree, f1, taken, log)
    kept = min(KEPT * budget, SOLVING * state[tl.S_VARIABLES])
    room = max(budget - kept - used, LEAST * budget)
    considered = min(count, max(FEWEST, int(budget / LOOKING)))
    # Where there are more, those of another part of the list in each step.
    first = (state[tl.S_STEP] * considered) % count
    chosen, left, picked = np.zeros(count, np.int64), room, 0
    for near in (NEAR * room, LESS_NEAR * room, np.inf):
        failures = 0
        for n in range(considered):
            k = (first + n) % count
            if failures >= FAILURES:
                break
            v = pending[k]
            if chosen[k] != 0 or (near < np.inf and work_to_root(node[v, tl.N_CLIQUE], clique, way) > near):
                continue
            work, marked = take_factors_of(v, left, graph.fac, node, tree.link, clique, taken, log)
            if work <= left:
                chosen[k], left, picked = 1, left - work, picked + 1
                continue
            failures += 1
            for m in range(marked):
                taken[log[m]] = 0
    moving, n = np.empty(picked, np.int64), 0
    for k in range(count):
        if chosen[k] != 0:
            moving[n] = pending[k]
            n += 1
    return moving


@part
def take_changed(graph: Graph, tree: Tree, f1: int, taken: I64, log: I64) -> float:
    """What it takes to eliminate the cliques that new and edited factors change; `taken` gets them."""
    fac, node, clique, state, work = graph.fac, tree.node, tree.clique, tree.state, 0.0
    for k in range(state[tl.S_EDITED]):
        work += take_above(node[tree.moved[k], tl.N_CLIQUE], np.inf, clique, taken, log, 0)[0]
    for f in range(state[tl.S_TAKEN], f1):
        for end in range(2):
            v = fac[f, at.F_I + end]
            if v >= 0:
                work += take_above(node[v, tl.N_CLIQUE], np.inf, clique, taken, log, 0)[0]
    return work


@part
def take_factors_of(
    v: int, left: float, fac: I64, node: I64, link: I64, clique: I64, taken: I64, log: I64
) -> tuple[float, int]:
    """What it takes in addition to relinearize variable v; `taken` gets those cliques, and `log` lists them.

    Gives it, as far as it was looked up: more than `left` is enough to know; and how many cliques.
    """
    work, marked, slot = RELINEARIZING, 0, node[v, tl.N_ADJ]
    while slot >= 0 and work <= left:
        f = head_of(slot // 2, fac)
        for n in range(count_ends(f, fac)):
            more, marked = take_above(node[end_of(f, n, fac), tl.N_CLIQUE], left - work, clique, taken, log, marked)
            work += more
        slot = next_incidence(slot, link)
    return work, marked


@inline_kernel
def take_above(c: int, left: float, clique: I64, taken: I64, log: I64, marked: int) -> tuple[float, int]:
    """Take clique c and those above it that are not taken, until that is more than `left`."""
    work = 0.0
    while c >= 0 and taken[c] == 0 and work <= left:
        taken[c], log[marked] = 1, c
        work, marked, c = work + work_of_clique(clique[c]), marked + 1, clique[c, tl.C_PARENT]
    return work, marked


@part
def work_to_root(c: int, clique: I64, way: F64) -> float:
    """What clique c and all above it take.  way: scratch, what is known of that by clique; 0.0: nothing"""
    work, above = 0.0, c
    while above >= 0 and way[above] == 0.0:
        work, above = work + work_of_clique(clique[above]), clique[above, tl.C_PARENT]
    total = work + (way[above] if above >= 0 else 0.0)
    known = total
    while c >= 0 and way[c] == 0.0:
        way[c], known, c = known, known - work_of_clique(clique[c]), clique[c, tl.C_PARENT]
    return total


@inline_kernel
def may_try(state: I64) -> bool:
    """Whether relinearizations are looked for: not where none fitted a few steps ago."""
    return state[tl.S_STEP] >= state[tl.S_TRY_AT]


@inline_kernel
def may_go_on(tree: Tree, budget: float) -> bool:
    """Whether a step has enough of its budget left for another round."""
    if not budget < np.inf:
        return True
    return may_try(tree.state) and tree.totals[tl.T_WORK] + SCANNING * tree.state[tl.S_FACTORS] < ENOUGH * budget


@inline_kernel
def fits_chord_step(tree: Tree, budget: float) -> bool:
    """Whether a chord step does: it looks through all factors, and moves what the step has moved so far."""
    state = tree.state
    work = SCANNING * state[tl.S_FACTORS] + SOLVING * state[tl.S_CHANGED]
    return tree.totals[tl.T_WORK] + work <= budget


@inline_kernel
def list_moving(pending: I64, node: I64) -> I64:
    """The waiting variables whose linearization points a step under way has moved."""
    moving, n = np.empty(pending.size, np.int64), 0
    for k in range(pending.size):
        if node[pending[k], tl.N_FLAGS] == MOVES:
            moving[n] = pending[k]
            n += 1
    return moving[:n].copy()
