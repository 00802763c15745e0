"""The covariance of every variable and, on the way, of every one with a certain other.  MATH §10.1, §10.2.

Rows [ K  T ] of a clique are there when its Σ_FS and Σ_FF are made; with Y = R⁻ᵀ E_h, zero but for the path of h,

    X_F = T Y_F − K X_S,   X = Σ_{·h}                                                        (10.11)

so that R is not gone through again.
"""

import numpy as np

from factorbus.solver.covariance.kernels.columns import climb
from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.covariance.kernels.squares import (
    gather,
    height,
    padded,
    row_length,
    solve_clique,
    square_size,
    working_size,
)
from factorbus.solver.covariance.kernels.substitute import collect, distribute, fetch
from factorbus.solver.covariance.kernels.tiles import negative
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.simd import LANES, put
from factorbus.solver.kernels.jit.simd import at as load

AHEAD = 3  # cliques: it takes that long for rows to come into the cache


@kernel(
    "void(int64[::1], int64, int64[:,::1], int64[::1], int64[:,::1], int64[::1], float64[::1], int64[::1],"
    " float64[:,:,::1], float64[:,:,::1])"
)
def whole_blocks(
    order: I64,
    hub: int,
    node: I64,
    scalar: I64,
    clique: I64,
    lists: I64,
    numbers: F64,
    dims: I64,
    out: F64,
    column: F64,
) -> None:
    """The covariance of every free variable; and with `hub`, unless that is −1.

    in   order: all cliques, depth first   scalar: where each variable starts in a column, −1: fixed
    out  out (n, d, d)  column (n, d, d): rows of the hub; upper left corners, the rest stays
    """
    depth, starts = np.zeros(len(clique), np.int64), np.zeros(order.size + 1, np.int64)
    scalars, widest = 0, 0
    for v in range(len(dims)):
        if scalar[v] >= 0:
            scalars = max(scalars, scalar[v] + dims[v])
    for c in order:
        widest = max(widest, 2 * clique[c, tl.C_PIVOTS] + clique[c, tl.C_BORDER])
    ldx = padded(dims[hub]) if hub >= 0 else 0
    local = scalars * ldx
    starts[0] = local + widest * ldx
    a = np.empty(room(order, starts[0], clique))
    on_path = np.zeros(len(clique), np.bool_)
    if hub >= 0:
        climb(hub, lists, numbers, dims, scalar, node, clique, a, ldx, ldx // LANES, local)
        c = node[hub, tl.N_CLIQUE]
        while c >= 0:
            on_path[c] = True
            c = clique[c, tl.C_PARENT]
    # Room for the widest clique's runs.
    runs, places = np.empty(5 * widest + 1, np.int64), np.empty(len(dims), np.int64)
    for k in range(order.size):
        c = order[k]
        row = clique[c]
        parent = row[tl.C_PARENT]
        if parent >= 0:
            depth[c] = depth[parent] + 1
        start = starts[depth[c]]
        starts[depth[c] + 1] = start + square_size(row[tl.C_PIVOTS], row[tl.C_BORDER])
        fetch(clique[order[min(k + AHEAD, order.size - 1)]], numbers)
        if parent >= 0:
            gather(row, clique[parent], lists, dims, places, runs, a, starts[depth[c] - 1], start)
        solve_clique(row, numbers, a, start, row[tl.C_CHILD] >= 0)
        put_blocks(row, lists, dims, a, start, out)
        if hub >= 0:
            put_column(row, on_path[c], lists, dims, scalar, a, start, ldx, local, dims[hub], column)


@part
def room(order: I64, first: int, clique: I64) -> int:
    """Doubles for the squares of a clique and of those above it, where that is most, behind `first`."""
    end, most = np.zeros(len(clique), np.int64), first
    for c in order:
        p, m, parent = clique[c, tl.C_PIVOTS], clique[c, tl.C_BORDER], clique[c, tl.C_PARENT]
        start = end[parent] if parent >= 0 else first
        end[c] = start + square_size(p, m)
        most = max(most, start + working_size(p, m))
    return most


@inline_kernel
def put_blocks(row: I64, lists: I64, dims: I64, a: F64, target: int, out: F64) -> None:
    """The diagonal blocks of a clique's frontals."""
    ld, corner = row_length(row[tl.C_PIVOTS], row[tl.C_BORDER]), target
    for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
        block, d = out[lists[s]], dims[lists[s]]
        for i in range(d):
            for j in range(i, d):
                block[i, j] = block[j, i] = load(a, corner + i * ld + j)
        corner += d * (ld + 1)


@part
def put_column(
    row: I64, on_path: bool, lists: I64, dims: I64, scalar: I64, a: F64, target: int, ldx: int, local: int, d: int,
    column: F64,
) -> None:  # fmt: skip
    """X_F (10.11) in place of Y_F, from the rows behind the square at `target`, and its blocks."""
    p, m, frontals, first = row[tl.C_PIVOTS], row[tl.C_BORDER], row[tl.C_FRONTALS], row[tl.C_LIST]
    wide, high, vectors = padded(p + m), height(p), ldx // LANES
    w, depth = target + (2 * p + m) * row_length(p, m), m
    collect(first + frontals, row[tl.C_SEPARATORS], lists, dims, scalar, a, 0, ldx, vectors, local)
    result = local + (m + p) * ldx
    if on_path:
        depth = m + p
        collect(first, frontals, lists, dims, scalar, a, 0, ldx, vectors, result)
        for i in range(p):
            for q in range(ldx):
                put(a, local + (m + p - 1 - i) * ldx + q, -load(a, result + i * ldx + q))
    for i in range(0, p, high):
        negative(a, min(high, p - i), vectors, result + i * ldx, ldx, a, w + i * wide, wide, 1, local, ldx, depth)
    distribute(first, frontals, lists, dims, scalar, a, 0, ldx, vectors, result)
    for s in range(first, first + frontals):
        block = column[lists[s]]
        for j in range(dims[lists[s]]):
            for i in range(d):
                block[i, j] = load(a, result + j * ldx + i)
        result += dims[lists[s]] * ldx
