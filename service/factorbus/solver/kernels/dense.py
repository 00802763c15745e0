"""Partial Cholesky of one dense front: p pivots out of p + m, the rest becomes the update matrix.

    [ A  B ]   [ Rᵀ   ] [ R  S ]          RᵀR = A,  S = R⁻ᵀB,  U = C − SᵀS
    [ ·  C ] = [ Sᵀ I ] [ 0  U ]

Rows are made four at a time, each tile of a row group held in registers while all earlier rows of the panel are
taken off it, so every number is loaded and stored once per panel.
"""

import math

from factorbus.solver.kernels._jit import F64, inline_kernel, kernel
from factorbus.solver.kernels.fronts import padded, update_row, update_stride
from factorbus.solver.kernels.simd import LANES, TILE_ROWS, TILE_VECTORS, at, put, solve_rows, tile

DEPTH = 128  # rows of a panel: with WIDTH columns they fit the second level cache
WIDTH = 192

# A pivot is what cancellation leaves of the diagonal entry Λₖₖ, with a rounding error of some ε·Λₖₖ.  Measured: the
# pivots of a free grid of 100 poses, zero in truth, come out at 4e-15·Λₖₖ or below zero, while the least pivot of a
# chain of 30,000 poses held at one end only and eliminated from there, poor but real, is 1e-11·Λₖₖ.
PIVOT_TOLERANCE = 1e-13


@kernel(
    "int64(float64[::1], int64, int64, int64, int64, int64, int64, float64[::1], int64)",
)
def factor_front(a: F64, r: int, ld: int, p: int, m: int, u: int, width: int, floors: F64, k: int) -> int:
    """Factorise a front in place; the layout is that of `fronts`.  Gives the pivot that failed, or -1.

    in   r, ld: its p rows over p + m columns   u, width: its m x m update matrix
         floors[k + i]: pivot i must exceed it
    out  rows: R and S   update matrix: U
    """
    for top in range(0, p, DEPTH):
        end = min(top + DEPTH, p)
        for i in range(top, end, TILE_ROWS):
            rows = min(TILE_ROWS, end - i)
            take_off(a, rows, r + i * ld, ld, r + top * ld, ld, i, i, p + m, padded(p) - p, i - top)
            failed = pivot_rows(a, rows, r + i * ld + i, ld, floors, k + i)
            if failed >= 0:
                return i + failed
            lead = padded(p) - p
            first = i - (lead + i) % LANES
            solve_rows(a, rows, (padded(lead + p + m) - lead - first) // LANES, r + i * ld + first, ld, 0)
        for i in range(end, p, TILE_ROWS):
            take_off(a, min(TILE_ROWS, p - i), r + i * ld, ld, r + top * ld, ld, i, i, p + m, padded(p) - p, end - top)
        for left in range(0, m, WIDTH):
            right = min(left + WIDTH, m)
            for i in range(0, right, TILE_ROWS):
                rows = min(TILE_ROWS, m - i)
                row, stride = u + update_row(i, width), update_stride(i, width)
                take_off(a, rows, row, stride, r + top * ld + p, ld, i, max(i, left), right, 0, end - top)
    return -1


@inline_kernel
def take_off(
    a: F64, rows: int, c: int, ldc: int, x: int, ld: int, i: int, first: int, last: int, lead: int, depth: int
) -> None:
    """Columns first .. last of `rows` rows at c (row i of a matrix) lose XᵀX, X of `depth` rows at x.

    Columns are counted so that column −lead is at a multiple of LANES; whole vectors are worked on.
    """
    j = first - (lead + first) % LANES
    vectors = (last - j + LANES - 1) // LANES
    while vectors > 0:
        some = min(vectors, TILE_VECTORS)
        tile(a, rows, some, c + j, ldc, x + i, x + j, ld, depth)
        j += some * LANES
        vectors -= some


@inline_kernel
def pivot_rows(a: F64, rows: int, d: int, ld: int, floors: F64, k: int) -> int:
    """Cholesky of the `rows` x `rows` block at d into the scratch at 0; gives the pivot that failed, or -1.

    Scratch: 1/T₀₀ 1/T₁₁ 1/T₂₂ 1/T₃₃ T₀₁ T₀₂ T₁₂ T₀₃ T₁₃ T₂₃.
    """
    for j in range(rows):
        for i in range(j):
            above = at(a, d + i * ld + j)
            for q in range(i):
                above -= at(a, 4 + i * (i - 1) // 2 + q) * at(a, 4 + j * (j - 1) // 2 + q)
            put(a, 4 + j * (j - 1) // 2 + i, above * at(a, i))
        pivot = at(a, d + j * ld + j)
        for q in range(j):
            pivot -= at(a, 4 + j * (j - 1) // 2 + q) ** 2
        if not (pivot > floors[k + j] and pivot > 0.0):
            return j
        put(a, j, 1.0 / math.sqrt(pivot))
    return -1
