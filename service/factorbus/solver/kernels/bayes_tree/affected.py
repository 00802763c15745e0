"""Which cliques a step affects, and what is left of the tree without them.  MATH §9.3.

A factor changes the clique that eliminates the first of its variables, and with its update matrix all cliques above.
Of a clique only the frontals from the first touched one on are affected: the rows before stay as they are.
"""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.scratch import take
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import dim_of


@inline_kernel
def touch(v: int, node: I64, clique: I64, state: I64, marked: I64, count: int) -> int:
    """Mark the clique of variable v from its place on, and those above; gives the count of marked cliques."""
    c, place, stamp = node[v, tl.N_CLIQUE], node[v, tl.N_PLACE], state[tl.S_STAMP]
    while c >= 0:
        if clique[c, tl.C_MARK] == stamp:
            if place < clique[c, tl.C_FIRST]:
                clique[c, tl.C_FIRST] = place
            break
        clique[c, tl.C_MARK], clique[c, tl.C_FIRST] = stamp, place
        marked[count] = c
        count += 1
        place = clique[c, tl.C_ABOVE]
        c = clique[c, tl.C_PARENT]
    return count


@part
def detach(graph: Graph, tree: Tree, marked: I64, settings: F64, affected: I64, orphans: I64) -> tuple[int, int]:
    """List the affected variables and the cliques that hang from them; gives how many there are of each.

    A marked clique is taken whole (C_FIRST becomes 0) or split (C_FIRST stays, and it is an orphan itself).  Nothing is
    changed but marks, so a step that fails has nothing to undo here.
    """
    var = graph.var
    node, clique, lists, state = tree.node, tree.clique, tree.lists, tree.state
    stamp, n, hanging = state[tl.S_STAMP], 0, 0
    for k in range(marked.size):
        c = marked[k]
        start, first = clique[c, tl.C_LIST], clique[c, tl.C_FIRST]
        if first > 0 and is_split(c, first, settings, var, clique, lists):
            orphans[hanging] = c
            hanging += 1
        else:
            clique[c, tl.C_FIRST] = first = 0
        for place in range(first, clique[c, tl.C_FRONTALS]):
            v = lists[start + place]
            node[v, tl.N_STAMP], node[v, tl.N_LOCAL] = stamp, n
            affected[n] = v
            n += 1
        child = clique[c, tl.C_CHILD]
        while child >= 0:
            if clique[child, tl.C_ABOVE] >= first and clique[child, tl.C_MARK] != stamp:
                orphans[hanging] = child
                hanging += 1
            child = clique[child, tl.C_NEXT]
    return n, hanging


@inline_kernel
def is_split(c: int, first: int, settings: F64, var: I64, clique: I64, lists: I64) -> bool:
    """Whether the frontals before place `first` are worth keeping."""
    pivots = clique[c, tl.C_PIVOTS]
    if pivots <= settings[tl.P_SPLIT_MIN_PIVOTS]:
        return False
    kept, start = 0, clique[c, tl.C_LIST]
    for place in range(first):
        kept += dim_of_variable(var, lists[start + place])
    return pivots - kept <= settings[tl.P_SPLIT_MAX_AFFECTED] * pivots


@inline_kernel
def dim_of_variable(var: I64, v: int) -> int:
    """Scalars of variable v."""
    return dim_of(var[v, at.V_KIND])


@inline_kernel
def separators_of(c: int, stamp: int, clique: I64) -> tuple:
    """(first, end) in its list of what an orphan hangs by: the separator; of a split clique also the frontals lost."""
    end = clique[c, tl.C_FRONTALS] + clique[c, tl.C_SEPARATORS]
    first = clique[c, tl.C_FIRST] if clique[c, tl.C_MARK] == stamp else clique[c, tl.C_FRONTALS]
    return first, end


@part
def gather_factors(graph: Graph, tree: Tree, affected: I64, f0: int, f1: int) -> I64:
    """The factors whose variables are all affected: those that affected variables own, and the new ones f0 .. f1−1."""
    node, link, fac, var = tree.node, tree.link, graph.fac, graph.var
    n, count = affected.size, 0
    for f in range(f0, f1):
        if has_free(f, var, fac):
            count += 1
    for k in range(n):
        f = node[affected[k], tl.N_OWN]
        while f >= 0:
            count += 1
            f = link[f, tl.L_OWN]
    found, put = take(count, tree.scratch), 0
    for k in range(n):
        f = node[affected[k], tl.N_OWN]
        while f >= 0:
            found[put] = f
            put += 1
            f = link[f, tl.L_OWN]
    for f in range(f0, f1):
        if has_free(f, var, fac):
            found[put] = f
            put += 1
    return found


@inline_kernel
def has_free(f: int, var: I64, fac: I64) -> bool:
    """Whether any end of factor f is estimated."""
    j = fac[f, at.F_J]
    return var[fac[f, at.F_I], at.V_COLUMN] >= 0 or (j >= 0 and var[j, at.V_COLUMN] >= 0)
