"""Steps 3 to 9 of a step: what it touches is eliminated again, and δ follows.  MATH §9.3 to §9.7."""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import gather_factors
from factorbus.solver.kernels.bayes_tree.assemble import give_back_updates, update_orphans
from factorbus.solver.kernels.bayes_tree.back_substitute import QUIET, substitute
from factorbus.solver.kernels.bayes_tree.commit import add_constants, commit
from factorbus.solver.kernels.bayes_tree.eliminate import eliminate_fronts
from factorbus.solver.kernels.bayes_tree.fronts import (
    analyze_affected,
    give_back_fronts,
    is_root_alone,
    keep_root,
    place_fronts,
)
from factorbus.solver.kernels.bayes_tree.linearization_error import measure
from factorbus.solver.kernels.bayes_tree.order import find_lowest, find_newest, list_pairs, order_affected
from factorbus.solver.kernels.bayes_tree.order_small import analyze_few, join_few, order_few
from factorbus.solver.kernels.bayes_tree.records import Affected, Fronts, Tree
from factorbus.solver.kernels.bayes_tree.refactor_in_place import commit_renewed, give_back_renewed, renew
from factorbus.solver.kernels.bayes_tree.reroot import account_for
from factorbus.solver.kernels.bayes_tree.thresholds import rescale
from factorbus.solver.kernels.bayes_tree.touch import NewRows, find_touched
from factorbus.solver.kernels.bayes_tree.work import RELINEARIZING, note_work, work_of_cliques
from factorbus.solver.kernels.jit.bit_sets import MOST
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.cycle_counter import cycles
from factorbus.solver.kernels.jit.scratch import clear_scratch, take, take_rows
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph

FREE = 0


@part
def eliminate_again(
    graph: Graph, tree: Tree, new: NewRows, moving: I64, settings: F64, queue: I64
) -> tuple[float, int]:
    """Steps 3 to 9; gives Σ error² as `measure` does, and the status."""
    node, link, clique, lists, numbers = tree.node, tree.link, tree.clique, tree.lists, tree.numbers
    state, totals = tree.state, tree.totals
    # 3
    now = cycles()
    clear_scratch(tree.scratch)
    touched = find_touched(graph, tree, new, moving, settings)
    cliques, orphans, variables, renewed = touched.cliques, touched.orphans, touched.variables, touched.renewed
    if variables.size == 0 and renewed.size == 0:
        add_constants(state[tl.S_TAKEN], new.f1, graph.var, graph.fac, link, tree.hessian, totals)
        return substitute_and_measure(graph, tree, renewed[:0], renewed[:0], settings)
    now = lap(now, tl.MARK, state)
    old = take_rows(renewed.size, tl.C_WIDTH, tree.scratch)
    if renewed.size > 0:
        # Before the others, who take in their update matrices.
        status = renew(graph, tree, renewed, variables.size, totals[tl.T_LARGEST_DIAGONAL], old, queue)
        if status != tl.DONE:
            return 0.0, status
    now = lap(now, tl.ELIMINATE, state)
    factors = gather_factors(graph, tree, variables, state[tl.S_TAKEN], new.f1)
    now = lap(now, tl.MARK, state)
    # 4, 5
    affected = Affected(cliques, orphans, variables, factors)
    fronts, lowest = order_fronts(graph, tree, new, affected, moving.size, settings)
    now = cycles()
    update = take_rows(orphans.size, 3, tree.scratch)
    if not update_orphans(graph, tree, orphans, update):
        give_back_renewed(renewed, old, clique, numbers, state)
        return 0.0, tl.NO_ROOM
    ids, placed = place_fronts(tree, fronts, variables)
    if not placed:
        give_back_renewed(renewed, old, clique, numbers, state)
        give_back_updates(update, numbers, state)
        return 0.0, tl.NO_ROOM
    now = lap(now, tl.SYMBOLIC, state)
    # 6
    flops = state[tl.S_FLOPS]
    failed = eliminate_fronts(graph, tree, ids, fronts, affected, lowest, update, queue)
    if failed < 0 and state[tl.S_EDITED] != 0 and state[tl.S_RAISED] != 0:
        failed = find_loose_end(graph.var, tree.moved, state)
    if failed >= 0:
        state[tl.S_FAILED] = failed
        give_back_fronts(ids, clique, lists, numbers, state)
        give_back_updates(update, numbers, state)
        give_back_renewed(renewed, old, clique, numbers, state)
        return 0.0, tl.FAILED
    account_for(state[tl.S_FLOPS] - flops, touched.near > 0, state)
    now = lap(now, tl.ELIMINATE, state)
    # 7
    commit(graph, tree, affected, fronts, ids, lowest, update)
    tops = commit_renewed(renewed, old, clique, numbers, state, totals)
    add_constants(state[tl.S_TAKEN], new.f1, graph.var, graph.fac, link, tree.hessian, totals)
    if state[tl.S_EDITED] != 0:
        rescale(new.f1, graph.counts[at.SCALARS], tree.settings, state, totals, settings)
    if moving.size > 0:
        note_relinearized(moving, state[tl.S_FLOPS] - flops, node, tree.pending, state)
    note_work(work_of_cliques(ids, clique) + work_of_cliques(renewed, clique), totals)
    note_work(RELINEARIZING * moving.size, totals)
    lap(now, tl.COMMIT, state)
    return substitute_and_measure(graph, tree, tops, ids, settings)


@part
def order_fronts(
    graph: Graph, tree: Tree, new: NewRows, affected: Affected, moving: int, settings: F64
) -> tuple[Fronts, I64]:
    """The fronts of the affected variables in a new order, and the place of the lowest variable of each orphan.

    moving: how many variables are relinearized
    """
    clique, state = tree.clique, tree.state
    variables, factors, orphans, n = affected.variables, affected.factors, affected.orphans, affected.variables.size
    now = cycles()
    if is_root_alone(affected.cliques, n, new.v1 - new.v0, variables, settings, graph.var, clique):
        fronts = keep_root(variables, graph.var, tree.scratch)
        lowest = find_lowest(fronts.place, orphans, tree)
    else:
        # No loop closes and nothing else moves: worth what it may cost that the newest pose is in the root.
        is_odometry = new.f1 - state[tl.S_TAKEN] <= new.v1 - new.v0 and moving == 0 and state[tl.S_EDITED] == 0
        last = find_newest(new.v1, graph.var) if is_odometry else -1
        recent = int(settings[tl.P_RECENT_STEPS])
        if n <= MOST:
            near, hung = join_few(graph, tree, n, factors, orphans)
            perm, row, planes = order_few(near, variables, recent, last, graph.var, tree)
            now = lap(now, tl.ORDER, state)
            fronts, lowest = analyze_few(perm, row, planes, hung, variables, graph.var, tree.scratch)
        else:
            perm = order_affected(graph, tree, n, variables, factors, orphans, recent, last)
            label = np.empty(n, np.int64)
            for k in range(n):
                label[perm[k]] = k
            now = lap(now, tl.ORDER, state)
            lowest = find_lowest(label, orphans, tree)
            rows, cols = list_pairs(graph, tree, lowest, factors, orphans)
            fronts = analyze_affected(perm, variables, graph.var, rows, cols, tree.scratch)
    lap(now, tl.SYMBOLIC, state)
    return fronts, lowest


@inline_kernel
def note_relinearized(moving: I64, flops: int, node: I64, pending: I64, state: I64) -> None:
    """The variables `moving` do not wait any more, and the others from now on; flops: what their elimination took."""
    for k in range(moving.size):
        node[moving[k], tl.N_FLAGS], node[moving[k], tl.N_LINEARIZED] = FREE, state[tl.S_STEP]
    left = 0
    if moving.size < state[tl.S_PENDING]:
        for k in range(state[tl.S_PENDING]):
            if node[pending[k], tl.N_FLAGS] != FREE:
                pending[left] = pending[k]
                left += 1
    state[tl.S_PENDING], state[tl.S_DUE], state[tl.S_WAITING] = left, 0, state[tl.S_STEP]
    state[tl.S_RELINEARIZED_AT] = state[tl.S_STEP]
    state[tl.S_RELINEARIZING] = flops


@inline_kernel
def find_loose_end(var: I64, moved: I64, state: I64) -> int:
    """A variable of an edited factor, in a step that raised a pivot: what was held before may not be any more."""
    for k in range(state[tl.S_EDITED]):
        if var[moved[k], at.V_COLUMN] >= 0:
            state[tl.S_RAISED] = 0
            return int(moved[k])
    return -1


@inline_kernel
def substitute_and_measure(graph: Graph, tree: Tree, tops: I64, ids: I64, settings: F64) -> tuple[float, int]:
    """Steps 8 and 9, from the renewed cliques `tops` and the new ones `ids`, or from all roots."""
    state, totals = tree.state, tree.totals
    now = cycles()
    behind = state[tl.S_BEHIND] != 0 and (state[tl.S_ROOTS] > 1 or tops.size + ids.size == 0)
    if state[tl.S_CONTINUES] != 0 or behind:
        begins = list_all_roots(tree)
    else:
        begins = take(tops.size + ids.size, tree.scratch)
        for k in range(begins.size):
            begins[k] = tops[k] if k < tops.size else ids[k - tops.size]
    quiet = QUIET * settings[tl.P_RELINEARIZE_THRESHOLD]
    substitute(graph, tree, begins, settings[tl.P_WILDFIRE_THRESHOLD], quiet, tree.marked, settings[tl.P_BUDGET])
    totals[tl.T_CHI2] += totals[tl.T_ADDED]
    totals[tl.T_BEFORE] += totals[tl.T_ADDED]
    totals[tl.T_WHOLE] += totals[tl.T_ADDED]
    totals[tl.T_ADDED_UP] += totals[tl.T_ADDED]
    totals[tl.T_ADDED] = 0.0
    weighted_error = measure(graph, tree, settings)
    lap(now, tl.SUBSTITUTE, state)
    return weighted_error, tl.DONE


@part
def follow_up(graph: Graph, tree: Tree, settings: F64) -> float:
    """Solve what was left behind, whatever it takes; gives Σ error² as `measure` does."""
    unbounded, none = settings.copy(), np.empty(0, np.int64)
    unbounded[tl.P_BUDGET] = np.inf
    return substitute_and_measure(graph, tree, none, none, unbounded)[0]


@part
def list_all_roots(tree: Tree) -> I64:
    """All roots of the tree."""
    node, clique, state = tree.node, tree.clique, tree.state
    roots, n = take(state[tl.S_ROOTS], tree.scratch), 0
    for v in range(state[tl.S_VARIABLES]):
        c = node[v, tl.N_CLIQUE]
        if c >= 0 and node[v, tl.N_PLACE] == 0 and clique[c, tl.C_PARENT] < 0:
            roots[n] = c
            n += 1
    return roots


@inline_kernel
def lap(since: int, phase: int, state: I64) -> int:
    """What passed since is the phase's; gives the present count."""
    now = cycles()
    state[tl.S_CYCLES + phase] += now - since
    return now
