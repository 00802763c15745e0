"""Other cores for large fronts and for subtrees: the chunks of one task at a time.  MATH §9.5.

    1  claim    the queue, if it is free and there is a worker thread
    2  post     what the task is, then how many chunks it has; worker threads that sleep are woken
    3  take     chunk after chunk, as long as there are any left; the worker threads do the same
    4  wait     for the chunks that others are at; the queue is free again

No thread waits for one that has not taken a chunk: a worker thread may come late, or be gone.  What a task is may be
read once a chunk of it is taken, and until that is done.
"""

from factorbus.solver.kernels.jit.atomics import SEMAPHORE, exchange, fetch_add, give_way, sleep, wake
from factorbus.solver.kernels.jit.compile import I64, inline_kernel
from factorbus.solver.kernels.sparse.fronts import MOST_WORKERS as MOST
from factorbus.solver.kernels.sparse.fronts import SCRATCH_OF_ONE

# Words of a queue.  Those that several threads change have a cache line each.
TASK = 0  # PANEL, SUBTREES or FRONTS
AT = 1  # entry of an array that the task is in, as in a table of arrays
MORE = 6  # what else is to be said of the task, up to
CHUNKS = 15
LEFT = 16  # chunks that nobody took; below 1: there are none
DONE = 24
TAKEN = 32  # 1: the queue has a task
WORKERS = 40  # a cache line for each: what it does, chunks that it made, and the semaphore where it sleeps
NOBODY = -1
ABSENT, WORKING, STOPPING = 0, 1, 2
MADE, SEMAPHORE_AT = 1, 8 - SEMAPHORE
WORDS = WORKERS + 8 * MOST

PANEL, SUBTREES, FRONTS = 0, 1, 2


@inline_kernel
def count_workers(queue: I64) -> int:
    """The number of worker threads."""
    count = 0
    for worker in range(WORKERS, WORDS, 8):
        count += int(queue[worker] == WORKING)
    return count


@inline_kernel
def claim(queue: I64) -> bool:
    """Claim the queue for a task.  False: there is no worker thread, or it has another task."""
    return count_workers(queue) > 0 and exchange(queue, TAKEN, 1) == 0


@inline_kernel
def post(queue: I64, task: int, chunks: int) -> None:
    """Let others take chunks of the task, of which all else is in the queue."""
    queue[TASK], queue[CHUNKS], queue[DONE] = task, chunks, 0
    exchange(queue, LEFT, chunks)
    for worker in range(WORKERS, WORDS, 8):
        if queue[worker] == WORKING:
            wake(queue, worker + SEMAPHORE_AT)


@inline_kernel
def take_chunk(queue: I64) -> int:
    """A chunk that nobody took, or −1.  Who takes one says when it is done."""
    left = fetch_add(queue, LEFT, -1)
    return queue[CHUNKS] - left if left > 0 else -1


@inline_kernel
def finish_chunk(queue: I64) -> None:
    """The chunk that this thread took is made."""
    fetch_add(queue, DONE, 1)


@inline_kernel
def wait_and_release(queue: I64) -> None:
    """Until all chunks are done; then the queue is free."""
    while fetch_add(queue, DONE, 0) < queue[CHUNKS]:
        give_way()
    exchange(queue, TAKEN, 0)


@inline_kernel
def goes_on_working(queue: I64, worker: int) -> bool:
    """Whether the thread that has the word `worker` goes on, after it has slept until it is woken."""
    sleep(queue, worker + SEMAPHORE_AT)
    return fetch_add(queue, worker, 0) == WORKING


@inline_kernel
def scratch_of(worker: int) -> int:
    """Where this thread has its scratch in an arena; the one that posted the task has it at 0."""
    return SCRATCH_OF_ONE * (1 + (worker - WORKERS) // 8)
