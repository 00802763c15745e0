"""Blocks of covariance between one variable and many: a column of Σ by two substitutions.  MATH §10.2.

    Rᵀ Y = E_h,   R X = Y,   X = Σ_{·h}                                                        (10.4)

Forward only the path of h is read, backward only the paths of those that are asked for.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.covariance.kernels.squares import whole_vectors
from factorbus.solver.covariance.kernels.substitute import (
    ColumnLayout,
    RightSides,
    backward,
    forward,
    prefetch_rows,
)
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree, tree_at
from factorbus.solver.kernels.jit.simd import LANES, zero


@kernel("void(int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], float64[:,:,:])")
def cross_blocks(
    hubs: I64, partners: I64, places: I64, tree_table: I64, order: I64, dims: I64, start: I64, out: F64
) -> None:
    """Σ between hubs[k] and partners[k]; equal hubs stand together.  An index of −1 is a fixed variable.

    in   order: all cliques, parents first   dims, start: see `ColumnLayout`
    out  (pairs, d, d): rows of the hub, columns of the partner; block k at places[k]; upper left corners, the rest
         stays
    """
    tree, layout = tree_at(tree_table), ColumnLayout(dims, start)
    clique = tree.clique
    scalars, widest, deepest = 0, 1, 1
    for v in range(len(dims)):
        if start[v] >= 0:
            scalars, deepest = max(scalars, start[v] + dims[v]), max(deepest, dims[v])
    rank = np.empty(len(clique), np.int64)
    for k in range(order.size):
        rank[order[k]] = k
        widest = max(widest, clique[order[k], tl.C_PIVOTS] + clique[order[k], tl.C_SEPARATOR_SCALARS])
    ldx = whole_vectors(deepest)
    a = np.empty((scalars + widest) * ldx)
    stamp, path = np.zeros(order.size, np.int64), np.zeros(order.size, np.int64)
    first = 0
    while first < hubs.size:
        last, hub = first + 1, int(hubs[first])
        while last < hubs.size and hubs[last] == hub:
            last += 1
        if hub >= 0:
            lowest = mark_path(hub, first + 1, tree, rank, path, 0)
            for k in range(first, last):
                if partners[k] >= 0:
                    lowest = mark_path(partners[k], first + 1, tree, rank, stamp, lowest)
            x = RightSides(0, ldx, whole_vectors(dims[hub]) // LANES, scalars * ldx)
            forward_path(hub, tree, layout, a, x)
            for k in range(lowest + 1):
                if stamp[k] == first + 1 or path[k] == first + 1:
                    prefetch_rows(tree, order[min(k + 1, lowest)])
                    backward(tree, order[k], layout, a, x, path[k] != first + 1)
        for k in range(first, last):
            put_cross_block(hub, partners[k], layout, a, ldx, out[places[k]])
        first = last


@inline_kernel
def mark_path(v: int, stamp: int, tree: Tree, rank: I64, stamps: I64, lowest: int) -> int:
    """Mark the path of v; returns the last place in the order that is marked."""
    clique = tree.clique
    c, last = tree.node[v, tl.N_CLIQUE], lowest
    while c >= 0 and stamps[rank[c]] != stamp:
        stamps[rank[c]] = stamp
        last = max(last, int(rank[c]))
        c = clique[c, tl.C_PARENT]
    return last


@part
def forward_path(hub: int, tree: Tree, layout: ColumnLayout, a: F64, x: RightSides) -> None:
    """X = R⁻ᵀ E of the hub, on its path to the root."""
    clique, lists, dims, start = tree.clique, tree.lists, layout.dims, layout.start
    c = tree.node[hub, tl.N_CLIQUE]
    while c >= 0:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            zero(a, x.at + start[lists[s]] * x.ld, dims[lists[s]] * x.ld)
        c = clique[c, tl.C_PARENT]
    for k in range(dims[hub]):
        a[x.at + (start[hub] + k) * x.ld + k] = 1.0
    c = tree.node[hub, tl.N_CLIQUE]
    while c >= 0:
        forward(tree, c, layout, a, x)
        c = clique[c, tl.C_PARENT]


@inline_kernel
def put_cross_block(hub: int, partner: int, layout: ColumnLayout, a: F64, ldx: int, out: F64) -> None:
    """A block from the columns."""
    if hub < 0 or partner < 0:
        out[:, :] = 0.0
        return
    first = layout.start[partner]
    for i in range(layout.dims[hub]):
        for j in range(layout.dims[partner]):
            out[i, j] = a[(first + j) * ldx + i]
