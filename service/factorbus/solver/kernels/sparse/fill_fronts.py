"""R that was made elsewhere, put into fronts."""

from factorbus.solver.kernels.jit.compile import F64, I64, kernel
from factorbus.solver.kernels.jit.simd import zero
from factorbus.solver.kernels.sparse import fronts as fr


@kernel("void(int64[:,::1], int64[::1], int64[::1], int64[::1], float64[::1], float64[::1])")
def fill_fronts(fronts: I64, separator: I64, begin: I64, rows: I64, values: F64, arena: F64) -> None:
    """The rows of R into `arena`: row k is column k of L, values[begin[k] : begin[k+1]] at `rows`, ascending.

    Columns of a front that L has no entry in are zero.
    """
    for f in range(fronts.shape[0]):
        front = fronts[f]
        p, m, ld, first = front[fr.PIVOTS], front[fr.SEPARATOR], front[fr.LD_ROWS], front[fr.COLUMN]
        for i in range(p):
            line = front[fr.ROWS] + i * ld
            zero(arena, line + i, p + m - i)
            j = 0
            for e in range(begin[first + i], begin[first + i + 1]):
                row = rows[e]
                if row < first + p:
                    arena[line + row - first] = values[e]
                else:
                    while separator[front[fr.SEPARATOR_AT] + j] != row:
                        j += 1
                    arena[line + p + j] = values[e]
