"""The covariance of one clique's variables as a square in an arena, and how it is made.  MATH (10.2).

A square has a row for every scalar, frontals first, and as many columns, those of the separator from a multiple of
LANES on; p further rows behind it are scratch.  So whole vectors can be worked on, and what is beyond a matrix is
overwritten before it is read.  An arena begins with 16 doubles of scratch, then room for [ R_S  I ] and R_Fᵀ, both with
the pivots in reverse, which makes of back-substitution the forward kind that `simd.solve_rows` does; then for [ K T ]ᵀ.
"""

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels.simd import LANES, TILE_ROWS, TILE_VECTORS, put, solve_rows, tile, zero
from factorbus.solver.kernels.simd import at as load

_SCRATCH = 16
_DIMS = 6  # of the largest variable
_STRIP = 8


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
    row: I64, above: I64, lists: I64, dims: I64, column: I64, runs: I64, a: F64, source: int, target: int
) -> None:
    """Σ_SS into the square at `target`, from that of the parent at `source`.

    column, runs: scratch
    """
    scalar = 0
    for s in range(above[tl.C_LIST], above[tl.C_LIST] + above[tl.C_FRONTALS] + above[tl.C_SEPARATORS]):
        column[lists[s]] = scalar
        scalar += dims[lists[s]]
    wide, pivots = row_length(above[tl.C_PIVOTS], above[tl.C_BORDER]), above[tl.C_PIVOTS]
    count, m, end, start = 0, 0, -1, row[tl.C_LIST] + row[tl.C_FRONTALS]
    for s in range(start, start + row[tl.C_SEPARATORS]):
        first, d = column[lists[s]], dims[lists[s]]
        if first != end or first == pivots:
            runs[3 * count], runs[3 * count + 1], runs[3 * count + 2] = first, 0, m
            count += 1
        runs[3 * count - 2] += d
        m, end = m + d, first + d
    p, gap = row[tl.C_PIVOTS], padded(pivots) - pivots
    ld = row_length(p, m)
    for k in range(count):
        for i in range(runs[3 * k + 1]):
            line, into = source + (runs[3 * k] + i) * wide, target + (p + runs[3 * k + 2] + i) * ld + padded(p)
            for n in range(count):
                first = runs[3 * n]
                copy(a, into + runs[3 * n + 2], line + (first + gap if first >= pivots else first), runs[3 * n + 1])


@inline_kernel
def copy(a: F64, target: int, source: int, count: int) -> None:
    """a[target : target + count] = a[source : source + count]"""
    for j in range(count):
        put(a, target + j, load(a, source + j))


@inline_kernel
def transpose(a: F64, rows: int, columns: int, source: int, step: int, target: int, ld: int) -> None:
    """The transpose of a matrix at `source`, rows `step` apart (also backwards), to `target`, rows `ld` apart."""
    for first in range(0, columns, _STRIP):
        last = min(first + _STRIP, columns)
        for i in range(rows):
            for k in range(first, last):
                put(a, target + k * ld + i, load(a, source + i * step + k))


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
        zero(a, target + i * ld, ld)
    product(p, m, m, a, target + border, ld, w, target + p * ld + border, ld)
    transpose(a, p, m, target + border, ld, target + p * ld, ld)
    for k in range(p):
        for i in range(p):
            put(a, target + (p + m + k) * ld + i, -load(a, w + (m + k) * ld + i))
    x = target + p * ld
    for j in range(0, p, TILE_VECTORS * LANES):
        some = min(TILE_VECTORS, (p - j + LANES - 1) // LANES)
        for i in range(0, min(p, j + some * LANES), TILE_ROWS):
            if whole or j < i + TILE_ROWS + _DIMS:
                tile(a, min(TILE_ROWS, p - i), some, target + i * ld + j, ld, x + i, w + j, ld, m + p)
    if whole:
        for i in range(p):
            for j in range(i + 1, p):
                put(a, target + j * ld + i, load(a, target + i * ld + j))
    else:
        for i in range(p):
            for j in range(i + 1, min(i + _DIMS, p)):
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
        zero(a, v + m, p)
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
    transpose(a, p, width, _SCRATCH + (p - 1) * wide, -wide, w, ld)


@inline_kernel
def product(p: int, width: int, depth: int, a: F64, c: int, ldc: int, x: int, y: int, ld: int) -> None:
    """C −= XᵀY:  C (p, width) at c,  X (depth, p) at x,  Y (depth, width) at y; the width is rounded up to vectors.

    A few columns of Y, which stay in the cache, with all of X.
    """
    for j in range(0, width, TILE_VECTORS * LANES):
        some = min(TILE_VECTORS, (width - j + LANES - 1) // LANES)
        for i in range(0, p, TILE_ROWS):
            tile(a, min(TILE_ROWS, p - i), some, c + i * ldc + j, ldc, x + i, y + j, ld, depth)


@inline_kernel
def across(rows: int, width: int, depth: int, a: F64, c: int, ldc: int, x: int, y: int, ld: int) -> None:
    """The same for a few rows, tile by tile."""
    vectors, j = (width + LANES - 1) // LANES, 0
    while vectors > 0 and depth > 0:
        some = min(vectors, TILE_VECTORS)
        tile(a, rows, some, c + j, ldc, x, y + j, ld, depth)
        j += some * LANES
        vectors -= some
