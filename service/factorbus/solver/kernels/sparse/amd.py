"""Constrained approximate minimum degree on a graph of weighted nodes.

After Amestoy, Davis and Duff, "An approximate minimum degree ordering algorithm" (1996) and "Algorithm 837: AMD"
(2004): a quotient graph whose eliminated nodes are elements (cliques), approximate external degrees, mass elimination,
indistinguishable nodes found by hashing, absorption of elements, aggressive too.  A node of dim d weighs d, so degrees
count scalars.  Constraint groups as in CAMD: only nodes of the present group may be pivots.

Nodes of the same degree are in a list, doubly linked: head, after, before.
"""

from typing import NamedTuple

import numpy as np

from factorbus.solver.kernels.jit.compile import I64, inline_kernel, kernel, part

NONE = -1
NODE, ELEMENT, GONE = 0, 1, 2


class QuotientGraph(NamedTuple):
    """Nodes, and behind them elements; each array has an entry for each (nodes + elements,).

    begin, length  the list of a live node i is lists[begin[i] : begin[i] + length[i]]: elements, then nodes; that of an
                   element holds nodes
    elements       how many elements the list of a node has
    kind           NODE, ELEMENT or GONE
    degree         approximate external degree of a node; what an element weighs
    weight         0 for what is absorbed, and negative for the nodes of the element that is being made
    mark           |Lₑ ∖ Lₚ| + clock where element e was met in this step; 0 where it is absorbed
    """

    begin: I64
    length: I64
    elements: I64
    kind: I64
    degree: I64
    weight: I64
    mark: I64


class _Members(NamedTuple):
    """The nodes that became one with a node i: i, after[i], and so on to last[i], whose next is NONE."""

    after: I64
    last: I64


@inline_kernel
def quotient_graph(begin: I64, length: I64) -> QuotientGraph:
    """The graph of these lists, of nodes alone.  Elements are marked in `elements`, `kind` and `degree`."""
    room = begin.size
    elements, kind, degree = np.zeros(room, np.int64), np.zeros(room, np.int64), np.zeros(room, np.int64)
    return QuotientGraph(begin, length, elements, kind, degree, np.ones(room, np.int64), np.ones(room, np.int64))


@kernel("int64[::1](int64[::1], int64[::1], int64[::1], int64[::1])")
def amd(dims: I64, rows: I64, cols: I64, group: I64) -> I64:
    """Elimination order of n nodes: perm[k] is eliminated k-th; lower groups go first.

    in   dims (n,) > 0   rows, cols (m,): each pair once, loops ignored   group (n,) >= 0
    """
    n = dims.size
    begin, length, lists = _graph(n, rows, cols)
    used = begin[-1] + length[-1] if n > 0 else 0
    return order_nodes(dims, quotient_graph(begin, length), lists, used, group)


@part
def order_nodes(dims: I64, graph: QuotientGraph, lists: I64, used: int, group: I64) -> I64:
    """The elimination order of the nodes of a quotient graph that may have elements from the start.

    dims, group (nodes,)   lists: of the graph, with room behind the first `used`
    The graph is used up.
    """
    begin, length, elements, kind, degree, weight, mark = graph
    n, total, left, room = dims.size, 0, 0, begin.size
    length_at_first = length[:n].copy()
    dense = max(16.0, 10.0 * np.sqrt(n))
    for i in range(n):
        weight[i] = dims[i]
        total += dims[i]
        if length[i] > dense:  # its place barely matters and its degree costs much: it becomes last of its group
            weight[i], kind[i] = 0, GONE
        left += weight[i]
    _first_degrees(n, left, graph, lists)
    members_of = _Members(np.full(n, NONE), np.arange(n))
    next_member = members_of.after
    head, after, before = np.full(total + 1, NONE), np.full(n, NONE), np.full(n, NONE)
    bucket, chain, code = np.full(n, NONE), np.full(n, NONE), np.zeros(n, np.int64)
    members, member_from = _by_group(group)
    perm = np.empty(n, np.int64)

    placed, clock, widest = 0, np.int64(2), 0
    for e in range(n, room):
        widest = max(widest, degree[e])
    for g in range(member_from.size - 1):
        lowest, waiting = _open_group(members[member_from[g] : member_from[g + 1]], weight, degree, head, after, before)
        while waiting > 0:
            # 1  the pivot: a node of least approximate degree
            while head[lowest] == NONE:
                lowest += 1
            me = head[lowest]
            _drop(me, degree, head, after, before)
            need = length[me]
            for p in range(begin[me], begin[me] + elements[me]):
                need += length[lists[p]]
            if used + need > lists.size:
                lists, used = _compact(need, graph, lists)
            # 2  its neighbours become the element Lₚ; elements next to it are absorbed
            own = weight[me]
            weight[me] = -own
            start = used
            width = 0
            own_end = begin[me] + length[me]
            for p in range(begin[me], begin[me] + elements[me] + 1):
                if p < begin[me] + elements[me]:
                    e = lists[p]
                    kind[e], mark[e] = GONE, 0
                    first, last = begin[e], begin[e] + length[e]
                else:
                    first, last = p, own_end
                for s in range(first, last):
                    i = lists[s]
                    if weight[i] > 0:
                        width += weight[i]
                        weight[i] = -weight[i]
                        lists[used] = i
                        used += 1
                        if group[i] == g:
                            _drop(i, degree, head, after, before)
            kind[me], elements[me], begin[me], length[me] = ELEMENT, 0, start, used - start
            # 3  |Lₑ ∖ Lₚ| of every element e next to a node of Lₚ
            for p in range(start, used):
                i = lists[p]
                for s in range(begin[i], begin[i] + elements[i]):
                    e = lists[s]
                    if mark[e] >= clock:
                        mark[e] += weight[i]
                    elif mark[e] != 0:
                        mark[e] = degree[e] + clock + weight[i]
            # 4  approximate degrees; a node with no other neighbours goes with the pivot
            for p in range(start, used):
                i = lists[p]
                external, hashed = _update(i, me, clock, graph, lists)
                if external == 0 and group[i] == g:
                    own -= weight[i]
                    width += weight[i]
                    _absorb(i, me, graph, members_of)
                    continue
                degree[i] = min(degree[i], external)
                code[i] = hashed % n
                chain[i] = bucket[code[i]]
                bucket[code[i]] = i
            widest = max(widest, width)
            clock += widest + 1
            # 5  nodes of Lₚ with the same neighbours become one
            for p in range(start, used):
                if weight[lists[p]] != 0:
                    h = code[lists[p]]
                    i, bucket[h] = bucket[h], NONE
                    while i != NONE and chain[i] != NONE:
                        _merge_twins(i, clock, graph, lists, group, chain, members_of)
                        clock += 1
                        i = chain[i]
            # 6  the nodes return to the queue, the pivot and what went with it leave
            waiting -= own
            left -= own
            put = start
            for p in range(start, used):
                i = lists[p]
                if weight[i] == 0:
                    continue
                weight[i] = -weight[i]
                degree[i] = min(degree[i] + width, left) - weight[i]
                lists[put] = i
                put += 1
                if group[i] == g:
                    _push(i, degree, head, after, before)
                    lowest = min(lowest, degree[i])
            used, length[me], degree[me], weight[me] = put, put - start, width, own
            while me != NONE:
                perm[placed] = me
                placed += 1
                me = next_member[me]
        for q in range(member_from[g], member_from[g + 1]):
            if length_at_first[members[q]] > dense:
                perm[placed] = members[q]
                placed += 1
    return perm


@part
def _graph(n: int, rows: I64, cols: I64) -> tuple[I64, I64, I64]:
    """Neighbour lists, with room for the elements to come."""
    length = np.zeros(n, np.int64)
    for e in range(rows.size):
        if rows[e] != cols[e]:
            length[rows[e]] += 1
            length[cols[e]] += 1
    begin, total = np.empty(n, np.int64), 0
    for i in range(n):
        begin[i] = total
        total += length[i]
    lists, put = np.empty(total + total // 2 + 4 * n, np.int64), begin.copy()
    for e in range(rows.size):
        i, j = rows[e], cols[e]
        if i != j:
            lists[put[i]] = j
            lists[put[j]] = i
            put[i] += 1
            put[j] += 1
    return begin, length, lists


@part
def _first_degrees(n: int, left: int, graph: QuotientGraph, lists: I64) -> None:
    begin, length, elements, degree, weight = graph.begin, graph.length, graph.elements, graph.degree, graph.weight
    for i in range(n):
        degree[i] = 0
        for p in range(begin[i], begin[i] + length[i]):
            near = lists[p]
            degree[i] += degree[near] - weight[i] if p < begin[i] + elements[i] else weight[near]
        degree[i] = max(min(degree[i], left - weight[i]), 0)


@part
def _by_group(group: I64) -> tuple[I64, I64]:
    """Nodes sorted by group, and where each group starts."""
    groups = 0
    for i in range(group.size):
        groups = max(groups, group[i] + 1)
    start = np.zeros(groups + 1, np.int64)
    for i in range(group.size):
        start[group[i] + 1] += 1
    for g in range(groups):
        start[g + 1] += start[g]
    members, put = np.empty(group.size, np.int64), start.copy()
    for i in range(group.size):
        members[put[group[i]]] = i
        put[group[i]] += 1
    return members, start


@part
def _open_group(members: I64, weight: I64, degree: I64, head: I64, after: I64, before: I64) -> tuple:
    """Queue the nodes of a group; gives the least degree and the weight of all."""
    lowest, waiting = head.size - 1, 0
    for i in members:
        if weight[i] > 0:
            _push(i, degree, head, after, before)
            lowest = min(lowest, degree[i])
            waiting += weight[i]
    return lowest, waiting


@inline_kernel
def _push(i: int, degree: I64, head: I64, after: I64, before: I64) -> None:
    first = head[degree[i]]
    head[degree[i]], after[i], before[i] = i, first, NONE
    if first != NONE:
        before[first] = i


@inline_kernel
def _drop(i: int, degree: I64, head: I64, after: I64, before: I64) -> None:
    if before[i] == NONE:
        head[degree[i]] = after[i]
    else:
        after[before[i]] = after[i]
    if after[i] != NONE:
        before[after[i]] = before[i]


@inline_kernel
def _update(i: int, me: int, clock: int, graph: QuotientGraph, lists: I64) -> tuple:
    """Rewrite the list of i without what is absorbed and with `me`; gives its degree outside Lₚ and a hash."""
    begin, length, elements, kind, _, weight, mark = graph
    first = begin[i]
    put, external, hashed = first, 0, 0
    for s in range(first, first + elements[i]):
        e = lists[s]
        if mark[e] > clock:
            external += mark[e] - clock
            hashed += e
            lists[put] = e
            put += 1
        elif mark[e] != 0:  # all of it lies in Lₚ: aggressive absorption
            kind[e], mark[e] = GONE, 0
    nodes = put
    for s in range(first + elements[i], first + length[i]):
        j = lists[s]
        if weight[j] > 0:
            external += weight[j]
            hashed += j
            lists[put] = j
            put += 1
    # i lost at least `me` or an absorbed element, so there is room for one more: first in the list
    lists[put] = lists[nodes]
    lists[nodes] = lists[first]
    lists[first] = me
    elements[i], length[i] = nodes - first + 1, put - first + 1
    return external, hashed


@inline_kernel
def _absorb(i: int, into: int, graph: QuotientGraph, members_of: _Members) -> None:
    graph.kind[i], graph.weight[i] = GONE, 0
    members_of.after[members_of.last[into]], members_of.last[into] = i, members_of.last[i]


@part
def _merge_twins(
    i: int, clock: int, graph: QuotientGraph, lists: I64, group: I64, chain: I64, members_of: _Members
) -> None:
    """Absorb into i the nodes behind it in its hash chain that have the same list."""
    begin, length, elements, _, _, weight, mark = graph
    for s in range(begin[i] + 1, begin[i] + length[i]):
        mark[lists[s]] = clock
    previous, j = i, chain[i]
    while j != NONE:
        same = length[j] == length[i] and elements[j] == elements[i] and group[j] == group[i]
        s = begin[j] + 1
        while same and s < begin[j] + length[j]:
            same = mark[lists[s]] == clock
            s += 1
        following = chain[j]
        if same:
            weight[i] += weight[j]
            _absorb(j, i, graph, members_of)
            chain[previous] = following
        else:
            previous = j
        j = following


@part
def _compact(need: int, graph: QuotientGraph, lists: I64) -> tuple:
    """Copy the living lists together, with room for `need` more."""
    begin, length, kind, weight = graph.begin, graph.length, graph.kind, graph.weight
    alive = 0
    for i in range(begin.size):
        if kind[i] == ELEMENT or weight[i] != 0:
            alive += length[i]
    fresh, used = np.empty(max(lists.size, 2 * (alive + need)), np.int64), 0
    for i in range(begin.size):
        if kind[i] == ELEMENT or weight[i] != 0:
            for p in range(length[i]):
                fresh[used + p] = lists[begin[i] + p]
            begin[i] = used
            used += length[i]
    return fresh, used
