"""The covariance of one clique's variables as a square in an arena, and how it is made.  MATH (10.2).

A square has a row for every scalar, frontals first, and as many columns, those of the separator from a multiple of
LANES on; p further rows behind it are scratch.  So whole vectors can be worked on, and what is beyond a matrix is
overwritten before it is read.  An arena begins with 16 doubles of scratch, then room for [ R_S  I ] and R_Fᵀ, both with
the pivots in reverse, which makes of back-substitution the forward kind that `simd.solve_rows` does; then for [ K T ]ᵀ.
"""

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels.simd import LANES, TILE_ROWS, TILE_VECTORS, put, solve_rows, tile
from factorbus.solver.kernels.simd import at as load

_SCRATCH = 16
_DIMS = 6  # of the largest variable


@inline_kernel
def padded(count: int) -> int:
    """The next multiple of LANES."""
    return (count + LANES - 1) & ~(LANES - 1)


@inline_kernel
def row_length(p: int, m: int) -> int:
    """Doubles from one row of a square to the next."""
    return padded(p) + padded(m)


@inline_kernel
def square_size(p: int, m: int) -> int:
    """Doubles that a square takes."""
    return (2 * p + m) * row_length(p, m) + LANES


@inline_kernel
def room_of(p: int, m: int) -> int:
    """Where the first square may start: doubles of scratch for a clique."""
    return _SCRATCH + 2 * p * padded(p + m) + (p + m) * row_length(p, m) + 2 * LANES


@part
def gather(
    row: I64, above: I64, lists: I64, dims: I64, column: I64, places: I64, a: F64, source: int, target: int
) -> None:
    """Σ_SS into the square at `target`, from that of the parent at `source`.

    column, places: scratch
    """
    scalar = 0
    for s in range(above[tl.C_LIST], above[tl.C_LIST] + above[tl.C_FRONTALS] + above[tl.C_SEPARATORS]):
        column[lists[s]] = scalar
        scalar += dims[lists[s]]
    wide, pivots = row_length(above[tl.C_PIVOTS], above[tl.C_BORDER]), above[tl.C_PIVOTS]
    gap = padded(pivots) - pivots
    m, start = 0, row[tl.C_LIST] + row[tl.C_FRONTALS]
    for s in range(start, start + row[tl.C_SEPARATORS]):
        first = column[lists[s]]
        for k in range(first, first + dims[lists[s]]):
            places[2 * m] = source + k * wide
            places[2 * m + 1] = k + gap if k >= pivots else k
            m += 1
    p = row[tl.C_PIVOTS]
    ld = row_length(p, m)
    for i in range(m):
        line, into = places[2 * i], target + (p + i) * ld + padded(p)
        for j in range(m):
            put(a, into + j, load(a, line + places[2 * j + 1]))


@part
def solve_clique(row: I64, numbers: F64, a: F64, target: int, whole: bool) -> None:
    """The square at `target` has Σ_SS and gets Σ_FS, Σ_SF and Σ_FF; unless `whole`, of that only what is near its
    diagonal.
    """
    p, m = row[tl.C_PIVOTS], row[tl.C_BORDER]
    ld, border = row_length(p, m), padded(p)
    w = _SCRATCH + 2 * p * padded(p + m) + LANES
    solve_rows_of(row, numbers, a, ld, w)
    for i in range(p):
        for j in range(m):
            put(a, target + i * ld + border + j, 0.0)
    product(p, m, m, a, target + border, ld, w, target + p * ld + border, ld)
    for i in range(p):
        line = target + i * ld
        for j in range(m):
            put(a, target + (p + j) * ld + i, load(a, line + border + j))
        for j in range(p):
            put(a, target + (p + m + j) * ld + i, -load(a, w + (m + j) * ld + i))
            put(a, line + j, 0.0)
    for i in range(0, p, TILE_ROWS):
        rows = min(TILE_ROWS, p - i)
        first = i & ~(LANES - 1)
        last = p if whole else min(p, i + TILE_ROWS + _DIMS)
        across(rows, last - first, m + p, a, target + i * ld + first, ld, target + p * ld + i, w + first, ld)
    for i in range(p):
        for j in range(i + 1, p):
            put(a, target + j * ld + i, load(a, target + i * ld + j))


@part
def solve_rows_of(row: I64, numbers: F64, a: F64, ld: int, w: int) -> None:
    """[ K T ]ᵀ at w, rows `ld` apart, from R_F [ K T ] = [ R_S I ]."""
    p, m, start, step = row[tl.C_PIVOTS], row[tl.C_BORDER], row[tl.C_ROWS], row[tl.C_LD]
    width = p + m
    wide = padded(width)
    turned = _SCRATCH + p * wide
    for i in range(p):
        source, v = start + (p - 1 - i) * step, _SCRATCH + i * wide
        for j in range(m):
            put(a, v + j, load(numbers, source + p + j))
        for j in range(p):
            put(a, v + m + j, 0.0)
        put(a, v + m + p - 1 - i, 1.0)
        for k in range(i):
            put(a, turned + k * wide + i, load(numbers, source + p - 1 - k))
        put(a, turned + i * wide + i, load(numbers, source + p - 1 - i))
    for top in range(0, p, TILE_ROWS):
        rows, v = min(TILE_ROWS, p - top), _SCRATCH + top * wide
        across(rows, width, top, a, v, wide, turned + top, _SCRATCH, wide)
        corner = turned + top * wide + top
        for j in range(rows):
            put(a, j, 1.0 / load(a, corner + j * wide + j))
            for i in range(j):
                put(a, 4 + j * (j - 1) // 2 + i, load(a, corner + i * wide + j))
        solve_rows(a, rows, wide // LANES, v, wide, 0)
    for i in range(p):
        v = _SCRATCH + (p - 1 - i) * wide
        for k in range(width):
            put(a, w + k * ld + i, load(a, v + k))


@inline_kernel
def product(p: int, width: int, depth: int, a: F64, c: int, ldc: int, x: int, y: int, ld: int) -> None:
    """C −= XᵀY:  C (p, width) at c,  X (depth, p) at x,  Y (depth, width) at y; the width is rounded up to vectors."""
    for i in range(0, p, TILE_ROWS):
        across(min(TILE_ROWS, p - i), width, depth, a, c + i * ldc, ldc, x + i, y, ld)


@inline_kernel
def across(rows: int, width: int, depth: int, a: F64, c: int, ldc: int, x: int, y: int, ld: int) -> None:
    """The same for a few rows, tile by tile."""
    vectors, j = (width + LANES - 1) // LANES, 0
    while vectors > 0 and depth > 0:
        some = min(vectors, TILE_VECTORS)
        tile(a, rows, some, c + j, ldc, x, y + j, ld, depth)
        j += some * LANES
        vectors -= some
