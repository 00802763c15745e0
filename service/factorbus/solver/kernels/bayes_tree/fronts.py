"""Fronts for affected variables, with their place in memory.  MATH §9.4."""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.allocator import (
    give_clique,
    give_list,
    give_numbers,
    size_class,
    take_clique,
    take_list,
    take_numbers,
)
from factorbus.solver.kernels.bayes_tree.records import Fronts, Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.scratch import take, take_filled
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.symbolic import (
    arrange_fronts,
    by_later,
    count_rows,
    elimination_tree,
    join_columns,
    list_separators,
    make_records,
)


@part
def analyze_affected(perm: I64, affected: I64, var: I64, rows: I64, cols: I64, scratch: I64) -> Fronts:
    """The fronts of the affected variables eliminated in the order perm (n,), or in one with the same fill."""
    n = perm.size
    label, dim = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        label[perm[k]], dim[k] = k, dim_of_variable(var, affected[perm[k]])
    begin, earlier = by_later(n, label, rows, cols)
    parent = elimination_tree(n, begin, earlier)
    variables, scalars = count_rows(n, begin, earlier, parent, dim)
    order, home, tops, records = join_fronts(perm, parent, dim, scalars, affected, var, label, scratch)
    begin, earlier = by_later(n, label, rows, cols)
    separator_at, separator_of = list_separators(n, begin, earlier, home, tops, variables, records)
    return Fronts(order, label, home, records, separator_at, separator_of)


@part
def join_fronts(
    perm: I64, parent: I64, dim: I64, scalars: I64, affected: I64, var: I64, label: I64, scratch: I64
) -> tuple:
    """order, home, tops as `arrange_fronts` gives them, and the records; label becomes the place of each variable.

    dim, scalars (n,): of row k of R, on its diagonal and off it
    """
    n = perm.size
    top_of, pivots = join_columns(n, parent, dim, scalars, scratch)
    order, home, tops, front_of = arrange_fronts(n, perm, parent, top_of, scratch)
    first_scalar = take(n + 1, scratch)
    first_scalar[0] = 0
    for k in range(n):
        label[order[k]] = k
        first_scalar[k + 1] = first_scalar[k] + dim_of_variable(var, affected[order[k]])
    return order, home, tops, make_records(tops, home, parent, front_of, pivots, scalars, first_scalar, scratch)


@inline_kernel
def is_root_alone(marked: I64, n: int, new: int, affected: I64, settings: F64, var: I64, clique: I64) -> bool:
    """Whether a step only puts a variable or two to a root that stays small: an odometry step."""
    if marked.size != 1 or new > 2 or clique[marked[0], tl.C_PARENT] >= 0:
        return False
    pivots = 0
    for k in range(n):
        pivots += dim_of_variable(var, affected[k])
    return pivots <= settings[tl.P_SPLIT_MIN_PIVOTS]


@part
def keep_root(affected: I64, var: I64, scratch: I64) -> Fronts:
    """As `analyze_affected`: one front of all affected variables, in the order they have."""
    n = affected.size
    records = take_filled(fr.FRONT, 0, scratch).reshape((1, fr.FRONT))
    order, home = take(n, scratch), take_filled(n, 0, scratch)
    for k in range(n):
        order[k] = k
        records[0, fr.PIVOTS] += dim_of_variable(var, affected[k])
    records[0, fr.PARENT] = records[0, fr.CHILD] = records[0, fr.SIBLING] = -1
    return Fronts(order, order, home, records, take_filled(2, 0, scratch), take(0, scratch))


@inline_kernel
def row_layout(p: int, m: int) -> tuple:
    """(offset of the rows in their block, stride, offset of the used δ, size of the block)."""
    ahead = fr.padded_size(p + m)
    stride = fr.row_stride(fr.padded_size(p) + m + 1)
    return ahead + fr.padded_size(p) - p, stride, 0, ahead + p * stride + fr.LANES


@inline_kernel
def update_layout(m: int) -> tuple:
    """(width of the first rows, size) of an update matrix, the right-hand side with it."""
    width = fr.padded_size(m + 1)
    return width, fr.update_size(m + 1, width)


@part
def place_fronts(tree: Tree, fronts: Fronts, affected: I64) -> tuple:
    """A record, a list and blocks for every front; gives (ids, whether there was room).  Without it none is taken."""
    clique, lists, numbers, state = tree.clique, tree.lists, tree.numbers, tree.state
    records, order, separator_at, separator_of = fronts.records, fronts.order, fronts.separator_at, fronts.separator_of
    count = len(records)
    ids, n = take(count, tree.scratch), order.size
    if not fronts_fit(records, separator_at, n, clique, lists, numbers, state):
        return ids, False
    for f in range(count):
        c = take_clique(clique, state)
        ids[f] = c
        p, m = records[f, fr.PIVOTS], records[f, fr.SEPARATOR]
        first = records[f, fr.VARIABLE]
        last = records[f + 1, fr.VARIABLE] if f + 1 < count else n
        row = clique[c]
        row[tl.C_FRONTALS], row[tl.C_SEPARATORS] = last - first, separator_at[f + 1] - separator_at[f]
        row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS] = p, m
        start, row[tl.C_LIST_SIZE] = take_list(row[tl.C_FRONTALS] + row[tl.C_SEPARATORS], lists, state)
        row[tl.C_LIST] = start
        for k in range(first, last):
            lists[start] = affected[order[k]]
            start += 1
        for e in range(separator_at[f], separator_at[f + 1]):
            lists[start] = affected[order[separator_of[e]]]
            start += 1
        lead, row[tl.C_LD], used, size = row_layout(p, m)
        row[tl.C_BLOCK], row[tl.C_BLOCK_SIZE] = take_numbers(size, numbers, state)
        row[tl.C_ROWS], row[tl.C_USED] = row[tl.C_BLOCK] + lead, row[tl.C_BLOCK] + used
        row[tl.C_WIDTH_UPDATE], size = update_layout(m)
        row[tl.C_UPDATE], row[tl.C_UPDATE_BLOCK_SIZE] = take_numbers(size, numbers, state)
        row[tl.C_PARENT] = row[tl.C_CHILD] = row[tl.C_NEXT] = -1
        row[tl.C_ABOVE] = 0
        row[tl.C_MARK], row[tl.C_FIRST] = state[tl.S_STAMP], -1
    return ids, True


@part
def fronts_fit(records: I64, separator_at: I64, n: int, clique: I64, lists: I64, numbers: F64, state: I64) -> bool:
    """Whether the arenas have room behind what is in use for all fronts; else `state` says what is needed."""
    count, listed, doubles = len(records), 0, 0
    for f in range(count):
        p, m = records[f, fr.PIVOTS], records[f, fr.SEPARATOR]
        last = records[f + 1, fr.VARIABLE] if f + 1 < count else n
        listed += size_class(last - records[f, fr.VARIABLE] + separator_at[f + 1] - separator_at[f])[1]
        doubles += size_class(row_layout(p, m)[3])[1] + size_class(update_layout(m)[1])[1]
    cliques = state[tl.S_CLIQUES] + count
    listed += state[tl.S_LISTS]
    doubles += state[tl.S_NUMBERS]
    if cliques <= len(clique) and listed <= lists.size and doubles <= numbers.size:
        return True
    state[tl.S_NEED_CLIQUES], state[tl.S_NEED_LISTS], state[tl.S_NEED_NUMBERS] = cliques, listed, doubles
    return False


@part
def give_back_fronts(ids: I64, clique: I64, lists: I64, numbers: F64, state: I64) -> None:
    """Free the records of fronts, their lists and blocks."""
    for f in range(ids.size - 1, -1, -1):
        free_clique(ids[f], clique, lists, numbers, state)


@inline_kernel
def free_clique(c: int, clique: I64, lists: I64, numbers: F64, state: I64) -> None:
    """Give back all that clique c has."""
    row = clique[c]
    give_numbers(row[tl.C_BLOCK], row[tl.C_BLOCK_SIZE], numbers, state)
    give_numbers(row[tl.C_UPDATE], row[tl.C_UPDATE_BLOCK_SIZE], numbers, state)
    give_list(row[tl.C_LIST], row[tl.C_LIST_SIZE], lists, state)
    give_clique(c, clique, state)
