"""Block Cholesky RᵀR = PΛPᵀ, front by front from the leaves to the roots (Duff and Reid's multifrontal method)."""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.kernels.jit.simd import add_run, at, put, zero
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.partial_cholesky import PIVOT_TOLERANCE, factor_front


@kernel("int64(int64[:,::1], int64[:,::1], int64[:,::1], float64[::1], int64[::1], float64, float64[::1], int64[::1])")
def factorize(
    fronts: I64, runs: I64, blocks: I64, values: F64, offsets: I64, damping: float, arena: F64, queue: I64
) -> int:
    """Factorize Λ with its diagonal multiplied by 1 + damping.  Gives the scalar whose pivot failed, or -1.

    in   values: blocks of Λ, block b row-major at offsets[b]   queue: for worker threads, see `task_queue`
    out  arena: rows of R;  scalars count in elimination order
    """
    most = 0
    for f in range(fronts.shape[0]):
        most = max(most, fronts[f, fr.PIVOTS])
    floors = np.empty(most)  # least pivots allowed in a front
    for f in range(fronts.shape[0]):
        record = fronts[f]
        front = fr.front_of(record)
        r, ld, p = front.rows, front.ld, front.pivots
        clear_front(arena, front)
        for b in range(record[fr.BLOCKS], record[fr.BLOCKS_END]):
            write_block(arena, blocks, b, ld, values, offsets[blocks[b, fr.BLOCK_NUMBER]], 1.0 + damping)
        for i in range(p):
            floor = PIVOT_TOLERANCE * at(arena, r + i * ld + i)
            floors[i] = floor if floor > 0.0 else 0.0
        c = record[fr.CHILD]
        while c >= 0:
            child = fronts[c]
            add_update(arena, fr.front_of(child), runs, child[fr.RUNS], child[fr.RUNS_END], front)
            c = child[fr.SIBLING]
        failed = factor_front(arena, front, floors, 0, queue)
        if failed >= 0:
            return record[fr.COLUMN] + failed
    return -1


@inline_kernel
def clear_front(a: F64, front: fr.Front) -> None:
    """Zero the rows of R, their padding too, and the update matrix."""
    zero(a, front.rows - (fr.padded_size(front.pivots) - front.pivots), front.pivots * front.ld)
    zero(a, front.update, fr.update_size(front.separator, front.width))


@inline_kernel
def write_block(a: F64, blocks: I64, b: int, ld: int, values: F64, source: int, on_diagonal: float) -> None:
    """Write a block of Λ into the front; `on_diagonal` multiplies the diagonal of a diagonal block."""
    target, height, width, how = (
        blocks[b, fr.BLOCK_AT],
        blocks[b, fr.BLOCK_ROWS],
        blocks[b, fr.BLOCK_COLUMNS],
        blocks[b, fr.BLOCK_TURN],
    )
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
def add_update(a: F64, child: fr.Front, runs: I64, run: int, run_end: int, front: fr.Front) -> None:
    """Add the update matrix of `child` into the front above it, by its runs runs[run : run_end]."""
    r, ld, p, u, wide = front.rows, front.ld, front.pivots, front.update, front.width
    for s in range(run, run_end):
        first, count, into = runs[s, fr.RUN_FIRST], runs[s, fr.RUN_COUNT], runs[s, fr.RUN_INTO]
        for i in range(count):
            c, source = into + i, child.update + fr.update_row(first + i, child.width)
            target = r + c * ld if into < p else u + fr.update_row(c - p, wide) - p
            add_run(a, target + c, source + first + i, count - i)
            for t in range(s + 1, run_end):
                add_run(a, target + runs[t, fr.RUN_INTO], source + runs[t, fr.RUN_FIRST], runs[t, fr.RUN_COUNT])
