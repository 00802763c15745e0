"""The order in which affected variables are eliminated again, and the fronts that follow.  MATH §9.4.

Affected variables are the nodes of a quotient graph, what hangs from them its elements: an orphan joins its separator
as if it had just been eliminated.
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable, separators_of
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.reroot import MOST_RINGS
from factorbus.solver.kernels.jit.compile import I64, inline_kernel, part
from factorbus.solver.kernels.jit.scratch import take
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import is_pose
from factorbus.solver.kernels.sparse.amd import ELEMENT, order_nodes, quotient_graph

NEWEST = MOST_RINGS + 3  # the last group: above those of all rings, and that of what is recent
MOST_JOINED = 10  # nodes of later groups that a variable may join by its elimination


@part
def order_affected(
    graph: Graph, tree: Tree, n: int, affected: I64, factors: I64, orphans: I64, recent: int, last: int
) -> I64:
    """perm (n,): affected[perm[k]] is eliminated k-th.

    Last go those that are near, ring by ring, then variables with a factor in the last `recent` steps, then the
    variable `last`; −1: none does.
    """
    var, fac = graph.var, graph.fac
    node, clique, lists, state = tree.node, tree.clique, tree.lists, tree.state
    dims, group = np.empty(n, np.int64), np.empty(n, np.int64)
    stamp, m = state[tl.S_STAMP], orphans.size
    for k in range(n):
        dims[k] = dim_of_variable(var, affected[k])
        group[k] = group_of(affected[k], recent, last, node, state)
    quotient = quotient_graph(np.empty(n + m, np.int64), np.zeros(n + m, np.int64))
    begin, length, elements, kind, degree, _, _ = quotient
    for e in range(m):
        start = clique[orphans[e], tl.C_LIST]
        first, end = separators_of(orphans[e], stamp, clique)
        length[n + e] = end - first
        for s in range(start + first, start + end):
            k = node[lists[s], tl.N_LOCAL]
            degree[n + e] += dims[k]
            elements[k] += 1
            length[k] += 1
    for q in range(factors.size):
        i, j = ends_of(factors[q], var, fac, node)
        if j >= 0:
            length[i] += 1
            length[j] += 1
    total = 0
    for k in range(n + m):
        begin[k] = total
        total += length[k]
    near = np.empty(total + total // 2 + 4 * n, np.int64)
    put, put_element = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        put_element[k], put[k] = begin[k], begin[k] + elements[k]
    for e in range(m):
        kind[n + e] = ELEMENT
        start, at_element = clique[orphans[e], tl.C_LIST], begin[n + e]
        first, end = separators_of(orphans[e], stamp, clique)
        for s in range(start + first, start + end):
            k = node[lists[s], tl.N_LOCAL]
            near[at_element] = k
            near[put_element[k]] = n + e
            at_element += 1
            put_element[k] += 1
    for q in range(factors.size):
        i, j = ends_of(factors[q], var, fac, node)
        if j >= 0:
            near[put[i]], near[put[j]] = j, i
            put[i] += 1
            put[j] += 1
    raise_hubs(n, m, near, begin, length, elements, group)
    return order_nodes(dims, quotient, near, total, group)


@part
def raise_hubs(n: int, m: int, near: I64, begin: I64, length: I64, elements: I64, group: I64) -> None:
    """A variable joined to more than MOST_JOINED nodes of later groups goes into the last group among them.

    Eliminated before them it would join each to all others: a beacon that a whole drive has ranges to.  After the n
    variables come m elements; the group of an element is the last one of its members.
    """
    last = np.zeros(n + m, np.int64)
    for k in range(n):
        last[k] = group[k]
    for e in range(n, n + m):
        for at_member in range(begin[e], begin[e] + length[e]):
            last[e] = max(last[e], group[near[at_member]])
    for k in range(n):
        joined, highest = 0, group[k]
        for slot in range(begin[k], begin[k] + length[k]):
            beside = last[near[slot]]
            joined += 1 if beside > group[k] else 0
            highest = max(highest, beside)
        if joined > MOST_JOINED:
            group[k] = min(highest, NEWEST - 2)


@inline_kernel
def group_of(v: int, recent: int, last: int, node: I64, state: I64) -> int:
    """Its group in the order, as `order_affected` says."""
    if v == last:
        return NEWEST
    if node[v, tl.N_SEEN] > state[tl.S_STEP] - recent:
        return NEWEST - 1
    return 1 + node[v, tl.N_RING] if node[v, tl.N_NEAR] == state[tl.S_STAMP] else 0


@inline_kernel
def find_newest(count: int, var: I64) -> int:
    """The newest pose that is free, of the first `count` variables; −1: there is none."""
    v = count - 1
    while v >= 0 and (var[v, at.V_COLUMN] < 0 or not is_pose(var[v, at.V_KIND])):
        v -= 1
    return v


@part
def find_lowest(label: I64, orphans: I64, tree: Tree) -> I64:
    """Each orphan's first variable to go, label (n,) being the place in the order."""
    node, clique, lists, state = tree.node, tree.clique, tree.lists, tree.state
    lowest = take(orphans.size, tree.scratch)
    for e in range(orphans.size):
        start = clique[orphans[e], tl.C_LIST]
        first, end = separators_of(orphans[e], state[tl.S_STAMP], clique)
        low = node[lists[start + first], tl.N_LOCAL]
        for s in range(start + first + 1, start + end):
            k = node[lists[s], tl.N_LOCAL]
            if label[k] < label[low]:
                low = k
        lowest[e] = low
    return lowest


@part
def list_pairs(graph: Graph, tree: Tree, lowest: I64, factors: I64, orphans: I64) -> tuple[I64, I64]:
    """Pairs (rows, cols) that have the same fill as factors and orphans.

    An orphan joins the first variable of its separator to go, `lowest`, to the others.
    """
    var, fac = graph.var, graph.fac
    node, clique, lists, state = tree.node, tree.clique, tree.lists, tree.state
    stamp, count = state[tl.S_STAMP], 0
    for e in range(orphans.size):
        first, end = separators_of(orphans[e], stamp, clique)
        count += end - first
    rows, cols, put = np.empty(count + factors.size, np.int64), np.empty(count + factors.size, np.int64), 0
    for q in range(factors.size):
        i, j = ends_of(factors[q], var, fac, node)
        if j >= 0:
            rows[put], cols[put] = i, j
            put += 1
    for e in range(orphans.size):
        start = clique[orphans[e], tl.C_LIST]
        first, end = separators_of(orphans[e], stamp, clique)
        for s in range(start + first, start + end):
            k = node[lists[s], tl.N_LOCAL]
            if k != lowest[e]:
                rows[put], cols[put] = lowest[e], k
                put += 1
    return rows[:put], cols[:put]


@inline_kernel
def ends_of(f: int, var: I64, fac: I64, node: I64) -> tuple:
    """Local indices of the two ends of a factor between free variables; (-1, -1) of any other."""
    i, j = fac[f, at.F_I], fac[f, at.F_J]
    if j < 0 or var[i, at.V_COLUMN] < 0 or var[j, at.V_COLUMN] < 0:
        return -1, -1
    return node[i, tl.N_LOCAL], node[j, tl.N_LOCAL]
