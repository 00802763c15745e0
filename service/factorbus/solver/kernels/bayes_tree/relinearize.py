"""Moving linearization points of single variables to the estimate, and back.  MATH §9.6."""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence, note_turn
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.hessian import linearize_factor
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, note_moved
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import I64, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import head_of
from factorbus.solver.kernels.model.linearize import make_scratch
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import size_of

WAITS, MOVES = 1, 2
SPARSE = 16  # where no more than one factor in this number is to be linearized, the others are not looked through


@part
def relinearize(graph: Graph, tree: Tree, pending: I64) -> None:
    """Move the pending variables to the estimate, and linearize their factors there."""
    var, values = graph.var, graph.values
    node, lin, scalars, turns, moved = tree.node, tree.lin, tree.scalars, tree.turns, tree.moved
    state = tree.state
    for k in range(pending.size):
        v = pending[k]
        if node[v, tl.N_FLAGS] != WAITS:
            continue
        x, d = var[v, at.V_AT], var[v, at.V_SCALAR]
        for a in range(size_of(var[v, at.V_KIND])):
            lin[1, x + a], lin[0, x + a] = lin[0, x + a], values[x + a]
        for a in range(dim_of_variable(var, v)):
            scalars[2, d + a], scalars[0, d + a] = scalars[0, d + a], 0.0
        note_turn(v, var, lin, turns)
        node[v, tl.N_FLAGS] = MOVES
        note_moved(MODEL, v, node, moved, state)
        state[tl.S_RELINEARIZED] += 1
    linearize_around(graph, tree, pending)


@part
def go_back(graph: Graph, tree: Tree, pending: I64) -> None:
    """Undo `relinearize`: its variables wait again."""
    var = graph.var
    node, lin, scalars, turns, state = tree.node, tree.lin, tree.scalars, tree.turns, tree.state
    for k in range(pending.size):
        v = pending[k]
        x, d = var[v, at.V_AT], var[v, at.V_SCALAR]
        for a in range(size_of(var[v, at.V_KIND])):
            lin[0, x + a] = lin[1, x + a]
        for a in range(dim_of_variable(var, v)):
            scalars[0, d + a] = scalars[2, d + a]
        note_turn(v, var, lin, turns)
        node[v, tl.N_FLAGS] = WAITS
        state[tl.S_RELINEARIZED] -= 1
    linearize_around(graph, tree, pending)


@part
def linearize_around(graph: Graph, tree: Tree, variables: I64) -> None:
    """Linearize the factors of some variables, each once, in the order of their ids: so they lie in memory.

    In that of the variables, which is the tree's, it takes twice as long.
    """
    fac, node, link, state = graph.fac, tree.node, tree.link, tree.state
    scratch = make_scratch()
    state[tl.S_SWEEP] += 1
    sweep, count, first, last = state[tl.S_SWEEP], 0, state[tl.S_FACTORS], -1
    for k in range(variables.size):
        slot = node[variables[k], tl.N_ADJ]
        while slot >= 0:
            f = head_of(slot // 2, fac)
            if link[f, tl.L_STAMP] != sweep:
                link[f, tl.L_STAMP] = sweep
                first, last, count = min(first, f), max(last, f), count + 1
            slot = next_incidence(slot, link)
    if last - first < SPARSE * count:
        for f in range(first, last + 1):
            if link[f, tl.L_STAMP] == sweep:
                linearize_factor(graph, tree, f, scratch)
        return
    for k in range(variables.size):
        slot = node[variables[k], tl.N_ADJ]
        while slot >= 0:
            f = head_of(slot // 2, fac)
            if link[f, tl.L_STAMP] == sweep:
                link[f, tl.L_STAMP] = -1
                linearize_factor(graph, tree, f, scratch)
            slot = next_incidence(slot, link)
