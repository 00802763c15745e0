"""The solver of a map that tests its loop closures, and what becomes of those it does not believe.

    1  an insert with closures is a step by itself: in goes what it has besides them, and those that the map expects
       (`solver.closures.ahead`), under the ids that all would have
    2  the judge looks at the others (`solver.closures.judging`).  Verdicts of both are entries of their own behind the
       insert, of the client `JUDGE`: they are what the journal has, and what is applied when it is run again
    3  verdicts that move closures then are a step, as any change is; then the insert is answered

A closure that is out keeps its id, in the ledger alone.  A user's `accept` and `reject` are final.  What changes add
is not tested: a person sends it.
"""

import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.closures import ClosureEntry, Suspects, encode_closure_entry, encode_suspects
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.service.config import Limits
from factorbus.service.core.events import (
    Applied,
    Arrived,
    MovedClosure,
    Outcome,
    SingleInsertResult,
    Stepped,
    Verdict,
    refusal,
)
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.asked import AskedChanges, asked_changes
from factorbus.service.solving.closure_entries import batch_of_insert, entry_again, is_ahead, verdicts_of_entry
from factorbus.service.solving.closure_news import forget_gone, moved_closures
from factorbus.solver.closures.ahead import StagedBatch, enter_closures, stage_with_believed
from factorbus.solver.closures.judging import COMPARED, ClosureJudge
from factorbus.solver.closures.ledger import (
    BELIEVED,
    NEW,
    NO_VERDICTS,
    SUSPECT,
    Closure,
    ClosureLedger,
    ClosureVerdicts,
)
from factorbus.solver.closures.loops import SplitFactors, TrustedForest, has_candidates
from factorbus.solver.closures.switching import note_switch, planned_switch
from factorbus.solver.errors import SolverError

# After these, what hangs together is looked up in the graph again.
_OF_THE_LAST = ("chi2", "converged", "converging")
_CUTTING = {"remove_factors", "remove_variables", "marginalize", "fix", "free"}

log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Testing:
    """An insert with closures, under way.  given: which of them go in with it, where that is not to be judged."""

    batch: Batch
    split: SplitFactors
    given: ClosureVerdicts | None
    staged: StagedBatch | None = None


class TestedMapSolver(MapSolver):
    """As `MapSolver`, of a map whose policy for closures is `test`."""

    POLICY = "test"

    def __init__(
        self, make_solver: Callable[[], Any], epoch: int, limits: Limits, options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(make_solver, epoch, limits, options)
        self._judge, self._replaying, self._testing = ClosureJudge(), False, None
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._ledger, self._forest = ClosureLedger(weighs=self.POLICY == "robust"), TrustedForest()
        self._entries = 0  # verdicts that were entered since
        self._left_new = False  # closures came without verdicts on them, as those of a replica that went back

    def _has_new(self) -> bool:
        return any(ledger.unjudged().size for ledger in self._ledger.of_kind.values())

    # ---- as of any map solver ---------------------------------------------------------------------------------------

    def apply_again(
        self, inserts: Sequence[Arrived], rebuilt: bool = False, further: bool = False
    ) -> Iterator[Verdict | Stepped]:
        """Verdicts are among `inserts`: nobody judges."""
        self._replaying = True
        try:
            yield from super().apply_again(inserts, rebuilt, further)
        finally:
            self._replaying, self._left_new = False, self._has_new()

    def apply_batch(
        self, inserts: Sequence[Arrived], further: bool
    ) -> SingleInsertResult | Iterator[Verdict | Stepped | Applied]:
        """As of any map; an insert with what may be a closure is never done in one go."""
        if self._left_new and inserts:
            return self.apply(inserts)
        if further or len(inserts) != 1 or inserts[0].is_change or getattr(inserts[0].content, "convert_below", 0.0):
            return super().apply_batch(inserts, further)
        batch = batch_of_insert(inserts[0])
        if batch is not None and has_candidates(batch):
            return self.apply(inserts)
        came = super().apply_batch(inserts, further)
        if isinstance(came, SingleInsertResult):
            if batch is not None:
                self._forest.join(batch)
            return came._replace(applied=came.applied._replace(closures=self._ledger.counts()))
        return self._joining(came)

    def apply(self, inserts: Sequence[Arrived]) -> Iterator[Verdict | Stepped | Applied]:
        """As of any map; an insert that has what may be a closure is a step by itself, as a change is."""
        cpu_s, plain, ahead = time.thread_time(), list[Arrived](), None
        for insert, following in zip_longest(inserts, inserts[1:]):
            if insert is ahead:
                continue  # with the insert before
            batch = None if insert.is_change else batch_of_insert(insert)
            if not insert.is_change and (batch is None or not has_candidates(batch)):
                plain.append(insert)
                continue
            yield from self._add_plain(plain)
            plain = []
            if isinstance(insert.content, ClosureEntry):
                yield from self._apply_judged(insert, insert.content)
            elif batch is not None:
                ahead = following if following and is_ahead(following.content) else None
                yield from self._insert_tested(insert, batch, ahead)
            else:
                yield from self._change_tested(insert)
        yield from self._add_plain(plain)
        if inserts and self._left_new and not self._replaying:
            self._left_new = False
            yield from self._judged([c for c in self._ledger.closures if c.reason == NEW])
        yield self._applied(cpu_s)

    def dump(self) -> dict[str, Any]:
        """With what became of closures."""
        return super().dump() | {"closures": {"ledger": self._ledger.dump(), "forest": self._forest.dump()}}

    def load(self, state: Mapping[str, Any] | None) -> bool:
        """With what became of closures."""
        same = super().load(state)
        self._begin_anew()
        if state is not None:
            own = state["closures"]
            self._ledger.load(own["ledger"], self._solver.factor_graph)
            self._forest.load(own["forest"])
            self._left_new = self._has_new()
        return same

    def _staying(self) -> I64:
        """Of suspects with which new closures may agree the poses stay; older ones and rejected ones go with theirs."""
        return np.array([c.keys for c in self._ledger.closures if c.state == SUSPECT][-COMPARED:], np.int64).ravel()

    def closure_counts(self) -> dict[str, int]:
        """How many are in each state."""
        return self._ledger.counts()

    def suspects(self, every: bool) -> bytes:
        """The answer to ask/suspects."""
        listed = [c for c in self._ledger.closures if every or c.state not in BELIEVED]
        return encode_suspects(self._told(listed))

    def _told(self, listed: Sequence[Closure]) -> Suspects:
        return Suspects(
            self._epoch,
            self._revision,
            self.POLICY,
            self._ledger.counts(),
            np.array([c.factor_id for c in listed], np.int64),
            np.array([c.keys for c in listed], np.int64).reshape(-1, 2),
            tuple(c.factor.kind for c in listed),
            tuple(c.state for c in listed),
            tuple(c.reason for c in listed),
            np.array([c.distance for c in listed], np.float64),
            np.array([c.chance for c in listed], np.float64),
            np.array([c.came for c in listed], np.int64),
            np.array([c.changed for c in listed], np.int64),
        )

    def _applied(self, cpu_s: float) -> Applied:
        return super()._applied(cpu_s)._replace(closures=self._ledger.counts())

    # ---- inserts ----------------------------------------------------------------------------------------------------

    def _add_plain(self, inserts: Sequence[Arrived]) -> Iterator[Verdict | Stepped]:
        if inserts:
            yield from self._joining(self._add(inserts))

    def _joining(self, events: Iterable[Any]) -> Iterator[Any]:
        """What comes of inserts without closures: what those join that are accepted hangs together."""
        for event in events:
            if isinstance(event, Verdict):
                for outcome in event.outcomes:
                    if outcome.first_factor >= 0 and (batch := batch_of_insert(outcome.insert)) is not None:
                        self._forest.join(batch)
            yield event._replace(closures=self._ledger.counts()) if isinstance(event, Applied) else event

    def _insert_tested(self, insert: Arrived, batch: Batch, entry: Arrived | None) -> Iterator[Verdict | Stepped]:
        """One that may have closures; entry: verdicts that were applied with it, when it is run again."""
        split = self._split(batch)
        given = verdicts_of_entry(entry.content) if entry else NO_VERDICTS if self._replaying else None
        (verdict, steps), staged = self._try_tested(insert, _Testing(batch, split, given))
        if staged and staged.verdicts().states and not entry:
            entry = self._entry_of(staged.verdicts(), True)
        failed = verdict.outcomes[0].answer
        if entry is not None and isinstance(failed, SolverError):
            yield from steps
            (verdict, steps), staged = self._try_tested(insert, _Testing(batch, split, NO_VERDICTS))
        outcome, report = verdict.outcomes[0], self._last_report
        behind, new = list[Verdict | Stepped](), list[Closure]()
        if outcome.first_factor < 0:
            self._forest.forget()
        elif staged is not None:
            new = self._enter_new(staged)
        if entry is not None:
            went_in, moved = isinstance(failed, bytes), moved_closures(c for c in new if c.is_in)
            behind.append(self._entered(entry, moved) if went_in else Verdict((refusal(entry, failed),)))
        if new:
            is_settled = (
                staged is not None and staged.all_in and self._judge.is_settled(self._solver, self._ledger, new)
            )
            judged = [] if self._replaying or is_settled else list(self._judged(new))
            counted = {
                **self._report_behind(report),
                "closures": len(new),
                "suspects": sum(c.state not in BELIEVED for c in new),
            }
            number = [(insert.sequence, outcome.first_factor)]
            (answer,) = self._messages.write_answers(number, self._epoch, self._revision, counted)
            verdict = verdict._replace(outcomes=(outcome._replace(answer=answer),))
            steps = [*steps, *judged]
        yield verdict
        yield from behind
        yield from steps
        if outcome.first_factor >= 0 and (below := getattr(insert.content, "convert_below", 0.0)):
            yield from self._convert_to_points(below)

    def _report_behind(self, report: dict[str, Any]) -> dict[str, Any]:
        """Where steps followed: what the last one has come to, whose revision the answer names."""
        return report | {name: self._last_report[name] for name in _OF_THE_LAST if name in self._last_report}

    def _split(self, batch: Batch) -> SplitFactors:
        return self._forest.split(batch)

    def _enter_new(self, staged: StagedBatch) -> Sequence[Closure]:
        return enter_closures(self._solver, self._ledger, staged, self._revision)

    def _try_tested(self, insert: Arrived, testing: _Testing) -> tuple[Any, StagedBatch | None]:
        """The step of an insert; what came of it, and what was staged of one with closures."""
        self._testing = testing if testing.split.closing else None
        try:
            return self._add_together([insert]), testing.staged
        finally:
            self._testing = None

    def _stage(self, insert: Arrived, counts: tuple[int, int]) -> tuple[int, tuple[int, int]]:
        """As of any map; closures go in that are believed."""
        if (testing := self._testing) is None or self._broken:
            return super()._stage(insert, counts)
        batch, split = testing.batch, testing.split
        counts = self._check_room(counts, batch.variable_count, batch.factor_count)
        self._solver.check_new_kinds(batch)
        mark = self._solver.factor_graph.mark()
        try:
            staged = stage_with_believed(self._solver, self._ledger, batch, split, self._judge, testing.given)
        except SolverError:
            raise
        except Exception:
            log.exception("closures are not judged ahead of their step: the judge failed")
            self._solver.factor_graph.forget(mark)
            staged = stage_with_believed(self._solver, self._ledger, batch, split, self._judge, NO_VERDICTS)
        testing.staged = staged
        return staged.first, counts

    # ---- verdicts ---------------------------------------------------------------------------------------------------

    def _judged(self, new: Sequence[Closure]) -> Iterator[Verdict | Stepped]:
        """What the judge says behind an insert with `new` closures is applied; where it fails they stay as they are."""
        looks = self._judge.looks(lambda: self._solver, self._ledger, new)
        while (verdicts := _next_look(looks)) is not None:
            yield from self._enter_or_keep(verdicts)

    def _enter_or_keep(self, verdicts: ClosureVerdicts) -> Iterator[Verdict | Stepped]:
        """Apply them; where their step fails, what was to go in are suspects."""
        if not (yield from self._enter(verdicts)):
            yield from self._enter(self._ledger.failed(verdicts))

    def _enter(self, verdicts: ClosureVerdicts) -> Generator[Verdict | Stepped, None, bool]:
        """Apply them as an entry that comes behind the insert; gives whether they are."""
        entry = self._entry_of(verdicts)
        return (yield from self._apply_judged(entry, entry.content))

    def _entry_of(self, verdicts: ClosureVerdicts, ahead: bool = False, scale: F64 | None = None) -> Arrived:
        self._entries += 1
        content = ClosureEntry(self._entries, *verdicts, ahead, scale)
        return entry_again(encode_closure_entry(content), content)

    def _entered(self, entry: Arrived, moved: tuple[MovedClosure, ...]) -> Verdict:
        """An entry that no step is made for, or that of its insert."""
        first = self._solver.factor_graph.next_id
        (answer,) = self._messages.write_answers([(entry.sequence, first)], self._epoch, self._revision, {})
        return Verdict((Outcome(entry, answer, first),), self._revision, 1, moved)

    def _apply_judged(self, insert: Arrived, content: Any) -> Generator[Verdict | Stepped, None, bool]:
        verdicts = verdicts_of_entry(content)
        try:
            switch = planned_switch(self._ledger, verdicts)
        except SolverError as problem:
            yield Verdict((refusal(insert, problem),))
            return False
        if not (switch.out or switch.into):
            changed = self._ledger.note(verdicts, self._revision)
            yield self._entered(insert, moved_closures(changed))
            return True
        changes = tuple(Change("remove_factors", removal.factors) for removal in switch.removals)
        batch = Batch((), tuple(switch.additions))  # pyright: ignore[reportArgumentType]
        asked = AskedChanges(
            insert._replace(content=Insert(insert.sequence, batch, changes=changes)), verdicts, switch, set()
        )
        with self._without_limits():
            return (yield from self._carry_out(insert, asked, 0))

    @contextmanager
    def _without_limits(self) -> Iterator[None]:
        """What was inserted had room."""
        limits, self._limits = self._limits, replace(self._limits, variables=1 << 62, factors=1 << 62)
        try:
            yield
        finally:
            self._limits = limits

    def _carry_out(self, insert: Arrived, asked: AskedChanges, added: int) -> Generator[Verdict | Stepped, None, bool]:
        """Make what is asked for, and note it; gives whether it was accepted.

        added: factors beside those that come.
        """
        done = False
        for event in self._change(asked.made) if asked.made.is_change else self._add([asked.made]):
            if not isinstance(event, Verdict):
                yield event
                continue
            outcome, changed = event.outcomes[0]._replace(insert=insert), list[Closure]()
            done = outcome.first_factor >= 0
            if done:
                following, graph = outcome.first_factor + added, self._solver.factor_graph
                changed = note_switch(graph, self._ledger, asked.said, asked.switch, following, self._revision)
            yield event._replace(outcomes=(outcome,), closures=moved_closures(changed))
        return done

    # ---- what a user says -------------------------------------------------------------------------------------------

    def _change_tested(self, insert: Arrived) -> Iterator[Verdict | Stepped]:
        content: Any = insert.content
        try:
            asked = asked_changes(self._ledger, insert, content)
        except SolverError as problem:
            yield Verdict((refusal(insert, problem),))
            return
        if not (yield from self._carry_out(insert, asked, content.batch.factor_count)):
            return
        graph, names = self._solver.factor_graph, {change.change for change in content.changes}
        if names & _CUTTING or asked.gone:
            gone = forget_gone(self._ledger, graph, asked.gone, content.changes)
            self._forest.renew(graph)
            if gone:  # behind the delta of the step that took them along
                yield Verdict((), self._revision, closures=gone)
        else:
            self._forest.join(content.batch)
        for change in content.changes:
            for factor in change.factors.tolist() if change.change in ("loss", "weigh") else ():
                if (c := self._ledger.of_factor.get(factor)) is not None:
                    self._ledger.measure(c, graph.factor_named(factor))


def _next_look(looks: Iterator[ClosureVerdicts]) -> ClosureVerdicts | None:
    try:
        return next(looks, None)
    except SolverError as problem:
        log.warning("closures are not judged, and stay as they are: %s", problem)
    except Exception:
        log.exception("closures are not judged, and stay as they are: the judge failed")
    return None
