"""A solver whose closures are weighed by graduated non-convexity as they come, in process; a map on the bus does the
same in its steps.

    1  a batch goes in with the final loss on its closures, one step
    2  what does not fit is graduated (`graduation`), a step for each stage

All of it follows from what was inserted: the same batches give the same weights, and the same bits.
"""

from collections.abc import Sequence

from factorbus.solver.closures.gated import GatedReport
from factorbus.solver.closures.graduated_kernel import graduated_split, with_final_loss
from factorbus.solver.closures.graduation import ClosureGraduation, step_with
from factorbus.solver.closures.ledger import SUSPECT, Closure, ClosureLedger
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.closures.switching import planned_switch
from factorbus.solver.errors import SolverError
from factorbus.solver.graph.groups import BatchLike
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport
from factorbus.solver.solver import Solver


class GraduatedSolver:
    """A `Solver`, in `solver`, with closures by their weight, without outweighed ones.  Not thread-safe."""

    def __init__(self, options: Options | None = None, policy: ClosurePolicy | None = None) -> None:
        self.solver, self.graduation = Solver(options), ClosureGraduation(policy)
        self.ledger = ClosureLedger(weighs=True)
        self._joined = TrustedForest()
        self._steps = 0

    @property
    def closures(self) -> list[Closure]:
        """All of them, in the order in which they came; `chance` is their weight."""
        return self.ledger.closures

    def insert(self, batch: BatchLike) -> GatedReport:
        """Take in `batch`, with its closures by their weight.

        Raises what `Solver.stage` and `step` do; nothing has changed then.
        """
        split = graduated_split(self._joined.split(batch))
        try:
            if split.closing:
                batch = with_final_loss(batch, split, self.graduation.final_scales)
            first = self.solver.stage(batch)
            report = self.solver.step()
        except SolverError:
            self._joined.forget()
            raise
        self._steps += 1
        if not split.closing:
            return GatedReport(report)
        placed = zip(split.closing, split.places, strict=True)
        graph = self.solver.factor_graph
        new = [self.ledger.add(factor, first + place, graph, self._steps) for factor, place in placed]
        return self._weighed(report, new)

    def suspects(self) -> list[Closure]:
        """Closures with less than a quarter of their weight."""
        return [c for c in self.closures if c.state == SUSPECT]

    def _weighed(self, report: StepReport, new: Sequence[Closure]) -> GatedReport:
        """Stage after stage."""
        moved = dict[int, tuple[Closure, str]]()
        stages = self.graduation.looks(lambda: self.solver, self.ledger, new)
        stage = next(stages, None)
        while stage is not None:
            done = True
            if stage.scale is not None or planned_switch(self.ledger, stage.verdicts).out:
                try:
                    self.solver, report = step_with(self.solver, self.ledger, stage)
                except SolverError:
                    done = False
            if done:
                for c in self.ledger.named(stage.verdicts.factors.tolist()):
                    moved.setdefault(c.factor_id, (c, c.state))
                self.ledger.note(stage.verdicts, self._steps)
            try:
                stage = stages.send(done)
            except StopIteration:
                stage = None
        came = {c.factor_id for c in new}
        changed = [c for c, was in moved.values() if c.state != was and c.factor_id not in came]
        return GatedReport(
            report,
            tuple(c for c in (*changed, *new) if c.state != SUSPECT),
            tuple(c for c in new if c.state == SUSPECT),
            tuple(c for c in changed if c.state == SUSPECT),
        )
