"""One map as a state machine: events in, effects out.  No bus, no clock, no thread, no solver: all of that is told.

    Arrived ─▶ admission ─▶ inbox ─┐                    ┌─▶ Answer, Refuse    to who inserted
    Asked ───▶ reads ──────────────┴▶ Run ─▶ Folded ────┼─▶ Publish           delta of every step
                                    (solver thread)     └─▶ Run               what came in meanwhile

At most one Run is out at a time, so what the solver does next is decided when it is free, from all that waits then.
"""

import math
from collections import Counter, deque
from typing import Any

from factorbus.proto import codec
from factorbus.proto.messages import Insert
from factorbus.proto.problems import Busy, Problem, ShuttingDown, UnknownMap
from factorbus.service.admission import Admission
from factorbus.service.config import Limits
from factorbus.service.events import (
    Arrived,
    Asked,
    Drained,
    Effect,
    Folded,
    Judged,
    Publish,
    Read,
    Refuse,
    Run,
    Stepped,
    Tell,
    Waiting,
)
from factorbus.service.questions import Question, parse

_KEYFRAME = Read(Question("keyframe"))
# A Run is short when it is for one insert of at most so many bytes and none of late took longer than so, unless the
# insert was already on its way when the last Run ended: then there are likely more behind it, to be folded together.
_SHORT_BYTES = 16 << 10
_SHORT_S = 0.002
_ROUND_TRIP_S = 0.0002


class MapCore:
    """The state of one map, short of its estimate.  Every method takes an event and returns effects, in order."""

    def __init__(self, name: str, mode: str, epoch: int, limits: Limits, now: float) -> None:
        self.name, self.mode, self.epoch = name, mode, epoch
        self.revision = self.variables = self.factors = 0
        self._limits, self._created = limits, now
        self._admission = Admission(epoch, limits)
        self._reads: deque[Read] = deque()
        self._running: Run | None = None
        self._started = self._ended = 0.0
        self._slowest_s = math.inf  # of late: forgotten by a tenth with every Run
        self._closing: Problem | None = None
        self._drained = False
        self._since_keyframe = [0, 0]  # steps, bytes of deltas
        self._strategies: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._chi2 = self._solver_ms = self._solver_cpu_s = 0.0

    def row(self) -> dict[str, Any]:
        """What admin/maps says of this map."""
        return {
            "name": self.name,
            "mode": self.mode,
            "epoch": self.epoch,
            "revision": self.revision,
            "variables": self.variables,
            "factors": self.factors,
        }

    def created(self) -> list[Effect]:
        """The map is on the bus."""
        return [self._event("created")]

    def insert(self, arrived: Arrived) -> list[Effect]:
        """An insert came in."""
        effects = self._admission.expire(arrived.now)
        judged = self._admission.admit(arrived)
        for effect in judged:
            if isinstance(effect, Refuse):
                self._counts["busy" if effect.problem.code == "busy" else "refused"] += 1
        return self._go_on(effects + judged, arrived.now)

    def ask(self, asked: Asked, now: float) -> list[Effect]:
        """A question came in."""
        if self._closing is not None:
            return [Refuse(asked.asker, self._closing)]
        try:
            question = parse(asked.question, asked.payload)
        except Problem as problem:
            return [Refuse(asked.asker, problem)]
        if question.name == "stats":
            return [Tell(asked.asker, self.stats(now))]
        if len(self._reads) >= self._limits.questions:
            return [Refuse(asked.asker, Busy(len(self._reads), 0.1))]
        self._reads.append(Read(question, asked.asker))
        return self._go_on([], now)

    def judged(self, judged: Judged) -> list[Effect]:
        """The solver's word on some of what it has."""
        effects: list[Effect] = []
        for outcome in judged.outcomes:
            effects += self._admission.answer(outcome.insert, outcome.answer)
            self._counts["accepted" if isinstance(outcome.answer, bytes) else "refused"] += 1
        return effects

    def stepped(self, stepped: Stepped) -> list[Effect]:
        """The solver made a step."""
        self.revision = stepped.revision
        self._chi2 = stepped.chi2
        self._solver_ms += stepped.solver_ms
        self._strategies[stepped.strategy] += 1
        self._since_keyframe[0] += 1
        self._since_keyframe[1] += len(stepped.delta)
        steps, size = self._since_keyframe
        if steps >= self._limits.keyframe_steps or size >= self._limits.keyframe_bytes:
            self._since_keyframe = [0, 0]
            self._reads.append(_KEYFRAME)
        return [Publish("delta", stepped.delta)]

    def folded(self, folded: Folded) -> list[Effect]:
        """The solver is free again."""
        taken = self._running.inserts if self._running else ()
        self._running = None
        self._ended = folded.now
        seconds = self._ended - self._started
        self._admission.took(len(taken), seconds)
        self._slowest_s = max(seconds, 0.9 * self._slowest_s if self._slowest_s < math.inf else 0.0)
        self.variables, self.factors, self._solver_cpu_s = folded.variables, folded.factors, folded.solver_cpu_s
        return self._go_on([], folded.now)

    def failed(self, problem: Problem, now: float) -> list[Effect]:
        """The map's thread ended by a fault: whoever waits for anything, now or later, is told so."""
        effects = self.drop(now, problem)
        for insert in self._running.inserts if self._running else ():
            if self._admission.is_open(insert):
                effects += self._admission.answer(insert, problem)
        self._running = None
        return self._go_on(effects, now)

    def tick(self, now: float) -> list[Effect]:
        """Time went by."""
        return self._admission.expire(now)

    def stop(self, now: float) -> list[Effect]:
        """Take nothing new; Drained comes when everything accepted is answered."""
        self._closing = ShuttingDown()
        return self._go_on([*self._admission.close(), self._event("stopping")], now)

    def drop(self, now: float, why: Problem | None = None) -> list[Effect]:
        """The map is to go: what waits is refused, what the solver has is still answered."""
        self._closing = why or UnknownMap(self.name)
        effects: list[Effect] = [Refuse(read.asker, self._closing) for read in self._reads if read.asker is not None]
        self._reads.clear()
        return self._go_on([*effects, *self._admission.close(self._closing), self._event("dropped")], now)

    def stats(self, now: float) -> dict[str, Any]:
        """What ask/stats says of this map."""
        return self.row() | {
            "chi2": self._chi2,
            "uptime_s": now - self._created,
            "waiting": self._admission.ready,
            "parked": self._admission.parked,
            "in_solver": len(self._running.inserts) if self._running else 0,
            "clients": self._admission.next_sequences,
            "inserts": {name: self._counts[name] for name in ("accepted", "refused", "busy")},
            "steps": self.revision,
            "strategies": dict(self._strategies),
            "solver_ms": self._solver_ms,
            "solver_cpu_s": self._solver_cpu_s,
        }

    def _go_on(self, effects: list[Effect], now: float) -> list[Effect]:
        """Give the solver what waits, if it is free."""
        if self._running is not None:
            return effects
        if self._reads or self._admission.ready:
            reads, inserts = tuple(self._reads), self._admission.take(self._limits.fold)
            self._running = Run(reads, inserts, self._is_short(reads, inserts, now))
            self._reads.clear()
            self._started = now
            effects.append(self._running)
        elif self._closing is not None and not self._drained:
            self._drained = True
            effects.append(Drained())
        return effects

    def _is_short(self, reads: tuple[Read, ...], inserts: tuple[Waiting, ...], now: float) -> bool:
        if reads or len(inserts) != 1 or self._slowest_s > _SHORT_S or now - self._ended < _ROUND_TRIP_S:
            return False
        content = inserts[0].content
        return inserts[0].size <= _SHORT_BYTES and not (isinstance(content, Insert) and content.settle)

    def _event(self, what: str) -> Publish:
        return Publish("event", codec.encode_map({"event": what, "epoch": self.epoch, "revision": self.revision}))
