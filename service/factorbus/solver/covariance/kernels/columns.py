"""Blocks of covariance between one variable and many: a column of Σ by two substitutions.  MATH §10.2.

    Rᵀ Y = E_h,   R X = Y,   X = Σ_{·h}                                                        (10.4)

Forward only the path of h is read, backward only the paths of those that are asked for.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.covariance.kernels.substitute import COLUMNS, backward, forward
from factorbus.solver.kernels import tree_layout as tl


@kernel(
    "void(int64[::1], int64[::1], int64[::1], int64[::1], int64[:,::1], int64[:,::1], int64[::1], float64[::1],"
    " int64[::1], float64[:,:,::1])"
)
def cross_blocks(
    hubs: I64, partners: I64, order: I64, scalar: I64, node: I64, clique: I64, lists: I64, numbers: F64, dims: I64,
    out: F64,
) -> None:  # fmt: skip
    """Σ between hubs[k] and partners[k]; equal hubs stand together.  An index of −1 is a fixed variable.

    in   order: all cliques, parents first   scalar: where each variable starts in a column
    out  (pairs, d, d): rows of the hub, columns of the partner; upper left corners
    """
    scalars, widest = 0, 1
    for v in range(len(dims)):
        if scalar[v] >= 0:
            scalars = max(scalars, scalar[v] + dims[v])
    rank = np.empty(len(clique), np.int64)
    for k in range(order.size):
        rank[order[k]] = k
        widest = max(widest, clique[order[k], tl.C_PIVOTS] + clique[order[k], tl.C_BORDER])
    x, local, places = np.zeros((2 * COLUMNS, scalars)), np.empty((COLUMNS, widest)), np.empty(widest, np.int64)
    stamp = np.zeros(order.size, np.int64)
    first = 0
    while first < hubs.size:
        last, hub = first + 1, int(hubs[first])
        while last < hubs.size and hubs[last] == hub:
            last += 1
        if hub >= 0:
            lowest = mark(hub, first + 1, node, clique, rank, stamp, 0)
            for k in range(first, last):
                if partners[k] >= 0:
                    lowest = mark(partners[k], first + 1, node, clique, rank, stamp, lowest)
            for g in range(0, dims[hub], COLUMNS):
                for k in range(lowest + 1):
                    if stamp[k] == first + 1:
                        clear(clique[order[k]], lists, dims, scalar, g, x)
                for a in range(g, min(g + COLUMNS, dims[hub])):
                    x[a, scalar[hub] + a] = 1.0
                c = node[hub, tl.N_CLIQUE]
                while c >= 0:
                    forward(clique[c], lists, numbers, dims, scalar, g, places, local, x)
                    c = clique[c, tl.C_PARENT]
                for k in range(lowest + 1):
                    if stamp[k] == first + 1:
                        backward(clique[order[k]], lists, numbers, dims, scalar, g, places, local, x)
        for k in range(first, last):
            put_block(hub, partners[k], dims, scalar, x, out[k])
        first = last


@inline_kernel
def mark(v: int, stamp: int, node: I64, clique: I64, rank: I64, stamps: I64, lowest: int) -> int:
    """Mark the path of v; gives the last place in the order that is marked."""
    c, last = node[v, tl.N_CLIQUE], lowest
    while c >= 0 and stamps[rank[c]] != stamp:
        stamps[rank[c]] = stamp
        last = max(last, int(rank[c]))
        c = clique[c, tl.C_PARENT]
    return last


@inline_kernel
def clear(row: I64, lists: I64, dims: I64, scalar: I64, first: int, x: F64) -> None:
    """Zero at a clique's frontals."""
    for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
        start = scalar[lists[s]]
        for b in range(start, start + dims[lists[s]]):
            x[first, b] = x[first + 1, b] = x[first + 2, b] = 0.0


@inline_kernel
def put_block(hub: int, partner: int, dims: I64, scalar: I64, x: F64, out: F64) -> None:
    """A block from a column."""
    if hub < 0 or partner < 0:
        out[:, :] = 0.0
        return
    start = scalar[partner]
    for a in range(dims[hub]):
        for b in range(dims[partner]):
            out[a, b] = x[a, start + b]
