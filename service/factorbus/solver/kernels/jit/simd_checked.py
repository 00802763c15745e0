"""The functions of `simd` behind range checks: what NUMBA_BOUNDSCHECK=1 runs."""

from factorbus.solver.kernels.jit import simd_llvm
from factorbus.solver.kernels.jit.compile import F64, inline_kernel, vector_lanes
from factorbus.solver.kernels.jit.simd_plain import Block, Panel

_LANES = vector_lanes()
_zero, _add_run = simd_llvm.zero, simd_llvm.add_run
_tile, _solve_tile, _six = simd_llvm.tile, simd_llvm.solve_tile, simd_llvm.six


@inline_kernel
def zero(a: F64, i: int, count: int) -> None:
    """See `simd_plain`; likewise below."""
    _within(a, i, count)
    _zero(a, i, count)


@inline_kernel
def add_run(a: F64, i: int, j: int, count: int) -> None:
    _within(a, i, count)
    _within(a, j, count)
    _add_run(a, i, j, count)


@inline_kernel
def tile(a: F64, rows: int, vectors: int, C: Block, X: Panel, y: int) -> None:
    _within(a, C.start, (rows - 1) * C.ld + vectors * _LANES)
    _within(a, X.start, (X.depth - 1) * X.ld + rows)
    _within(a, y, (X.depth - 1) * X.ld + vectors * _LANES)
    _tile(a, rows, vectors, C, X, y)


@inline_kernel
def solve_tile(a: F64, rows: int, vectors: int, c: int, ld: int, t: int) -> None:
    _within(a, c, (rows - 1) * ld + vectors * _LANES)
    _within(a, t, 10)
    _solve_tile(a, rows, vectors, c, ld, t)


@inline_kernel
def six(x: F64, X: Panel, y: F64, j: int, out: F64, to: int) -> None:
    _within(x, X.start, (X.depth - 1) * X.ld + 1)
    _within(y, j, 6 * X.depth)
    _within(out, to, 6)
    _six(x, X, y, j, out, to)


@inline_kernel
def _within(a: F64, first: int, count: int) -> None:
    if first < 0 or first + count > a.size:
        raise IndexError("a kernel reached outside its array")
