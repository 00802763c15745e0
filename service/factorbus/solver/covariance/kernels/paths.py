"""Covariances of a few variables, along their paths to the roots.  MATH §10.2.

    Σ = R⁻¹ R⁻ᵀ,   Σ_AB = Y_Aᵀ Y_B,   Y_A = R⁻ᵀ E_A                                          (10.3)

Y_A is zero but for the cliques between A and its root, so only those are read.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.covariance.kernels.operands import Strided, Tile, VectorRows
from factorbus.solver.covariance.kernels.squares import whole_vectors
from factorbus.solver.covariance.kernels.substitute import GROUP, ColumnLayout, forward, group_of_columns
from factorbus.solver.covariance.kernels.tiles import negative_product
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree, tree_at
from factorbus.solver.kernels.jit.simd import LANES, TILE_ROWS, TILE_VECTORS
from factorbus.solver.kernels.model import layout as at


@kernel("void(int64[::1], int64[:,::1], int64[::1], int64[::1], float64[:,::1])")
def joint_block(variables: I64, var: I64, sizes: I64, tree_table: I64, out: F64) -> None:
    """The joint covariance of different free `variables`, in their order.

    in   sizes: the dimension of each kind of variable
    out  (d, d)
    """
    tree = tree_at(tree_table)
    node, clique, lists = tree.node, tree.clique, tree.lists
    order = list_paths(variables, tree)
    # Rows of the variables on the paths alone.
    layout = ColumnLayout(np.empty(len(node), np.int64), np.empty(len(node), np.int64))
    dims, start = layout.dims, layout.start
    rows, widest = 0, 0
    for c in order:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            start[lists[s]], dims[lists[s]] = rows, sizes[var[lists[s], at.V_KIND]]
            rows += dims[lists[s]]
        widest = max(widest, clique[c, tl.C_PIVOTS] + clique[c, tl.C_SEPARATOR_SCALARS])
    d = len(out)
    ld = whole_vectors(d)
    scratch = (rows + d) * ld
    a = np.zeros(scratch + widest * min(ld, GROUP * LANES))
    column = 0
    for v in variables:
        for i in range(dims[v]):
            a[(start[v] + i) * ld + column] = 1.0
            column += 1
    for c in order:
        for g in range(0, ld, GROUP * LANES):
            forward(tree, c, layout, a, group_of_columns(g, ld, scratch))
    square(rows, d, a, ld)
    for i in range(d):
        for j in range(i, d):
            out[i, j] = out[j, i] = -a[(rows + i) * ld + j]


@inline_kernel
def square(rows: int, d: int, a: F64, ld: int) -> None:
    """−YᵀY behind Y, which is at the start of `a`, as far as it is right of the diagonal."""
    for i in range(0, d, TILE_ROWS):
        for j in range(i - i % LANES, d, TILE_VECTORS * LANES):
            vectors = min(TILE_VECTORS, (d - j + LANES - 1) // LANES)
            C = Tile(min(TILE_ROWS, d - i), vectors, (rows + i) * ld + j, ld)
            negative_product(a, C, a, Strided(i, 1, ld), VectorRows(j, ld), rows)


@part
def list_paths(variables: I64, tree: Tree) -> I64:
    """The cliques from those of `variables` up to the roots, every one before its parent."""
    node, clique = tree.node, tree.clique
    depth = np.zeros(len(clique), np.int64)  # 1 at a root
    found, count, deepest = np.empty(16, np.int64), 0, 0
    for v in variables:
        first, c = count, node[v, tl.N_CLIQUE]
        while c >= 0 and depth[c] == 0:
            if count == found.size:
                larger = np.empty(2 * count, np.int64)
                for k in range(count):
                    larger[k] = found[k]
                found = larger
            found[count] = c
            count += 1
            c = clique[c, tl.C_PARENT]
        level = 0 if c < 0 else depth[c]
        for k in range(count - 1, first - 1, -1):
            level += 1
            depth[found[k]] = level
        deepest = max(deepest, level)
    begin = np.zeros(deepest + 2, np.int64)
    for k in range(count):
        begin[deepest - depth[found[k]] + 1] += 1
    for k in range(deepest):
        begin[k + 1] += begin[k]
    out = np.empty(count, np.int64)
    for k in range(count):
        level = deepest - depth[found[k]]
        out[begin[level]] = found[k]
        begin[level] += 1
    return out
