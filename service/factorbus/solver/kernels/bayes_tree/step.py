"""One step of the incremental solver, in one call.  MATH §9.

1  take in        new variables, at good places if they are few, and new factors, linearized
2  relinearize    variables whose factors have linearization errors above their threshold
3  touch, detach  the cliques that new factors change, and where that is much those around the robot;
                  what hangs from them are orphans
   renew          what is below these and only has relinearized factors is eliminated again as it is
4  order          the affected variables, constrained approximate minimum degree
5  fronts         elimination tree, amalgamation, memory
6  eliminate      front by front, on several cores where that takes long; orphans bring their update matrices
7  commit         new cliques and numbers take the place of the old ones
8  substitute     back down from the new roots, as far as anything changes
9  measure        χ² at the estimate, and how far factors are from their linear models
10 correct        models and right-hand sides where that is so far that it cannot wait, with R as it is, and 8 and 9
11 again from 2   while it is so far still
A step with nothing new goes on from 2 with what waits, and without a budget substitutes back through the whole tree.
One with a budget does of 2, 8, 10 and 11 what fits: what is left goes on in the steps that follow (`defer`).
"""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import add_factors, add_variables, remove_added
from factorbus.solver.kernels.bayes_tree.begin_step import begin_step
from factorbus.solver.kernels.bayes_tree.changed_variables import count_differing
from factorbus.solver.kernels.bayes_tree.chord_step import TOO_MUCH, chord_step
from factorbus.solver.kernels.bayes_tree.convergence import (
    check_decrement,
    goes_on,
    is_clear,
    is_slow,
    least_error,
    mark_unconverged,
    may_keep_factor,
    note_after,
)
from factorbus.solver.kernels.bayes_tree.defer import (
    RETRY,
    choose_due,
    is_in_vain,
    is_torn_apart,
    list_moving,
    may_go_on,
)
from factorbus.solver.kernels.bayes_tree.eliminate_again import eliminate_again, follow_up, lap
from factorbus.solver.kernels.bayes_tree.records import Tree, tree_at
from factorbus.solver.kernels.bayes_tree.relinearize import go_back, relinearize
from factorbus.solver.kernels.bayes_tree.thresholds import LEAST_CHI2, note_cooldown, residual_unit, scale_thresholds
from factorbus.solver.kernels.bayes_tree.touch import NewRows
from factorbus.solver.kernels.bayes_tree.worker_thread import run_tasks
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.cycle_counter import cycles
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.sparse.task_queue import NOBODY


@kernel("int64(int64[::1], int64[::1], int64[::1], int64)")
def tree_step(graph_table: I64, tree_table: I64, queue: I64, worker: int) -> int:
    """Take in what is new in the graph, and solve.  graph_table, tree_table: of their arrays (`records`); queue: for
    worker threads (`task_queue`); worker: NOBODY, or this is a worker thread (`run_tasks`).

    Gives DONE, or CLEAR; or NO_ROOM: `state` says what is needed, and the step goes on when it is called again; or
    UNSURE: only the numbers can tell whether all new variables are held, and the step begins when it is called with
    S_CHECKED set; or FAILED: the pivot of S_FAILED was not positive; or INFINITE: the χ² of a new factor is beyond
    numbers.  After the last two the tree is as it was before the step.
    """
    if worker != NOBODY:
        run_tasks(queue, worker)
        return tl.DONE
    began = cycles()
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    settings, state, totals = tree.settings, tree.state, tree.totals
    v1, f1 = graph.counts[at.VARIABLES], graph.counts[at.FACTORS]
    goes_on_with_it = state[tl.S_BEGUN] != 0  # after NO_ROOM: what moves was marked, and is linearized
    if not goes_on_with_it:
        if len(tree.clique) > tree.marked.size:
            return tl.NO_ROOM
        status = begin_step(graph, tree)
        if status != tl.DONE:
            return status
        note_before(v1, f1, settings[tl.P_BUDGET] < math.inf, state, totals)
        note_cooldown(settings, state, totals)
    scaled = scale_thresholds(f1, graph.counts[at.SCALARS], settings, state, totals)
    bounded = scaled[tl.P_BUDGET] < math.inf
    if state[tl.S_CONTINUES] != 0 and not goes_on_with_it:
        mark_unconverged(graph, tree, scaled)
    v0 = state[tl.S_FIRST_NEW]
    add_variables(v1, graph.var, graph.values, tree.node, tree.lin, tree.scalars, tree.turns, state)
    if not add_factors(graph, tree, f1):
        undo(graph, tree, v0)
        return tl.INFINITE
    put_off = False  # of what is due a part is left for later steps
    fell, fell_before = 0.0, 0.0  # by how much the last round lowered χ², and the one before
    while True:
        moving = tree.pending[: count_due(state)]
        if moving.size > 0 and bounded:
            moving = list_moving(moving, tree.node) if goes_on_with_it else choose_due(graph, tree, f1, scaled)
            put_off = moving.size < state[tl.S_PENDING]
            if moving.size == 0 and state[tl.S_ROUNDS] > 0:
                break
        goes_on_with_it = False
        if moving.size > 0:
            relinearize(graph, tree, moving)
        lap(began, tl.LINEARIZE, state)
        before = totals[tl.T_CHI2]
        weighted_error, status = eliminate_again(graph, tree, NewRows(v0, v1, f1), moving, scaled, queue)
        if status == tl.NO_ROOM:
            return tl.NO_ROOM
        began = cycles()
        if status == tl.FAILED:
            if moving.size > 0:
                go_back(graph, tree, moving)
            if state[tl.S_ROUNDS] > 0:
                break
            if moving.size > 0:
                state[tl.S_WAIT] = 1
                continue
            undo(graph, tree, v0)
            return tl.FAILED
        v0 = v1
        state[tl.S_TAKEN], state[tl.S_FIRST_NEW], state[tl.S_EDITED] = f1, v1, 0
        state[tl.S_ROUNDS] += 1
        if is_torn_apart(state, totals):
            weighted_error = follow_up(graph, tree, scaled)
        chi2 = totals[tl.T_CHI2]
        if state[tl.S_ROUNDS] > 1:
            fell, fell_before = before - chi2, fell
            totals[tl.T_GAINED] = max(totals[tl.T_GAINED], before - chi2)
        totals[tl.T_GAINED] = max(totals[tl.T_GAINED], totals[tl.T_BEFORE] - chi2)
        if state[tl.S_BEHIND] != 0:  # χ² of what is torn says nothing
            break
        if state[tl.S_ROUNDS] > 1 and not chi2 <= (1.0 + settings[tl.P_CONVERGED]) * before + LEAST_CHI2:
            state[tl.S_RISES] = 1
            break
        check_decrement(is_slow(fell, fell_before, state, totals), graph, tree, scaled)
        if state[tl.S_WAIT] != 0 or not goes_on(weighted_error, scaled, state, totals):
            break
        if put_off or not may_go_on(tree, scaled[tl.P_BUDGET]):
            break
        if may_keep_factor(tree, scaled):
            left = chord_step(least_error(scaled, state, totals), graph, tree, scaled)
            began = cycles()
            if left != TOO_MUCH:
                weighted_error, totals[tl.T_GAINED] = left, max(totals[tl.T_GAINED], chi2 - totals[tl.T_CHI2])
                check_decrement(state[tl.S_SLOW] != 0, graph, tree, scaled)
                if totals[tl.T_CHI2] <= chi2 and not goes_on(weighted_error, scaled, state, totals):
                    break
        mark_unconverged(graph, tree, scaled)
    changed = tree.changed[: state[tl.S_CHANGED]]
    state[tl.S_DIFFERING] = count_differing(state[tl.S_OLD], v1, changed, graph.var, tree.lin, graph.values)
    state[tl.S_WAIT] = state[tl.S_BEGUN] = state[tl.S_CHECKED] = state[tl.S_ONCE] = 0
    if put_off and state[tl.S_CONTINUES] == 0 and is_in_vain(scaled, state, totals):
        state[tl.S_TRY_AT] = state[tl.S_STEP] + RETRY
    note_after(settings, state, totals)
    return tl.CLEAR if is_clear(state, totals) else tl.DONE


@inline_kernel
def note_before(v1: int, f1: int, bounded: bool, state: I64, totals: F64) -> None:
    """How things are when a step begins that is up to v1 variables and f1 factors."""
    totals[tl.T_LARGEST_DIAGONAL_BEFORE] = totals[tl.T_LARGEST_DIAGONAL]
    totals[tl.T_UNIT], totals[tl.T_BEFORE] = residual_unit(f1, totals), totals[tl.T_CHI2]
    totals[tl.T_GAINED] = totals[tl.T_WORK] = 0.0
    state[tl.S_WAS_BEHIND], totals[tl.T_ERROR_BEFORE] = state[tl.S_BEHIND], totals[tl.T_ERROR]
    if state[tl.S_BEHIND] == 0 and not (bounded and state[tl.S_AFTER] & (tl.WORSE + tl.ROSE) != 0):
        totals[tl.T_WHOLE] = totals[tl.T_CHI2]
    state[tl.S_OLD], state[tl.S_RISES] = state[tl.S_FIRST_NEW], 0
    nothing_new = v1 == state[tl.S_FIRST_NEW] and f1 == state[tl.S_TAKEN] and state[tl.S_EDITED] == 0
    state[tl.S_CONTINUES] = 1 if nothing_new else 0


@inline_kernel
def count_due(state: I64) -> int:
    """How many of the variables that wait are relinearized now: all or none."""
    due = state[tl.S_WAIT] == 0 and (state[tl.S_DUE] != 0 or state[tl.S_ROUNDS] > 0)
    return state[tl.S_PENDING] if due else 0


@part
def undo(graph: Graph, tree: Tree, v0: int) -> None:
    """The tree is as it was before the step."""
    node, moved, state, totals = tree.node, tree.moved, tree.state, tree.totals
    for k in range(state[tl.S_MOVED]):
        node[moved[k], tl.N_LISTED] = 0
    state[tl.S_MOVED], totals[tl.T_ADDED] = 0, 0.0
    totals[tl.T_LARGEST_DIAGONAL] = totals[tl.T_LARGEST_DIAGONAL_BEFORE]
    remove_added(graph, tree, v0, state[tl.S_TAKEN])
    state[tl.S_STEP] -= 1
    state[tl.S_CHANGED] = state[tl.S_CHANGED_BEFORE]
    state[tl.S_WAIT] = state[tl.S_BEGUN] = state[tl.S_CHECKED] = 0
