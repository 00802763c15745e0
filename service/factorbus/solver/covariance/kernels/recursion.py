"""All covariances on the pattern of R, from the roots down.  MATH §10.1.

Of a clique with rows [ R_F  R_S ] and the covariance of its separator,

    T = R_F⁻¹,   K = T R_S,   Σ_FS = −K Σ_SS,   Σ_FF = T Tᵀ − Σ_FS Kᵀ                        (10.2)

Its children's separators lie in F ∪ S, so that their Σ_SS are parts of this.  Cliques are visited depth first, and the
covariances of those above the present one stand in a pile.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.covariance.kernels.squares import (
    gather,
    room_of,
    row_length,
    solve_clique,
    square_size,
    working_size,
)
from factorbus.solver.covariance.kernels.substitute import fetch
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels.simd import at as load


@kernel("int64(int64[:,::1], int64[:,::1], int64[::1])")
def list_cliques(node: I64, clique: I64, order: I64) -> int:
    """Cliques that hold variables, depth first from the roots; gives how many there are."""
    count = 0
    for v in range(len(node)):
        c = node[v, tl.N_CLIQUE]
        if c < 0 or node[v, tl.N_PLACE] != 0 or clique[c, tl.C_PARENT] >= 0:
            continue
        while c >= 0:
            order[count] = c
            count += 1
            c = following(c, clique[c, tl.C_CHILD], clique)
    return count


@inline_kernel
def following(c: int, child: int, clique: I64) -> int:
    """The clique that comes after c, depth first, when `child` is the first below it that is gone down to; −1: none."""
    while child < 0 and clique[c, tl.C_PARENT] >= 0:
        child, c = clique[c, tl.C_NEXT], clique[c, tl.C_PARENT]
    return int(child)


@kernel("void(int64[::1], int64[:,::1], int64[::1], float64[::1], int64[::1], float64[:,:,::1])")
def diagonal_blocks(order: I64, clique: I64, lists: I64, numbers: F64, dims: I64, out: F64) -> None:
    """The covariance of every variable that is a frontal in one of the cliques `order`, as `list_cliques` gives them.

    out  (n, d, d): upper left corners
    """
    starts, level, widest, first, size = lay_out(order, clique)
    a = np.empty(size)
    column, runs = np.empty(len(dims), np.int64), np.empty(5 * widest, np.int64)
    starts[0] = first
    for k in range(order.size):
        c = order[k]
        row, depth = clique[c], level[c]
        fetch(clique[order[min(k + 1, order.size - 1)]], numbers)
        starts[depth + 1] = starts[depth] + square_size(row[tl.C_PIVOTS], row[tl.C_BORDER])
        if row[tl.C_BORDER] > 0:
            above = clique[row[tl.C_PARENT]]
            gather(row, above, lists, dims, column, runs, a, starts[depth - 1], starts[depth])
        solve_clique(row, numbers, a, starts[depth], row[tl.C_CHILD] >= 0)
        put_diagonal(row, lists, dims, a, starts[depth], out)


@part
def lay_out(order: I64, clique: I64) -> tuple:
    """Room for the pile of a clique's covariance and those of all above it, behind the scratch.

    out  starts (levels + 2,): for whoever fills it   level (cliques,)
         the widest clique, scalars; where the pile starts; doubles in all
    """
    level = np.empty(len(clique), np.int64)
    deepest, widest, first = 0, 1, 0
    for c in order:
        above = clique[c, tl.C_PARENT]
        level[c] = 0 if above < 0 else level[above] + 1
        deepest = max(deepest, level[c])
        p, m = clique[c, tl.C_PIVOTS], clique[c, tl.C_BORDER]
        widest, first = max(widest, p + m), max(first, room_of(p, m))
    starts = np.zeros(deepest + 2, np.int64)
    size, starts[0] = first, first
    for c in order:
        starts[level[c] + 1] = starts[level[c]] + square_size(clique[c, tl.C_PIVOTS], clique[c, tl.C_BORDER])
        size = max(size, starts[level[c]] + working_size(clique[c, tl.C_PIVOTS], clique[c, tl.C_BORDER]))
    return starts, level, widest, first, size


@inline_kernel
def put_diagonal(row: I64, lists: I64, dims: I64, a: F64, target: int, out: F64) -> None:
    """The diagonal blocks of a clique's frontals."""
    ld, scalar = row_length(row[tl.C_PIVOTS], row[tl.C_BORDER]), 0
    for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
        d = dims[lists[s]]
        for i in range(d):
            start = target + (scalar + i) * ld + scalar
            for j in range(d):
                out[lists[s], i, j] = load(a, start + j)
        scalar += d
