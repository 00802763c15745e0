"""What a step of the tree moved, and the way back."""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.sorting import put_in_order, sort
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.sizes import size_of


@kernel("int64(int64, int64[::1], int64[::1], int64[::1])")
def list_changed(first: int, graph_table: I64, tree_table: I64, out: I64) -> int:
    """List in `out`, ascending, the variables that have other bits than before the last step, and all from `first` on.

    graph_table, tree_table: of their arrays (`records`).  Gives how many.
    """
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    counts, var, values = graph.counts, graph.var, graph.values
    changed, lin, state = tree.changed, tree.lin, tree.state
    before, now = lin.view(np.int64), values.view(np.int64)  # bits: −0.0 is not 0.0
    n = 0
    for k in range(state[tl.S_CHANGED]):
        v = changed[k]
        if v < first and differs_in_tree(v, var, before, now):
            out[n] = v
            n += 1
    if not put_in_order(out[:n], first):
        sort(out[:n])
    for v in range(first, counts[at.VARIABLES]):
        out[n] = v
        n += 1
    return n


@inline_kernel
def differs_in_tree(v: int, var: I64, lin: I64, values: I64) -> bool:
    """Whether a value has other bits than in lin[2]."""
    x = var[v, at.V_AT]
    last = x + size_of(var[v, at.V_KIND])
    while x < last and lin[2, x] == values[x]:
        x += 1
    return x < last


@part
def count_differing(first: int, count: int, changed: I64, var: I64, lin: F64, values: F64) -> int:
    """How many `list_changed` would list."""
    n, before, now = count - first, lin.view(np.int64), values.view(np.int64)
    for k in range(changed.size):
        if changed[k] < first and differs_in_tree(changed[k], var, before, now):
            n += 1
    return n


@kernel("void(int64[::1], int64[:,::1], float64[:,::1], float64[::1])")
def exchange(changed: I64, var: I64, lin: F64, values: F64) -> None:
    """Exchange the values of the changed variables and those from before the step."""
    for k in range(changed.size):
        x = var[changed[k], at.V_AT]
        for a in range(size_of(var[changed[k], at.V_KIND])):
            lin[2, x + a], values[x + a] = values[x + a], lin[2, x + a]
