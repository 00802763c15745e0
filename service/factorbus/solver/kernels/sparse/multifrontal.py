"""Block Cholesky RᵀR = PΛPᵀ, front by front from the leaves to the roots (Duff and Reid's multifrontal method).

What takes long is shared with worker threads: subtrees first, then panels of the fronts above them.  MATH §9.5
"""

import numpy as np

from factorbus.solver.kernels.jit.array_table import (
    WIDTH,
    address_of,
    floats,
    int_rows,
    ints,
    put_entry,
)
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.simd import add_run, zero
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.partial_cholesky import PIVOT_TOLERANCE, factor_front
from factorbus.solver.kernels.sparse.subtrees import END, FAILED, FIRST, SUBTREE, TURN, cut_whole
from factorbus.solver.kernels.sparse.task_queue import (
    AT,
    FRONTS,
    claim,
    count_workers,
    finish_chunk,
    post,
    take_chunk,
    wait_and_release,
)

# Entries of a plan, a table as in `array_table`: the arguments of `factorize`, and the subtrees, a row each.
RECORDS, RUNS, BLOCKS, VALUES, OFFSETS, ARENA, DAMPING, CUT = range(8)
PLAN = WIDTH * 8


@kernel("int64(int64[:,::1], int64[:,::1], int64[:,::1], float64[::1], int64[::1], float64, float64[::1], int64[::1])")
def factorize(
    fronts: I64, runs: I64, blocks: I64, values: F64, offsets: I64, damping: float, arena: F64, queue: I64
) -> int:
    """Factorize Λ with its diagonal multiplied by 1 + damping.  Gives the scalar whose pivot failed, or -1.

    in   values: blocks of Λ, block b row-major at offsets[b]   queue: for worker threads, see `task_queue`
    out  arena: rows of R;  scalars count in elimination order
    """
    plan, scale = np.empty(PLAN, np.int64), np.empty(1)
    scale[0] = 1.0 + damping
    put_entry(plan, RECORDS, address_of(fronts), len(fronts), fr.FRONT)
    put_entry(plan, RUNS, address_of(runs), len(runs), fr.RUN)
    put_entry(plan, BLOCKS, address_of(blocks), len(blocks), fr.BLOCK)
    put_entry(plan, VALUES, address_of(values), values.size, 1)
    put_entry(plan, OFFSETS, address_of(offsets), offsets.size, 1)
    put_entry(plan, ARENA, address_of(arena), arena.size, 1)
    put_entry(plan, DAMPING, address_of(scale), 1, 1)
    return _factorize_in_pieces(plan, fronts, scale, queue)


@part
def _factorize_in_pieces(plan: I64, records: I64, _scale: F64, queue: I64) -> int:
    """Subtrees on several cores, if it is worth it, and then what is above them; what fails first is what counts."""
    cut, pieces = records[:0], 0
    if count_workers(queue) > 0:
        cut = cut_whole(records)
        if len(cut) > 0 and claim(queue):
            pieces = len(cut)
            put_entry(plan, CUT, address_of(cut), pieces, SUBTREE)
            _factorize_together(plan, pieces, queue)
    f = 0
    for k in range(pieces):
        failed = factorize_range(plan, f, cut[k, FIRST], 0, queue)
        if failed < 0:
            failed = cut[k, FAILED]
        if failed >= 0:
            return failed
        f = cut[k, END]
    return factorize_range(plan, f, len(records), 0, queue)


@part
def _factorize_together(plan: I64, pieces: int, queue: I64) -> None:
    """All subtrees; the queue is this thread's."""
    put_entry(queue, AT, address_of(plan), plan.size, 1)
    post(queue, FRONTS, pieces)
    chunk = take_chunk(queue)
    while chunk >= 0:
        factorize_subtree(queue, chunk, 0)
        finish_chunk(queue)
        chunk = take_chunk(queue)
    wait_and_release(queue)


@part
def factorize_subtree(queue: I64, chunk: int, t: int) -> None:
    """Factorize a subtree of the plan that the queue has, with the scratch at t."""
    plan = ints(queue, AT)
    subtrees = int_rows(plan, CUT)
    subtree = subtrees[subtrees[chunk, TURN]]
    subtree[FAILED] = factorize_range(plan, subtree[FIRST], subtree[END], t, queue)


@part
def factorize_range(plan: I64, begin: int, end: int, t: int, queue: I64) -> int:
    """Factorize fronts begin .. end, whose children are.  Gives the scalar whose pivot failed, or −1."""
    fronts, runs, blocks = int_rows(plan, RECORDS), int_rows(plan, RUNS), int_rows(plan, BLOCKS)
    values, offsets, arena = floats(plan, VALUES), ints(plan, OFFSETS), floats(plan, ARENA)
    on_diagonal = floats(plan, DAMPING)[0]
    most = 0
    for f in range(begin, end):
        most = max(most, fronts[f, fr.PIVOTS])
    floors = np.empty(most)  # least pivots allowed in a front
    for f in range(begin, end):
        record = fronts[f]
        front = fr.front_of(record)
        r, ld, p = front.rows, front.ld, front.pivots
        clear_front(arena, front)
        for b in range(record[fr.BLOCKS], record[fr.BLOCKS_END]):
            write_block(arena, blocks, b, ld, values, offsets[blocks[b, fr.BLOCK_NUMBER]], on_diagonal)
        for i in range(p):
            floor = PIVOT_TOLERANCE * arena[r + i * ld + i]
            floors[i] = floor if floor > 0.0 else 0.0
        c = record[fr.CHILD]
        while c >= 0:
            child = fronts[c]
            add_update(arena, fr.front_of(child), runs, child[fr.RUNS], child[fr.RUNS_END], front)
            c = child[fr.SIBLING]
        failed = factor_front(arena, front, floors, t, queue)
        if failed >= 0:
            return int(record[fr.COLUMN] + failed)
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
                a[target + i * ld + j] = values[source + j * height + i]
        else:
            for j in range(width):
                a[target + i * ld + j] = values[source + i * width + j]
            if how == fr.DIAGONAL:
                a[target + i * ld + i] = values[source + i * width + i] * on_diagonal


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
