"""What a panel of R, rows top .. end of a front, takes off the rows behind it: most of what a large front takes."""

from factorbus.solver.kernels.jit.compile import F64, inline_kernel
from factorbus.solver.kernels.jit.simd import LANES, TILE_ROWS, TILE_VECTORS, Block, Panel, tile
from factorbus.solver.kernels.sparse.fronts import Front, padded_size, update_row, update_stride

DEPTH = 128  # rows of a panel: with WIDTH columns they fit the second level cache
WIDTH = 192


@inline_kernel
def take_panel_off(a: F64, front: Front, top: int, end: int, low: int, high: int) -> None:
    """Rows low .. high of the front, of R and then of U, lose what the panel has in their columns.

    low: `end` or behind it by a multiple of TILE_ROWS; in U, p + i with i such a multiple.
    """
    r, ld, p, m, u, width = front
    lead, above = padded_size(p) - p, r + top * ld
    for i in range(low, min(high, p), TILE_ROWS):
        take_off(a, min(TILE_ROWS, p - i), Block(r + i * ld, ld), Panel(above, ld, end - top), i, i, p + m, lead)
    first, last = max(low - p, 0), high - p
    for left in range(first - first % WIDTH, m, WIDTH):
        right = min(left + WIDTH, m)
        for i in range(first, min(last, right), TILE_ROWS):
            line = Block(u + update_row(i, width), update_stride(i, width))
            take_off(a, min(TILE_ROWS, m - i), line, Panel(above + p, ld, end - top), i, max(i, left), right, 0)


@inline_kernel
def take_off(a: F64, rows: int, C: Block, X: Panel, i: int, first: int, last: int, lead: int) -> None:
    """Columns first .. last of `rows` rows C, from row i of a matrix on, lose what XᵀX has there.

    Columns are counted so that column −lead is at a multiple of LANES; whole vectors are worked on.
    """
    j = first - (lead + first) % LANES
    vectors = (last - j + LANES - 1) // LANES
    while vectors > 0:
        some = min(vectors, TILE_VECTORS)
        tile(a, rows, some, Block(C.start + j, C.ld), Panel(X.start + i, X.ld, X.depth), X.start + j)
        j += some * LANES
        vectors -= some
