"""The Hessian of a factor that `many` evaluates, in its rows.  MATH §9.2."""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.simd import LANES, TILE_ROWS, TILE_VECTORS, Block, Panel, tile, zero
from factorbus.solver.kernels.model.factor_rows import row_of_pair
from factorbus.solver.kernels.model.many import Many, width_of


@part
def write_hessian_rows(f: int, many: Many, chi2: float, link: I64, out: F64) -> None:
    """The Hessians of all rows of the factor that begins at row f.

    The rows (0, 1), …, (0, n−1) have the diagonal block and the gradient of their second variable, the first row those
    of the first one and χ² too; what else there is room for is zero.  So the sum of the rows is the factor.
    """
    columns, start, ends = many.J.shape[1], many.start, many.start.size - 1
    ld = (columns // LANES + 1) * LANES
    w, M = multiplied(many, ld)
    for n in range(max(ends - 1, 1)):
        di = width_of(n, many)
        for m in range(n + 1, max(ends, 2)):
            h, dj = link[row_of_pair(f, n, m, ends), tl.L_AT], width_of(m, many)
            first = n == 0 and m == 1
            s, t = start[n], start[min(m, ends)]
            h = _copy_diagonal(first, w, Block(M + s * ld + s, ld), di, h, out)
            h = _copy(w, Block(M + s * ld + t, ld), di, dj, h, out)
            h = _copy_diagonal(n == 0 and m < ends, w, Block(M + t * ld + t, ld), dj, h, out)
            h = _copy_gradient(first, w, M + s * ld + columns, ld, di, h, out)
            h = _copy_gradient(n == 0 and m < ends, w, M + t * ld + columns, ld, dj, h, out)
            out[h] = chi2 if first else 0.0


@part
def multiplied(many: Many, ld: int) -> tuple[F64, int]:
    """An array with −Jᵀ (J r) in rows of ld numbers, on and above its diagonal; and where that begins."""
    dim, columns = many.J.shape
    M = dim * ld
    w = np.empty(M + columns * ld)
    J = many.J.reshape(dim * columns)
    for a in range(dim):
        for c in range(columns):
            w[a * ld + c] = J[a * columns + c]
        w[a * ld + columns] = many.r[a]
        for c in range(columns + 1, ld):
            w[a * ld + c] = 0.0
    zero(w, M, columns * ld)
    for i in range(0, columns, TILE_ROWS):
        rows, j = min(TILE_ROWS, columns - i), i // LANES * LANES
        while j < ld:
            vectors = min(TILE_VECTORS, (ld - j) // LANES)
            tile(w, rows, vectors, Block(M + i * ld + j, ld), Panel(i, ld, dim), j)
            j += vectors * LANES
    return w, M


@inline_kernel
def _copy(w: F64, block: Block, rows: int, columns: int, h: int, out: F64) -> int:
    """A block of JᵀJ above the diagonal, row by row, from h on; gives where it ends."""
    for i in range(rows):
        for j in range(columns):
            out[h + i * columns + j] = -w[block.start + i * block.ld + j]
    return h + rows * columns


@inline_kernel
def _copy_diagonal(has: bool, w: F64, block: Block, rows: int, h: int, out: F64) -> int:
    """One on the diagonal, or zeros."""
    if not has:
        zero(out, h, rows * rows)
        return h + rows * rows
    for i in range(rows):
        for j in range(i, rows):
            value = -w[block.start + i * block.ld + j]
            out[h + i * rows + j] = value
            out[h + j * rows + i] = value
    return h + rows * rows


@inline_kernel
def _copy_gradient(has: bool, w: F64, start: int, ld: int, count: int, h: int, out: F64) -> int:
    """−Jᵀ r of a variable, or zeros."""
    for i in range(count):
        out[h + i] = w[start + i * ld] if has else 0.0
    return h + count
