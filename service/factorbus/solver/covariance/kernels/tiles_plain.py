"""What the functions of `tiles` mean, in NumPy.  Offsets count doubles from the start of the array."""

import numpy as np

from factorbus.solver.covariance.kernels.operands import Strided, Tile, VectorRows
from factorbus.solver.kernels.jit.compile import F64, I64, vector_lanes

_LANES = vector_lanes()
_RUN = 4
# What is beyond a matrix, in the last of its vectors, may be anything.
_whatever_is_beyond = np.errstate(invalid="ignore", over="ignore", divide="ignore", under="ignore")


def copy_runs(a: F64, rows: int, target: int, ldt: int, source: int, lds: int, runs: I64) -> None:
    """Copy four doubles of each of some rows for every pair (from, to) in `runs`, the pairs in their order:

    a[target + i·ldt + to] .. = a[source + i·lds + from] ..   rows ≤ 4
    """
    for k in range(0, runs.size, 2):
        for i in range(rows):
            start, into = source + i * lds + runs[k], target + i * ldt + runs[k + 1]
            a[into : into + _RUN] = a[start : start + _RUN].copy()


def transpose(a: F64, rows: int, columns: int, source: int, step: int, target: int, ld: int) -> None:
    """The transpose of a matrix at `source`, rows `step` apart, to `target`, rows `ld` apart.

    Of `target` whole runs may be written, and of `source` whole vectors read.
    """
    for i in range(rows):
        a[target + i : target + i + columns * ld : ld] = a[source + i * step : source + i * step + columns]


def transpose_negative(a: F64, rows: int, columns: int, source: int, step: int, target: int, ld: int) -> None:
    """The same of minus the matrix"""
    for i in range(rows):
        a[target + i : target + i + columns * ld : ld] = -a[source + i * step : source + i * step + columns]


def copy_vectors(a: F64, target: int, source: int, count: int) -> None:
    """`count` vectors of LANES doubles from `source` to `target`; they do not overlap"""
    a[target : target + count * _LANES] = a[source : source + count * _LANES]


def prefetch(b: F64, first: int, count: int) -> None:
    """b[first : first+count] is read soon: the processor may fetch it"""


@_whatever_is_beyond
def subtract_product(a: F64, C: Tile, b: F64, X: Strided, Y: VectorRows, depth: int) -> None:
    """C −= X Y:  C in `a`, X (C.rows, depth) in `b`, Y (depth, C.vectors·LANES) in `a`"""
    width = C.vectors * _LANES
    for i in range(C.rows):
        for k in range(depth):
            factor, y = b[X.at + i * X.row + k * X.column], Y.at + k * Y.ld
            a[C.at + i * C.ld : C.at + i * C.ld + width] -= factor * a[y : y + width]


@_whatever_is_beyond
def negative_product(a: F64, C: Tile, b: F64, X: Strided, Y: VectorRows, depth: int) -> None:
    """C = −X Y, likewise"""
    for line in _lines(a, C):
        line[:] = 0.0
    subtract_product(a, C, b, X, Y, depth)


@_whatever_is_beyond
def solve_tile_upper(a: F64, C: Tile, b: F64, u: int, ldu: int) -> None:
    """C = U⁻¹ C:  U (C.rows, C.rows) upper triangular at u of `b`, its rows `ldu` apart"""
    lines = _lines(a, C)
    for i in range(C.rows - 1, -1, -1):
        for k in range(i + 1, C.rows):
            lines[i] -= b[u + i * ldu + k] * lines[k]
        lines[i] /= b[u + i * ldu + i]


@_whatever_is_beyond
def solve_tile_lower(a: F64, C: Tile, b: F64, u: int, ldu: int) -> None:
    """C = U⁻ᵀ C, likewise"""
    lines = _lines(a, C)
    for i in range(C.rows):
        for k in range(i):
            lines[i] -= b[u + k * ldu + i] * lines[k]
        lines[i] /= b[u + i * ldu + i]


def _lines(a: F64, C: Tile) -> list[F64]:
    return [a[C.at + i * C.ld : C.at + i * C.ld + C.vectors * _LANES] for i in range(C.rows)]
