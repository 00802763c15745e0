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
10 again from 2   while that is so far that it cannot wait
A step with nothing new goes on from 2 with what waits, and substitutes back through the whole tree.
"""

import math

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence, take_in_factors, take_in_variables, take_out
from factorbus.solver.kernels.bayes_tree.affected import detach, gather_factors, touch
from factorbus.solver.kernels.bayes_tree.assemble import give_back_updates, update_orphans
from factorbus.solver.kernels.bayes_tree.back_substitute import substitute
from factorbus.solver.kernels.bayes_tree.begin_step import begin
from factorbus.solver.kernels.bayes_tree.changed_variables import count_differing
from factorbus.solver.kernels.bayes_tree.commit import add_constants, commit
from factorbus.solver.kernels.bayes_tree.eliminate import eliminate_fronts
from factorbus.solver.kernels.bayes_tree.fronts import (
    analyze_affected,
    give_back_fronts,
    is_root_alone,
    keep_root,
    place_fronts,
)
from factorbus.solver.kernels.bayes_tree.linearization_error import await_all, measure
from factorbus.solver.kernels.bayes_tree.order import find_lowest, find_newest, list_pairs, order_affected
from factorbus.solver.kernels.bayes_tree.order_small import analyze_few, join_few, order_few
from factorbus.solver.kernels.bayes_tree.records import Affected, Tree, tree_at
from factorbus.solver.kernels.bayes_tree.refactor_in_place import (
    OLD,
    commit_renewed,
    give_back_renewed,
    is_worth_ordering,
    mark_renewed,
    renew,
    still_renewed,
)
from factorbus.solver.kernels.bayes_tree.relinearize import go_back, relinearize
from factorbus.solver.kernels.bayes_tree.reroot import account_for, count_near, touch_near
from factorbus.solver.kernels.bayes_tree.worker_thread import run_tasks
from factorbus.solver.kernels.jit.bit_sets import MOST
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.cycle_counter import cycles
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.sparse.task_queue import NOBODY

FREE = 0
LEAST_CHI2 = 1e-2
QUIET = 0.05  # of P_RELINEARIZE_THRESHOLD: a turn with a smaller error is not counted
MOST_ROUNDS = 10  # of a step that has not converged
FINISHED = 1e-8  # a step with nothing new goes on while Σ error² is more than this share of χ²
LARGE_GAIN = 0.05  # of χ², in one round or all,
AFTER_LARGE_GAIN = 0.02  # times as much error² is allowed after it
PASSED_OVER = 0.1  # of the Σ error² that is allowed: what may be left to factors none of whose variables moves


@kernel("int64(int64[::1], int64[::1], int64[::1], int64)")
def tree_step(graph_table: I64, tree_table: I64, board: I64, worker: int) -> int:
    """Take in what is new in the graph, and solve.  graph_table, tree_table: of their arrays (`records`); board: where
    cores are lent (`task_queue`); worker: NOBODY, or this is a worker thread (`run_tasks`).

    Gives DONE; or NO_ROOM: `state` says what is needed, and the step goes on when it is called again; or UNSURE: only
    the numbers can tell whether all new variables are held, and the step begins when it is called with S_CHECKED set;
    or FAILED: the pivot of S_FAILED was not positive; or INFINITE: the χ² of a new factor is beyond numbers.  After
    the last two the tree is as it was before the step.
    """
    if worker != NOBODY:
        run_tasks(board, worker)
        return tl.DONE
    began = cycles()
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    counts, var, fac, values, settings = graph.counts, graph.var, graph.fac, graph.values, tree.settings
    node, clique, lin, stiff = tree.node, tree.clique, tree.lin, tree.stiff
    scalars, turns, pending, changed, marked = tree.scalars, tree.turns, tree.pending, tree.changed, tree.marked
    state, account = tree.state, tree.account
    v1, f1 = counts[at.VARIABLES], counts[at.FACTORS]
    if state[tl.S_BEGUN] == 0:
        if len(clique) > marked.size:
            return tl.NO_ROOM
        status = begin(graph, tree)
        if status != tl.DONE:
            return status
        account[tl.A_STIFFEST_BEFORE] = account[tl.A_STIFFEST]
        account[tl.A_UNIT], account[tl.A_BEFORE] = residual_unit(f1, account), account[tl.A_CHI2]
        account[tl.A_GAINED] = 0.0
        state[tl.S_OLD], state[tl.S_RISES] = state[tl.S_FIRST_NEW], 0
        nothing_new = v1 == state[tl.S_FIRST_NEW] and f1 == state[tl.S_TAKEN] and state[tl.S_EDITED] == 0
        state[tl.S_CONTINUES] = 1 if nothing_new else 0
    unit = account[tl.A_UNIT]
    scaled = settings.copy()
    scaled[tl.P_WILDFIRE_THRESHOLD] *= unit * math.sqrt(f1 / max(counts[at.SCALARS], 1))  # (9.17)
    if state[tl.S_CONTINUES] != 0:
        scaled[tl.P_WILDFIRE_THRESHOLD] = 0.0
        await_bound(scaled, var, fac, node, stiff, pending, state, account)
    scaled[tl.P_RELINEARIZE_THRESHOLD] *= unit
    scaled[tl.P_MAX_ERROR] *= unit
    scaled[tl.P_COOLDOWN_FLOPS] = max(state[tl.S_RELINEARIZING] / settings[tl.P_COOLDOWN_FLOPS], 1.0)
    share = unit * unit * max(f1, 1) * reluctance(scaled, state)  # of χ²
    scaled[tl.P_SAME_STEP_SHARE] *= share
    scaled[tl.P_NEXT_STEP_SHARE] *= share
    scaled[tl.P_MAX_WAIT] *= scaled[tl.P_COOLDOWN_FLOPS]
    v0 = state[tl.S_FIRST_NEW]
    take_in_variables(v1, var, values, node, lin, scalars, turns, state)
    if not take_in_factors(graph, tree, f1):
        undo(graph, tree, v0)
        return tl.INFINITE
    while True:
        moving = pending[: count_due(state)]
        if moving.size > 0:
            relinearize(graph, tree, moving)
        lap(began, tl.LINEARIZE, state)
        before = account[tl.A_CHI2]
        pull, status = eliminate_again(graph, tree, v0, v1, f1, moving, scaled, board)
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
        chi2 = account[tl.A_CHI2]
        if state[tl.S_ROUNDS] > 1:
            account[tl.A_GAINED] = max(account[tl.A_GAINED], before - chi2)
        account[tl.A_GAINED] = max(account[tl.A_GAINED], account[tl.A_BEFORE] - chi2)
        if state[tl.S_ROUNDS] > 1 and not chi2 <= (1.0 + settings[tl.P_CONVERGED]) * before + LEAST_CHI2:
            state[tl.S_RISES] = 1
            break
        if state[tl.S_WAIT] != 0 or not goes_on(pull, scaled, state, account):
            break
        await_bound(scaled, var, fac, node, stiff, pending, state, account)
    state[tl.S_TOLD] = count_differing(state[tl.S_OLD], v1, changed[: state[tl.S_CHANGED]], var, lin, values)
    state[tl.S_WAIT] = state[tl.S_BEGUN] = state[tl.S_CHECKED] = state[tl.S_ONCE] = 0
    note_after(settings, state, account)
    return tl.DONE


@part
def undo(graph: Graph, tree: Tree, v0: int) -> None:
    """The tree is as it was before the step."""
    node, moved, state, account = tree.node, tree.moved, tree.state, tree.account
    for k in range(state[tl.S_MOVED]):
        node[moved[k], tl.N_LISTED] = 0
    state[tl.S_MOVED], account[tl.A_ADDED] = 0, 0.0
    account[tl.A_STIFFEST] = account[tl.A_STIFFEST_BEFORE]
    take_out(graph, tree, v0, state[tl.S_TAKEN])
    state[tl.S_STEP] -= 1
    state[tl.S_CHANGED] = state[tl.S_CHANGED_BEFORE]
    state[tl.S_WAIT] = state[tl.S_BEGUN] = state[tl.S_CHECKED] = 0


@inline_kernel
def note_after(settings: F64, state: I64, account: F64) -> None:
    """What is to be done after the step, and what the optimum is at least."""
    chi2 = account[tl.A_CHI2]
    account[tl.A_ALLOWED] = converged_error(settings, state, account)
    state[tl.S_AFTER] = 0
    if not chi2 <= (1.0 + settings[tl.P_CONVERGED]) * account[tl.A_BEFORE] + LEAST_CHI2:
        state[tl.S_AFTER] += tl.WORSE
    if state[tl.S_RISES] != 0:
        state[tl.S_AFTER] += tl.ROSE
    if state[tl.S_RAISED] != 0:
        state[tl.S_AFTER] += tl.RAISED
    if state[tl.S_AFTER] == 0:
        account[tl.A_LEAST] = max(chi2 - account[tl.A_ERROR], 0.0)


@inline_kernel
def residual_unit(factors: int, account: F64) -> float:
    """What a residual is like in this map, in its σ: √(χ² per factor), as far as known.  (9.6)"""
    return math.sqrt((max(account[tl.A_MODEL], 0.0) + LEAST_CHI2) / max(factors, 1))


@part
def rescale(factors: int, settings: F64, account: F64) -> None:
    """The thresholds in what a residual is like without the factors that were taken out, or with their new weights."""
    unit = residual_unit(factors, account)
    times = unit / account[tl.A_UNIT]
    account[tl.A_UNIT] = unit
    for each in (tl.P_WILDFIRE_THRESHOLD, tl.P_RELINEARIZE_THRESHOLD, tl.P_MAX_ERROR):
        settings[each] *= times
    for each in (tl.P_SAME_STEP_SHARE, tl.P_NEXT_STEP_SHARE):
        settings[each] *= times * times


@inline_kernel
def find_loose_end(var: I64, moved: I64, state: I64) -> int:
    """A variable of an edited factor, in a step that raised a pivot: what was held before may not be any more."""
    for k in range(state[tl.S_EDITED]):
        if var[moved[k], at.V_COLUMN] >= 0:
            state[tl.S_RAISED] = 0
            return int(moved[k])
    return -1


@inline_kernel
def goes_on(pull: float, settings: F64, state: I64, account: F64) -> bool:
    """Whether what waits is relinearized and solved for again in the same step; pull: as `measure` gives it."""
    rounds = state[tl.S_ROUNDS]
    if state[tl.S_ONCE] != 0:
        return False
    if account[tl.A_ERROR] > allowed(settings, state, account):
        return rounds < (settings[tl.P_MAX_ROUNDS] if state[tl.S_CONTINUES] != 0 else MOST_ROUNDS)
    return state[tl.S_CONTINUES] == 0 and pull > settings[tl.P_SAME_STEP_SHARE] and rounds < settings[tl.P_MAX_ROUNDS]


@inline_kernel
def allowed(settings: F64, state: I64, account: F64) -> float:
    """The Σ error² with which a step ends: what its report calls converged; FINISHED of χ² with nothing new."""
    if state[tl.S_CONTINUES] != 0:
        return FINISHED * (account[tl.A_CHI2] + LEAST_CHI2)
    return converged_error(settings, state, account)


@inline_kernel
def converged_error(settings: F64, state: I64, account: F64) -> float:
    """The Σ error² up to which the step has converged.  (9.32)"""
    chi2 = account[tl.A_CHI2] + LEAST_CHI2
    share = settings[tl.P_CONVERGED] / max(state[tl.S_ROUNDS], 1)
    return share * chi2 * (AFTER_LARGE_GAIN if account[tl.A_GAINED] > LARGE_GAIN * chi2 else 1.0)


@inline_kernel
def await_bound(
    settings: F64, var: I64, fac: I64, node: I64, stiff: F64, pending: I64, state: I64, account: F64
) -> None:
    """Where Σ error² is more than is allowed, all variables that have a part in it are relinearized next."""
    most = allowed(settings, state, account)
    if account[tl.A_ERROR] > most:
        await_all(PASSED_OVER * most / state[tl.S_FACTORS], var, fac, node, stiff, pending, state)
        state[tl.S_DUE] = 1


@inline_kernel
def reluctance(settings: F64, state: I64) -> float:
    """The factor on both shares so soon after the last relinearization.  (9.19)"""
    dear = settings[tl.P_COOLDOWN_FLOPS]
    rested = settings[tl.P_COOLDOWN_STEPS] * dear / max(state[tl.S_STEP] - state[tl.S_RELINEARIZED_AT], 1)
    return min(max(rested * rested, 1.0), settings[tl.P_COOLDOWN_FACTOR] * math.sqrt(dear))


@inline_kernel
def count_due(state: I64) -> int:
    """How many of the variables that wait are relinearized now: all or none."""
    due = state[tl.S_WAIT] == 0 and (state[tl.S_DUE] != 0 or state[tl.S_ROUNDS] > 0)
    return state[tl.S_PENDING] if due else 0


@part
def eliminate_again(
    graph: Graph, tree: Tree, v0: int, v1: int, f1: int, moving: I64, settings: F64, board: I64
) -> tuple[float, int]:
    """Steps 3 to 9; gives Σ error² as `measure` does, and the status."""
    var, fac = graph.var, graph.fac
    node, link, clique, lists, numbers = tree.node, tree.link, tree.clique, tree.lists, tree.numbers
    hessian, moved, listed, state, account = tree.hessian, tree.moved, tree.marked, tree.state, tree.account
    # 3
    now = cycles()
    state[tl.S_STAMP] += 1
    count = 0
    for k in range(state[tl.S_EDITED]):
        count = touch(moved[k], node, clique, state, listed, count)
    for f in range(state[tl.S_TAKEN], f1):
        count = touch_ends(f, fac, node, clique, state, listed, count)
    renewed = mark_renewed(moving, fac, node, link, clique, state, listed)
    reorders = is_worth_ordering(renewed, clique)
    if reorders:
        renewed = renewed[:0]
        count = touch_around(moving, fac, node, link, clique, state, listed, count)
    around = count_near(listed[:count], reorders, settings, clique, state)
    if around > 0:
        count = touch_near(graph, tree, around, f1, settings, listed, count)
        renewed = still_renewed(renewed, clique, state)
    marked = listed[:count]
    room = v1 - v0
    hanging = 0
    for k in range(count):
        room += clique[marked[k], tl.C_FRONTALS]
        hanging += 1
        child = clique[marked[k], tl.C_CHILD]
        while child >= 0:
            hanging += 1
            child = clique[child, tl.C_NEXT]
    affected, orphans = np.empty(room, np.int64), np.empty(hanging, np.int64)
    n, hanging = detach(graph, tree, marked, settings, affected, orphans)
    for v in range(v0, v1):
        if var[v, at.V_COLUMN] >= 0:
            node[v, tl.N_STAMP], node[v, tl.N_LOCAL] = state[tl.S_STAMP], n
            affected[n] = v
            n += 1
    orphans = orphans[:hanging]
    if n == 0 and renewed.size == 0:
        add_constants(state[tl.S_TAKEN], f1, var, fac, link, hessian, account)
        return substitute_and_measure(graph, tree, renewed[:0], renewed[:0], settings, listed)
    now = lap(now, tl.MARK, state)
    old = np.empty((renewed.size, OLD), np.int64)
    if renewed.size > 0:
        # Before the others, who take in their update matrices.
        status = renew(graph, tree, renewed, n, account[tl.A_STIFFEST], old, board)
        if status != tl.DONE:
            return 0.0, status
    now = lap(now, tl.ELIMINATE, state)
    factors = gather_factors(n, affected, state[tl.S_TAKEN], f1, node, link, fac, var)
    now = lap(now, tl.MARK, state)
    # 4, 5
    if is_root_alone(marked, n, v1 - v0, affected, settings, var, clique):
        fronts = keep_root(n, affected, var)
        lowest = find_lowest(fronts.place, orphans, node, clique, lists, state)
    else:
        # No loop closes and nothing else moves: worth what it may cost that the newest pose is in the root.
        drives_on = f1 - state[tl.S_TAKEN] <= v1 - v0 and moving.size == 0 and state[tl.S_EDITED] == 0
        last = find_newest(v1, var) if drives_on else -1
        recent = int(settings[tl.P_RECENT_STEPS])
        if n <= MOST:
            near, hung = join_few(graph, tree, n, factors, orphans)
            perm, row, planes = order_few(n, near, affected, recent, last, var, node, state)
            now = lap(now, tl.ORDER, state)
            fronts, lowest = analyze_few(n, perm, row, planes, hung, affected, var)
        else:
            perm = order_affected(graph, tree, n, affected, factors, orphans, recent, last)
            label = np.empty(n, np.int64)
            for k in range(n):
                label[perm[k]] = k
            now = lap(now, tl.ORDER, state)
            lowest = find_lowest(label, orphans, node, clique, lists, state)
            rows, cols = list_pairs(graph, tree, lowest, factors, orphans)
            fronts = analyze_affected(n, perm, affected, var, rows, cols)
    update = np.empty((orphans.size, 3), np.int64)
    if not update_orphans(graph, tree, orphans, update):
        give_back_renewed(renewed, old, clique, numbers, state)
        return 0.0, tl.NO_ROOM
    ids, placed = place_fronts(tree, fronts, affected)
    if not placed:
        give_back_renewed(renewed, old, clique, numbers, state)
        give_back_updates(update, numbers, state)
        return 0.0, tl.NO_ROOM
    now = lap(now, tl.SYMBOLIC, state)
    # 6
    flops = state[tl.S_FLOPS]
    taken_apart = Affected(marked, orphans, affected, factors)
    failed = eliminate_fronts(graph, tree, ids, fronts, taken_apart, lowest, update, board)
    if failed < 0 and state[tl.S_EDITED] != 0 and state[tl.S_RAISED] != 0:
        failed = find_loose_end(var, moved, state)
    if failed >= 0:
        state[tl.S_FAILED] = failed
        give_back_fronts(ids, clique, lists, numbers, state)
        give_back_updates(update, numbers, state)
        give_back_renewed(renewed, old, clique, numbers, state)
        return 0.0, tl.FAILED
    account_for(state[tl.S_FLOPS] - flops, around > 0, state)
    now = lap(now, tl.ELIMINATE, state)
    # 7
    commit(graph, tree, taken_apart, fronts, ids, lowest, update)
    tops = commit_renewed(renewed, old, clique, numbers, state, account)
    add_constants(state[tl.S_TAKEN], f1, var, fac, link, hessian, account)
    if state[tl.S_EDITED] != 0:
        rescale(f1, settings, account)
    for k in range(moving.size):
        v = moving[k]
        node[v, tl.N_FLAGS], node[v, tl.N_LINEARIZED] = FREE, state[tl.S_STEP]
    if moving.size > 0:
        state[tl.S_PENDING] = state[tl.S_DUE] = 0
        state[tl.S_RELINEARIZED_AT] = state[tl.S_STEP]
        state[tl.S_RELINEARIZING] = state[tl.S_FLOPS] - flops
    lap(now, tl.COMMIT, state)
    return substitute_and_measure(graph, tree, tops, ids, settings, listed)


@inline_kernel
def substitute_and_measure(
    graph: Graph, tree: Tree, tops: I64, ids: I64, settings: F64, listed: I64
) -> tuple[float, int]:
    """Steps 8 and 9, from the renewed cliques `tops` and the new ones `ids`, or from all roots."""
    node, clique, state, account = tree.node, tree.clique, tree.state, tree.account
    now = cycles()
    if state[tl.S_CONTINUES] != 0:
        begins = list_roots(node, clique, state)
    else:
        begins = np.empty(tops.size + ids.size, np.int64)
        for k in range(begins.size):
            begins[k] = tops[k] if k < tops.size else ids[k - tops.size]
    quiet = QUIET * settings[tl.P_RELINEARIZE_THRESHOLD]
    substitute(graph, tree, begins, settings[tl.P_WILDFIRE_THRESHOLD], quiet, listed)
    account[tl.A_CHI2] += account[tl.A_ADDED]
    account[tl.A_BEFORE] += account[tl.A_ADDED]
    account[tl.A_ADDED_UP] += account[tl.A_ADDED]
    account[tl.A_ADDED] = 0.0
    pull = measure(graph, tree, settings)
    lap(now, tl.SUBSTITUTE, state)
    return pull, tl.DONE


@part
def list_roots(node: I64, clique: I64, state: I64) -> I64:
    """All roots of the tree."""
    roots, n = np.empty(state[tl.S_ROOTS], np.int64), 0
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


@part
def touch_around(
    moving: I64, fac: I64, node: I64, link: I64, clique: I64, state: I64, marked: I64, count: int
) -> int:  # fmt: skip
    """Touch the variables of all factors of `moving`."""
    for k in range(moving.size):
        slot = node[moving[k], tl.N_ADJ]
        while slot >= 0:
            count = touch_ends(slot // 2, fac, node, clique, state, marked, count)
            slot = next_incidence(slot, link)
    return count


@inline_kernel
def touch_ends(f: int, fac: I64, node: I64, clique: I64, state: I64, marked: I64, count: int) -> int:
    """Touch both variables of factor f."""
    count = touch(fac[f, at.F_I], node, clique, state, marked, count)
    if fac[f, at.F_J] >= 0:
        count = touch(fac[f, at.F_J], node, clique, state, marked, count)
    return count
