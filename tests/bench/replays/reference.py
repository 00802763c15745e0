"""χ²_batch: the optimum of the graph as it is after each sampled step."""

from collections.abc import Callable, Sequence

from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver

from .chi2 import chi2_at
from .columns import Columns, Values
from .ours import values_of

_CLOSE = 1e-9
_STRIDE = 10  # poses between ordinary steps, so that no settling starts far from its optimum


def optima(
    steps: Sequence[Batch], columns: Columns, samples: Sequence[int], progress: Callable[[int], None] = lambda _: None
) -> tuple[list[tuple[int, float]], Values]:
    """(step, χ²_batch) at `samples`, and the values after the last of them.

    The all-batch solver follows the replay with a step every few poses and settles at the samples: iterates until
    the next step would lower χ² by less than 1e-14 of it.  Where the samples are more than every tenth step, each but
    the last is an ordinary step instead, from the optimum of the one before, until the next one would lower χ² by less
    than 1e-9 of it: that is one pass as a rule, and none where only a pose was added.  χ² is the common evaluator's.
    """
    solver, wanted, found, values = Solver(Options(mode="all-batch", batch_tolerance=_CLOSE)), set(samples), [], {}
    many = len(wanted) * _STRIDE > len(steps)
    for k, batch in enumerate(steps):
        solver.stage(batch)
        if k in wanted:
            solver.step(settle=not many or k == samples[-1])
            values = values_of(solver.estimate())
            found.append((k, chi2_at(columns, values, k)))
        elif k % _STRIDE == _STRIDE - 1:
            solver.step()
        progress(k)
    return found, values
