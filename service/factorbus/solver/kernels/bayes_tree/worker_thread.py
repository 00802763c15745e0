"""What a worker thread does for the eliminations of this process.

It has the elimination in it, and to compile that once more would take two seconds: so it is called by `step`.
"""

from factorbus.solver.kernels.bayes_tree.eliminate import make_subtree
from factorbus.solver.kernels.jit.compile import I64, part
from factorbus.solver.kernels.sparse.multifrontal import factorize_subtree
from factorbus.solver.kernels.sparse.parallel_panels import make_panel_chunk
from factorbus.solver.kernels.sparse.task_queue import (
    FRONTS,
    MADE,
    PANEL,
    TASK,
    finish_chunk,
    goes_on_working,
    scratch_of,
    take_chunk,
)


@part
def run_tasks(queue: I64, worker: int) -> None:
    """Make chunks of whatever the queue has, until the word `worker` of it says that this thread is to leave."""
    while goes_on_working(queue, worker):
        chunk = take_chunk(queue)
        while chunk >= 0:
            if queue[TASK] == PANEL:
                make_panel_chunk(queue, chunk)
            elif queue[TASK] == FRONTS:
                factorize_subtree(queue, chunk, scratch_of(worker))
            else:
                make_subtree(queue, chunk, scratch_of(worker))
            queue[worker + MADE] += 1
            finish_chunk(queue)
            chunk = take_chunk(queue)
