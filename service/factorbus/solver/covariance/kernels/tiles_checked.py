"""The functions of `tiles` behind range checks: what NUMBA_BOUNDSCHECK=1 runs."""

from factorbus.solver.covariance.kernels import tiles_llvm
from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel
from factorbus.solver.kernels.jit.compile import vector_lanes

prefetch = tiles_llvm.prefetch  # reaches nothing
_LANES = vector_lanes()
_RUN = 4
_STRIP = tiles_llvm.STRIP
_copy_runs, _copy_vectors = tiles_llvm.copy_runs, tiles_llvm.copy_vectors
_transpose, _transpose_negative = tiles_llvm.transpose, tiles_llvm.transpose_negative
_subtract, _negative = tiles_llvm.subtract, tiles_llvm.negative
_solve_upper, _solve_lower = tiles_llvm.solve_upper, tiles_llvm.solve_lower


@inline_kernel
def copy_runs(
    a: F64, rows: int, target: int, ldt: int, source: int, lds: int, runs: I64, first: int, count: int
) -> None:
    """See `tiles_plain`; likewise below."""
    for k in range(first, first + 2 * count, 2):
        _within(a, source + runs[k], (rows - 1) * lds + _RUN)
        _within(a, target + runs[k + 1], (rows - 1) * ldt + _RUN)
    _copy_runs(a, rows, target, ldt, source, lds, runs, first, count)


@inline_kernel
def transpose(a: F64, rows: int, columns: int, source: int, step: int, target: int, ld: int) -> None:
    _transpose_within(a, rows, columns, source, step, target, ld)
    _transpose(a, rows, columns, source, step, target, ld)


@inline_kernel
def transpose_negative(a: F64, rows: int, columns: int, source: int, step: int, target: int, ld: int) -> None:
    _transpose_within(a, rows, columns, source, step, target, ld)
    _transpose_negative(a, rows, columns, source, step, target, ld)


@inline_kernel
def _transpose_within(a: F64, rows: int, columns: int, source: int, step: int, target: int, ld: int) -> None:
    if rows > 0 and columns > 0:
        _within(a, source, (rows - 1) * step + (columns + _LANES - 1) // _LANES * _LANES)
        _within(a, target, (columns - 1) * ld + (rows + _STRIP - 1) // _STRIP * _STRIP)


@inline_kernel
def copy_vectors(a: F64, target: int, source: int, count: int) -> None:
    _within(a, target, count * _LANES)
    _within(a, source, count * _LANES)
    _copy_vectors(a, target, source, count)


@inline_kernel
def subtract(
    a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, x: int, row: int, column: int, y: int, ldy: int,
    depth: int,
) -> None:  # fmt: skip
    _product_within(a, rows, vectors, c, ldc, b, x, row, column, y, ldy, depth)
    _subtract(a, rows, vectors, c, ldc, b, x, row, column, y, ldy, depth)


@inline_kernel
def negative(
    a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, x: int, row: int, column: int, y: int, ldy: int,
    depth: int,
) -> None:  # fmt: skip
    _product_within(a, rows, vectors, c, ldc, b, x, row, column, y, ldy, depth)
    _negative(a, rows, vectors, c, ldc, b, x, row, column, y, ldy, depth)


@inline_kernel
def solve_upper(a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, u: int, ldu: int) -> None:
    _within(a, c, (rows - 1) * ldc + vectors * _LANES)
    _within(b, u, (rows - 1) * ldu + rows)
    _solve_upper(a, rows, vectors, c, ldc, b, u, ldu)


@inline_kernel
def solve_lower(a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, u: int, ldu: int) -> None:
    _within(a, c, (rows - 1) * ldc + vectors * _LANES)
    _within(b, u, (rows - 1) * ldu + rows)
    _solve_lower(a, rows, vectors, c, ldc, b, u, ldu)


@inline_kernel
def _product_within(
    a: F64, rows: int, vectors: int, c: int, ldc: int, b: F64, x: int, row: int, column: int, y: int, ldy: int,
    depth: int,
) -> None:  # fmt: skip
    _within(a, c, (rows - 1) * ldc + vectors * _LANES)
    if depth > 0:
        _within(b, x, (rows - 1) * row + (depth - 1) * column + 1)
        _within(a, y, (depth - 1) * ldy + vectors * _LANES)


@inline_kernel
def _within(a: F64, first: int, count: int) -> None:
    if first < 0 or first + count > a.size:
        raise IndexError("a kernel reached outside its array")
