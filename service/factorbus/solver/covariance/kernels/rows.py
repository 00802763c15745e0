"""R by itself: the rows of all cliques, copied out of the tree's arena one behind the other."""

from factorbus.solver.covariance.kernels.compile import F64, I64, kernel
from factorbus.solver.kernels.bayes_tree import layout as tl


@kernel("int64(int64[::1], int64[:,::1])")
def size_of_rows(order: I64, clique: I64) -> int:
    """Doubles in the rows of the cliques `order`."""
    size = 0
    for c in order:
        size += clique[c, tl.C_PIVOTS] * (clique[c, tl.C_PIVOTS] + clique[c, tl.C_SEPARATOR_SCALARS])
    return size


@kernel("void(int64[::1], int64[:,::1], float64[::1], float64[::1])")
def copy_rows(order: I64, clique: I64, numbers: F64, out: F64) -> None:
    """Rows of the cliques `order` into `out`; their records, a copy, say where they are now."""
    first = 0
    for c in order:
        row = clique[c]
        p, width, ld = row[tl.C_PIVOTS], row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS], row[tl.C_LD]
        for i in range(p):
            start = row[tl.C_ROWS] + i * ld
            for k in range(i, width):
                out[first + i * width + k] = numbers[start + k]
        row[tl.C_ROWS], row[tl.C_LD] = first, width
        first += p * width
