"""What a panel takes off the rows behind it, in chunks of rows that several threads make.  Same bits by any."""

from factorbus.solver.kernels.jit.array_table import address_of, floats, put_entry
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.sparse.fronts import Front
from factorbus.solver.kernels.sparse.panels import take_panel_off
from factorbus.solver.kernels.sparse.task_queue import (
    AT,
    MORE,
    PANEL,
    claim,
    finish_chunk,
    post,
    take_chunk,
    wait_and_release,
)

CHUNK = 32  # rows
LARGE = 4_000_000  # multiplications that are worth waking somebody, a sixth of a millisecond

R, LD, P, M, U, WIDTH, TOP, END = range(MORE, MORE + 8)  # words of the task; its array is the one with the front


@inline_kernel
def is_large(depth: int, behind: int) -> bool:
    """Whether a panel of `depth` rows takes much off the `behind` rows behind it."""
    return depth * behind * behind > 2 * LARGE


@part
def take_panel_off_together(queue: I64, a: F64, front: Front, top: int, end: int) -> bool:
    """As `take_panel_off`, from all rows behind the panel.  False: there is nobody to do it with; nothing is done."""
    if not claim(queue):
        return False
    put_entry(queue, AT, address_of(a), a.size, 1)
    queue[R], queue[LD], queue[P], queue[M], queue[U], queue[WIDTH] = front
    queue[TOP], queue[END] = top, end
    post(queue, PANEL, _chunks(front.pivots - end) + _chunks(front.separator))
    chunk = take_chunk(queue)
    while chunk >= 0:
        make_panel_chunk(queue, chunk)
        finish_chunk(queue)
        chunk = take_chunk(queue)
    wait_and_release(queue)
    return True


@part
def make_panel_chunk(queue: I64, chunk: int) -> None:
    """CHUNK rows of R, or of the update matrix, lose what the panel has."""
    p, m, end = queue[P], queue[M], queue[END]
    in_r = _chunks(p - end)
    if chunk < in_r:
        low = end + chunk * CHUNK
        high = min(low + CHUNK, p)
    else:
        low = p + (chunk - in_r) * CHUNK
        high = min(low + CHUNK, p + m)
    a = floats(queue, AT)
    front = Front(queue[R], queue[LD], p, m, queue[U], queue[WIDTH])
    take_panel_off(a, front, queue[TOP], end, low, high)


@inline_kernel
def _chunks(rows: int) -> int:
    return (rows + CHUNK - 1) // CHUNK
