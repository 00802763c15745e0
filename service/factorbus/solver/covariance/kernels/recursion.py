"""All covariances on the pattern of R, from the roots down.  MATH §10.1.

Of a clique with rows [ R_F  R_S ] and the covariance of its separator,

    T = R_F⁻¹,   K = T R_S,   Σ_FS = −K Σ_SS,   Σ_FF = T Tᵀ − Σ_FS Kᵀ                        (10.2)

Its children's separators lie in F ∪ S, so that their Σ_SS are parts of this.  Cliques are visited depth first, and the
covariances of those above the present one stand in a pile.  What has not changed, and hangs on nothing that has, need
not be visited again.
"""

import numpy as np

from factorbus.solver.covariance.kernels.changed_blocks import BlockChanges, has_changed_separator, mark_changed
from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.covariance.kernels.squares import (
    gather_separator_block,
    put_blocks,
    solve_square,
    square_size,
    working_size,
)
from factorbus.solver.covariance.kernels.substitute import prefetch_rows
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import tree_at


@kernel("int64(int64[:,::1], int64[:,::1], int64[::1])")
def list_cliques(node: I64, clique: I64, order: I64) -> int:
    """Cliques that hold variables, depth first from the roots; returns how many there are."""
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


@kernel("int64(int64[:,::1], int64[:,::1], int64[::1])")
def list_root_cliques(node: I64, clique: I64, roots: I64) -> int:
    """Cliques without a parent that hold variables; returns how many there are."""
    count = 0
    for v in range(len(node)):
        c = node[v, tl.N_CLIQUE]
        if c >= 0 and node[v, tl.N_PLACE] == 0 and clique[c, tl.C_PARENT] < 0:
            roots[count] = c
            count += 1
    return count


@kernel("int64(int64[::1], int64[::1], int64[::1], int64, int64, int64[::1], float64[:,:,::1])")
def diagonal_blocks(roots: I64, tree_table: I64, dims: I64, since: int, step: int, changed_at: I64, out: F64) -> int:
    """The covariance of every variable in the trees of `roots`; returns the number of cliques it was computed for.

    in   since: a clique that was not eliminated after that, and whose separator's blocks are as they were in `out`, is
         left as it is, with all below; −1: none is
         step: `changed_at` of variables gets it where their blocks changed
    out  (n, d, d): upper left corners
    """
    tree, changes = tree_at(tree_table), BlockChanges(changed_at, step)
    clique = tree.clique
    a, used, column, runs = np.empty(1 << 14), 0, np.empty(len(dims), np.int64), np.empty(5, np.int64)
    starts = np.zeros(len(clique) + 2, np.int64)
    for root in roots:
        c, depth = int(root), 0
        while c >= 0:
            row, child = clique[c], -1
            if since < 0 or row[tl.C_MARK] > since or has_changed_separator(tree, c, changes):
                p, m = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS]
                if starts[depth] + working_size(p, m) > a.size:
                    a = enlarged(a, starts[depth], 2 * (starts[depth] + working_size(p, m)))
                if 5 * (p + m) > runs.size:
                    runs = np.empty(10 * (p + m), np.int64)
                child = row[tl.C_CHILD]
                after = child if child >= 0 else row[tl.C_NEXT]
                if after >= 0:
                    prefetch_rows(tree, after)
                starts[depth + 1] = starts[depth] + square_size(p, m)
                if m > 0:
                    gather_separator_block(tree, c, dims, column, runs, a, starts[depth - 1], starts[depth])
                solve_square(tree, c, a, starts[depth], child >= 0)
                if since >= 0:
                    mark_changed(tree, c, dims, a, starts[depth], changes, out)
                put_blocks(tree, c, dims, a, starts[depth], out)
                used += 1
            while child < 0 and clique[c, tl.C_PARENT] >= 0:
                child, c, depth = clique[c, tl.C_NEXT], clique[c, tl.C_PARENT], depth - 1
            c, depth = child, depth + 1
    return used


@part
def enlarged(a: F64, kept: int, size: int) -> F64:
    """A copy of the first `kept` with room for `size`."""
    larger = np.empty(size)
    for k in range(kept):
        larger[k] = a[k]
    return larger
