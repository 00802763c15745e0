"""Where worker threads of this process work on the eliminations of this process.  MATH §9.5.

The solver has no thread of its own: a caller with one to spare makes a `WorkerThread`, and calls its `run` on that
thread. There is one queue in a process, as there is one set of cores.
"""

import ctypes

import numpy as np

from factorbus.solver.graph.arenas import lines
from factorbus.solver.kernels.bayes_tree.step import tree_step
from factorbus.solver.kernels.jit.atomics import CAN_SLEEP
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.sparse import task_queue as at

TASK_QUEUE: I64 = lines(at.WORDS, np.int64)  # see `kernels/sparse/task_queue.py`
_NOTHING: I64 = np.empty(0, np.int64)

# Words of workers that nobody has; none where threads cannot sleep in a kernel.
_free = list(range(at.WORKERS, at.WORDS, 8)) if CAN_SLEEP else []


def count_free() -> int:
    """How many workers there may be in addition to those that there are."""
    return len(_free)


def can_work() -> bool:
    """Whether the kernel that workers run is compiled or loaded: called before, `run` has to do that first."""
    return CAN_SLEEP and bool(tree_step.signatures)


class WorkerThread:
    """A worker thread.  Raises ValueError when there are as many as there may be.

    made: chunks of eliminations that it has made.
    """

    def __init__(self) -> None:
        if not _free:
            raise ValueError(f"{at.MOST} worker threads, which is all that can, or none can on this system")
        self._word = _free.pop()
        self._semaphore = ctypes.c_void_p(TASK_QUEUE.ctypes.data + 8 * (self._word + at.SEMAPHORE_AT))
        self._libc = ctypes.CDLL(None)
        self._libc.sem_init(self._semaphore, 0, 0)
        self._line = TASK_QUEUE[self._word : self._word + 8]
        self._line[at.MADE], self._line[0] = 0, at.WORKING

    @property
    def made(self) -> int:
        return int(self._line[at.MADE])

    def run(self) -> None:
        """Returns after `leave`.  Once, on the thread whose core it is."""
        tree_step(_NOTHING, _NOTHING, TASK_QUEUE, self._word)
        self._line[0] = at.ABSENT
        self._line = self._line.copy()
        _free.append(self._word)

    def leave(self) -> None:
        """Have `run` return, if need be after the chunk that it is at.  Once."""
        self._line[0] = at.STOPPING
        self._libc.sem_post(self._semaphore)
