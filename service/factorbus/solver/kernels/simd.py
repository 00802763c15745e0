"""Loads, stores and register tiles on a float64 array, written in LLVM vectors.

Why not plain indexing: `a[i + j]` with signed indices compiles to a compare and a select for negative ones, which
keeps loops from being vectorised, and no compiler keeps a tile of a product in registers by itself.

Every function here exists three times with one meaning: LLVM (fast, no checks), LLVM behind range checks
(NUMBA_BOUNDSCHECK=1) and NumPy (NUMBA_DISABLE_JIT=1).  Offsets count doubles from the start of the array.
"""

from typing import Any

from factorbus.solver.kernels import _jit
from factorbus.solver.kernels._jit import F64, inline_kernel

LANES = _jit.vector_lanes()  # doubles in a vector register: 2, 4 or 8
TILE_ROWS = 4
TILE_VECTORS = 3  # 4 x 3 sums, 3 loads and a broadcast: the 16 registers of AVX2


if _jit.DISABLED:

    def at(a: F64, i: int) -> float:
        """a[i]"""
        return a[i]

    def put(a: F64, i: int, x: float) -> None:
        """a[i] = x"""
        a[i] = x

    def zero(a: F64, i: int, count: int) -> None:
        """a[i : i+count] = 0"""
        a[i : i + count] = 0.0

    def add_run(a: F64, i: int, j: int, count: int) -> None:
        """a[i : i+count] += a[j : j+count]"""
        a[i : i + count] += a[j : j + count]

    def tile(a: F64, rows: int, vectors: int, c: int, ldc: int, x: int, y: int, ld: int, depth: int) -> None:
        """C −= XᵀY: C rows x vectors·LANES at c, X depth x rows at x, Y depth x vectors·LANES at y; X, Y share ld."""
        for i in range(rows):
            for k in range(depth):
                span = vectors * LANES
                a[c + i * ldc : c + i * ldc + span] -= a[x + k * ld + i] * a[y + k * ld : y + k * ld + span]

    def solve_rows(a: F64, rows: int, vectors: int, c: int, ld: int, t: int) -> None:
        """C = T⁻ᵀ C for `rows` rows of vectors·LANES at c; T as ten doubles at t: see `dense.pivot_rows`."""
        span = vectors * LANES
        row = [a[c + i * ld : c + i * ld + span] for i in range(rows)]
        for i in range(rows):
            for k in range(i):
                row[i] -= a[t + _PAIR[k, i]] * row[k]
            row[i] *= a[t + i]

else:
    from factorbus.solver.kernels import _tiles

    if _jit.BOUNDSCHECK:

        @inline_kernel
        def _within(a: F64, first: int, last: int) -> None:
            if first < 0 or last >= a.size:
                raise IndexError("a kernel reached outside its array")

        @inline_kernel
        def at(a: F64, i: int) -> Any:
            _within(a, i, i)
            return _tiles.at(a, i)

        @inline_kernel
        def put(a: F64, i: int, x: float) -> None:
            _within(a, i, i)
            _tiles.put(a, i, x)

        @inline_kernel
        def zero(a: F64, i: int, count: int) -> None:
            _within(a, i, i + count - 1)
            _tiles.zero(a, i, count)

        @inline_kernel
        def add_run(a: F64, i: int, j: int, count: int) -> None:
            _within(a, i, i + count - 1)
            _within(a, j, j + count - 1)
            _tiles.add_run(a, i, j, count)

        @inline_kernel
        def tile(a: F64, rows: int, vectors: int, c: int, ldc: int, x: int, y: int, ld: int, depth: int) -> None:
            _within(a, c, c + (rows - 1) * ldc + vectors * LANES - 1)
            _within(a, x, x + (depth - 1) * ld + rows - 1)
            _within(a, y, y + (depth - 1) * ld + vectors * LANES - 1)
            _tiles.tile(a, rows, vectors, c, ldc, x, y, ld, depth)

        @inline_kernel
        def solve_rows(a: F64, rows: int, vectors: int, c: int, ld: int, t: int) -> None:
            _within(a, c, c + (rows - 1) * ld + vectors * LANES - 1)
            _within(a, t, t + 9)
            _tiles.solve_rows(a, rows, vectors, c, ld, t)

    else:
        at, put, zero, add_run = _tiles.at, _tiles.put, _tiles.zero, _tiles.add_run
        tile, solve_rows = _tiles.tile, _tiles.solve_rows

# Where the ten doubles of a 4 x 4 upper triangle T sit: 1/T00 1/T11 1/T22 1/T33, then the pairs above the diagonal.
_PAIR = {(0, 1): 4, (0, 2): 5, (1, 2): 6, (0, 3): 7, (1, 3): 8, (2, 3): 9}
