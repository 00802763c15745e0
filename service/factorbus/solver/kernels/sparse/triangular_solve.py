"""Solving with the fronts of R: RᵀR δ = η."""

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.kernels.sparse import fronts as fr


@kernel("void(int64[:,::1], int64[::1], float64[::1], float64[::1], float64[::1])")
def solve_fronts_transposed(fronts: I64, separator: I64, arena: F64, x: F64, room: F64) -> None:
    """x = R⁻ᵀx in place, from the leaves to the roots; scalars in elimination order.

    room: at least as long as the longest separator
    """
    for f in range(fronts.shape[0]):
        front = fronts[f]
        r, ld, p, m, k = front[fr.ROWS], front[fr.LD_ROWS], front[fr.PIVOTS], front[fr.SEPARATOR], front[fr.COLUMN]
        forward_front(arena, r, ld, p, m, x, k, room)
        b = front[fr.SEPARATOR_AT]
        for j in range(m):
            x[separator[b + j]] -= room[j]


@kernel("void(int64[:,::1], int64[::1], float64[::1], float64[::1], float64[::1])")
def solve_fronts(fronts: I64, separator: I64, arena: F64, x: F64, room: F64) -> None:
    """x = R⁻¹x in place, from the roots to the leaves; otherwise as `solve_fronts_transposed`."""
    for f in range(fronts.shape[0] - 1, -1, -1):
        front = fronts[f]
        r, ld, p, m, k = front[fr.ROWS], front[fr.LD_ROWS], front[fr.PIVOTS], front[fr.SEPARATOR], front[fr.COLUMN]
        b = front[fr.SEPARATOR_AT]
        for j in range(m):
            room[j] = x[separator[b + j]]
        backward_front(arena, r, ld, p, m, x, k, room)


@kernel("void(int64[::1], int64[::1], int64[::1], float64[::1], float64[::1])")
def into_elimination_order(place: I64, starts: I64, dims: I64, given: F64, x: F64) -> None:
    """x[place] = given, variable by variable."""
    for v in range(place.size):
        for i in range(dims[v]):
            x[place[v] + i] = given[starts[v] + i]


@kernel("void(int64[::1], int64[::1], int64[::1], float64[::1], float64[::1])")
def into_insertion_order(place: I64, starts: I64, dims: I64, x: F64, out: F64) -> None:
    """out = x[place], variable by variable."""
    for v in range(place.size):
        for i in range(dims[v]):
            out[starts[v] + i] = x[place[v] + i]


@inline_kernel
def forward_front(a: F64, r: int, ld: int, p: int, m: int, x: F64, k: int, room: F64) -> None:
    """x[k : k+p] = R⁻ᵀ x[k : k+p];  room[: m] = Sᵀ x[k : k+p]"""
    for j in range(m):
        room[j] = 0.0
    for i in range(p):
        row = r + i * ld
        y = x[k + i] / a[row + i]
        x[k + i] = y
        for j in range(i + 1, p):
            x[k + j] -= a[row + j] * y
        for j in range(m):
            room[j] += a[row + p + j] * y


@inline_kernel
def backward_front(a: F64, r: int, ld: int, p: int, m: int, x: F64, k: int, room: F64) -> None:
    """x[k : k+p] = R⁻¹ (x[k : k+p] − S room[: m])"""
    for i in range(p - 1, -1, -1):
        row = r + i * ld
        dot = 0.0
        for j in range(m):
            dot += a[row + p + j] * room[j]
        for j in range(i + 1, p):
            dot += a[row + j] * x[k + j]
        x[k + i] = (x[k + i] - dot) / a[row + i]
