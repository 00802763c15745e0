"""What the next Gauss-Newton step would take off χ², where R of the tree is not that of Λ.  MATH (6.4), §9.5

The gradient is that of all factors at the estimate, for the linear problem is not solved where pivots were raised.
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.decrement import solve_backwards, solve_forwards
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.bayes_tree.refactor_in_place import mark_above
from factorbus.solver.kernels.jit.compile import I64, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.linearize import make_scratch
from factorbus.solver.kernels.model.multiply_hessian import add_products
from factorbus.solver.kernels.model.records import graph_at

ITERATIONS = 30  # at most: with more, a batch takes no longer
LEFT = 1e-6  # of what is looked for: with less left by R, and found, there is no more


@kernel("float64(float64, int64[::1], int64[::1])")
def remaining_decrement(most: float, graph_table: I64, tree_table: I64) -> float:
    """δᵀη with Λ δ = η at the estimate, by conjugate gradients with the tree's R; or some number above `most` where it
    is more, or is not found.  graph_table, tree_table: of their arrays (`records`)."""
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    var, node, clique, state, scratch = graph.var, tree.node, tree.clique, tree.state, make_scratch()
    g, factors, end = np.zeros(graph.counts[at.SCALARS]), state[tl.S_FACTORS], tree.marked.size
    p, factor, found = np.zeros(g.size), 0.0, 0.0
    add_products(factors, graph, scratch, p, True, g)
    state[tl.S_STAMP] += 1
    for v in range(state[tl.S_VARIABLES]):
        if var[v, at.V_SCALAR] >= 0:
            end = mark_above(v, node, clique, state, tree.marked, end)
    cliques, z = tree.marked[end:], g.copy()
    square = solve_forwards(graph, tree, cliques, z)
    for _ in range(ITERATIONS):
        if square <= LEFT * most:
            return found
        if not square < np.inf:
            break
        solve_backwards(graph, tree, cliques, z)
        Ap, curvature = np.zeros(g.size), 0.0
        for s in range(g.size):
            p[s] = z[s] + factor * p[s]
        add_products(factors, graph, scratch, p, False, Ap)
        for s in range(g.size):
            curvature += p[s] * Ap[s]
        if not curvature > 0.0:
            break
        found += square * (square / curvature)
        if not found <= most:
            break
        for s in range(g.size):
            g[s] -= square / curvature * Ap[s]
            z[s] = g[s]
        before, square = square, solve_forwards(graph, tree, cliques, z)
        factor = square / before
    return np.inf
