"""The covariance of every variable and, on the way, of every one with a certain other.  MATH §10.1, §10.2.

Rows [ K  T ] of a clique are there when its Σ_FS and Σ_FF are made; with Y = R⁻ᵀ E_h, zero but for the path of h,

    X_F = T Y_F − K X_S,   X = Σ_{·h}                                                        (10.11)

so that R is not gone through again.
"""

import numpy as np

from factorbus.solver.covariance.kernels.columns import forward_path
from factorbus.solver.covariance.kernels.compile import F64, I64, kernel, part
from factorbus.solver.covariance.kernels.operands import Strided, Tile, VectorRows
from factorbus.solver.covariance.kernels.squares import (
    gather_separator_block,
    height,
    put_blocks,
    row_length,
    solve_square,
    square_size,
    whole_vectors,
    working_size,
)
from factorbus.solver.covariance.kernels.substitute import (
    ColumnLayout,
    RightSides,
    gather_rows,
    prefetch_rows,
    scatter_rows,
)
from factorbus.solver.covariance.kernels.tiles import negative_product
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree, tree_at
from factorbus.solver.kernels.jit.simd import LANES

AHEAD = 3  # cliques: it takes that long for rows to come into the cache


@kernel("void(int64[::1], int64, int64[::1], int64[::1], int64[::1], float64[:,:,::1], float64[:,:,::1])")
def whole_blocks(order: I64, hub: int, tree_table: I64, dims: I64, start: I64, out: F64, column: F64) -> None:
    """The covariance of every free variable; and with `hub`, unless that is −1.

    in   order: all cliques, depth first   dims, start: see `ColumnLayout`
    out  out (n, d, d)  column (n, d, d): rows of the hub; upper left corners, the rest stays
    """
    tree, layout = tree_at(tree_table), ColumnLayout(dims, start)
    clique = tree.clique
    depth, starts = np.zeros(len(clique), np.int64), np.zeros(order.size + 1, np.int64)
    scalars, widest = 0, 0
    for v in range(len(dims)):
        if start[v] >= 0:
            scalars = max(scalars, start[v] + dims[v])
    for c in order:
        widest = max(widest, 2 * clique[c, tl.C_PIVOTS] + clique[c, tl.C_SEPARATOR_SCALARS])
    width = dims[hub] if hub >= 0 else 0
    ldx = whole_vectors(width)
    x, block_rows = RightSides(0, ldx, ldx // LANES, scalars * ldx), column[:, :width]
    starts[0] = x.scratch + widest * ldx
    a = np.empty(squares_size(tree, order, starts[0]))
    on_path = np.zeros(len(clique), np.bool_)
    if hub >= 0:
        forward_path(hub, tree, layout, a, x)
        c = tree.node[hub, tl.N_CLIQUE]
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
        square = starts[depth[c]]
        starts[depth[c] + 1] = square + square_size(row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS])
        prefetch_rows(tree, order[min(k + AHEAD, order.size - 1)])
        if parent >= 0:
            gather_separator_block(tree, c, dims, places, runs, a, starts[depth[c] - 1], square)
        solve_square(tree, c, a, square, row[tl.C_CHILD] >= 0)
        put_blocks(tree, c, dims, a, square, out)
        if hub >= 0:
            put_column(tree, c, layout, a, square, x, on_path[c], block_rows)


@part
def squares_size(tree: Tree, order: I64, first: int) -> int:
    """Doubles for the squares of a clique and of those above it, where that is most, behind `first`."""
    clique = tree.clique
    end, most = np.zeros(len(clique), np.int64), first
    for c in order:
        p, m, parent = clique[c, tl.C_PIVOTS], clique[c, tl.C_SEPARATOR_SCALARS], clique[c, tl.C_PARENT]
        start = end[parent] if parent >= 0 else first
        end[c] = start + square_size(p, m)
        most = max(most, start + working_size(p, m))
    return most


@part
def put_column(
    tree: Tree, c: int, layout: ColumnLayout, a: F64, square: int, x: RightSides, on_path: bool, out: F64
) -> None:
    """X_F (10.11) in place of Y_F, from the rows behind the square of clique c, and its blocks, out (n, d, ·)."""
    row, ldx = tree.clique[c], x.ld
    p, m, first = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS], row[tl.C_LIST]
    middle = first + row[tl.C_FRONTALS]
    frontals, separator = tree.lists[first:middle], tree.lists[middle : middle + row[tl.C_SEPARATORS]]
    wide, high = whole_vectors(p + m), height(p)
    w, depth, result = square + (2 * p + m) * row_length(p, m), m, x.scratch + (m + p) * ldx
    gather_rows(separator, layout, a, x, x.scratch)
    if on_path:
        depth = m + p
        gather_rows(frontals, layout, a, x, result)
        for i in range(p):
            for q in range(ldx):
                a[x.scratch + (m + p - 1 - i) * ldx + q] = -a[result + i * ldx + q]
    for i in range(0, p, high):
        C = Tile(min(high, p - i), x.vectors, result + i * ldx, ldx)
        negative_product(a, C, a, Strided(w + i * wide, wide, 1), VectorRows(x.scratch, ldx), depth)
    scatter_rows(frontals, layout, a, x, result)
    for s in range(frontals.size):
        block, d = out[frontals[s]], layout.dims[frontals[s]]
        for j in range(d):
            for i in range(len(block)):
                block[i, j] = a[result + j * ldx + i]
        result += d * ldx
