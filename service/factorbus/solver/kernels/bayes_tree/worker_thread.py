"""What a worker thread does for the eliminations of this process.

It has the elimination in it, and to compile that once more would take two seconds: so it is called by `step`.
"""

from factorbus.solver.kernels.bayes_tree.eliminate import make_subtree
from factorbus.solver.kernels.jit.compile import I64, part
from factorbus.solver.kernels.sparse.parallel_panels import make_panel_chunk
from factorbus.solver.kernels.sparse.task_queue import (
    MADE,
    PANEL,
    TASK,
    goes_on_working,
    say_done,
    scratch_of,
    take_chunk,
)


@part
def run_tasks(board: I64, worker: int) -> None:
    """Make chunks of whatever the board has, until the word `worker` of it says that this thread is to leave."""
    while goes_on_working(board, worker):
        chunk = take_chunk(board)
        while chunk >= 0:
            if board[TASK] == PANEL:
                make_panel_chunk(board, chunk)
            else:
                make_subtree(board, chunk, scratch_of(worker))
            board[worker + MADE] += 1
            say_done(board)
            chunk = take_chunk(board)
