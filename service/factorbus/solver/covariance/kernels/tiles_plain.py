"""What the functions of `tiles` mean, in NumPy.  Offsets count doubles from the start of the array."""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, vector_lanes

_LANES = vector_lanes()
_RUN = 4
# What is beyond a matrix, in the last of its vectors, may be anything.
_whatever_is_beyond = np.errstate(invalid="ignore", over="ignore", divide="ignore", under="ignore")


def copy_runs(
    a: F64, rows: int, target: int, ldt: int, source: int, lds: int, runs: I64, first: int, count: int
) -> None:
    """Of some rows four doubles each, from and to where `count` pairs say:

    a[target + i·ldt + runs[first+1]] .. = a[source + i·lds + runs[first]] ..,  the pairs in their order   rows ≤ 4
    """
    for k in range(first, first + 2 * count, 2):
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
def subtract(
    a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, x: int, row: int, column: int, y: int, ldy: int,
    depth: int,
) -> None:  # fmt: skip
    """C −= X Y:  C (rows, vectors·LANES) at c of `a`, X (rows, depth) at x of `b`, Y (depth, vectors·LANES) at y of `a`

    X's rows are `row` apart, its columns `column`.  rows ≤ 4, vectors ≤ 3
    """
    width = vectors * _LANES
    for i in range(rows):
        for k in range(depth):
            a[c + i * ldc : c + i * ldc + width] -= b[x + i * row + k * column] * a[y + k * ldy : y + k * ldy + width]


@_whatever_is_beyond
def negative(
    a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, x: int, row: int, column: int, y: int, ldy: int,
    depth: int,
) -> None:  # fmt: skip
    """C = −X Y, likewise"""
    for i in range(rows):
        a[c + i * ldc : c + i * ldc + vectors * _LANES] = 0.0
    subtract(a, rows, vectors, c, ldc, b, x, row, column, y, ldy, depth)


@_whatever_is_beyond
def solve_upper(a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, u: int, ldu: int) -> None:
    """C = U⁻¹ C:  C (rows, vectors·LANES) at c of `a`, U (rows, rows) upper triangular at u of `b`, rows ≤ 4"""
    lines = [a[c + i * ldc : c + i * ldc + vectors * _LANES] for i in range(rows)]
    for i in range(rows - 1, -1, -1):
        for k in range(i + 1, rows):
            lines[i] -= b[u + i * ldu + k] * lines[k]
        lines[i] /= b[u + i * ldu + i]


@_whatever_is_beyond
def solve_lower(a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, u: int, ldu: int) -> None:
    """C = U⁻ᵀ C, likewise"""
    lines = [a[c + i * ldc : c + i * ldc + vectors * _LANES] for i in range(rows)]
    for i in range(rows):
        for k in range(i):
            lines[i] -= b[u + k * ldu + i] * lines[k]
        lines[i] /= b[u + i * ldu + i]
