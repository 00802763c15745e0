"""Cliques that keep their variables and only get other numbers.  MATH §9.5.

New factors change what has to be eliminated together; those that are only linearized anew do not.  So below the cliques
that new factors change nothing has to be ordered: there the cliques with a relinearized factor in or below them are
eliminated again as they are, and then they are orphans like others.
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence
from factorbus.solver.kernels.bayes_tree.allocator import give_numbers, size_class, take_numbers
from factorbus.solver.kernels.bayes_tree.assemble import (
    add_hessian,
    damp_pivots,
    extend_add,
    front_of_clique,
    list_column_runs,
    number_columns,
    variable_at,
)
from factorbus.solver.kernels.bayes_tree.fronts import row_layout, update_layout
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.reroot import flops_of
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.multifrontal import clear_front
from factorbus.solver.kernels.sparse.partial_cholesky import RAISED, ROUNDING, factor_front

ORDERING = 1e4  # flops of a variable: from there on it is worth to order it, for the fill that this may spare


@part
def mark_renewed(moving: I64, fac: I64, node: I64, link: I64, clique: I64, state: I64, marked: I64) -> I64:
    """The cliques that the factors of `moving` change and no touched one, children first.

    Their C_MARK is −S_STAMP, and S_STAMP again when they are committed.  Above them the touched cliques are touched
    from where they hang.  marked: its end is used up
    """
    end = marked.size
    for k in range(moving.size):
        slot = node[moving[k], tl.N_ADJ]
        while slot >= 0:
            f = slot // 2
            end = mark_above(fac[f, at.F_I], node, clique, state, marked, end)
            if fac[f, at.F_J] >= 0:
                end = mark_above(fac[f, at.F_J], node, clique, state, marked, end)
            slot = next_incidence(slot, link)
    return marked[end:].copy()


@inline_kernel
def mark_above(v: int, node: I64, clique: I64, state: I64, marked: I64, end: int) -> int:
    """Mark the clique of v and those above up to a marked one, before what `marked` has from `end` on; gives the new
    end.
    """
    stamp, low, place = state[tl.S_STAMP], node[v, tl.N_CLIQUE], node[v, tl.N_PLACE]
    c, count = low, 0
    while c >= 0 and abs(clique[c, tl.C_MARK]) != stamp:
        clique[c, tl.C_MARK] = -stamp
        place, c, count = clique[c, tl.C_ABOVE], clique[c, tl.C_PARENT], count + 1
    if c >= 0 and clique[c, tl.C_MARK] == stamp and place < clique[c, tl.C_FIRST]:
        clique[c, tl.C_FIRST] = place
    for k in range(end - count, end):
        marked[k], low = low, clique[low, tl.C_PARENT]
    return end - count


@inline_kernel
def is_worth_ordering(renewed: I64, clique: I64) -> bool:
    """Whether an elimination of these cliques takes so long that it is worth to order their variables anew."""
    variables = 0
    for k in range(renewed.size):
        variables += clique[renewed[k], tl.C_FRONTALS]
    return flops_of(renewed, clique) > ORDERING * variables


@part
def still_renewed(renewed: I64, clique: I64, state: I64) -> I64:
    """Those of them that no touch has reached since.  The others are touched as a whole, and the cliques that any of
    them hang from are touched from there on.
    """
    stamp, count = state[tl.S_STAMP], 0
    for k in range(renewed.size):
        c = renewed[k]
        if clique[c, tl.C_MARK] == stamp:
            clique[c, tl.C_FIRST] = 0
            continue
        renewed[count] = c
        count += 1
        above, place = clique[c, tl.C_PARENT], clique[c, tl.C_ABOVE]
        if above >= 0 and clique[above, tl.C_MARK] == stamp and place < clique[above, tl.C_FIRST]:
            clique[above, tl.C_FIRST] = place
    return renewed[:count]


@part
def renew(graph: Graph, tree: Tree, renewed: I64, n: int, largest_diagonal: float, old: I64, queue: I64) -> int:
    """Eliminate the frontals of the cliques `renewed` again, in new blocks; gives the status.

    old (renewed, C_WIDTH): gets their present rows.  Local numbers of affected variables are below n.  queue: see
    `task_queue`.
    """
    var = graph.var
    node, link, clique, lists, numbers = tree.node, tree.link, tree.clique, tree.lists, tree.numbers
    scalars, state = tree.scalars, tree.state
    if not take_blocks(renewed, old, clique, numbers, state):
        return tl.NO_ROOM
    widest, most, total = 0, 0, n
    for k in range(renewed.size):
        row = clique[renewed[k]]
        widest, most = max(widest, row[tl.C_PIVOTS]), max(most, row[tl.C_SEPARATORS])
        child = row[tl.C_CHILD]
        while child >= 0:
            most = max(most, clique[child, tl.C_SEPARATORS])
            child = clique[child, tl.C_NEXT]
        for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
            node[lists[s], tl.N_LOCAL] = total
            total += 1
    column, floors, runs = np.empty(total, np.int64), np.empty(widest), np.empty((most + 1, fr.RUN), np.int64)
    for k in range(renewed.size):
        row = clique[renewed[k]]
        p, m, front = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS], front_of_clique(row)
        number_columns(row, ROUNDING * largest_diagonal, var, node, lists, scalars, column, floors)
        clear_front(numbers, front)
        if state[tl.S_RAISED] == tl.DAMPED:
            damp_pivots(graph, tree, row)
        for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
            f = node[lists[s], tl.N_OWN]
            while f >= 0:
                add_hessian(graph, tree, f, row, column)
                f = link[f, tl.L_OWN]
        child = row[tl.C_CHILD]
        while child >= 0:
            other = clique[child]
            start = other[tl.C_LIST] + other[tl.C_FRONTALS]
            count = list_column_runs(graph, tree, start, start + other[tl.C_SEPARATORS], column, p, m, runs)
            extend_add(numbers, other[tl.C_UPDATE], other[tl.C_WIDTH_UPDATE], runs, count, row)
            child = other[tl.C_NEXT]
        failed = factor_front(numbers, front, floors, 0, queue)
        if failed == RAISED:
            state[tl.S_RAISED] = max(state[tl.S_RAISED], tl.RAISED_PIVOT)
        if failed >= 0:
            state[tl.S_FAILED] = variable_at(failed, row, var, lists)
            give_back_renewed(renewed, old, clique, numbers, state)
            return tl.FAILED
    return tl.DONE


@part
def take_blocks(renewed: I64, old: I64, clique: I64, numbers: F64, state: I64) -> bool:
    """New blocks for rows and update matrices; False: there is no room, and none is taken."""
    need = state[tl.S_NUMBERS]
    for k in range(renewed.size):
        row = clique[renewed[k]]
        need += size_class(row_layout(row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS])[3])[1]
        need += size_class(update_layout(row[tl.C_SEPARATOR_SCALARS])[1])[1]
    if need > numbers.size:
        state[tl.S_NEED_NUMBERS] = need
        return False
    for k in range(renewed.size):
        row = clique[renewed[k]]
        for column in range(tl.C_WIDTH):
            old[k, column] = row[column]
        lead, row[tl.C_LD], used, size = row_layout(row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS])
        row[tl.C_BLOCK], row[tl.C_BLOCK_SIZE] = take_numbers(size, numbers, state)
        row[tl.C_ROWS], row[tl.C_USED] = row[tl.C_BLOCK] + lead, row[tl.C_BLOCK] + used
        row[tl.C_WIDTH_UPDATE], size = update_layout(row[tl.C_SEPARATOR_SCALARS])
        row[tl.C_UPDATE], row[tl.C_UPDATE_BLOCK_SIZE] = take_numbers(size, numbers, state)
    return True


@part
def give_back_renewed(renewed: I64, old: I64, clique: I64, numbers: F64, state: I64) -> None:
    """The cliques are as they were."""
    for k in range(renewed.size):
        row = clique[renewed[k]]
        give_numbers(row[tl.C_BLOCK], row[tl.C_BLOCK_SIZE], numbers, state)
        give_numbers(row[tl.C_UPDATE], row[tl.C_UPDATE_BLOCK_SIZE], numbers, state)
        row[tl.C_BLOCK], row[tl.C_BLOCK_SIZE], row[tl.C_ROWS] = (
            old[k, tl.C_BLOCK],
            old[k, tl.C_BLOCK_SIZE],
            old[k, tl.C_ROWS],
        )
        row[tl.C_LD], row[tl.C_USED], row[tl.C_UPDATE] = old[k, tl.C_LD], old[k, tl.C_USED], old[k, tl.C_UPDATE]
        row[tl.C_WIDTH_UPDATE], row[tl.C_UPDATE_BLOCK_SIZE] = old[k, tl.C_WIDTH_UPDATE], old[k, tl.C_UPDATE_BLOCK_SIZE]
        row[tl.C_MARK] = state[tl.S_STAMP]


@part
def commit_renewed(renewed: I64, old: I64, clique: I64, numbers: F64, state: I64, totals: F64) -> I64:
    """The old blocks are free, and the cliques to be solved; gives those of them that are roots."""
    roots, count = np.empty(renewed.size, np.int64), 0
    for k in range(renewed.size):
        row = clique[renewed[k]]
        if row[tl.C_PARENT] < 0:
            roots[count] = renewed[k]
            count += 1
            totals[tl.T_MODEL] -= numbers[old[k, tl.C_UPDATE]]
        row[tl.C_FIRST], row[tl.C_MARK] = -1, state[tl.S_STAMP]
        state[tl.S_ELIMINATED] += row[tl.C_FRONTALS]
    if count == state[tl.S_ROOTS]:
        totals[tl.T_MODEL] = totals[tl.T_CONSTANT]
    for k in range(count):
        totals[tl.T_MODEL] += numbers[clique[roots[k], tl.C_UPDATE]]
    for k in range(renewed.size):
        give_numbers(old[k, tl.C_BLOCK], old[k, tl.C_BLOCK_SIZE], numbers, state)
        give_numbers(old[k, tl.C_UPDATE], old[k, tl.C_UPDATE_BLOCK_SIZE], numbers, state)
    state[tl.S_FLOPS] += int(flops_of(renewed, clique))
    return roots[:count]
