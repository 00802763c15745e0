"""The solver of a map that tests its loop closures, and what becomes of those it does not believe.

    1  an insert with closures is a step by itself: in go what it has besides them, under the ids that all would have
    2  the judge looks (`solver.closures.judging`); its verdicts are entries of their own behind the insert, as changes
       of the client `JUDGE`: they are what the journal has, and what is applied when it is run again
    3  verdicts that move closures are a step, as any change is; then the insert is answered

A closure that is out keeps its id and is in the ledger alone.  A user's `accept` and `reject` are final.  What an
insert with changes adds is not tested: a person sends it.
"""

import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from factorbus.proto import codec
from factorbus.proto.closures import JUDGE, ClosureEntry, Suspects, encode_closure_entry, encode_suspects
from factorbus.proto.limits import ANSWER_LIMITS
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.proto.problems import Internal, Problem
from factorbus.service.config import Limits
from factorbus.service.core.events import (
    Applied,
    Arrived,
    MovedClosure,
    Outcome,
    ParsedInsert,
    SingleInsertResult,
    Stepped,
    Verdict,
    refusal,
)
from factorbus.service.kernels.digest import digest
from factorbus.service.solving.apply import MapSolver
from factorbus.solver.closures.judging import ClosureJudge
from factorbus.solver.closures.ledger import REJECTED, RESTORED, Closure, ClosureLedger, ClosureVerdicts, SwitchedOff
from factorbus.solver.closures.loops import TrustedForest, has_candidates
from factorbus.solver.closures.switching import ClosureSwitch, add_closures, check_whole, note_switch, planned_switch
from factorbus.solver.errors import NamedTwice, SolverError

# After these, what hangs together is looked up in the graph again.
_CUTTING = {"remove_factors", "remove_variables", "marginalize", "fix", "free"}
_SAYS = {"accept": RESTORED, "reject": REJECTED}
_NONE = np.empty(0, np.int64)
_NOBODY = ClosureVerdicts(_NONE, (), (), np.empty(0), np.empty(0), _NONE)

log = logging.getLogger(__name__)


class _Asked(NamedTuple):
    """What a user's insert asks for.  made: the insert that does it.  gone: closures that are removed and were out."""

    made: Arrived
    said: ClosureVerdicts
    switch: ClosureSwitch
    gone: set[int]


class TestedMapSolver(MapSolver):
    """As `MapSolver`, of a map whose policy for closures is `test`."""

    def __init__(
        self, make_solver: Callable[[], Any], epoch: int, limits: Limits, options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(make_solver, epoch, limits, options)
        self._judge, self._replaying = ClosureJudge(), False
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._ledger, self._forest = ClosureLedger(), TrustedForest()
        self._entries = 0  # verdicts that were entered since

    # ---- as of any map solver ---------------------------------------------------------------------------------------

    def apply_again(
        self, inserts: Sequence[Arrived], rebuilt: bool = False, further: bool = False
    ) -> Iterator[Verdict | Stepped]:
        """Verdicts are among `inserts`: nobody judges."""
        self._replaying = True
        try:
            yield from super().apply_again(inserts, rebuilt, further)
        finally:
            self._replaying = False

    def apply_batch(
        self, inserts: Sequence[Arrived], further: bool
    ) -> SingleInsertResult | Iterator[Verdict | Stepped | Applied]:
        """As of any map; an insert with what may be a closure is never done in one go."""
        if further or len(inserts) != 1 or inserts[0].is_change or getattr(inserts[0].content, "convert_below", 0.0):
            return super().apply_batch(inserts, further)
        batch = _batch_of(inserts[0])
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
        cpu_s, plain = time.thread_time(), list[Arrived]()
        for insert in inserts:
            batch = None if insert.is_change else _batch_of(insert)
            if not insert.is_change and (batch is None or not has_candidates(batch)):
                plain.append(insert)
                continue
            yield from self._add_plain(plain)
            plain = []
            if isinstance(insert.content, ClosureEntry):
                yield from self._apply_judged(insert, insert.content)
            elif batch is not None:
                yield from self._insert_tested(insert, batch)
            else:
                yield from self._change_tested(insert)
        yield from self._add_plain(plain)
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
        return same

    def closure_counts(self) -> dict[str, int]:
        """How many are in each state."""
        return self._ledger.counts()

    def suspects(self, every: bool) -> bytes:
        """The answer to ask/suspects."""
        listed = [c for c in self._ledger.closures if every or not c.is_in]
        told = Suspects(
            self._epoch,
            self._revision,
            "test",
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
        return encode_suspects(told)

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
                    if outcome.first_factor >= 0 and (batch := _batch_of(outcome.insert)) is not None:
                        self._forest.join(batch)
            yield event._replace(closures=self._ledger.counts()) if isinstance(event, Applied) else event

    def _insert_tested(self, insert: Arrived, batch: Batch) -> Iterator[Verdict | Stepped]:
        """One that may have closures."""
        content: Any = insert.content
        split = self._forest.split(batch)
        try:
            if split.closing and not self._broken:
                self._check_room(self._accepted_counts, batch.variable_count, batch.factor_count)
                self._solver.check_new_kinds(batch)
                check_whole(self._solver.factor_graph, batch)
        except (Problem, SolverError) as problem:
            self._forest.forget()
            yield Verdict((refusal(insert, problem),))
            return
        except Exception:
            self._forest.forget()
            reference = self._fault()
            yield Verdict((Outcome(insert, Internal(reference)),))
            yield from self._replace_solver(reference)
            return
        trusted = Batch(batch.variables, tuple(split.trusted))  # pyright: ignore[reportArgumentType]
        made = insert._replace(content=Insert(insert.sequence, trusted, content.settle))
        verdict, steps = self._add_together([made])
        outcome, report = verdict.outcomes[0]._replace(insert=insert), self._last_report
        if outcome.first_factor < 0:
            self._forest.forget()
            yield verdict._replace(outcomes=(outcome,))
            yield from steps
            return
        revision, first = self._revision, outcome.first_factor
        new = add_closures(self._solver.factor_graph, self._ledger, split, first, revision)
        judged = [] if self._replaying or not new else list(self._judged(dict.fromkeys(c.factor.kind for c in new)))
        if new:
            out = [c for c in new if not c.is_in]
            told = {**report, "closures": len(new), "suspects": len(out)}
            (answer,) = self._messages.write_answers([(insert.sequence, first)], self._epoch, self._revision, told)
            outcome = outcome._replace(answer=answer)
        yield verdict._replace(outcomes=(outcome,))
        yield from steps
        yield from judged
        if content.convert_below:
            yield from self._convert_to_points(content.convert_below)

    # ---- verdicts ---------------------------------------------------------------------------------------------------

    def _judged(self, kinds: Iterable[str]) -> Iterator[Verdict | Stepped]:
        """The judge looks at the new closures of these kinds, and what it says is applied."""
        for kind in kinds:
            while (verdicts := self._looked(self._judge.look, kind)) is not None:
                yield from self._enter_or_keep(verdicts)
            if (verdicts := self._looked(self._judge.look_back, kind)) is not None:
                yield from self._enter_or_keep(verdicts)

    def _looked(self, look: Callable[..., ClosureVerdicts | None], kind: str) -> ClosureVerdicts | None:
        """What the judge says; None: nothing, or it failed."""
        try:
            return look(self._solver, self._ledger, kind)
        except SolverError as problem:
            log.warning("closures are not judged, and stay as they are: %s", problem)
        except Exception:
            log.exception("closures are not judged, and stay as they are: the judge failed")
        return None

    def _enter_or_keep(self, verdicts: ClosureVerdicts) -> Iterator[Verdict | Stepped]:
        """Apply them; where their step fails, what was to go in are suspects."""
        if not (yield from self._enter(verdicts)):
            yield from self._enter(self._ledger.failed(verdicts))

    def _enter(self, verdicts: ClosureVerdicts) -> Generator[Verdict | Stepped, None, bool]:
        """Apply them as an entry that comes behind the insert; gives whether they are."""
        self._entries += 1
        content = ClosureEntry(self._entries, *verdicts)
        message = encode_closure_entry(content)
        return (yield from self._apply_judged(entry_again(message, content), content))

    def _apply_judged(self, insert: Arrived, content: ClosureEntry) -> Generator[Verdict | Stepped, None, bool]:
        verdicts = ClosureVerdicts(*(getattr(content, name) for name in ClosureVerdicts._fields))
        try:
            switch = planned_switch(self._ledger, verdicts)
        except SolverError as problem:
            yield Verdict((refusal(insert, problem),))
            return False
        if not (switch.out or switch.into):
            changed, first = self._ledger.note(verdicts, self._revision), self._solver.factor_graph.next_id
            number = [(insert.sequence, first)]
            (answer,) = self._messages.write_answers(number, self._epoch, self._revision, {})
            yield Verdict((Outcome(insert, answer, first),), self._revision, 1, _moved(changed))
            return True
        changes = tuple(Change("remove_factors", removal.factors) for removal in switch.removals)
        batch = Batch((), tuple(switch.additions))  # pyright: ignore[reportArgumentType]
        asked = _Asked(
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

    def _carry_out(self, insert: Arrived, asked: _Asked, added: int) -> Generator[Verdict | Stepped, None, bool]:
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
            yield event._replace(outcomes=(outcome,), closures=_moved(changed))
        return done

    # ---- what a user says -------------------------------------------------------------------------------------------

    def _change_tested(self, insert: Arrived) -> Iterator[Verdict | Stepped]:
        content: Any = insert.content
        try:
            asked = self._asked(insert, content)
        except SolverError as problem:
            yield Verdict((refusal(insert, problem),))
            return
        if not (yield from self._carry_out(insert, asked, content.batch.factor_count)):
            return
        graph, names = self._solver.factor_graph, {change.change for change in content.changes}
        if names & _CUTTING or asked.gone:
            here = [c for c in self._ledger.closures if c.factor_id not in asked.gone]
            rows = graph.rows_of(np.array([c.factor_id for c in here], np.int64))
            lost = [c for c, row in zip(here, rows.tolist(), strict=True) if not _stands(c, row, graph)]
            self._ledger.forget(asked.gone | {c.factor_id for c in lost}, graph)
            self._forest.renew(graph)
        else:
            self._forest.join(content.batch)
        for change in content.changes:
            for factor in change.factors.tolist() if change.change in ("loss", "weigh") else ():
                if (c := self._ledger.of_factor.get(factor)) is not None:
                    self._ledger.of_kind[c.factor.kind].measure(c, graph.factor_named(factor))

    def _asked(self, insert: Arrived, content: Insert) -> _Asked:
        """What a user's changes come to in this map.  Raises SolverError."""
        said, left, gone = list[ClosureVerdicts](), list[Change](), set[int]()
        for change in content.changes:
            ids = [] if change.factors is None else change.factors.tolist()
            if change.change in _SAYS:
                said.append(self._ledger.said(ids, _SAYS[change.change]))
                continue
            out = [factor for factor in ids if (c := self._ledger.of_factor.get(factor)) is not None and not c.is_in]
            if out and change.change != "remove_factors":
                raise SwitchedOff(change.change, out[0], self._ledger.of_factor[out[0]].state)
            _check_once(change.change, [*gone, *out])
            gone |= set(out)
            if not out or len(out) < len(ids):
                left.append(change._replace(factors=np.array([i for i in ids if i not in gone])) if out else change)
        verdicts = _together(said)
        _check_once("accept, reject and remove_factors", [*verdicts.factors.tolist(), *gone])
        switch = planned_switch(self._ledger, verdicts)
        removals = [Change("remove_factors", removal.factors) for removal in switch.removals]
        batch: Any = content.batch._replace(factors=(*content.batch.factors, *switch.additions))
        made = content._replace(batch=batch, changes=(*removals, *left))
        return _Asked(insert._replace(content=made), verdicts, switch, gone)


def entry_again(message: bytes, content: ClosureEntry) -> Arrived:
    """Verdicts as an entry, which nobody waits for."""
    return Arrived([], JUDGE, content.sequence, 0, len(message), int(digest(message)), content, 0.0, message)


def _batch_of(insert: Arrived) -> Batch | None:
    """What an insert adds; None of one that is wrong."""
    content = insert.content
    if isinstance(content, ParsedInsert):
        return codec.decode_insert(content.message, ANSWER_LIMITS).batch
    return content.batch if isinstance(content, Insert) else None


def _stands(closure: Closure, row: int, graph: Any) -> bool:
    """Whether a closure is still one: in the map, or out and between poses that are there."""
    return row >= 0 if closure.is_in else all(graph.find(key) >= 0 for key in closure.keys)


def _moved(changed: Iterable[Closure]) -> tuple[MovedClosure, ...]:
    return tuple(MovedClosure(c.factor_id, c.state, c.reason) for c in changed)


def _together(said: Sequence[ClosureVerdicts]) -> ClosureVerdicts:
    if not said:
        return _NOBODY
    columns = zip(*said, strict=True)
    factors, states, reasons, distance, chance, tried = columns
    return ClosureVerdicts(
        np.concatenate(factors), sum(states, ()), sum(reasons, ()), np.concatenate(distance), np.concatenate(chance),
        np.concatenate(tried),
    )  # fmt: skip


def _check_once(what: str, factors: Sequence[int]) -> None:
    """Raises NamedTwice."""
    for k, factor in enumerate(factors):
        if factor in factors[:k]:
            raise NamedTwice(what, f"factor {factor}", factor=factor)
