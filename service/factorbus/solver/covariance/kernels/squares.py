"""The covariance of one clique's variables as a square in an arena, and how it is made.  MATH (10.2).

A square has a row for every scalar, frontals first, and as many columns, those of the separator from a multiple of
LANES on; p further rows behind it are scratch while it is made.  So whole vectors can be worked on, and what is beyond
a matrix is overwritten before it is read.  Behind that come the rows [ K  T ], the columns of T in reverse: what is
zero of it is at the ends of the rows, and the products stop before.
"""

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, part
from factorbus.solver.covariance.kernels.operands import Strided, Tile, VectorRows
from factorbus.solver.covariance.kernels.tiles import (
    RUN,
    copy_runs,
    negative_product,
    solve_tile_upper,
    subtract_product,
    transpose,
    transpose_negative,
)
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.simd import LANES, TILE_ROWS, TILE_VECTORS, zero

_DIMS = 6  # of the largest variable
_TOGETHER = 3  # rows that are copied together: a variable of the plane has as many


@inline_kernel
def whole_vectors(count: int) -> int:
    """Numbers in the vectors of LANES that hold `count` of them."""
    return (count + LANES - 1) & ~(LANES - 1)


@inline_kernel
def height(p: int) -> int:
    """Rows of a tile, so that p rows are tiles of about the same height."""
    tiles = (p + TILE_ROWS - 1) // TILE_ROWS
    return (p + tiles - 1) // tiles


@inline_kernel
def row_length(p: int, m: int) -> int:
    """Doubles from one row of a square to the next."""
    return whole_vectors(p) + whole_vectors(m)


@inline_kernel
def square_size(p: int, m: int) -> int:
    """Doubles that a square takes."""
    return (p + m) * row_length(p, m)


@inline_kernel
def working_size(p: int, m: int) -> int:
    """The same with what is behind it while it is made."""
    return (2 * p + m) * row_length(p, m) + p * whole_vectors(p + m) + LANES + RUN


@part
def gather_separator_block(
    tree: Tree, c: int, dims: I64, column: I64, runs: I64, a: F64, source: int, target: int
) -> None:
    """Σ_SS of clique c into its square at `target`, from that of the parent at `source`.

    column (n,), runs (5 w,): scratch
    """
    row = tree.clique[c]
    above = tree.clique[row[tl.C_PARENT]]
    count = list_separator_runs(row, above, tree.lists, dims, column, runs)
    p, pivots = row[tl.C_PIVOTS], above[tl.C_PIVOTS]
    wide, gap = row_length(pivots, above[tl.C_SEPARATOR_SCALARS]), whole_vectors(pivots) - pivots
    ld, end = row_length(p, row[tl.C_SEPARATOR_SCALARS]), 3 * count
    for k in range(count):
        start = runs[3 * k] + gap if runs[3 * k] >= pivots else runs[3 * k]
        for n in range(0, runs[3 * k + 1], RUN):
            runs[end], runs[end + 1] = start + n, runs[3 * k + 2] + n
            end += 2
    moves = runs[3 * count : end]
    # Too much is copied at the end of a run: the next run, row or step overwrites it.  Of rows that are copied together
    # the last run must not reach into the next row, where vectors have two numbers.
    together = _TOGETHER if ld - row[tl.C_SEPARATOR_SCALARS] >= RUN - 1 else 1
    for k in range(count):
        for i in range(0, runs[3 * k + 1], together):
            line = source + (runs[3 * k] + i) * wide
            into = target + (p + runs[3 * k + 2] + i) * ld + whole_vectors(p)
            copy_runs(a, min(together, runs[3 * k + 1] - i), into, ld, line, wide, moves)


@inline_kernel
def list_separator_runs(row: I64, above: I64, lists: I64, dims: I64, column: I64, runs: I64) -> int:
    """Where the separator's scalars are in the parent: runs of (first there, how many, first here); how many runs."""
    scalar = 0
    for s in range(above[tl.C_LIST], above[tl.C_LIST] + above[tl.C_FRONTALS] + above[tl.C_SEPARATORS]):
        column[lists[s]] = scalar
        scalar += dims[lists[s]]
    count, m, end, start = 0, 0, -1, row[tl.C_LIST] + row[tl.C_FRONTALS]
    for s in range(start, start + row[tl.C_SEPARATORS]):
        first, d = column[lists[s]], dims[lists[s]]
        if first != end or first == above[tl.C_PIVOTS]:
            runs[3 * count], runs[3 * count + 1], runs[3 * count + 2] = first, 0, m
            count += 1
        runs[3 * count - 2] += d
        m, end = m + d, first + d
    return count


@part
def solve_square(tree: Tree, c: int, a: F64, target: int, whole: bool) -> None:
    """The square at `target` has Σ_SS and gets Σ_FS, Σ_SF and Σ_FF; unless `whole`, of that only what is near its
    diagonal and right of it.
    """
    row = tree.clique[c]
    p, m = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS]
    ld, past_pivots, wide = row_length(p, m), whole_vectors(p), whole_vectors(p + m)
    high, w = height(p), target + (2 * p + m) * ld
    solve_for_square(row, tree.numbers, a, w, wide)
    for j in range(0, m, TILE_VECTORS * LANES):
        vectors, Y = min(TILE_VECTORS, (m - j + LANES - 1) // LANES), VectorRows(target + p * ld + past_pivots + j, ld)
        for i in range(0, p, high):
            C = Tile(min(high, p - i), vectors, target + i * ld + past_pivots + j, ld)
            negative_product(a, C, a, Strided(w + i * wide, wide, 1), Y, m)
    transpose(a, p, m, target + past_pivots, ld, target + p * ld, ld)
    transpose_negative(a, p, p, w + m, wide, target + (p + m) * ld, ld)
    for j in range(0, p, TILE_VECTORS * LANES):
        vectors, Y = min(TILE_VECTORS, (p - j + LANES - 1) // LANES), VectorRows(target + p * ld + j, ld)
        for i in range(0, min(p, j + vectors * LANES), high):
            if whole or j < i + high + _DIMS:
                C = Tile(min(high, p - i), vectors, target + i * ld + j, ld)
                negative_product(a, C, a, Strided(w + i * wide, wide, 1), Y, m + p - max(i, j))
        if whole and j > 0:
            transpose(a, j, min(vectors * LANES, p - j), target + j, ld, target + j * ld, ld)


@part
def solve_for_square(row: I64, numbers: F64, a: F64, w: int, wide: int) -> None:
    """[ K T ] at w from R_F [ K T ] = [ R_S I ], some rows at a time from the last."""
    p, m, start, step = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS], row[tl.C_ROWS], row[tl.C_LD]
    for i in range(p):
        source, v = start + i * step + p, w + i * wide
        for j in range(m):
            a[v + j] = numbers[source + j]
        zero(a, v + m, wide - m)
        a[v + m + p - 1 - i] = 1.0
    end, high = p, height(p)
    while end > 0:
        top = max(0, end - high)
        width = m + p - end
        if end < p:
            X = Strided(start + top * step + end, step, 1)
            for j in range(0, width, TILE_VECTORS * LANES):
                vectors = min(TILE_VECTORS, (width - j + LANES - 1) // LANES)
                C = Tile(end - top, vectors, w + top * wide + j, wide)
                subtract_product(a, C, numbers, X, VectorRows(w + end * wide + j, wide), p - end)
        C = Tile(end - top, whole_vectors(m + p - top) // LANES, w + top * wide, wide)
        solve_tile_upper(a, C, numbers, start + top * step + top, step)
        end = top


@inline_kernel
def put_blocks(tree: Tree, c: int, dims: I64, a: F64, target: int, out: F64) -> None:
    """The diagonal blocks of the frontals of clique c, from its square at `target`, into out (n, d, d)."""
    row, lists = tree.clique[c], tree.lists
    ld, corner = row_length(row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS]), target
    for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
        block, d = out[lists[s]], dims[lists[s]]
        for i in range(d):
            for j in range(i, d):
                block[i, j] = block[j, i] = a[corner + i * ld + j]
        corner += d * (ld + 1)
