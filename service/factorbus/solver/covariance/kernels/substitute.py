"""Substitution with the rows of one clique, for several right-hand sides that lie side by side.

What one clique needs of the right-hand sides is gathered in scratch, worked on in register tiles, and scattered back.
"""

from typing import NamedTuple

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, part
from factorbus.solver.covariance.kernels.operands import Strided, Tile, VectorRows
from factorbus.solver.covariance.kernels.tiles import (
    copy_vectors,
    negative_product,
    prefetch,
    solve_tile_lower,
    solve_tile_upper,
    subtract_product,
)
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.simd import LANES, TILE_ROWS, TILE_VECTORS

GROUP = TILE_VECTORS  # vectors of columns that are worked on together, at most


class ColumnLayout(NamedTuple):
    """Where variables are in a column of numbers: variable v has dims[v] of them from row start[v] on.

    dims (n,)   start (n,): −1 where a variable is fixed
    """

    dims: I64
    start: I64


class RightSides(NamedTuple):
    """Right-hand sides X, a column each, in an array `a`.

    Row s of X is at `at + s·ld` and has `vectors` ≤ GROUP vectors of LANES numbers.  scratch: where `a` has room for
    what a clique needs of X.
    """

    at: int
    ld: int
    vectors: int
    scratch: int


@inline_kernel
def group_of_columns(first: int, ld: int, scratch: int) -> RightSides:
    """The columns of X from `first` on that are worked on together, where X is at the start of its array."""
    return RightSides(first, ld, min(GROUP, (ld - first) // LANES), scratch)


@part
def forward(tree: Tree, c: int, layout: ColumnLayout, a: F64, x: RightSides) -> None:
    """X_F := R_F⁻ᵀ X_F,  X_S −= R_Sᵀ X_F, with the rows of clique c."""
    row, numbers = tree.clique[c], tree.numbers
    p, start, step = row[tl.C_PIVOTS], row[tl.C_ROWS], row[tl.C_LD]
    width = p + row[tl.C_SEPARATOR_SCALARS]
    ld, every = x.vectors * LANES, row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]
    variables, solved = tree.lists[row[tl.C_LIST] : row[tl.C_LIST] + every], VectorRows(x.scratch, ld)
    gather_rows(variables, layout, a, x, x.scratch)
    for top in range(0, p, TILE_ROWS):
        C = Tile(min(TILE_ROWS, p - top), x.vectors, x.scratch + top * ld, ld)
        subtract_product(a, C, numbers, Strided(start + top, 1, step), solved, top)
        solve_tile_lower(a, C, numbers, start + top * step + top, step)
    for top in range(p, width, TILE_ROWS):
        C = Tile(min(TILE_ROWS, width - top), x.vectors, x.scratch + top * ld, ld)
        subtract_product(a, C, numbers, Strided(start + top, 1, step), solved, p)
    scatter_rows(variables, layout, a, x, x.scratch)


@part
def backward(tree: Tree, c: int, layout: ColumnLayout, a: F64, x: RightSides, fresh: bool) -> None:
    """X_F := R_F⁻¹ (X_F − R_S X_S), likewise; if `fresh` X_F is zero, whatever is there."""
    row, numbers = tree.clique[c], tree.numbers
    p, start, step = row[tl.C_PIVOTS], row[tl.C_ROWS], row[tl.C_LD]
    width = p + row[tl.C_SEPARATOR_SCALARS]
    ld, first = x.vectors * LANES, row[tl.C_LIST]
    middle = first + row[tl.C_FRONTALS]
    frontals, separator = tree.lists[first:middle], tree.lists[middle : middle + row[tl.C_SEPARATORS]]
    if not fresh:
        gather_rows(frontals, layout, a, x, x.scratch)
    gather_rows(separator, layout, a, x, x.scratch + p * ld)
    end = p
    while end > 0:
        top = max(0, end - TILE_ROWS)
        C, solved = Tile(end - top, x.vectors, x.scratch + top * ld, ld), VectorRows(x.scratch + end * ld, ld)
        right = Strided(start + top * step + end, step, 1)
        if fresh:
            negative_product(a, C, numbers, right, solved, width - end)
        else:
            subtract_product(a, C, numbers, right, solved, width - end)
        solve_tile_upper(a, C, numbers, start + top * step + top, step)
        end = top
    scatter_rows(frontals, layout, a, x, x.scratch)


@inline_kernel
def prefetch_rows(tree: Tree, c: int) -> None:
    """The rows of clique c will be read next."""
    row = tree.clique[c]
    size = (row[tl.C_PIVOTS] - 1) * row[tl.C_LD] + row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS]
    prefetch(tree.numbers, row[tl.C_ROWS], size)


@inline_kernel
def gather_rows(variables: I64, layout: ColumnLayout, a: F64, x: RightSides, target: int) -> None:
    """Copy the rows of X of these variables to `target`, one behind the other."""
    dims, start = layout.dims, layout.start
    for k in range(variables.size):
        v = variables[k]
        source = x.at + start[v] * x.ld
        for i in range(dims[v]):
            copy_vectors(a, target, source + i * x.ld, x.vectors)
            target += x.vectors * LANES


@inline_kernel
def scatter_rows(variables: I64, layout: ColumnLayout, a: F64, x: RightSides, source: int) -> None:
    """Copy them back from `source`."""
    dims, start = layout.dims, layout.start
    for k in range(variables.size):
        v = variables[k]
        target = x.at + start[v] * x.ld
        for i in range(dims[v]):
            copy_vectors(a, target + i * x.ld, source, x.vectors)
            source += x.vectors * LANES
