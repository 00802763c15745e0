"""The downdate of all blocks of covariance by new factors between old variables.  MATH §10.6.

    Y = R⁻ᵀ Hᵀ L,   C Cᵀ = G = I − Yᵀ Y,   Z = R⁻¹ Y C⁻ᵀ,   Σ := Σ − Z Zᵀ                    (10.10)

Y is zero but for the paths of the factors' variables; of Z Zᵀ only what is within a variable is made.
"""

import math

import numpy as np
from numpy.typing import NDArray

from factorbus.solver.covariance.kernels.changed_blocks import NEGLIGIBLE, BlockChanges, has_changed_separator
from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.covariance.kernels.paths import list_paths
from factorbus.solver.covariance.kernels.recursion import following
from factorbus.solver.covariance.kernels.squares import whole_vectors
from factorbus.solver.covariance.kernels.substitute import (
    GROUP,
    ColumnLayout,
    RightSides,
    backward,
    forward,
    group_of_columns,
    prefetch_rows,
)
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree, tree_at
from factorbus.solver.kernels.jit.simd import LANES, zero

NEAR_SINGULAR, DONE = 0, 1
# The smallest eigenvalue that G may have: the share that other factors have in what a factor measures.  Of what is
# subtracted, that many times the rounding error is lost.
LEAST_EIGENVALUE = 1e-6


@kernel("void(int64[:,::1], int64[::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1])")
def weighted_jacobians(ends: I64, sizes: I64, A: F64, B: F64, W: F64, H: F64) -> None:
    """Hᵀ L of factors, Ω = L Lᵀ.

    in   ends (k, 2), −1: none or fixed   sizes (k,): of r   A, B (k, 6, 6): Jacobians   W (k, 6, 6): Ω
    out  H (2 k, 6, ranks): of the first and the second end of each factor, side by side; has to be zero before
    """
    L, column = np.empty((6, 6)), 0
    for k in range(sizes.size):
        d = sizes[k]
        for i in range(d):
            for j in range(i + 1):
                total = W[k, i, j]
                for q in range(j):
                    total -= L[i, q] * L[j, q]
                L[i, j] = math.sqrt(total) if i == j else total / L[j, j]
        for e in range(2):
            if ends[k, e] < 0:
                continue
            J, out = A[k] if e == 0 else B[k], H[2 * k + e]
            for i in range(len(out)):
                for j in range(d):
                    total = 0.0
                    for q in range(j, d):
                        total += J[q, i] * L[q, j]
                    out[i, column + j] = total
        column += d


@kernel("int64(int64[::1], float64[:,:,::1], int64[::1], int64[::1], int64[::1], int64, int64[::1], float64[:,:,::1])")
def downdate_blocks(
    ends: I64, H: F64, tree_table: I64, dims: I64, start: I64, step: int, changed_at: I64, blocks: F64
) -> int:
    """Take from `blocks` what factors tell; NEAR_SINGULAR, and nothing done, if G may be too near to singular.

    Where no more than a negligible share of a variance is taken from a separator, nothing is done below it.

    in   ends (e,): variables, −1: none   H (e, 6, ranks): what Hᵀ L has in their rows
         dims, start: see `ColumnLayout`
         step: `changed_at` of variables gets it where more is taken
    out  blocks (n, d, d): of the variables up to n
    """
    tree, layout, ranks, scalars = tree_at(tree_table), ColumnLayout(dims, start), H.shape[2], 0
    clique, lists = tree.clique, tree.lists
    for v in range(len(dims)):
        if start[v] >= 0:
            scalars = max(scalars, start[v] + dims[v])
    ld = whole_vectors(ranks)
    a, scratch = np.empty(2 * scalars * ld), scalars * ld
    path = list_paths(without_gaps(ends), tree)
    for c in path:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            zero(a, start[lists[s]] * ld, dims[lists[s]] * ld)
    add_rows(ends, H, layout, a, ld)
    for c in path:
        for g in range(0, ld, GROUP * LANES):
            forward(tree, c, layout, a, group_of_columns(g, ld, scratch))
    if scale(path, tree, layout, a, ld, ranks) == NEAR_SINGULAR:
        return NEAR_SINGULAR
    on_path = np.zeros(len(clique), np.bool_)
    for c in path:
        on_path[c] = True
    changes, x = BlockChanges(changed_at, step), group_of_columns(0, ld, scratch)
    for c in path:
        if clique[c, tl.C_PARENT] < 0:
            descend(c, on_path, tree, layout, a, x, changes, blocks)
    return DONE


@part
def descend(
    root: int, on_path: NDArray[np.bool_], tree: Tree, layout: ColumnLayout, a: F64, x: RightSides,
    changes: BlockChanges, blocks: F64,
) -> None:  # fmt: skip
    """Z and what it takes from the blocks, from a root down to where it is negligible."""
    clique, lists, dims, start, ld = tree.clique, tree.lists, layout.dims, layout.start, x.ld
    c = root
    while c >= 0:
        row, child = clique[c], -1
        if on_path[c] or has_changed_separator(tree, c, changes):
            child = row[tl.C_CHILD]
            after = child if child >= 0 else row[tl.C_NEXT]
            if after >= 0:
                prefetch_rows(tree, after)
            for g in range(0, ld, GROUP * LANES):
                backward(tree, c, layout, a, group_of_columns(g, ld, x.scratch), not on_path[c])
            for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
                v = lists[s]
                if v >= len(blocks):
                    changed = True
                elif dims[v] == 3 and ld == 4:  # with constants the loops are unrolled
                    changed = subtract_square(a, start[v] * 4, 4, 3, blocks[v])
                else:
                    changed = subtract_square(a, start[v] * ld, ld, dims[v], blocks[v])
                if changed:
                    changes.at[v] = changes.step
        c = following(c, child, clique)


@part
def without_gaps(ends: I64) -> I64:
    """The variables of `ends`, without −1; some may come twice."""
    found, count = np.empty(ends.size, np.int64), 0
    for v in ends:
        if v >= 0:
            found[count] = v
            count += 1
    return found[:count]


@part
def add_rows(ends: I64, H: F64, layout: ColumnLayout, a: F64, ld: int) -> None:
    """Add Hᵀ L in the rows of the factors' variables."""
    dims, start = layout.dims, layout.start
    for e in range(ends.size):
        v = ends[e]
        if v < 0:
            continue
        for i in range(dims[v]):
            place = (start[v] + i) * ld
            for j in range(H.shape[2]):
                a[place + j] += H[e, i, j]


@part
def scale(path: I64, tree: Tree, layout: ColumnLayout, a: F64, ld: int, ranks: int) -> int:
    """Y := Y C⁻ᵀ,  unless 1/tr G⁻¹, which no eigenvalue of G is below, is less than LEAST_EIGENVALUE."""
    clique, lists, dims, start = tree.clique, tree.lists, layout.dims, layout.start
    C = np.zeros((ranks, ranks))
    for c in path:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            for line in range(start[lists[s]] * ld, (start[lists[s]] + dims[lists[s]]) * ld, ld):
                for i in range(ranks):
                    for j in range(i + 1):
                        C[i, j] -= a[line + i] * a[line + j]
    for i in range(ranks):
        C[i, i] += 1.0
        for j in range(i + 1):
            total = C[i, j]
            for q in range(j):
                total -= C[i, q] * C[j, q]
            if i == j and not total >= LEAST_EIGENVALUE:
                return NEAR_SINGULAR
            C[i, j] = math.sqrt(total) if i == j else total / C[j, j]
    if trace_of_inverse(ranks, C) * LEAST_EIGENVALUE > 1.0:
        return NEAR_SINGULAR
    for c in path:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            for line in range(start[lists[s]] * ld, (start[lists[s]] + dims[lists[s]]) * ld, ld):
                for i in range(ranks):
                    total = a[line + i]
                    for j in range(i):
                        total -= a[line + j] * C[i, j]
                    a[line + i] = total / C[i, i]
    return DONE


@inline_kernel
def trace_of_inverse(n: int, C: F64) -> float:
    """Of (C Cᵀ)⁻¹: the sum of the squares of C⁻¹."""
    total, x = 0.0, np.empty(n)
    for column in range(n):
        for i in range(column, n):
            value = 1.0 if i == column else 0.0
            for q in range(column, i):
                value -= C[i, q] * x[q]
            x[i] = value / C[i, i]
            total += x[i] * x[i]
    return total


@inline_kernel
def subtract_square(a: F64, first: int, ld: int, d: int, block: F64) -> bool:
    """block −= Z Zᵀ with the rows of Z at `first`; whether that was more than a negligible share of a variance."""
    more = False
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            for q in range(ld):
                total += a[first + i * ld + q] * a[first + j * ld + q]
            if i == j and total > NEGLIGIBLE * block[i, i]:
                more = True
            block[i, j] -= total
            if i != j:
                block[j, i] = block[i, j]
    return more
