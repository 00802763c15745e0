"""One map as a state machine: events in, effects out.  No bus, no clock, no thread, no solver: events bring all.

    Arrived ─▶ admission ─▶ inbox ─┐                    ┌─▶ Answer, Refuse    to who inserted
    ArrivedQuestion ───▶ reads ──────────────┴▶ InsertBatch ─▶ Applied ────┼─▶ Publish           delta of every step
                                    (solver thread)     └─▶ InsertBatch       what came in meanwhile; nothing did, and
                                                                              it is not at its optimum: a further step

At most one InsertBatch is out at a time: what the solver does next is decided when it is free, from all that waits.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from factorbus.proto import codec
from factorbus.proto.own_clients import OWN_CLIENTS
from factorbus.proto.problems import Busy, Problem, ShuttingDown, UnknownMap
from factorbus.service.config import Limits
from factorbus.service.core.admission import Admission
from factorbus.service.core.budget import StepBudget
from factorbus.service.core.closures import asked_outcomes, closures_moved
from factorbus.service.core.converging import Converging
from factorbus.service.core.events import (
    Applied,
    Arrived,
    ArrivedQuestion,
    Asker,
    BudgetUse,
    Drained,
    Effect,
    Follow,
    InsertBatch,
    MovedClosure,
    ParsedInsert,
    Publish,
    Read,
    Refuse,
    Restored,
    SingleInsertResult,
    Stepped,
    Tell,
    Verdict,
    reproducible_fields,
)  # fmt: skip
from factorbus.service.core.kept_steps import KeptSteps
from factorbus.service.core.pending_questions import Reads, is_graft
from factorbus.service.core.removals import IdleRemovals
from factorbus.service.core.short_batches import ShortBatches
from factorbus.service.core.statistics import InsertDone, MapStatistics
from factorbus.service.questions.admin import MovedOn
from factorbus.service.questions.answers import Question, parse

_SNAPSHOT = Read(Question("snapshot"))


class MapCore:
    """The state of one map, short of its estimate.  Every method takes an event and returns effects, in order."""

    def __init__(
        self, name: str, mode: str, epoch: int, limits: Limits, now: float, closures: str = "trust",
        budget: StepBudget | None = None, removals: IdleRemovals | None = None,
    ) -> None:  # fmt: skip
        self.name, self.mode, self.epoch, self.closures = name, mode, epoch, closures
        self._budget, self.removals = budget or StepBudget(), removals or IdleRemovals()
        self.revision = self.variables = self.factors = 0
        self.differs: str | None = None  # as `Restored` has it
        self._limits, self._created = limits, now
        self._admission = Admission(epoch, limits)
        self.check_numbers = self._admission.check_numbers
        self._reads, self._converging = Reads(), Converging()
        self._running: InsertBatch | None = None
        self._unanswered = self._unanswered_bytes = 0  # given to the solver, and not answered
        self._must_reload = self._drained = False
        self._started, self._short = 0.0, ShortBatches()
        self._closing: Problem | None = None
        self._since_snapshot = [0, 0]  # steps, bytes of deltas
        self._solver_cpu_s = 0.0
        self._statistics, self._steps = MapStatistics(), KeptSteps()
        self._moved_at = 0  # the revision of the last step that was not a further one

    def row(self) -> dict[str, Any]:
        """What admin/maps says of this map."""
        return {
            "name": self.name,
            "mode": self.mode,
            "closures": self.closures,
            "epoch": self.epoch,
            "revision": self.revision,
            "variables": self.variables,
            "factors": self.factors,
            "state": "blocked" if self._admission.blocked else "open",
            "converged": self._converging.converged,
            "converging": self._converging.converging,
            **self._budget.row() | self.removals.row(),
            **reproducible_fields(self.differs),
        }

    def created(self) -> list[Effect]:
        """The map is on the bus: new, or as it was before."""
        happened: list[Effect] = [self._event("opened" if self.revision else "created")]
        return [*happened, self._event("blocked")] if self._admission.blocked else happened

    def insert(self, arrived: Arrived) -> list[Effect]:
        """An insert came in."""
        if isinstance(arrived.content, ParsedInsert) and (run := self._try_alone(arrived, arrived.content)):
            self._statistics.received(arrived.size)
            return [run]
        effects = self._admission.expire(arrived.now)
        admitted = self._admission.admit(arrived)
        self._statistics.received(arrived.size)
        return self._go_on(effects + self._statistics.count_refused(admitted), arrived.now)

    def unread(self, client: str, refuse: Refuse) -> list[Effect]:
        """An insert of `client` came in of which not even the number can be read."""
        self._statistics.refused(refuse.problem)
        return [replace(refuse, following=self._admission.wanted(client))]

    def ask(self, arrived: ArrivedQuestion, now: float) -> list[Effect]:
        """A question came in."""
        try:
            if self._closing is not None:
                raise self._closing
            question = parse(arrived.question, arrived.payload)
        except Problem as problem:
            return [Refuse(arrived.asker, problem)]
        if question.name == "stats":
            return [Tell(arrived.asker, self.stats(now))]
        if question.name == "history":
            return [self._steps.answer(arrived.asker, self.epoch, self.revision)]
        if question.name == "interest":
            return [Follow(arrived.asker, question.ask, self.row())]
        return self.read(Read(question, arrived.asker), now)

    def read(self, read: Read, now: float) -> list[Effect]:
        """A question that needs the solver's state."""
        if self._closing is not None:
            return [Refuse(read.asker, self._closing)]
        if len(self._reads) >= self._limits.questions:
            return [Refuse(read.asker, Busy(len(self._reads), 0.1))]
        self._reads.append(read)
        return self._go_on([], now)

    def give_verdict(self, verdict: Verdict) -> list[Effect]:
        """The solver's word on some of what it has."""
        effects, asked = closures_moved(verdict.closures, self.epoch, verdict.revision), asked_outcomes(verdict)
        self._unanswered -= len(asked)
        effects += self.removals.told(verdict, self.epoch)
        for outcome in asked:
            self._unanswered_bytes -= outcome.insert.size
            effects += self._admission.answer(outcome.insert, outcome.answer)
            if isinstance(outcome.answer, bytes):
                self._statistics.accepted(len(outcome.answer))
            else:
                self._statistics.refused(outcome.answer)
        return effects

    def alone(self, alone: SingleInsertResult, answered: Asker) -> list[Effect]:
        """One insert was applied by itself; `answered` has its answer, and the delta is published."""
        (insert, answer, _), stepped, applied = alone
        others = self._admission.answer(insert, answer, answered)
        self._unanswered -= 1
        self._unanswered_bytes -= insert.size
        step = stepped.strategy, stepped.chi2, stepped.solver_ms
        self._statistics.note(InsertDone(*step, applied.now - insert.now, len(answer), len(stepped.delta)))
        self._moved_on(stepped)
        self._converging.moved_on(stepped.converged, stepped.unfinished, stepped.chi2, stepped.use)
        self._moved_at = stepped.revision
        self._budget.stepped(stepped)
        others += self._budget.correction(self.epoch, self.revision)
        self._free(applied, 1)
        return self._go_on(others, applied.now)

    def kept(self, events: Sequence[Verdict | Stepped], now: float) -> list[Effect]:
        """What came of an InsertBatch is written down."""
        effects: list[Effect] = []
        for event in events:
            effects += self.give_verdict(event) if isinstance(event, Verdict) else self.stepped(event)
        return self._go_on(effects, now)

    def block(self, problem: Problem, now: float) -> list[Effect]:
        """The journal cannot be written: nothing new is taken in, and what has not gone to the solver is refused."""
        self._admission.block(problem)
        effects = self._statistics.count_refused(self._admission.take_back(problem, given=False))
        return self._go_on([*effects, self._event("blocked")], now)

    def unkept(self, problem: Problem, now: float) -> list[Effect]:
        """The same, and what came of Runs since the last `kept` did not happen: the solver is to go back."""
        self._admission.block(problem)
        effects = self._statistics.count_refused(self._admission.take_back(problem, given=True))
        self._unanswered = self._unanswered_bytes = 0
        self._converging.undone()
        self.removals.undone()
        self._must_reload = True
        return self._go_on([*effects, self._event("blocked")], now)

    def unblock(self) -> list[Effect]:
        """The journal can be written again."""
        self._admission.block(None)
        return [self._event("unblocked")]

    def restore(
        self, senders: Iterable[tuple[str, int, Iterable[tuple[int, int, object]]]], restored: Restored
    ) -> None:
        """The map was here before: what its clients have sent, and how it is."""
        for name, following, answered in ((*sender,) for sender in senders if sender[0] not in OWN_CLIENTS):
            self._admission.restore(name, following, answered, self._created)
        self.revision, self.variables, self.factors, self._statistics.chi2 = restored[:4]
        use = BudgetUse(unsolved=math.inf, complete=restored.complete)
        self._converging.moved_on(restored.converged, restored.unfinished, restored.chi2, use)
        self._budget.restore(use)
        self._moved_at, self.differs = restored.revision, restored.differs
        self._statistics.closures = restored.closures

    def stepped(self, stepped: Stepped) -> list[Effect]:
        """The solver made a step."""
        self._statistics.stepped(stepped.strategy, stepped.chi2, stepped.solver_ms, len(stepped.delta))
        self._moved_on(stepped)
        self._budget.stepped(stepped)
        if stepped.further:
            self._converging.went_on(stepped)
        else:
            self._converging.moved_on(stepped.converged, stepped.unfinished, stepped.chi2, stepped.use)
            self._moved_at = stepped.revision
        return [Publish("delta", stepped.delta), *self._budget.correction(self.epoch, self.revision)]

    def grafted(
        self, inserts: Iterable[tuple[str, int, int, object]], steps: Iterable[Stepped],
        closures: Sequence[MovedClosure], now: float,
    ) -> list[Effect]:  # fmt: skip
        """Records of another journal were applied: (client, number, digest, answer) of each insert; what came of it."""
        effects = [effect for i in inserts if i[0] not in OWN_CLIENTS for effect in self._admission.note(*i, now)]
        effects += [effect for stepped in steps for effect in self.stepped(stepped)]
        self._converging.hold(now)  # who sent them takes further steps, too, and sends those
        self.removals.ended(1, now)
        return [*effects, *closures_moved(closures, self.epoch, self.revision)]

    def _moved_on(self, stepped: Stepped) -> None:
        self.revision = stepped.revision
        self._steps.add(stepped)
        self._since_snapshot[0] += 1
        self._since_snapshot[1] += len(stepped.delta)
        steps, size = self._since_snapshot
        if steps >= self._limits.snapshot_steps or size >= self._limits.snapshot_bytes:
            self._since_snapshot = [0, 0]
            self._reads.append(_SNAPSHOT)

    def applied(self, applied: Applied) -> list[Effect]:
        """The solver is free again."""
        taken = self._running.inserts if self._running else ()
        for insert in taken:
            self._statistics.took(applied.now - insert.now)
        if applied.refused:
            self._converging.refused()
        self._free(applied, len(taken))
        return self._go_on([], applied.now)

    def _free(self, applied: Applied, taken: int) -> None:
        self._running = None
        self.removals.ended(taken, applied.now)
        self._statistics.closures = applied.closures
        self._converging.ended(applied.solver_cpu_s - self._solver_cpu_s, applied.now)
        seconds = applied.now - self._started
        self._admission.took(taken, seconds)
        self._short.ended(seconds, applied.now)
        self.variables, self.factors, self._solver_cpu_s = applied.variables, applied.factors, applied.solver_cpu_s

    def failed(self, problem: Problem, now: float) -> list[Effect]:
        """The map's thread ended by a fault: all that wait for anything, now or later, get that."""
        effects = self.drop(now, problem)
        for insert in self._running.inserts if self._running else ():
            if self._admission.is_open(insert):
                effects += self._admission.answer(insert, problem)
                self._unanswered -= 1
                self._unanswered_bytes -= insert.size
        self._running = None
        return self._go_on(effects, now)

    def tick(self, now: float) -> list[Effect]:
        """Time went by."""
        self._statistics.count()
        self._converging.look(now)
        return self._go_on(self._admission.expire(now), now)

    def change_budget(self, budget_ms: float, units_per_ms: float) -> None:
        """Steps that begin from now on have this budget, also those that finish what is left; 0: no bound."""
        self._budget.change(budget_ms, units_per_ms)
        self._converging.try_again()

    def stop(self, now: float) -> list[Effect]:
        """Take nothing new; Drained comes when everything accepted is answered."""
        self._closing = ShuttingDown()
        return self._go_on([*self._admission.close(), self._event("stopping")], now)

    def check_at(self, revision: int) -> None:
        """Is the map at `revision`, but for further steps, and with nothing under way that would change what it has?

        Raises MovedOn.
        """
        waiting = self._unanswered + self._admission.ready + self._admission.parked
        if not self._moved_at <= revision <= self.revision or waiting:
            raise MovedOn(self.name, self.revision, revision, waiting)

    def drop(self, now: float, why: Problem | None = None) -> list[Effect]:
        """The map is to go: what waits is refused, what the solver has is still answered."""
        self._closing = why or UnknownMap(self.name)
        effects: list[Effect] = [Refuse(read.asker, self._closing) for read in self._reads if read.asker is not None]
        self._reads.clear()
        return self._go_on([*effects, *self._admission.close(self._closing), self._event("dropped")], now)

    def stats(self, now: float) -> dict[str, Any]:
        """What ask/stats says of this map."""
        return self.row() | {
            "uptime_s": now - self._created,
            "waiting": self._admission.ready,
            "parked": self._admission.parked,
            "unwritten": self._unanswered - (len(self._running.inserts) if self._running else 0),
            "in_solver": len(self._running.inserts) if self._running else 0,
            "clients": self._admission.next_sequences,
            "steps": self.revision,
            "further_steps": self._converging.steps,
            "gave_up": self._converging.gave_up,
            "solver_cpu_s": self._solver_cpu_s,
            **self._budget.stats() | self.removals.stats(),
            **self._statistics.stats(),
        }

    def operator_stats(self, now: float) -> dict[str, Any]:
        """What admin/stats says of this map: `stats`, with what only an operator asks for."""
        return self.stats(now) | {
            "clients": len(self._admission.next_sequences),
            **self._statistics.for_operators(),
        }

    def running_s(self, now: float) -> float:
        """For how long the solver has been at what it has; 0 when it is free."""
        return now - self._started if self._running is not None else 0.0

    def _go_on(self, effects: list[Effect], now: float) -> list[Effect]:
        """Give the solver what waits, if it is free."""
        if self._running is not None:
            return effects
        room = self._has_room()
        further = (idle := self._is_idle()) and self._converging.is_due(now)
        keep = idle and not further and self.removals.is_due(now)
        if self._reads or self._must_reload or (self._admission.ready and room) or further or keep:
            reads = self._reads.take()
            if is_graft(reads):  # nothing goes with it
                room = further = keep = False
            inserts = self._admission.take(self._limits.step_inserts) if room else ()
            short = not keep and self._short.is_short(reads, inserts, now)
            units = self._budget.units(self._converging.doubled if further else 0)
            self._running = InsertBatch(
                reads, inserts, short, self._must_reload, further, units, keep, self._budget.budget_ms
            )
            self.removals.began(keep)
            if inserts or further:
                self._converging.began(further)
            self._must_reload = False
            self._unanswered += len(inserts)
            self._unanswered_bytes += sum([insert.size for insert in inserts])
            self._started = now
            effects.append(self._running)
        elif self._closing is not None and not self._drained and not self._unanswered:
            self._drained = True
            effects.append(Drained())
        return effects

    def _is_idle(self) -> bool:
        """May the solver do what nobody asked for?  Inserts come first, and nothing is left to be told or written."""
        waits = self._admission.ready or self._unanswered or self._must_reload
        return not (waits or self._admission.blocked or self._closing is not None)

    def _has_room(self) -> bool:
        """May the solver have more, or has the journal to write first?"""
        return self._unanswered < self._limits.unwritten and self._unanswered_bytes < self._limits.waiting_bytes

    def _try_alone(self, arrived: Arrived, content: ParsedInsert) -> InsertBatch | None:
        """The short InsertBatch of this insert and nothing else, if that is what `_go_on` would come to."""
        if (
            content.settle
            or content.convert_below
            or self._running is not None
            or self._reads
            or self._must_reload
            or not self._short.is_quick(arrived.size, arrived.now)
            or not self._has_room()
            or not self._admission.take_alone(arrived)
        ):
            return None
        self._started = arrived.now
        self._converging.began(False)
        self._unanswered += 1
        self._unanswered_bytes += arrived.size
        units, budget_ms = self._budget.units(), self._budget.budget_ms
        self._running = run = InsertBatch((), (arrived,), True, budget=units, budget_ms=budget_ms)
        return run

    def _event(self, what: str) -> Publish:
        return Publish("event", codec.encode_map({"event": what, "epoch": self.epoch, "revision": self.revision}))
