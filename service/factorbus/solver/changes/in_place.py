"""A change of factors as a step of the tree that has them, or not at all.  MATH §11.5."""

from collections.abc import Callable

import numpy as np

from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.changes.factor_edit import FactorEdit
from factorbus.solver.changes.requested import Edits
from factorbus.solver.errors import KindTaken, SolverError, TooLarge
from factorbus.solver.graph.escaped import find_beyond
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.report import StepReport
from factorbus.solver.stepper import Stepper
from factorbus.wording import counted


def try_in_place(
    graph: FactorGraph, steps: Stepper, edits: Edits, stage: Callable[[], int]
) -> tuple[int, StepReport] | None:
    """Make `edits`, add what `stage` brings, and step: the id of the first new factor, and the report.

    None: this is no change for a step, or one that failed, or in another mode than "bayes-tree"; then everything is as
    it was.  Raises the errors of `stage`.
    """
    if not isinstance(steps, TreeSteps):
        return None
    edit = FactorEdit(graph, steps.tree, edits)
    if not edit.is_possible:
        return None
    try:
        first = stage()
    except (KindTaken, TooLarge):
        if not edit.gone.size:
            raise
        return None  # what is removed may be what stands in the way: a solver of what is left says
    count = edit.gone.size, edit.members
    steps.rebase(*count)
    try:
        if edit.make():
            report = steps.step(settle=False)
            if is_sound(graph, steps, report):
                return first, report._replace(because=f"{_described(edit)}; {report.because}")
            steps.restore(report)
    except SolverError:
        pass  # whether it can be made at all, and why not, is for a solver of what is left to say
    except BaseException:
        _take_back(steps, edit, count)
        raise
    made = not steps.tree.state[tl.S_EDITED]
    _take_back(steps, edit, count)
    if made:
        steps.start_over()
    return None


def _take_back(steps: TreeSteps, edit: FactorEdit, count: tuple[int, int]) -> None:
    steps.forget()
    edit.undo()
    steps.rebase(-count[0], -count[1])


def is_sound(graph: FactorGraph, steps: TreeSteps, report: StepReport) -> bool:
    """Whether everything that the step moved, and χ², is within bounds."""
    escaped = find_beyond(steps.changed(), graph) >= 0
    return not escaped and bool(np.isfinite(report.chi2) and np.isfinite(report.chi2_before))


def _described(edit: FactorEdit) -> str:
    parts = [(edit.counts[0], "removed"), (edit.counts[1], "with another weight or loss")]
    return ", ".join(f"{counted(count, 'factor')} {what}" for count, what in parts if count)
