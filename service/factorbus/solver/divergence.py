"""Did a step leave everything within its bounds?  If not: what was there before it.  MATH §2.5.

What comes in is within bounds (`admission`), but what follows from it need not be: a landmark whose bearings are all
but parallel, or a distance of nothing in a denominator.  A map that holds one value that is not finite is lost to all
who share it, so such a step does not count.

A step of the tree cannot be taken back when it is done.  So what is of unusual sizes is tried on a copy, and everything
on a map that has such numbers; where a step diverges all the same, the values are put back and eliminated anew.

Not every insert whose step diverges is to blame: a map that has taken numbers of 10²⁴ and 10⁻²⁴ may run off elsewhere
when the next one comes.  An insert that has nothing to do with what ran off is made again, within the bounds.
"""

import math
from collections.abc import Sequence

import numpy as np

from factorbus.solver import errors
from factorbus.solver.changes.requested import ChangeLike
from factorbus.solver.changing import with_changes
from factorbus.solver.graph.escaped import find_beyond
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import BatchLike
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import LEAST_SCALE, MOST_NUMBER, are_usual
from factorbus.solver.report import StepReport
from factorbus.solver.solver import Solver
from factorbus.wording import outside


def check_step(solver: Solver, report: StepReport) -> None:
    """Raises Diverged if the last step of `solver`, which gave `report`, left anything out of bounds."""
    if (diverged := find_diverged(*solver.pick_changed(), report)) is not None:
        raise diverged


def find_diverged(changed: I64, graph: FactorGraph, report: StepReport) -> errors.Diverged | None:
    """What the last step, which `changed` these variables, left out of bounds: one of them, or χ²."""
    v = find_beyond(changed, graph)
    if v >= 0:
        kind, start = VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])], int(graph.var[v, at.V_AT])
        key, value = int(graph.keys[v]), graph.values[start : start + kind.size]
        beyond = np.flatnonzero(~(np.abs(value) <= MOST_NUMBER))
        if not beyond.size:
            where = f"the scale of {kind} {errors.printed(key)}"
            return errors.Diverged(
                where, outside(float(value[-1]), LEAST_SCALE, MOST_NUMBER), MOST_NUMBER, key=key, least=LEAST_SCALE
            )
        seen = outside(float(value[beyond[0]]), -MOST_NUMBER, MOST_NUMBER)
        return errors.Diverged(f"{kind} {errors.printed(key)}", seen, MOST_NUMBER, key=key)
    if math.isfinite(report.chi2) and math.isfinite(report.chi2_before):
        return None
    return errors.Diverged("χ²", f"{max(report.chi2, report.chi2_before):g}", math.inf)


def is_elsewhere(solver: Solver, report: StepReport) -> bool:
    """Whether all that the last step of `solver`, which gave `report`, left out of bounds is nothing that it brought:
    no new variable, and no end of a new factor.
    """
    changed, graph = solver.pick_changed()
    first = int(graph.counts[at.VARIABLES]) - report.new_variables
    rows = graph.fac[graph.rows_of_first(graph.factor_count - report.new_factors) : graph.counts[at.FACTORS]]
    own = (changed >= first) | np.isin(changed, rows[:, [at.F_I, at.F_J]])
    return find_beyond(changed[own], graph) < 0 <= find_beyond(changed[~own], graph)


def with_changes_within(
    solver: Solver, changes: Sequence[ChangeLike], batch: BatchLike | None = None, settle: bool = False
) -> tuple[Solver, int, StepReport, dict[str, int]]:
    """`with_changes` whose step is within its bounds, and is held there if need be.  Raises Diverged, too."""
    came = with_changes(solver, changes, batch, settle)
    made, _, report, _ = came
    if find_diverged(*made.pick_changed(), report) is not None and is_elsewhere(made, report):
        made, _, report, _ = came = with_changes(solver, changes, batch, settle, within=True)
    check_step(made, report)
    return came


def is_usual(solver: Solver, variables: int = 0, factors: int = 0) -> bool:
    """Whether all numbers are of usual sizes, but for those of a leading part of the variables and factors."""
    return bool(are_usual(variables, factors, solver._graph.array_table))


def unstage(solver: Solver) -> None:
    """Forget what was staged since the last step."""
    solver._graph.forget(solver._stepper.mark)


def copied(solver: Solver) -> Solver:
    """The same solver again, as of its last step: it goes on with the same bits.  What is staged is forgotten."""
    unstage(solver)
    made = Solver(solver._options)
    made.load(solver.dump())
    return made


def undone(solver: Solver, report: StepReport, variables: int, factors: int) -> tuple[Solver, StepReport]:
    """A new solver with the leading part of the variables and factors of `solver`, and the values they had before its
    last step, which gave `report`; and the report of its own first step, which eliminates everything at these values.

    `solver` is of no use then.  Raises SolverError.
    """
    solver._stepper.restore(report)
    made = Solver(solver._options)
    report = made.renew(solver, variables, factors)
    check_step(made, report)
    return made, report
