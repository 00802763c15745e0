"""Rows of factors that go: the rows behind them moved up, and back.  MATH §11.5.

Factors are looked up by their rows in many places, in the order of which they came.  So none is left empty: what is
behind a row that goes moves up by one, in the graph and in the tree, and what refers to a row is renumbered.
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree, tree_at
from factorbus.solver.kernels.jit.compile import I64, inline_kernel, kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at


@kernel("void(int64[::1], int64[::1], int64[::1])")
def close_gaps(gone: I64, graph_table: I64, tree_table: I64) -> None:
    """The rows behind `gone`, ascending, which are in no list any more, move up.

    graph_table, tree_table: of their arrays (`records`).
    """
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    fac, counts = graph.fac, graph.counts
    link, factor_errors, state = tree.link, tree.factor_errors, tree.state
    first, count, taken = gone[0], counts[at.FACTORS], state[tl.S_FACTORS]
    rows = np.empty(count - first, np.int64)
    k = 0
    for f in range(first, count):
        rows[f - first] = f - k
        if k < gone.size and gone[k] == f:
            k += 1
    renumber(first, rows, fac, tree)
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
            for c in range(tl.E_WIDTH):
                factor_errors[f - k, c] = factor_errors[f, c]
    counts[at.FACTORS] -= gone.size
    state[tl.S_FACTORS] -= gone.size
    state[tl.S_TAKEN] -= gone.size


@kernel("void(int64[::1], int64[::1], int64[::1])")
def open_gaps(gone: I64, graph_table: I64, tree_table: I64) -> None:
    """Undo `close_gaps`: the rows `gone` are there again, to be filled and linked by the caller.

    Two functions, as one moves rows up from the first on, the other down from the last on: neither overwrites what it
    has yet to move.
    """
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    fac, counts = graph.fac, graph.counts
    link, factor_errors, state = tree.link, tree.factor_errors, tree.state
    first, count, taken = gone[0], counts[at.FACTORS], state[tl.S_FACTORS]
    rows = np.empty(count - first, np.int64)
    k = 0
    for f in range(first, count):
        while k < gone.size and gone[k] <= f + k:
            k += 1
        rows[f - first] = f + k
    renumber(first, rows, fac, tree)
    for f in range(count - 1, first - 1, -1):
        to = rows[f - first]
        for c in range(at.F_WIDTH):
            fac[to, c] = fac[f, c]
        if f < taken:
            for c in range(tl.L_WIDTH):
                link[to, c] = link[f, c]
            for c in range(tl.E_WIDTH):
                factor_errors[to, c] = factor_errors[f, c]
    counts[at.FACTORS] += gone.size
    state[tl.S_FACTORS] += gone.size
    state[tl.S_TAKEN] += gone.size


@part
def renumber(first: int, rows: I64, fac: I64, tree: Tree) -> None:
    """Lists that name factor f ≥ first name rows[f − first] instead; fac: rows as they were."""
    node, link, state = tree.node, tree.link, tree.state
    for v in range(state[tl.S_VARIABLES]):
        node[v, tl.N_OWN] = renumbered(node[v, tl.N_OWN], first, rows)
        node[v, tl.N_ADJ] = renumbered_slot(node[v, tl.N_ADJ], first, rows)
    for f in range(state[tl.S_FACTORS]):
        link[f, tl.L_OWN] = renumbered(link[f, tl.L_OWN], first, rows)
        link[f, tl.L_I] = renumbered_slot(link[f, tl.L_I], first, rows)
        if fac[f, at.F_J] >= 0:
            link[f, tl.L_J] = renumbered_slot(link[f, tl.L_J], first, rows)


@inline_kernel
def renumbered(f: int, first: int, rows: I64) -> int:
    """The row of factor f now; −1 stays."""
    return int(rows[f - first]) if f >= first else f


@inline_kernel
def renumbered_slot(slot: int, first: int, rows: I64) -> int:
    """The same of an incidence, 2 · factor + end."""
    return 2 * int(rows[slot // 2 - first]) + slot % 2 if slot >= 2 * first else slot
