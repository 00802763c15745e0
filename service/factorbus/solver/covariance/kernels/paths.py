"""Covariances of a few variables, along their paths to the roots.  MATH §10.2.

    Σ = R⁻¹ R⁻ᵀ,   Σ_AB = Y_Aᵀ Y_B,   Y_A = R⁻ᵀ E_A                                          (10.3)

Y_A is zero but for the cliques between A and its root, so only those are read.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, kernel, part
from factorbus.solver.covariance.kernels.substitute import COLUMNS, forward
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl


@kernel(
    "void(int64[::1], int64[:,::1], int64[::1], int64[:,::1], int64[:,::1], int64[::1], float64[::1], float64[:,::1])"
)
def joint_block(
    variables: I64, var: I64, sizes: I64, node: I64, clique: I64, lists: I64, numbers: F64, out: F64
) -> None:
    """The joint covariance of different free `variables`, in their order.

    in   sizes: the dimension of each kind of variable
    out  (d, d)
    """
    order = list_paths(variables, node, clique)
    row_of, dims = np.empty(len(node), np.int64), np.empty(len(node), np.int64)
    rows, widest = 0, 0
    for c in order:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            row_of[lists[s]], dims[lists[s]] = rows, sizes[var[lists[s], at.V_KIND]]
            rows += dims[lists[s]]
        widest = max(widest, clique[c, tl.C_PIVOTS] + clique[c, tl.C_BORDER])
    d = len(out)
    groups = (d + COLUMNS - 1) // COLUMNS
    y, local, places = np.zeros((groups * COLUMNS, rows)), np.empty((COLUMNS, widest)), np.empty(widest, np.int64)
    column = 0
    for v in variables:
        for a in range(dims[v]):
            y[column, row_of[v] + a] = 1.0
            column += 1
    for c in order:
        for g in range(groups):
            forward(clique[c], lists, numbers, dims, row_of, g * COLUMNS, places, local, y)
    for i in range(d):
        for j in range(i, d):
            total, yi, yj = 0.0, y[i], y[j]
            for k in range(rows):
                total += yi[k] * yj[k]
            out[i, j] = out[j, i] = total


@part
def list_paths(variables: I64, node: I64, clique: I64) -> I64:
    """The cliques from those of `variables` up to the roots, every one before its parent."""
    depth = np.zeros(len(clique), np.int64)  # 1 at a root
    found, count, deepest = np.empty(16, np.int64), 0, 0
    for v in variables:
        first, c = count, node[v, tl.N_CLIQUE]
        while c >= 0 and depth[c] == 0:
            if count == found.size:
                larger = np.empty(2 * count, np.int64)
                larger[:count] = found
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
