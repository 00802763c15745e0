"""A solver whose closures are tested as they come, in process; a map on the bus does the same in its steps.

    1  a batch goes in with those of its closures that the map expects (`ahead`), one step
    2  the others are judged, with suspects (`judging`), and what that says is done (`switching`), a step each time it
       moves any

All of it follows from what was inserted: the same batches give the same verdicts, and the same bits.
"""

from collections.abc import Sequence
from typing import NamedTuple

from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.closures.ahead import enter_closures, restage, stage_with_believed
from factorbus.solver.closures.judging import ClosureJudge
from factorbus.solver.closures.ledger import REJECTED, RESTORED, SUSPECT, Closure, ClosureLedger, ClosureVerdicts
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.closures.switching import note_switch, planned_switch
from factorbus.solver.errors import SolverError
from factorbus.solver.graph.groups import Addition, BatchLike
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport
from factorbus.solver.solver import Solver

_new = tuple.__new__  # as in `ahead`


class GatedReport(NamedTuple):
    """What one insert did: the report of its last step, and the closures whose state it changed.

    accepted: new ones, and suspects of before.  suspects: new ones.  contradicted: they were in, and are suspects.
    """

    step: StepReport
    accepted: Sequence[Closure] = ()
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
            if not split.closing:
                self.solver.stage(batch)
                report = self.solver.step()
                self._steps += 1
                return _new(GatedReport, (report, (), (), ()))
            staged = stage_with_believed(self.solver, self.ledger, batch, split, self.judge)
            try:
                report = self.solver.step()
            except SolverError:
                if not any(staged.believed):
                    raise
                staged = staged._replace(believed=[False] * len(staged.believed), all_in=False)
                restage(self.solver, batch, staged)
                report = self.solver.step()
        except SolverError:
            self._joined.forget()
            raise
        self._steps += 1
        new = enter_closures(self.solver, self.ledger, staged, self._steps)
        if staged.all_in and self.judge.is_settled(self.solver, self.ledger, new):
            return _new(GatedReport, (report, new, (), ()))
        return self._judged(report, new)

    def _judged(self, report: StepReport, new: Sequence[Closure]) -> GatedReport:
        """New closures are judged, with suspects, now that the rest of their batch is in."""
        moved = dict[int, bool]()
        for verdicts in self.judge.looks(lambda: self.solver, self.ledger, new):
            for c in self.ledger.named(verdicts.factors.tolist()):
                moved.setdefault(c.factor_id, c.is_in)
            report = self._apply_or_keep(verdicts) or report
        if not moved:
            return GatedReport(report, tuple(c for c in new if c.is_in), tuple(c for c in new if not c.is_in))
        for c in new:
            moved[c.factor_id] = False
        changed = [c for factor, was in sorted(moved.items()) if (c := self.ledger.of_factor[factor]).is_in != was]
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
