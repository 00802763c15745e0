"""What a panel takes off the rows behind it, in chunks of rows that several threads make.  Same bits, whoever does."""

from factorbus.solver.kernels.jit.array_table import address_of, floats, put_place
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.sparse.fronts import Front
from factorbus.solver.kernels.sparse.panels import take_panel_off
from factorbus.solver.kernels.sparse.task_queue import (
    AT,
    MORE,
    PANEL,
    post,
    say_done,
    take_board,
    take_chunk,
    wait_and_leave,
)

CHUNK = 32  # rows
LARGE = 4_000_000  # multiplications that are worth waking somebody, a sixth of a millisecond

R, LD, P, M, U, WIDTH, TOP, END = range(MORE, MORE + 8)  # words of the task; its array is the one with the front


@inline_kernel
def is_large(depth: int, behind: int) -> bool:
    """Whether a panel of `depth` rows takes much off the `behind` rows behind it."""
    return depth * behind * behind > 2 * LARGE


@part
def take_panel_off_together(board: I64, a: F64, front: Front, top: int, end: int) -> bool:
    """As `take_panel_off`, from all rows behind the panel.  False: there is nobody to do it with; nothing is done."""
    if not take_board(board):
        return False
    put_place(board, AT, address_of(a), a.size, 1)
    board[R], board[LD], board[P], board[M], board[U], board[WIDTH] = front
    board[TOP], board[END] = top, end
    post(board, PANEL, _chunks(front.pivots - end) + _chunks(front.border))
    chunk = take_chunk(board)
    while chunk >= 0:
        make_panel_chunk(board, chunk)
        say_done(board)
        chunk = take_chunk(board)
    wait_and_leave(board)
    return True


@part
def make_panel_chunk(board: I64, chunk: int) -> None:
    """CHUNK rows of R, or of the update matrix, lose what the panel has."""
    p, m, end = board[P], board[M], board[END]
    in_r = _chunks(p - end)
    if chunk < in_r:
        low = end + chunk * CHUNK
        high = min(low + CHUNK, p)
    else:
        low = p + (chunk - in_r) * CHUNK
        high = min(low + CHUNK, p + m)
    a = floats(board, AT)
    front = Front(board[R], board[LD], p, m, board[U], board[WIDTH])
    take_panel_off(a, front, board[TOP], end, low, high)


@inline_kernel
def _chunks(rows: int) -> int:
    return (rows + CHUNK - 1) // CHUNK
