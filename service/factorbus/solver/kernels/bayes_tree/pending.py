"""Variables that wait to be relinearized."""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.relinearize import WAITS
from factorbus.solver.kernels.jit.compile import I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of
from factorbus.solver.kernels.model.records import Graph


@part
def mark_first_pending(f: int, both: bool, graph: Graph, tree: Tree) -> None:
    """The first variable of factor f is to be relinearized, and with `both`, or where that is fixed, the second."""
    var, first, second = graph.var, graph.fac[f, at.F_I], graph.fac[f, at.F_J]
    free = var[first, at.V_COLUMN] >= 0
    if free:
        mark_pending(first, tree.node, tree.pending, tree.state)
    if (both or not free) and var[second, at.V_COLUMN] >= 0:
        mark_pending(second, tree.node, tree.pending, tree.state)


@inline_kernel
def mark_ends_pending(f: int, fac: I64, var: I64, node: I64, pending: I64, state: I64) -> None:
    """The variables of factor f that are free are to be relinearized."""
    for n in range(count_ends(f, fac)):
        v = end_of(f, n, fac)
        if var[v, at.V_COLUMN] >= 0:
            mark_pending(v, node, pending, state)


@inline_kernel
def mark_pending(v: int, node: I64, pending: I64, state: I64) -> None:
    """Variable v is to be relinearized."""
    if node[v, tl.N_FLAGS] == 0:
        node[v, tl.N_FLAGS] = WAITS
        pending[state[tl.S_PENDING]] = v
        state[tl.S_PENDING] += 1
