"""Partial Cholesky of one dense front: p pivots out of p + m, the rest becomes the update matrix.

    [ A  B ]   [ Rᵀ   ] [ R  S ]          RᵀR = A,  S = R⁻ᵀB,  U = C − SᵀS
    [ ·  C ] = [ Sᵀ I ] [ 0  U ]

Rows are made four at a time, each tile of a row group held in registers while all earlier rows of the panel are
taken off it, so every number is loaded and stored once per panel.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.simd import LANES, TILE_ROWS, Block, Panel, solve_tile
from factorbus.solver.kernels.sparse.fronts import Front, padded_size
from factorbus.solver.kernels.sparse.panels import DEPTH, take_off, take_panel_off
from factorbus.solver.kernels.sparse.parallel_panels import is_large, take_panel_off_together

# A pivot is what cancellation leaves of the diagonal entry Λₖₖ, with a rounding error of some ε·Λₖₖ.  Measured: the
# pivots of a free grid of 100 poses, zero in truth, come out at 4e-15·Λₖₖ or below zero, while the least pivot of a
# chain of 30,000 poses held at one end only and eliminated from there, poor but real, is 1e-11·Λₖₖ.
PIVOT_TOLERANCE = 1e-13
# Where it is known that everything is held, a pivot below this share of Λₖₖ is rounding, and is raised to it.
LEAST_PIVOT = 1e-12
# The same of the largest Λₖₖ of all: its rounding, and that of its gradient, go on to what is eliminated later, and
# what is known of anything by less is lost in them.  A map that only a prior of σ 1e5 rad holds would turn by 0.1 rad.
ROUNDING = 2.0**-46
# Where a pivot had to be raised, each Λₖₖ is multiplied by one plus this, some 30 times the rounding of one number:
# that is positive definite, and no entry of R is more than it should be.
DAMPING = 2.0**-48
RAISED = -2  # what `factor_front` gives where it raised a pivot


@part
def factor_front(a: F64, front: Front, floors: F64, t: int, queue: I64) -> int:
    """Factorize a front in place; the layout is that of `fronts`.  Gives the pivot that failed, or -1; or RAISED.

    in   floors[i]: pivot i must exceed it, or, where it is negative, is raised to its size if it does not
         t: scratch of this thread
         queue: for worker threads, see `task_queue`
    out  rows: R and S   update matrix: U
    """
    r, ld, p, m = front.rows, front.ld, front.pivots, front.separator
    raised, lead = False, padded_size(p) - p
    for top in range(0, p, DEPTH):
        end = min(top + DEPTH, p)
        for i in range(top, end, TILE_ROWS):
            rows = min(TILE_ROWS, end - i)
            take_off(a, rows, Block(r + i * ld, ld), Panel(r + top * ld, ld, i - top), i, i, p + m, lead)
            failed = pivot_rows(a, rows, r + i * ld + i, ld, floors, i, t)
            if failed >= 0:
                return i + failed
            raised |= failed == RAISED
            first = i - (lead + i) % LANES
            solve_tile(a, rows, (padded_size(lead + p + m) - lead - first) // LANES, r + i * ld + first, ld, t)
        large = is_large(end - top, p + m - end)
        if not (large and take_panel_off_together(queue, a, front, top, end)):
            take_panel_off(a, front, top, end, end, p + m)
    return RAISED if raised else -1


@inline_kernel
def pivot_rows(a: F64, rows: int, d: int, ld: int, floors: F64, k: int, t: int) -> int:
    """Cholesky of the `rows` x `rows` block at d into the scratch at t; gives the pivot that failed, or -1; or RAISED.

    Scratch: 1/T₀₀ 1/T₁₁ 1/T₂₂ 1/T₃₃ T₀₁ T₀₂ T₁₂ T₀₃ T₁₃ T₂₃.
    """
    status = -1
    for j in range(rows):
        column = t + 4 + j * (j - 1) // 2
        for i in range(j):
            above = a[d + i * ld + j]
            for q in range(i):
                above -= a[t + 4 + i * (i - 1) // 2 + q] * a[column + q]
            a[column + i] = above * a[t + i]
        pivot = a[d + j * ld + j]
        for q in range(j):
            pivot -= a[column + q] ** 2
        floor = floors[k + j]
        if not (pivot > abs(floor) and pivot > 0.0):
            if not (floor < 0.0 and pivot <= abs(floor)):
                return j
            a[d + j * ld + j] = a[d + j * ld + j] - floor - pivot
            pivot, status = -floor, RAISED
        a[t + j] = 1.0 / math.sqrt(pivot)
    return status
