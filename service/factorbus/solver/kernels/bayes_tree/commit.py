"""Putting new cliques in the place of those they replace.  MATH §9.4.

Until here a step has changed no link of the tree, so one that fails has only its own fronts to give back.
"""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable, has_free
from factorbus.solver.kernels.bayes_tree.allocator import give_numbers
from factorbus.solver.kernels.bayes_tree.assemble import UPDATE_AT, UPDATE_SIZE, UPDATE_WIDTH, split_sizes
from factorbus.solver.kernels.bayes_tree.eliminate import first_end
from factorbus.solver.kernels.bayes_tree.fronts import free_clique
from factorbus.solver.kernels.bayes_tree.hessian_room import hessian_size
from factorbus.solver.kernels.bayes_tree.records import Affected, Fronts, Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.sparse import fronts as fr


@part
def commit(graph: Graph, tree: Tree, affected: Affected, fronts: Fronts, ids: I64, lowest: I64, update: I64) -> None:
    """Split or free the marked cliques, hang the new ones and the orphans up, and give the factors their owners."""
    var, fac = graph.var, graph.fac
    marked, orphans, factors = affected.cliques, affected.orphans, affected.factors
    records, place, home = fronts.records, fronts.place, fronts.home
    node, link, clique, lists, numbers = tree.node, tree.link, tree.clique, tree.lists, tree.numbers
    state, totals = tree.state, tree.totals
    for k in range(marked.size):
        state[tl.S_NONZEROS] -= nonzeros(clique[marked[k]])
        if clique[marked[k], tl.C_PARENT] < 0:
            totals[tl.T_MODEL] -= numbers[clique[marked[k], tl.C_UPDATE]]
            state[tl.S_ROOTS] -= 1
    if state[tl.S_ROOTS] == 0:
        totals[tl.T_MODEL] = totals[tl.T_CONSTANT]
    for e in range(orphans.size):
        if clique[orphans[e], tl.C_MARK] == state[tl.S_STAMP]:
            keep_leading(orphans[e], update[e], var, clique, lists, numbers, state)
    for k in range(marked.size):
        c = marked[k]
        if clique[c, tl.C_FIRST] == 0:
            free_clique(c, clique, lists, numbers, state)
        else:
            state[tl.S_NONZEROS] += nonzeros(clique[c])
    for k in range(marked.size):
        clique[marked[k], tl.C_FIRST] = 0
    for f in range(ids.size):
        c, row = ids[f], clique[ids[f]]
        row[tl.C_FIRST] = -1
        state[tl.S_NONZEROS] += nonzeros(row)
        for q in range(row[tl.C_FRONTALS]):
            v = lists[row[tl.C_LIST] + q]
            node[v, tl.N_CLIQUE], node[v, tl.N_PLACE], node[v, tl.N_OWN] = c, q, -1
        above = records[f, fr.PARENT]
        if above < 0:
            state[tl.S_ROOTS] += 1
            totals[tl.T_MODEL] += numbers[row[tl.C_UPDATE]]
        else:
            hang(c, ids[above], fronts.separator_of[fronts.separator_at[f]] - records[above, fr.VARIABLE], clique)
    for e in range(orphans.size):
        k = place[lowest[e]]
        hang(orphans[e], ids[home[k]], k - records[home[k], fr.VARIABLE], clique)
    for q in range(factors.size - 1, -1, -1):
        v = affected.variables[fronts.order[first_end(factors[q], place, var, fac, node)]]
        link[factors[q], tl.L_OWN], node[v, tl.N_OWN] = node[v, tl.N_OWN], factors[q]
    state[tl.S_ELIMINATED] += fronts.order.size


@inline_kernel
def nonzeros(row: I64) -> int:
    """Of R in the rows of a clique, zeros of joined columns among them."""
    return row[tl.C_PIVOTS] * row[tl.C_SEPARATOR_SCALARS] + row[tl.C_PIVOTS] * (row[tl.C_PIVOTS] + 1) // 2


@part
def add_constants(f0: int, f1: int, var: I64, fac: I64, link: I64, hessian: F64, totals: F64) -> None:
    """χ² of the factors f0 .. f1−1 that join fixed variables only."""
    for f in range(f0, f1):
        if not has_free(f, var, fac):
            i, j = fac[f, at.F_I], fac[f, at.F_J]
            dj = dim_of_variable(var, j) if j >= 0 else 0
            chi2 = hessian[link[f, tl.L_AT] + hessian_size(dim_of_variable(var, i), dj) - 1]
            totals[tl.T_CONSTANT] += chi2
            totals[tl.T_MODEL] += chi2


@part
def keep_leading(c: int, update: I64, var: I64, clique: I64, lists: I64, numbers: F64, state: I64) -> None:
    """Clique c loses its frontals from the first touched one on, and the children that hang there."""
    row = clique[c]
    p, m = split_sizes(c, var, clique, lists)
    lost = row[tl.C_FRONTALS] - row[tl.C_FIRST]
    row[tl.C_FRONTALS] -= lost
    row[tl.C_SEPARATORS] += lost
    row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS] = p, m
    give_numbers(row[tl.C_UPDATE], row[tl.C_UPDATE_BLOCK_SIZE], numbers, state)
    row[tl.C_UPDATE], row[tl.C_WIDTH_UPDATE], row[tl.C_UPDATE_BLOCK_SIZE] = (
        update[UPDATE_AT],
        update[UPDATE_WIDTH],
        update[UPDATE_SIZE],
    )
    child, row[tl.C_CHILD] = row[tl.C_CHILD], -1
    while child >= 0:
        following = clique[child, tl.C_NEXT]
        if clique[child, tl.C_ABOVE] < row[tl.C_FRONTALS]:
            clique[child, tl.C_NEXT], row[tl.C_CHILD] = row[tl.C_CHILD], child
        child = following


@part
def hang(c: int, parent: int, above: int, clique: I64) -> None:
    """Clique c becomes a child of `parent`; `above`: the place there of the first of its separator."""
    clique[c, tl.C_PARENT], clique[c, tl.C_ABOVE] = parent, above
    clique[c, tl.C_NEXT] = clique[parent, tl.C_CHILD]
    clique[parent, tl.C_CHILD] = c
