"""The functions of `tiles` behind range checks: what NUMBA_BOUNDSCHECK=1 runs."""

from factorbus.solver.covariance.kernels import tiles_llvm
from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel
from factorbus.solver.covariance.kernels.operands import Strided, Tile, VectorRows
from factorbus.solver.kernels.jit.compile import vector_lanes

prefetch = tiles_llvm.prefetch  # reaches nothing
_LANES = vector_lanes()
_RUN = 4
_STRIP = tiles_llvm.STRIP
_copy_runs, _copy_vectors = tiles_llvm.copy_runs, tiles_llvm.copy_vectors
_transpose, _transpose_negative = tiles_llvm.transpose, tiles_llvm.transpose_negative
_subtract_product, _negative_product = tiles_llvm.subtract_product, tiles_llvm.negative_product
_solve_tile_upper, _solve_tile_lower = tiles_llvm.solve_tile_upper, tiles_llvm.solve_tile_lower


@inline_kernel
def copy_runs(a: F64, rows: int, target: int, ldt: int, source: int, lds: int, runs: I64) -> None:
    """See `tiles_plain`; likewise below."""
    for k in range(0, runs.size, 2):
        _within(a, source + runs[k], (rows - 1) * lds + _RUN)
        _within(a, target + runs[k + 1], (rows - 1) * ldt + _RUN)
    _copy_runs(a, rows, target, ldt, source, lds, runs)


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
def subtract_product(a: F64, C: Tile, b: F64, X: Strided, Y: VectorRows, depth: int) -> None:
    _product_within(a, C, b, X, Y, depth)
    _subtract_product(a, C, b, X, Y, depth)


@inline_kernel
def negative_product(a: F64, C: Tile, b: F64, X: Strided, Y: VectorRows, depth: int) -> None:
    _product_within(a, C, b, X, Y, depth)
    _negative_product(a, C, b, X, Y, depth)


@inline_kernel
def solve_tile_upper(a: F64, C: Tile, b: F64, u: int, ldu: int) -> None:
    _triangle_within(a, C, b, u, ldu)
    _solve_tile_upper(a, C, b, u, ldu)


@inline_kernel
def solve_tile_lower(a: F64, C: Tile, b: F64, u: int, ldu: int) -> None:
    _triangle_within(a, C, b, u, ldu)
    _solve_tile_lower(a, C, b, u, ldu)


@inline_kernel
def _product_within(a: F64, C: Tile, b: F64, X: Strided, Y: VectorRows, depth: int) -> None:
    _within(a, C.at, (C.rows - 1) * C.ld + C.vectors * _LANES)
    if depth > 0:
        _within(b, X.at, (C.rows - 1) * X.row + (depth - 1) * X.column + 1)
        _within(a, Y.at, (depth - 1) * Y.ld + C.vectors * _LANES)


@inline_kernel
def _triangle_within(a: F64, C: Tile, b: F64, u: int, ldu: int) -> None:
    _within(a, C.at, (C.rows - 1) * C.ld + C.vectors * _LANES)
    _within(b, u, (C.rows - 1) * ldu + C.rows)


@inline_kernel
def _within(a: F64, first: int, count: int) -> None:
    if first < 0 or first + count > a.size:
        raise IndexError("a kernel reached outside its array")
