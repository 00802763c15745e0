"""The solver of a map that weighs its loop closures by graduated non-convexity (`solver.closures.graduation`).

    1  an insert with closures is a step by itself, in which each has the final loss, under the ids that all have
    2  closures that do not fit are graduated.  Each stage is an entry of its own behind the insert, of the client
       `JUDGE`, with the scales of losses, and a step; its report says that the map has not converged until the losses
       are final.  Applied again entries are what they were: nobody weighs
    3  what has become of closures is an entry without scales, and a step where that takes any out; then the insert is
       answered

One that is outweighed is in the ledger alone, as are suspects of a map that tests.  One that a user has accepted has no
loss.
"""

import logging
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from factorbus.proto.closures import Suspects
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.service.core.events import Arrived, Stepped, Verdict
from factorbus.service.solving.asked import AskedChanges
from factorbus.service.solving.closure_entries import verdicts_of_entry
from factorbus.service.solving.tested import TestedMapSolver
from factorbus.solver.closures.ahead import StagedBatch
from factorbus.solver.closures.graduated_kernel import GRADUATED_LOSS, graduated_split, with_final_loss, with_scale
from factorbus.solver.closures.graduation import GRADUATING, ClosureGraduation, GraduationStage
from factorbus.solver.closures.ledger import NO_VERDICTS, REJECTED, RESTORED, Closure
from factorbus.solver.closures.loops import SplitFactors
from factorbus.solver.closures.switching import ClosureSwitch
from factorbus.solver.errors import SolverError
from factorbus.solver.report import StepReport
from factorbus.wording import counted as counted_text

_NOTHING: Mapping[str, int] = {}
_WEIGHT_BY_USER = {RESTORED: 1.0, REJECTED: 0.0}

log = logging.getLogger(__name__)


class RobustMapSolver(TestedMapSolver):
    """As `MapSolver`, of a map whose policy for closures is `robust`."""

    POLICY = "robust"

    def _begin_anew(self) -> None:
        super()._begin_anew()
        self._graduation, self._stage_of, self._on_the_way = ClosureGraduation(), 0, False

    # ---- inserts ----------------------------------------------------------------------------------------------------

    def _split(self, batch: Batch) -> SplitFactors:
        return graduated_split(super()._split(batch))

    def _stage(self, insert: Arrived, counts: tuple[int, int]) -> tuple[int, tuple[int, int]]:
        """As of any map; closures have the final loss."""
        if (testing := self._testing) is None or self._broken:
            return super()._stage(insert, counts)
        batch, split = testing.batch, testing.split
        counts = self._check_room(counts, batch.variable_count, batch.factor_count)
        self._solver.check_new_kinds(batch)
        first = self._solver.stage(with_final_loss(batch, split, self._graduation.final_scales))
        testing.staged = StagedBatch(split, first, 0, [True] * len(split.places), None, NO_VERDICTS)
        return first, counts

    def _enter_new(self, staged: StagedBatch) -> Sequence[Closure]:
        graph, revision = self._solver.factor_graph, self._revision
        placed = zip(staged.split.closing, staged.split.places, strict=True)
        return [self._ledger.add(factor, staged.first + place, graph, revision) for factor, place in placed]

    # ---- stages -----------------------------------------------------------------------------------------------------

    def _judged(self, new: Sequence[Closure]) -> Iterator[Verdict | Stepped]:
        """What follows an insert with `new` closures is applied; where weighing fails they stay as they are."""
        stages = self._graduation.looks(lambda: self._solver, self._ledger, new)
        stage = _next_stage(stages, None)
        while stage is not None:
            entry = self._entry_of(stage.verdicts, scale=stage.scale)
            done = yield from self._apply_judged(entry, entry.content)
            stage = _next_stage(stages, done)

    def _apply_judged(self, insert: Arrived, content: Any) -> Generator[Verdict | Stepped, None, bool]:
        if content.scale is None:
            return (yield from super()._apply_judged(insert, content))
        closures = self._ledger.named(content.factors.tolist())
        inside = np.array([c.is_in for c in closures])
        loss = Change("loss", content.factors[inside], loss=GRADUATED_LOSS, scale=content.scale[inside])
        into = [(c, scale) for c, scale in zip(closures, content.scale.tolist(), strict=True) if not c.is_in]
        added: Any = tuple(with_scale(c.factor, scale) for c, scale in into)
        made = insert._replace(
            content=Insert(insert.sequence, Batch((), added), changes=(loss,) if inside.any() else ())
        )
        switch = ClosureSwitch((), tuple(c for c, _ in into))
        asked = AskedChanges(made, verdicts_of_entry(content), switch, set())
        self._stage_of, self._on_the_way = content.factors.size, GRADUATING in content.reasons
        try:
            with self._without_limits():
                return (yield from self._carry_out(insert, asked, 0))
        finally:
            self._stage_of, self._on_the_way = 0, False

    def _report_of(self, report: StepReport, started: float, counted: Mapping[str, int] = _NOTHING) -> dict[str, Any]:
        """As of any map; while losses are on their way to the final ones no step has converged."""
        if self._stage_of:
            because = f"{counted_text(self._stage_of, 'closure')} graduated; {report.because}"
            report = report._replace(because=because, converged=report.converged and not self._on_the_way)
        return super()._report_of(report, started, counted)

    # ---- what it tells ----------------------------------------------------------------------------------------------

    def _told(self, listed: Sequence[Closure]) -> Suspects:
        weight = np.array([_WEIGHT_BY_USER.get(c.state, c.chance) for c in listed], np.float64)
        return replace(super()._told(listed), chance=1.0 - weight, weight=weight)


def _next_stage(stages: Generator[GraduationStage, bool, None], done: bool | None) -> GraduationStage | None:
    """The next one; done: whether the one before was applied, None: there was none."""
    try:
        return next(stages) if done is None else stages.send(done)
    except StopIteration:
        return None
    except SolverError as problem:
        log.warning("closures are not weighed, and stay as they are: %s", problem)
    except Exception:
        log.exception("closures are not weighed, and stay as they are: weighing failed")
    return None
