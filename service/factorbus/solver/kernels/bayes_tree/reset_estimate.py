"""The estimate put back to the linearization points, which R stays that of.  MATH §9.6"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.linearization_error import measure
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, note_moved
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.jit.compile import I64, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.sizes import size_of


@kernel("void(int64[::1], int64[::1])")
def reset_to_linearization(graph_table: I64, tree_table: I64) -> None:
    """δ = 0 everywhere, as if every clique had been solved so; the next back-substitution from a root moves on.

    graph_table, tree_table: of their arrays (`records`).  χ² and linearization errors are measured anew.
    """
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    var = graph.var
    values, settings = graph.values, tree.settings
    node, clique = tree.node, tree.clique
    numbers, motions = tree.numbers, tree.motions
    lin, scalars = tree.lin, tree.scalars
    moved = tree.moved
    state, totals = tree.state, tree.totals
    state[tl.S_BEHIND] = 0
    for v in range(state[tl.S_VARIABLES]):
        x, d, c = var[v, at.V_AT], var[v, at.V_SCALAR], node[v, tl.N_CLIQUE]
        note_moved(MODEL, v, node, moved, state)
        if d < 0:
            continue
        for a in range(size_of(var[v, at.V_KIND])):
            values[x + a] = lin[0, x + a]
        for a in range(dim_of_variable(var, v)):
            scalars[0, d + a] = 0.0
        if c >= 0 and node[v, tl.N_PLACE] == 0:
            for k in range(clique[c, tl.C_PIVOTS] + clique[c, tl.C_SEPARATOR_SCALARS]):
                numbers[clique[c, tl.C_USED] + k] = 0.0
            for k in range(tl.M_WIDTH):
                motions[c * tl.M_WIDTH + k] = 0.0
            clique[c, tl.C_MOVES] = 0
    measure(graph, tree, settings)
    totals[tl.T_LEFT] = np.inf
