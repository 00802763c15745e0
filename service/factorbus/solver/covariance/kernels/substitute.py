"""Substitution with the rows of one clique, for several right-hand sides that lie side by side.

Row s of a matrix x of right-hand sides is for scalar s; it has a multiple of LANES columns.  What one clique needs of
it is collected in `local`, worked on in register tiles, and put back.
"""

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, part
from factorbus.solver.covariance.kernels.tiles import (
    copy_vectors,
    negative,
    prefetch,
    solve_lower,
    solve_upper,
    subtract,
)
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.simd import LANES, TILE_ROWS, TILE_VECTORS

GROUP = TILE_VECTORS  # vectors of columns that are worked on together, at most


@part
def forward(
    row: I64, lists: I64, numbers: F64, dims: I64, scalar: I64, a: F64, x: int, ldx: int, vectors: int, local: int
) -> None:
    """x_F := R_F⁻ᵀ x_F,  x_S −= R_Sᵀ x_F, for `vectors` ≤ GROUP of columns.

    scalar: the row of x where each variable starts   a: has x at `x`, rows `ldx` apart, and scratch at `local`
    """
    p, width, start, step = row[tl.C_PIVOTS], row[tl.C_PIVOTS] + row[tl.C_BORDER], row[tl.C_ROWS], row[tl.C_LD]
    ld, every = vectors * LANES, row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]
    collect(row[tl.C_LIST], every, lists, dims, scalar, a, x, ldx, vectors, local)
    for top in range(0, p, TILE_ROWS):
        rows, c = min(TILE_ROWS, p - top), local + top * ld
        subtract(a, rows, vectors, c, ld, numbers, start + top, 1, step, local, ld, top)
        solve_lower(a, rows, vectors, c, ld, numbers, start + top * step + top, step)
    for top in range(p, width, TILE_ROWS):
        rows = min(TILE_ROWS, width - top)
        subtract(a, rows, vectors, local + top * ld, ld, numbers, start + top, 1, step, local, ld, p)
    distribute(row[tl.C_LIST], every, lists, dims, scalar, a, x, ldx, vectors, local)


@part
def backward(
    row: I64, lists: I64, numbers: F64, dims: I64, scalar: I64, a: F64, x: int, ldx: int, vectors: int, local: int,
    fresh: bool,
) -> None:  # fmt: skip
    """x_F := R_F⁻¹ (x_F − R_S x_S), likewise; if `fresh` x_F is zero, whatever is there."""
    p, width, start, step = row[tl.C_PIVOTS], row[tl.C_PIVOTS] + row[tl.C_BORDER], row[tl.C_ROWS], row[tl.C_LD]
    ld, frontals = vectors * LANES, row[tl.C_FRONTALS]
    first = row[tl.C_LIST]
    if not fresh:
        collect(first, frontals, lists, dims, scalar, a, x, ldx, vectors, local)
    collect(first + frontals, row[tl.C_SEPARATORS], lists, dims, scalar, a, x, ldx, vectors, local + p * ld)
    end = p
    while end > 0:
        top = max(0, end - TILE_ROWS)
        c, r, y = local + top * ld, start + top * step + end, local + end * ld
        if fresh:
            negative(a, end - top, vectors, c, ld, numbers, r, step, 1, y, ld, width - end)
        else:
            subtract(a, end - top, vectors, c, ld, numbers, r, step, 1, y, ld, width - end)
        solve_upper(a, end - top, vectors, c, ld, numbers, start + top * step + top, step)
        end = top
    distribute(first, frontals, lists, dims, scalar, a, x, ldx, vectors, local)


@inline_kernel
def fetch(row: I64, numbers: F64) -> None:
    """The rows of this clique will be read next."""
    prefetch(numbers, row[tl.C_ROWS], (row[tl.C_PIVOTS] - 1) * row[tl.C_LD] + row[tl.C_PIVOTS] + row[tl.C_BORDER])


@inline_kernel
def collect(
    first: int, count: int, lists: I64, dims: I64, scalar: I64, a: F64, x: int, ldx: int, vectors: int, local: int
) -> None:
    """Rows of x for the variables lists[first : first+count], one behind the other."""
    place = local
    for s in range(first, first + count):
        v = lists[s]
        source = x + scalar[v] * ldx
        for i in range(dims[v]):
            copy_vectors(a, place, source + i * ldx, vectors)
            place += vectors * LANES


@inline_kernel
def distribute(
    first: int, count: int, lists: I64, dims: I64, scalar: I64, a: F64, x: int, ldx: int, vectors: int, local: int
) -> None:
    """The other way."""
    place = local
    for s in range(first, first + count):
        v = lists[s]
        target = x + scalar[v] * ldx
        for i in range(dims[v]):
            copy_vectors(a, target + i * ldx, place, vectors)
            place += vectors * LANES
