"""Blocks of covariance between one variable and many: a column of Σ by two substitutions.  MATH §10.2.

    Rᵀ Y = E_h,   R X = Y,   X = Σ_{·h}                                                        (10.4)

Forward only the path of h is read, backward only the paths of those that are asked for.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.covariance.kernels.squares import padded
from factorbus.solver.covariance.kernels.substitute import backward, fetch, forward
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.simd import LANES, put, zero
from factorbus.solver.kernels.jit.simd import at as load


@kernel(
    "void(int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64[:,::1], int64[:,::1], int64[::1],"
    " float64[::1], int64[::1], boolean, float64[:,:,::1])"
)
def cross_blocks(
    hubs: I64, partners: I64, places: I64, order: I64, scalar: I64, node: I64, clique: I64, lists: I64, numbers: F64,
    dims: I64, turned: bool, out: F64,
) -> None:  # fmt: skip
    """Σ between hubs[k] and partners[k]; equal hubs stand together.  An index of −1 is a fixed variable.

    in   order: all cliques, parents first   scalar: where each variable starts in a column
    out  (pairs, d, d): rows of the hub, columns of the partner, or the transpose; block k at places[k]; upper left
         corners, the rest stays
    """
    scalars, widest, deepest = 0, 1, 1
    for v in range(len(dims)):
        if scalar[v] >= 0:
            scalars, deepest = max(scalars, scalar[v] + dims[v]), max(deepest, dims[v])
    rank = np.empty(len(clique), np.int64)
    for k in range(order.size):
        rank[order[k]] = k
        widest = max(widest, clique[order[k], tl.C_PIVOTS] + clique[order[k], tl.C_BORDER])
    ldx = padded(deepest)
    a, local = np.empty((scalars + widest) * ldx), scalars * ldx
    stamp, path = np.zeros(order.size, np.int64), np.zeros(order.size, np.int64)
    first = 0
    while first < hubs.size:
        last, hub = first + 1, int(hubs[first])
        while last < hubs.size and hubs[last] == hub:
            last += 1
        if hub >= 0:
            lowest = mark(hub, first + 1, node, clique, rank, path, 0)
            for k in range(first, last):
                if partners[k] >= 0:
                    lowest = mark(partners[k], first + 1, node, clique, rank, stamp, lowest)
            vectors = padded(dims[hub]) // LANES
            climb(hub, lists, numbers, dims, scalar, node, clique, a, ldx, vectors, local)
            for k in range(lowest + 1):
                if stamp[k] == first + 1 or path[k] == first + 1:
                    fetch(clique[order[min(k + 1, lowest)]], numbers)
                    fresh = path[k] != first + 1
                    backward(clique[order[k]], lists, numbers, dims, scalar, a, 0, ldx, vectors, local, fresh)
        for k in range(first, last):
            put_block(hub, partners[k], dims, scalar, a, ldx, turned, out[places[k]])
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


@part
def climb(
    hub: int, lists: I64, numbers: F64, dims: I64, scalar: I64, node: I64, clique: I64, a: F64, ldx: int, vectors: int,
    local: int,
) -> None:  # fmt: skip
    """Y = R⁻ᵀ E of the hub, on its path."""
    c = node[hub, tl.N_CLIQUE]
    while c >= 0:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            zero(a, scalar[lists[s]] * ldx, dims[lists[s]] * ldx)
        c = clique[c, tl.C_PARENT]
    for k in range(dims[hub]):
        put(a, (scalar[hub] + k) * ldx + k, 1.0)
    c = node[hub, tl.N_CLIQUE]
    while c >= 0:
        forward(clique[c], lists, numbers, dims, scalar, a, 0, ldx, vectors, local)
        c = clique[c, tl.C_PARENT]


@inline_kernel
def put_block(hub: int, partner: int, dims: I64, scalar: I64, a: F64, ldx: int, turned: bool, out: F64) -> None:
    """A block from the columns."""
    if hub < 0 or partner < 0:
        out[:, :] = 0.0
        return
    start = scalar[partner]
    for i in range(dims[hub]):
        for j in range(dims[partner]):
            value = load(a, (start + j) * ldx + i)
            if turned:
                out[j, i] = value
            else:
                out[i, j] = value
