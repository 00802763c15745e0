"""What a panel of R, rows top .. end of a front, takes off the rows behind it: most of what a large front takes."""

from factorbus.solver.kernels.jit.compile import F64, inline_kernel
from factorbus.solver.kernels.jit.simd import LANES, TILE_ROWS, TILE_VECTORS, tile
from factorbus.solver.kernels.sparse.fronts import padded, update_row, update_stride

DEPTH = 128  # rows of a panel: with WIDTH columns they fit the second level cache
WIDTH = 192


@inline_kernel
def take_panel_off(
    a: F64, r: int, ld: int, p: int, m: int, u: int, width: int, top: int, end: int, low: int, high: int
) -> None:
    """Rows low .. high of the front, of R and then of U, lose what the panel has in their columns.

    r, ld, p, m, u, width: as in `factor_front`.  low: `end` or behind it by a multiple of TILE_ROWS; in U, p + i with i
    such a multiple.
    """
    for i in range(low, min(high, p), TILE_ROWS):
        take_off(a, min(TILE_ROWS, p - i), r + i * ld, ld, r + top * ld, ld, i, i, p + m, padded(p) - p, end - top)
    first, last = max(low - p, 0), high - p
    for left in range(first - first % WIDTH, m, WIDTH):
        right = min(left + WIDTH, m)
        for i in range(first, min(last, right), TILE_ROWS):
            row, stride = u + update_row(i, width), update_stride(i, width)
            rows = min(TILE_ROWS, m - i)
            take_off(a, rows, row, stride, r + top * ld + p, ld, i, max(i, left), right, 0, end - top)


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
