"""Other cores for large fronts and for subtrees: a board with one task at a time, cut into chunks.  MATH §9.5.

    1  take     the board, if nobody has it and a worker thread is there
    2  post     what the task is, then how many chunks it has; who sleeps is woken
    3  make     chunk after chunk, as long as there are any that nobody took; the worker threads do the same
    4  wait     for the chunks that others are at; the board is free again

No thread waits for one that has not taken a chunk: a worker thread may come late, or be gone.  What a task is may be
read once a chunk of it is taken, and until that is done.
"""

from factorbus.solver.kernels.jit.atomics import SEMAPHORE, exchange, fetch_add, give_way, sleep, wake
from factorbus.solver.kernels.jit.compile import I64, inline_kernel
from factorbus.solver.kernels.sparse.fronts import LENDERS as MOST
from factorbus.solver.kernels.sparse.fronts import SCRATCH_OF_ONE

# Words of a board.  Those that several threads change have a cache line each.
TASK = 0  # PANEL or SUBTREES
AT = 1  # entry of an array that the task is in, as in a table of `places`
MORE = 6  # what else is to be said of the task, up to
CHUNKS = 15
LEFT = 16  # chunks that nobody took; below 1: there are none
DONE = 24
TAKEN = 32  # 1: the board has a task
LENDERS = 40  # a cache line for each: what it does, chunks that it made, and the semaphore where it sleeps
NOBODY = -1
AWAY, LENDS, LEAVES = 0, 1, 2
MADE, ASLEEP = 1, 8 - SEMAPHORE
WORDS = LENDERS + 8 * MOST

PANEL, SUBTREES = 0, 1


@inline_kernel
def count_lenders(board: I64) -> int:
    """The number of worker threads."""
    count = 0
    for worker in range(LENDERS, WORDS, 8):
        count += int(board[worker] == LENDS)
    return count


@inline_kernel
def take_board(board: I64) -> bool:
    """Have the board for a task.  False: there is no worker thread, or another task is there."""
    return count_lenders(board) > 0 and exchange(board, TAKEN, 1) == 0


@inline_kernel
def post(board: I64, task: int, chunks: int) -> None:
    """Let others take chunks of the task, of which all else is on the board."""
    board[TASK], board[CHUNKS], board[DONE] = task, chunks, 0
    exchange(board, LEFT, chunks)
    for worker in range(LENDERS, WORDS, 8):
        if board[worker] == LENDS:
            wake(board, worker + ASLEEP)


@inline_kernel
def take_chunk(board: I64) -> int:
    """A chunk that nobody took, or −1.  Who takes one says when it is done."""
    left = fetch_add(board, LEFT, -1)
    return board[CHUNKS] - left if left > 0 else -1


@inline_kernel
def say_done(board: I64) -> None:
    """The chunk that this thread took is made."""
    fetch_add(board, DONE, 1)


@inline_kernel
def wait_and_leave(board: I64) -> None:
    """Until all chunks are done; then the board is free."""
    while fetch_add(board, DONE, 0) < board[CHUNKS]:
        give_way()
    exchange(board, TAKEN, 0)


@inline_kernel
def goes_on_working(board: I64, worker: int) -> bool:
    """Whether the thread that has the word `worker` goes on, after it has slept until it is woken."""
    sleep(board, worker + ASLEEP)
    return fetch_add(board, worker, 0) == LENDS


@inline_kernel
def scratch_of(worker: int) -> int:
    """Where this thread has its scratch in an arena; the one that posted the task has it at 0."""
    return SCRATCH_OF_ONE * (1 + (worker - LENDERS) // 8)
