"""What the functions of `simd` mean, in NumPy.  Offsets count doubles from the start of the array."""

from typing import NamedTuple

from factorbus.solver.kernels.jit.compile import F64, vector_lanes

_LANES = vector_lanes()
# Where the ten doubles of a 4 x 4 upper triangle T sit: 1/T₀₀ 1/T₁₁ 1/T₂₂ 1/T₃₃, then what is above the diagonal.
TRIANGLE = {(0, 1): 4, (0, 2): 5, (1, 2): 6, (0, 3): 7, (1, 3): 8, (2, 3): 9}


class Block(NamedTuple):
    """A dense block of an array, row by row: column j of row i is at `start` + i·`ld` + j."""

    start: int
    ld: int


class Panel(NamedTuple):
    """A block of `depth` rows."""

    start: int
    ld: int
    depth: int


def zero(a: F64, i: int, count: int) -> None:
    """a[i : i+count] = 0"""
    a[i : i + count] = 0.0


def add_run(a: F64, i: int, j: int, count: int) -> None:
    """a[i : i+count] += a[j : j+count]; the runs do not overlap"""
    a[i : i + count] += a[j : j + count]


def tile(a: F64, rows: int, vectors: int, C: Block, X: Panel, y: int) -> None:
    """C −= XᵀY: C (rows, vectors·LANES), X (depth, rows), Y (depth, vectors·LANES) at y with the ld of X."""
    width = vectors * _LANES
    for i in range(rows):
        line = C.start + i * C.ld
        for k in range(X.depth):
            row = y + k * X.ld
            a[line : line + width] -= a[X.start + k * X.ld + i] * a[row : row + width]


def solve_tile(a: F64, rows: int, vectors: int, c: int, ld: int, t: int) -> None:
    """C = T⁻ᵀC: C (rows, vectors·LANES) at c, T (rows, rows) at t as TRIANGLE says"""
    lines = [a[c + i * ld : c + i * ld + vectors * _LANES] for i in range(rows)]
    for i in range(rows):
        for k in range(i):
            lines[i] -= a[t + TRIANGLE[k, i]] * lines[k]
        lines[i] *= a[t + i]


def six(x: F64, X: Panel, y: F64, j: int, out: F64, to: int) -> None:
    """out[to : to+6] = Σ X[k, 0] y[j + 6 k : j + 6 k + 6], k from 0 to depth − 1; X is in x"""
    out[to : to + 6] = sum(x[X.start + k * X.ld] * y[j + 6 * k : j + 6 * k + 6] for k in range(X.depth))
