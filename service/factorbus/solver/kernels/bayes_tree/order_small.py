"""Order and fronts of few affected variables, as most steps have them: who is next to whom is in the bits of words.
MATH §9.4.

1  join    by factors, and by what hangs from them: an orphan's separator is next to itself
2  order   constrained minimum degree, exact: what is left next to a pivot becomes next to each other; of those of
           the least degree one that was next to the last pivot, if there is one, and the last of them
3  fronts  row k of R has what was next to the k-th pivot then

Variables are the local ones of an elimination, 0 to n − 1; n is `bits.MOST` at most.
"""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable, separators_of
from factorbus.solver.kernels.bayes_tree.fronts import join_fronts
from factorbus.solver.kernels.bayes_tree.order import ends_of, group_of
from factorbus.solver.kernels.bayes_tree.records import Fronts, Tree
from factorbus.solver.kernels.jit.bit_sets import count_bits, highest_bit, lowest_bit
from factorbus.solver.kernels.jit.compile import I64, inline_kernel, part
from factorbus.solver.kernels.jit.scratch import take, take_filled
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import MOST_SCALARS

NONE = -1
PLANES = MOST_SCALARS.bit_length()  # binary digits of how many scalars a variable has


@part
def join_few(graph: Graph, tree: Tree, n: int, factors: I64, orphans: I64) -> tuple[I64, I64]:
    """near (n,): who is next to each variable; hung: each orphan's separator."""
    var, fac = graph.var, graph.fac
    node, clique, lists, state = tree.node, tree.clique, tree.lists, tree.state
    near, hung = take(n, tree.scratch), take(orphans.size, tree.scratch)
    for k in range(n):
        near[k] = 1 << k
    for q in range(factors.size):
        i, j = ends_of(factors[q], var, fac, node)
        if j >= 0:
            near[i] |= 1 << j
            near[j] |= 1 << i
    for e in range(orphans.size):
        start, there = clique[orphans[e], tl.C_LIST], 0
        first, end = separators_of(orphans[e], state[tl.S_STAMP], clique)
        for s in range(start + first, start + end):
            there |= 1 << node[lists[s], tl.N_LOCAL]
        hung[e] = rest = there
        while rest != 0:
            near[lowest_bit(rest)] |= there
            rest &= rest - 1
    return near, hung


@part
def order_few(near: I64, affected: I64, recent: int, last: int, var: I64, tree: Tree) -> tuple[I64, I64, I64]:
    """perm (n,), as of `order_affected`; row (n,): what row k of R has off its diagonal; planes: for `scalars_in`.

    near is used up.
    """
    node, state, scratch = tree.node, tree.state, tree.scratch
    n, total = near.size, 0
    planes, group, degree = take_filled(PLANES, 0, scratch), take(n, scratch), take(n, scratch)
    for k in range(n):
        dim = dim_of_variable(var, affected[k])
        total += dim
        for p in range(PLANES):
            planes[p] |= (dim >> p & 1) << k
        group[k] = group_of(affected[k], recent, last, node, state)
    perm, row, queue = take(n, scratch), take(n, scratch), take_filled(total + 1, 0, scratch)
    left, own, placed = (1 << n) - 1, 0, 0
    while left != 0:
        members = first_group(left, group)
        rest = members
        while rest != 0:
            i = lowest_bit(rest)
            rest &= rest - 1
            degree[i] = scalars_in(near[i] & left & ~(1 << i), planes)
            queue[degree[i]] |= 1 << i
        lowest = 0
        while members != 0:
            while queue[lowest] == 0:
                lowest += 1
            beside = queue[lowest] & own
            me = highest_bit(beside if beside != 0 else queue[lowest])
            queue[lowest] ^= 1 << me
            members ^= 1 << me
            left ^= 1 << me
            own = near[me] & left
            perm[placed], row[placed] = me, own
            placed += 1
            rest = own
            while rest != 0:
                i = lowest_bit(rest)
                rest &= rest - 1
                near[i] |= own
                if members >> i & 1 != 0:
                    queue[degree[i]] ^= 1 << i
                    degree[i] = scalars_in(near[i] & left & ~(1 << i), planes)
                    queue[degree[i]] |= 1 << i
                    lowest = min(lowest, degree[i])
    return perm, row, planes


@inline_kernel
def first_group(left: int, group: I64) -> int:
    """Those of `left` that are in its lowest group."""
    lowest, members, rest = group[lowest_bit(left)], 0, left
    while rest != 0:
        i = lowest_bit(rest)
        rest &= rest - 1
        if group[i] < lowest:
            lowest, members = group[i], 0
        if group[i] == lowest:
            members |= 1 << i
    return members


@inline_kernel
def scalars_in(word: int, planes: I64) -> int:
    """How many scalars these variables have; planes: who has a 1 in each binary digit of it."""
    total = 0
    for p in range(PLANES):
        total += count_bits(word & planes[p]) << p
    return total


@part
def analyze_few(
    perm: I64, row: I64, planes: I64, hung: I64, affected: I64, var: I64, scratch: I64
) -> tuple[Fronts, I64]:
    """As `analyze_affected`, and lowest: each orphan's first variable to go."""
    n = perm.size
    label, dim, parent, separator = take(n, scratch), take(n, scratch), take(n, scratch), take(n, scratch)
    for k in range(n):
        label[perm[k]], dim[k] = k, dim_of_variable(var, affected[perm[k]])
    for k in range(n):
        separator[k] = scalars_in(row[k], planes)
        parent[k] = label[first_to_go(row[k], label)] if row[k] != 0 else NONE
    order, home, tops, records = join_fronts(perm, parent, dim, separator, affected, var, label, scratch)
    separator_at, separator_of = list_small_separators(tops, row, label, scratch)
    lowest = take(hung.size, scratch)
    for e in range(hung.size):
        lowest[e] = first_to_go(hung[e], label)
    return Fronts(order, label, home, records, separator_at, separator_of), lowest


@inline_kernel
def first_to_go(word: int, label: I64) -> int:
    """The variable of the set whose label is the lowest."""
    low = lowest_bit(word)
    rest = word & (word - 1)
    while rest != 0:
        i = lowest_bit(rest)
        rest &= rest - 1
        if label[i] < label[low]:
            low = i
    return low


@inline_kernel
def list_small_separators(tops: I64, row: I64, label: I64, scratch: I64) -> tuple:
    """separator_at, separator_of: the labels of each front's separator, ascending."""
    separator_at = take(tops.size + 1, scratch)
    separator_at[0] = 0
    for f in range(tops.size):
        separator_at[f + 1] = separator_at[f] + count_bits(row[tops[f]])
    separator_of, put = take(separator_at[tops.size], scratch), 0
    for f in range(tops.size):
        rest, there = row[tops[f]], 0
        while rest != 0:
            there |= 1 << label[lowest_bit(rest)]
            rest &= rest - 1
        while there != 0:
            separator_of[put] = lowest_bit(there)
            put += 1
            there &= there - 1
    return separator_at, separator_of
