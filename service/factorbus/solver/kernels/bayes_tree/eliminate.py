"""Eliminating the affected variables: fronts from the leaves to the roots.  MATH §9.5.

    1  sort       factors and orphans by the front that takes them in
    2  cut        subtrees off, which several threads can eliminate, where that takes long and worker threads are there
    3  eliminate  the subtrees, and what is above them, children first

A front takes in the factors that its pivots own and the update matrices of its children, which may be fronts of this
step or orphans of earlier ones, whose separators may now be eliminated in another order than their columns have.
"""

from typing import NamedTuple

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import separators_of
from factorbus.solver.kernels.bayes_tree.assemble import (
    UPDATE_AT,
    UPDATE_WIDTH,
    add_hessian,
    damp_pivots,
    extend_add,
    front_of_clique,
    list_column_runs,
    number_columns,
    variable_at,
)
from factorbus.solver.kernels.bayes_tree.records import Affected, Fronts, Tree, tree_at
from factorbus.solver.kernels.bayes_tree.rigid_subtrees import is_invariant
from factorbus.solver.kernels.jit.array_table import WIDTH, address_of, int_rows, ints, put_entry
from factorbus.solver.kernels.jit.compile import I64, inline_kernel, part
from factorbus.solver.kernels.jit.records import table_of
from factorbus.solver.kernels.jit.scratch import take, take_filled
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.multifrontal import clear_front
from factorbus.solver.kernels.sparse.partial_cholesky import RAISED, ROUNDING, factor_front
from factorbus.solver.kernels.sparse.subtrees import END, FAILED, FIRST, FLOPS, SUBTREE, TURN, cut_subtrees
from factorbus.solver.kernels.sparse.task_queue import (
    AT,
    SUBTREES,
    claim,
    count_workers,
    finish_chunk,
    post,
    take_chunk,
    wait_and_release,
)

# Entries of a plan, a table as in `array_table`: what a thread has to know to eliminate fronts.
GRAPH, TREE = 0, 1  # tables
IDS, RECORDS = 2, 3  # the clique and the record of each front
FIRST_FACTOR, FACTORS = 4, 5  # those of front f are FACTORS[FIRST_FACTOR[f] : FIRST_FACTOR[f + 1]]
FIRST_ORPHAN, NEXT_ORPHAN = 6, 7  # of each front, and of each orphan the next one of the same front; −1: none
ORPHANS, UPDATE = 8, 9  # the cliques, and where their update matrices are and how wide
CUT = 10  # the subtrees, a row each
# And words of it behind those: affected variables, the most pivots of a front, the most separator variables of what is
# taken in.
N = WIDTH * (CUT + 1)
MOST_PIVOTS, MOST_SEPARATORS = N + 1, N + 2
PLAN = MOST_SEPARATORS + 1


class SortedIn(NamedTuple):
    """Factors and orphans by the front that takes them in, see FIRST_FACTOR and so on."""

    first_factor: I64
    factors: I64
    first_orphan: I64
    next_orphan: I64


@part
def eliminate_fronts(
    graph: Graph, tree: Tree, ids: I64, fronts: Fronts, affected: Affected, lowest: I64, update: I64, queue: I64
) -> int:
    """Fill the rows and update matrices of all fronts.  Gives the variable whose pivot failed, or −1.

    ids: the clique of each front   lowest: of each orphan the local number of its first separator to be eliminated
    update (orphans, 3): where the update matrix of each orphan is, and its width   queue: see `task_queue`
    """
    # 1
    clique, state = tree.clique, tree.state
    orphans, records, count = affected.orphans, fronts.records, ids.size
    first_factor, factor_of = _by_front(graph, tree, count, affected.factors, fronts)
    first_orphan, next_orphan = take_filled(count, -1, tree.scratch), take(orphans.size, tree.scratch)
    for e in range(orphans.size - 1, -1, -1):
        f = fronts.home[fronts.place[lowest[e]]]
        next_orphan[e], first_orphan[f] = first_orphan[f], e
    pivots, separators = 0, 0
    for f in range(count):
        pivots = max(pivots, records[f, fr.PIVOTS])
        separators = max(separators, clique[ids[f], tl.C_SEPARATORS])
    for e in range(orphans.size):
        first, end = separators_of(orphans[e], state[tl.S_STAMP], clique)
        separators = max(separators, end - first)
    plan = take(PLAN, tree.scratch)
    plan[N], plan[MOST_PIVOTS], plan[MOST_SEPARATORS] = fronts.order.size, pivots, separators
    put_entry(plan, GRAPH, address_of(table_of(graph)), table_of(graph).size, 1)
    put_entry(plan, TREE, address_of(table_of(tree)), table_of(tree).size, 1)
    put_entry(plan, ORPHANS, address_of(orphans), orphans.size, 1)
    put_entry(plan, UPDATE, address_of(update), len(update), update.shape[1])
    # 2, 3.  The arrays of a plan have to exist for as long: these do, while the next function runs.
    sorted_in = SortedIn(first_factor, factor_of, first_orphan, next_orphan)
    failed, flops = _eliminate_sorted(plan, ids, records, sorted_in, orphans, update, queue)
    if failed < 0:
        state[tl.S_FLOPS] += flops
    return failed


@part
def _eliminate_sorted(
    plan: I64, ids: I64, records: I64, sorted_in: SortedIn, _orphans: I64, _update: I64, queue: I64
) -> tuple[int, int]:
    """Complete the plan, and go by it; gives the variable whose pivot failed, or −1, and flops."""
    put_entry(plan, IDS, address_of(ids), ids.size, 1)
    put_entry(plan, RECORDS, address_of(records), len(records), fr.FRONT)
    put_entry(plan, FIRST_FACTOR, address_of(sorted_in.first_factor), sorted_in.first_factor.size, 1)
    put_entry(plan, FACTORS, address_of(sorted_in.factors), sorted_in.factors.size, 1)
    put_entry(plan, FIRST_ORPHAN, address_of(sorted_in.first_orphan), sorted_in.first_orphan.size, 1)
    put_entry(plan, NEXT_ORPHAN, address_of(sorted_in.next_orphan), sorted_in.next_orphan.size, 1)
    workers = count_workers(queue)
    if workers > 0:
        return _eliminate_in_pieces(plan, records, workers, queue)
    return eliminate_range(plan, 0, ids.size, 0, queue)


@part
def _eliminate_in_pieces(plan: I64, records: I64, workers: int, queue: I64) -> tuple[int, int]:
    """Subtrees on several cores, if it is worth it, and then what is above them; what fails first is what counts."""
    cut = cut_subtrees(records, workers)
    pieces = len(cut)
    if pieces > 0 and claim(queue):
        put_entry(plan, CUT, address_of(cut), pieces, SUBTREE)
        _eliminate_together(plan, pieces, queue)
    else:
        pieces = 0
    f, flops = 0, 0
    for k in range(pieces):
        failed, spent = eliminate_range(plan, f, cut[k, FIRST], 0, queue)
        if failed < 0:
            failed = cut[k, FAILED]
        if failed >= 0:
            return failed, 0
        f = cut[k, END]
        flops += spent + cut[k, FLOPS]
    failed, spent = eliminate_range(plan, f, len(records), 0, queue)
    return failed, flops + spent


@part
def _eliminate_together(plan: I64, subtrees: int, queue: I64) -> None:
    """All subtrees; the queue is this thread's."""
    put_entry(queue, AT, address_of(plan), plan.size, 1)
    post(queue, SUBTREES, subtrees)
    chunk = take_chunk(queue)
    while chunk >= 0:
        make_subtree(queue, chunk, 0)
        finish_chunk(queue)
        chunk = take_chunk(queue)
    wait_and_release(queue)


@part
def make_subtree(queue: I64, chunk: int, t: int) -> None:
    """Eliminate a subtree of the plan that the queue has, with the scratch at t."""
    plan = ints(queue, AT)
    subtrees = int_rows(plan, CUT)
    subtree = subtrees[subtrees[chunk, TURN]]
    subtree[FAILED], subtree[FLOPS] = eliminate_range(plan, subtree[FIRST], subtree[END], t, queue)


@part
def eliminate_range(plan: I64, begin: int, end: int, t: int, queue: I64) -> tuple[int, int]:
    """Eliminate fronts begin .. end, whose children are; gives the variable whose pivot failed, or −1, and flops."""
    graph, tree = graph_at(ints(plan, GRAPH)), tree_at(ints(plan, TREE))
    var, fac = graph.var, graph.fac
    node, clique, lists, numbers = tree.node, tree.clique, tree.lists, tree.numbers
    scalars, stamp = tree.scalars, tree.state[tl.S_STAMP]
    noise = ROUNDING * tree.totals[tl.T_LARGEST_DIAGONAL]
    ids, records = ints(plan, IDS), int_rows(plan, RECORDS)
    orphans, update = ints(plan, ORPHANS), int_rows(plan, UPDATE)
    first_factor, factor_of = ints(plan, FIRST_FACTOR), ints(plan, FACTORS)
    first_orphan, next_orphan = ints(plan, FIRST_ORPHAN), ints(plan, NEXT_ORPHAN)
    column, floors = np.empty(plan[N], np.int64), np.empty(plan[MOST_PIVOTS])
    runs = np.empty((plan[MOST_SEPARATORS] + 1, fr.RUN), np.int64)
    flops = 0
    for f in range(begin, end):
        row = clique[ids[f]]
        p, m, front = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS], front_of_clique(row)
        number_columns(row, noise, var, node, lists, scalars, column, floors)
        clear_front(numbers, front)
        if tree.state[tl.S_RAISED] == tl.DAMPED:
            damp_pivots(graph, tree, row)
        anchored = 0
        for q in range(first_factor[f], first_factor[f + 1]):
            anchored |= int(not is_invariant(factor_of[q], var, fac))
            add_hessian(graph, tree, factor_of[q], row, column)
        child = records[f, fr.CHILD]
        while child >= 0:
            other = clique[ids[child]]
            start = other[tl.C_LIST] + other[tl.C_FRONTALS]
            k = list_column_runs(graph, tree, start, start + other[tl.C_SEPARATORS], column, p, m, runs)
            extend_add(numbers, other[tl.C_UPDATE], other[tl.C_WIDTH_UPDATE], runs, k, row)
            anchored |= other[tl.C_ANCHORED]
            child = records[child, fr.SIBLING]
        e = first_orphan[f]
        while e >= 0:
            start = clique[orphans[e], tl.C_LIST]
            low, high = separators_of(orphans[e], stamp, clique)
            k = list_column_runs(graph, tree, start + low, start + high, column, p, m, runs)
            extend_add(numbers, update[e, UPDATE_AT], update[e, UPDATE_WIDTH], runs, k, row)
            anchored |= clique[orphans[e], tl.C_ANCHORED]
            e = next_orphan[e]
        row[tl.C_ANCHORED] = anchored
        failed = factor_front(numbers, front, floors, t, queue)
        if failed >= 0:
            return variable_at(failed, row, var, lists), flops
        if failed == RAISED:
            tree.state[tl.S_RAISED] = max(tree.state[tl.S_RAISED], tl.RAISED_PIVOT)
        flops += p * (p + m + 1) * (p + m + 1)
    return -1, flops


@part
def _by_front(graph: Graph, tree: Tree, count: int, factors: I64, fronts: Fronts) -> tuple[I64, I64]:
    """The factors sorted by the front that takes them in."""
    var, fac, node, home, place = graph.var, graph.fac, tree.node, fronts.home, fronts.place
    begin, front = take_filled(count + 2, 0, tree.scratch), take(factors.size, tree.scratch)
    for q in range(factors.size):
        front[q] = home[first_end(factors[q], place, var, fac, node)]
        begin[front[q] + 2] += 1
    for f in range(count):
        begin[f + 2] += begin[f + 1]
    out = take(factors.size, tree.scratch)
    for q in range(factors.size):
        out[begin[front[q] + 1]] = factors[q]
        begin[front[q] + 1] += 1
    return begin, out


@inline_kernel
def first_end(f: int, place: I64, var: I64, fac: I64, node: I64) -> int:
    """The place in the order of the first end of factor f that is eliminated."""
    i, j = fac[f, at.F_I], fac[f, at.F_J]
    if j < 0 or var[j, at.V_COLUMN] < 0:
        return int(place[node[i, tl.N_LOCAL]])
    if var[i, at.V_COLUMN] < 0:
        return int(place[node[j, tl.N_LOCAL]])
    return int(min(place[node[i, tl.N_LOCAL]], place[node[j, tl.N_LOCAL]]))
