"""R by orthogonal transformations of the Jacobians, where R of Λ is rounding.  MATH §10.1

    1  sort       the factors by the clique that the first of their variables is eliminated in
    2  eliminate  children first: the rows of a clique's factors, and what its children leave, are [ R S; 0 U ] after a
                  Householder transformation; U goes to the parent

Λ has information, σ⁻², and its rounding hides what is less than 2⁻⁵² of the most; J has σ⁻¹, and that as 2⁻²⁶ of it.
"""

import numpy as np

from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.linearized import linearized_factor
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at


def replace_rows(graph: FactorGraph, tree: CliqueTree, order: I64, dims: I64, first_rows: I64) -> None:
    """Make the rows of R in `tree` anew, of the factors of `graph` at its values.

    order: the cliques, depth first from the roots   dims: of every variable   first_rows: of every factor
    """
    # 1
    turn = np.full(len(tree.clique), -1)
    turn[order] = np.arange(order.size)
    rows: list[list[tuple[I64, F64]]] = [[] for _ in range(order.size)]
    for f in first_rows.tolist():
        linear = linearized_factor(graph, f)
        free = [n for n, v in enumerate(linear.ends.tolist()) if graph.var[v, at.V_COLUMN] >= 0]
        if free:
            root = np.linalg.cholesky(linear.W).T
            J = root @ np.hstack([linear.jacobian_of(int(linear.ends[n])) for n in free])
            owner = int(turn[tree.node[linear.ends[free], tl.N_CLIQUE]].max())
            rows[owner].append((linear.ends[free], J))
    # 2
    for k in range(order.size - 1, -1, -1):
        row = tree.clique[order[k]]
        variables = tree.lists[row[tl.C_LIST] :][: row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]]
        R = _triangle(variables, dims, rows[k])
        rows[k] = []
        p, ld, start = int(row[tl.C_PIVOTS]), int(row[tl.C_LD]), int(row[tl.C_ROWS])
        for i in range(p):
            tree.numbers[start + i * ld + i : start + i * ld + R.shape[1]] = R[i, i:]
        if row[tl.C_PARENT] >= 0:
            rows[turn[row[tl.C_PARENT]]].append((variables[row[tl.C_FRONTALS] :], R[p:, p:]))


def _triangle(variables: I64, dims: I64, rows: list[tuple[I64, F64]]) -> F64:
    """Upper triangular, with a positive diagonal: `rows` of some of the `variables` each, by their columns."""
    start: I64 = np.cumsum(dims[variables]) - dims[variables]
    place = dict(zip(variables.tolist(), start.tolist(), strict=True))
    width = int(dims[variables].sum())
    stacked = np.zeros((max(sum(len(J) for _, J in rows), width), width))
    at_row = 0
    for ends, J in rows:
        columns = np.concatenate([place[v] + np.arange(int(dims[v])) for v in ends.tolist()] or [np.empty(0, np.int64)])
        stacked[at_row : at_row + len(J), columns] = J
        at_row += len(J)
    # The largest first: a transformation that begins with a small row would round what it takes from the others.
    stacked = stacked[np.argsort(-np.abs(stacked).max(1, initial=0.0), kind="stable")]
    R = np.asarray(np.linalg.qr(stacked, mode="r"))
    return R * np.where(R.diagonal() < 0.0, -1.0, 1.0)[:, None]
