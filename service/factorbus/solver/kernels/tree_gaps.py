"""Rows of factors that go: is everything held without them, the rows behind them moved up, and back.  MATH §11.5.

Factors are looked up by their rows in many places, in the order of which they came.  So none is left empty: what is
behind a row that goes moves up by one, in the graph and in the tree, and what tells of a row is renumbered.
"""

import numpy as np

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels._jit import I64, inline_kernel, kernel, part
from factorbus.solver.kernels.places import float_rows, int_rows, ints
from factorbus.solver.kernels.tree_take_in import next_incidence


@kernel("int64(int64[::1], int64[::1], int64[::1])")
def find_adrift(gone: I64, graph: I64, tree: I64) -> int:
    """A variable of the factors `gone` (rows, ascending) that without them nothing joins, however indirectly, to one
    that is fixed or has a factor by itself; or −1.  graph, tree: tables of their arenas (`places`)
    """
    var, fac = int_rows(graph, at.T_VAR), int_rows(graph, at.T_FAC)
    node, link, count = int_rows(tree, tl.T_NODE), int_rows(tree, tl.T_LINK), ints(tree, tl.T_STATE)[tl.S_VARIABLES]
    seen, queue = np.zeros(count, np.int64), np.empty(count, np.int64)
    for k in range(gone.size):
        for end in range(2):
            v = fac[gone[k], at.F_I + end]
            if v < 0 or seen[v] != 0:
                continue
            if not is_joined(v, 1 + 2 * k + end, gone, var, fac, node, link, seen, queue):
                return v
    return -1


@part
def is_joined(
    start: int, turn: int, gone: I64, var: I64, fac: I64, node: I64, link: I64, seen: I64, queue: I64
) -> bool:
    """Whether anything holds the variable `start`; what an earlier turn has seen is held."""
    if var[start, at.V_COLUMN] < 0:
        return True
    queue[0], done, todo = start, 0, 1
    seen[start] = turn
    while done < todo:
        slot = node[queue[done], tl.N_ADJ]
        done += 1
        while slot >= 0:
            f = slot // 2
            if not is_among(f, gone):
                other = fac[f, at.F_J - slot % 2]
                if other < 0 or var[other, at.V_COLUMN] < 0 or (seen[other] != 0 and seen[other] != turn):
                    return True
                if seen[other] == 0:
                    queue[todo], seen[other] = other, turn
                    todo += 1
            slot = next_incidence(slot, link)
    return False


@inline_kernel
def is_among(f: int, rows: I64) -> bool:
    """Whether f is one of `rows`, which ascend."""
    low = count_below(f, rows)
    return low < rows.size and rows[low] == f


@inline_kernel
def count_below(f: int, rows: I64) -> int:
    """How many of `rows`, which ascend, are less than f."""
    low, high = 0, rows.size
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < f:
            low = middle + 1
        else:
            high = middle
    return low


@kernel("void(int64[::1], int64[::1], int64[::1])")
def close_gaps(gone: I64, graph: I64, tree: I64) -> None:
    """The rows behind `gone`, ascending, which are in no list any more, move up.

    graph, tree: tables of their arenas (`places`).
    """
    fac, counts = int_rows(graph, at.T_FAC), ints(graph, at.T_COUNTS)
    link, stiff, state = int_rows(tree, tl.T_LINK), float_rows(tree, tl.T_STIFF), ints(tree, tl.T_STATE)
    first, count, taken = gone[0], counts[at.FACTORS], state[tl.S_FACTORS]
    rows = np.empty(count - first, np.int64)
    k = 0
    for f in range(first, count):
        rows[f - first] = f - k
        if k < gone.size and gone[k] == f:
            k += 1
    renumber(first, rows, tree)
    k = 0
    for f in range(first, count):
        if k < gone.size and gone[k] == f:
            k += 1
            continue
        for c in range(at.F_WIDTH):
            fac[f - k, c] = fac[f, c]
        if f < taken:
            for c in range(tl.L_WIDTH):
                link[f - k, c] = link[f, c]
            for c in range(tl.B_WIDTH):
                stiff[f - k, c] = stiff[f, c]
    counts[at.FACTORS] -= gone.size
    state[tl.S_FACTORS] -= gone.size
    state[tl.S_TAKEN] -= gone.size


@kernel("void(int64[::1], int64[::1], int64[::1])")
def open_gaps(gone: I64, graph: I64, tree: I64) -> None:
    """Undo `close_gaps`: the rows `gone` are there again, for whoever fills them and links them."""
    fac, counts = int_rows(graph, at.T_FAC), ints(graph, at.T_COUNTS)
    link, stiff, state = int_rows(tree, tl.T_LINK), float_rows(tree, tl.T_STIFF), ints(tree, tl.T_STATE)
    first, count, taken = gone[0], counts[at.FACTORS], state[tl.S_FACTORS]
    rows = np.empty(count - first, np.int64)
    k = 0
    for f in range(first, count):
        while k < gone.size and gone[k] <= f + k:
            k += 1
        rows[f - first] = f + k
    renumber(first, rows, tree)
    for f in range(count - 1, first - 1, -1):
        to = rows[f - first]
        for c in range(at.F_WIDTH):
            fac[to, c] = fac[f, c]
        if f < taken:
            for c in range(tl.L_WIDTH):
                link[to, c] = link[f, c]
            for c in range(tl.B_WIDTH):
                stiff[to, c] = stiff[f, c]
    counts[at.FACTORS] += gone.size
    state[tl.S_FACTORS] += gone.size
    state[tl.S_TAKEN] += gone.size


@part
def renumber(first: int, rows: I64, tree: I64) -> None:
    """What tells of factor f ≥ first tells of rows[f − first]."""
    node, link, state = int_rows(tree, tl.T_NODE), int_rows(tree, tl.T_LINK), ints(tree, tl.T_STATE)
    for v in range(state[tl.S_VARIABLES]):
        node[v, tl.N_OWN] = renumbered(node[v, tl.N_OWN], first, rows)
        node[v, tl.N_ADJ] = renumbered_slot(node[v, tl.N_ADJ], first, rows)
    for f in range(state[tl.S_FACTORS]):
        link[f, tl.L_OWN] = renumbered(link[f, tl.L_OWN], first, rows)
        link[f, tl.L_I] = renumbered_slot(link[f, tl.L_I], first, rows)
        if link[f, tl.L_SECOND] >= 0:
            link[f, tl.L_J] = renumbered_slot(link[f, tl.L_J], first, rows)


@inline_kernel
def renumbered(f: int, first: int, rows: I64) -> int:
    """The row of factor f now; −1 stays."""
    return int(rows[f - first]) if f >= first else f


@inline_kernel
def renumbered_slot(slot: int, first: int, rows: I64) -> int:
    """The same of an incidence, 2 · factor + end."""
    return 2 * int(rows[slot // 2 - first]) + slot % 2 if slot >= 2 * first else slot
