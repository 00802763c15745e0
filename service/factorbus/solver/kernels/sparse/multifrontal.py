"""Block Cholesky RᵀR = PΛPᵀ, front by front from the leaves to the roots (Duff and Reid's multifrontal method)."""

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.kernels.jit.simd import add_run, at, put, zero
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.partial_cholesky import PIVOT_TOLERANCE, factor_front


@kernel(
    "int64(int64[:,::1], int64[:,::1], int64[:,::1], float64[::1], int64[::1], float64, float64[::1], float64[::1], "
    "int64[::1])"
)
def factorize(
    fronts: I64, runs: I64, blocks: I64, values: F64, offsets: I64, damping: float, arena: F64, floors: F64, board: I64
) -> int:
    """Factorize Λ with its diagonal multiplied by 1 + damping.  Gives the scalar whose pivot failed, or -1.

    in   values: blocks of Λ, block b row-major at offsets[b]   board: where cores are lent, see `task_queue`
    out  arena: rows of R   floors (n,): least pivot allowed;  scalars count in elimination order
    """
    for f in range(fronts.shape[0]):
        front = fronts[f]
        r, ld, p, column = front[fr.ROWS], front[fr.LD_ROWS], front[fr.PIVOTS], front[fr.COLUMN]
        m, u, width = front[fr.BORDER], front[fr.UPDATE], front[fr.WIDTH_UPDATE]
        clear_front(arena, r, ld, p, m, u, width)
        for b in range(front[fr.BLOCKS], front[fr.BLOCKS_END]):
            put_block(arena, blocks, b, ld, values, offsets[blocks[b, 0]], 1.0 + damping)
        for i in range(p):
            floor = PIVOT_TOLERANCE * at(arena, r + i * ld + i)
            floors[column + i] = floor if floor > 0.0 else 0.0
        c = front[fr.CHILD]
        while c >= 0:
            child = fronts[c]
            extend_add(arena, child[fr.UPDATE], child[fr.WIDTH_UPDATE], runs, child[fr.RUNS], child[fr.RUNS_END], front)
            c = child[fr.SIBLING]
        failed = factor_front(arena, r, ld, p, m, u, width, floors, column, 0, board)
        if failed >= 0:
            return column + failed
    return -1


@inline_kernel
def clear_front(a: F64, r: int, ld: int, p: int, m: int, u: int, width: int) -> None:
    """Zero the rows of R, their padding too, and the update matrix."""
    zero(a, r - (fr.padded(p) - p), p * ld)
    zero(a, u, fr.update_size(m, width))


@inline_kernel
def put_block(a: F64, blocks: I64, b: int, ld: int, values: F64, source: int, on_diagonal: float) -> None:
    """Write a block of Λ into the front; `on_diagonal` multiplies the diagonal of a diagonal block."""
    target, height, width, how = blocks[b, 1], blocks[b, 2], blocks[b, 3], blocks[b, 4]
    for i in range(height):
        if how == fr.TURNED:
            for j in range(width):
                put(a, target + i * ld + j, at(values, source + j * height + i))
        else:
            for j in range(width):
                put(a, target + i * ld + j, at(values, source + i * width + j))
            if how == fr.DIAGONAL:
                put(a, target + i * ld + i, at(values, source + i * width + i) * on_diagonal)


@inline_kernel
def extend_add(a: F64, child: int, width: int, runs: I64, run: int, run_end: int, front: I64) -> None:
    """Add the update matrix at `child`, its first rows `width` wide, into the front above it, run by run."""
    p, r, ld, u, wide = front[fr.PIVOTS], front[fr.ROWS], front[fr.LD_ROWS], front[fr.UPDATE], front[fr.WIDTH_UPDATE]
    for s in range(run, run_end):
        first, count, into = runs[s, 0], runs[s, 1], runs[s, 2]
        for i in range(count):
            c, source = into + i, child + fr.update_row(first + i, width)
            target = r + c * ld if into < p else u + fr.update_row(c - p, wide) - p
            add_run(a, target + c, source + first + i, count - i)
            for t in range(s + 1, run_end):
                add_run(a, target + runs[t, 2], source + runs[t, 0], runs[t, 1])
