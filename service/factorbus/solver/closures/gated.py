"""A solver whose closures are tested as they come, in process; a map on the bus does the same in its steps.

    1  what a batch has besides closures goes in, one step
    2  its closures are judged (`judging`), and what that says is done (`switching`), a step each time it moves any

All of it follows from what was inserted: the same batches give the same verdicts, and the same bits.
"""

from dataclasses import dataclass

from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.closures.judging import ClosureJudge
from factorbus.solver.closures.ledger import REJECTED, RESTORED, SUSPECT, Closure, ClosureLedger, ClosureVerdicts
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.closures.switching import add_closures, check_whole, note_switch, planned_switch
from factorbus.solver.errors import SolverError
from factorbus.solver.graph.groups import Addition, BatchLike
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport
from factorbus.solver.solver import Solver


@dataclass(frozen=True, slots=True)
class GatedReport:
    """What one insert did: the report of its last step, and the closures whose state it changed.

    accepted: new ones, and suspects of before.  suspects: new ones.  contradicted: they were in, and are suspects.
    """

    step: StepReport
    accepted: tuple[Closure, ...] = ()
    suspects: tuple[Closure, ...] = ()
    contradicted: tuple[Closure, ...] = ()


class GatedSolver:
    """A `Solver`, in `solver`, that takes in no closure that it does not believe.  Not thread-safe."""

    def __init__(self, options: Options | None = None, policy: ClosurePolicy | None = None) -> None:
        self.solver, self.judge = Solver(options), ClosureJudge(policy)
        self.ledger = ClosureLedger()
        self._joined = TrustedForest()
        self._steps = 0

    @property
    def closures(self) -> list[Closure]:
        """All of them, in the order in which they came."""
        return self.ledger.closures

    def insert(self, batch: BatchLike) -> GatedReport:
        """Take in `batch`, but for closures that are not believed.

        Raises what `Solver.stage` and `step` do; nothing has changed then.
        """
        split = self._joined.split(batch)
        try:
            if split.closing:
                check_whole(self.solver._graph, batch)
            first = self.solver.stage(Addition(batch.variables, split.trusted))
            report = self.solver.step()
        except SolverError:
            self._joined.forget()
            raise
        self._steps += 1
        new = add_closures(self.solver._graph, self.ledger, split, first, self._steps)
        before = {c.factor_id: c.is_in for c in self.closures} if new else {}
        for kind in dict.fromkeys(c.factor.kind for c in new):
            while (verdicts := self.judge.look(self.solver, self.ledger, kind)) is not None:
                report = self._apply_or_keep(verdicts) or report
            if (verdicts := self.judge.look_back(self.solver, self.ledger, kind)) is not None:
                report = self._apply_or_keep(verdicts) or report
        changed = [c for c in self.closures if c.is_in != before.get(c.factor_id, c.is_in)]
        return GatedReport(
            report,
            tuple(c for c in changed if c.is_in),
            tuple(c for c in new if not c.is_in),
            tuple(c for c in changed if not c.is_in),
        )

    def suspects(self) -> list[Closure]:
        """Closures that the estimate does not have, and that may still be believed."""
        return [c for c in self.closures if c.state == SUSPECT]

    def accept(self, factor: int) -> StepReport | None:
        """Take a closure in, for good.  None: it is in already.  Raises NotAClosure, and what `step` does."""
        return self._apply(self.ledger.said([factor], RESTORED))

    def reject(self, factor: int) -> StepReport | None:
        """Take a closure out, for good.  None: it was out already.  Raises NotAClosure."""
        return self._apply(self.ledger.said([factor], REJECTED))

    def _apply_or_keep(self, verdicts: ClosureVerdicts) -> StepReport | None:
        """Where the step fails, what was to go in are suspects."""
        try:
            return self._apply(verdicts)
        except SolverError:
            return self._apply(self.ledger.failed(verdicts))

    def _apply(self, verdicts: ClosureVerdicts) -> StepReport | None:
        """Make the step that verdicts ask for, if any; None: nothing goes in or out."""
        switch = planned_switch(self.ledger, verdicts)
        following, report = self.solver._graph.next_id, None
        if switch.out:
            batch = Addition((), switch.additions)
            if (came := try_change(self.solver, switch.removals, batch)) is not None:
                report = came[1]
            else:
                self.solver, _, report, _ = with_changes(self.solver, switch.removals, batch)
        elif switch.into:
            self.solver.stage(Addition((), switch.additions))
            report = self.solver.step()
        note_switch(self.solver._graph, self.ledger, verdicts, switch, following, self._steps)
        return report
