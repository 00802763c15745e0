"""One map at work: its core, its lock, its solver and the thread that the solver runs on.  Knows no bus.

The thread that brings an event takes the lock for the microseconds that the core needs; what the core wants done is
done after the lock is free again.

There is one InsertBatch at a time, and the thread that has it has the solver.  It goes to the map's own thread, unless
it is short: then the thread that brought the insert does it at once, which saves waking two others (a tenth of a small
exchange).  That thread is one of the few with which Zenoh receives, so only one may do so at a time, over all maps
(the inline_run): however wrong the guess was, only the client that sent the insert is not heard meanwhile.  An
InsertBatch ends (Applied) when its messages are sent or in the outbox, so deltas leave in order.
"""

import logging
import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

from factorbus.journal.problems import JournalFailed
from factorbus.proto.problems import Internal, Problem
from factorbus.proto.records import JournalPlace, RecordsAnswer, encode_records_answer
from factorbus.service.core.events import (
    Answer,
    Applied,
    Arrived,
    ArrivedQuestion,
    Asker,
    Effect,
    InsertBatch,
    Publish,
    Read,
    Refuse,
    SingleInsertResult,
    Stepped,
    Verdict,
)
from factorbus.service.core.map_state import MapCore
from factorbus.service.core.pending_questions import is_graft
from factorbus.service.journal.grafting import Graft, graft_records
from factorbus.service.journal.keeping import Events, Keeper, Keeping
from factorbus.service.journal.record_problems import NotRecorded
from factorbus.service.process.health import Pulse
from factorbus.service.questions.answers import Question, QuestionCopies
from factorbus.service.solving.apply import MapSolver
from factorbus.solver.errors import SolverError

log = logging.getLogger(__name__)

# What a core wants done; answer(reads, copies) turns copies into answers, elsewhere.
Perform: TypeAlias = Callable[[list[Effect]], None]
SendBoth: TypeAlias = Callable[[Asker, bytes, bytes], None]
AnswerReads: TypeAlias = Callable[[Sequence[Read], QuestionCopies], None]


class Host:
    """A map, running.  Its methods may be called from any thread and return at once; `insert` does after a short
    InsertBatch.

    perform: has done what the core wants done, in order, elsewhere; send: the same, at once if the order allows.
    inline_run: shared by all maps; who has it may do short Runs.  send_both: `send` for an answer and a delta.
    """

    def __init__(
        self,
        core: MapCore,
        map_solver: MapSolver,
        perform: Perform,
        send: Perform,
        answer: AnswerReads,
        inline_run: threading.Lock,
        send_both: SendBoth,
        keeping: Keeping | None = None,
    ) -> None:
        self.core = core
        self._keeper = keeping.keeper(self) if keeping else None
        self._keeping = keeping
        self._map_solver, self._do, self._send, self._answer, self._inline_run = (
            map_solver,
            perform,
            send,
            answer,
            inline_run,
        )
        self._send_both = send_both
        self.upstream_stats: Callable[[], dict[str, Any]] = dict  # of a replica
        self._lock = threading.Lock()
        self._runs: queue.SimpleQueue[InsertBatch | Callable[[], None] | None] = queue.SimpleQueue()
        self._pulse = Pulse(self._runs.put)
        self._thread = threading.Thread(target=self._solve_all, name=f"solver {core.name}", daemon=True)
        self._thread.start()
        if self._keeper is not None and (problem := self._keeper.start()) is not None:
            core.block(problem, time.monotonic())  # it has nothing yet that would come of it; `created` tells

    def memory_bytes(self) -> int:
        """What the map's solver has in use, seen from any thread: by a step more or less."""
        return self._map_solver.memory_bytes()

    def created(self) -> None:
        """The map is on the bus."""
        self._perform(self.core.created())

    def insert(self, arrived: Arrived) -> None:
        """An insert came in."""
        with self._lock:
            effects = self.core.insert(arrived)
        if (
            effects
            and isinstance(run := effects[-1], InsertBatch)
            and run.short
            and self._inline_run.acquire(blocking=False)
        ):
            try:
                if len(effects) > 1:
                    self._perform(effects[:-1])
                self._solve(run, self._send)
            finally:
                self._inline_run.release()
        else:
            self._perform(effects)

    def unread(self, client: str, refuse: Refuse) -> None:
        """An insert of `client` came in of which not even the number can be read."""
        with self._lock:
            effects = self.core.unread(client, refuse)
        self._perform(effects)

    def ask(self, question: ArrivedQuestion) -> None:
        """A question came in."""
        with self._lock:
            effects = self.core.ask(question, time.monotonic())
        self._perform(effects)

    def read(self, read: Read) -> None:
        """A question of the service itself came in."""
        with self._lock:
            effects = self.core.read(read, time.monotonic())
        self._perform(effects)

    def graft(self, asker: Asker, graft: Graft) -> None:
        """Put records of another journal into this one; `asker` gets a RecordsAnswer."""
        self.read(Read(Question("graft", ask=graft), asker))

    def change_budget(self, budget_ms: float, units_per_ms: float) -> None:
        """Steps that begin from now on have this budget; 0: no bound.  The journal has it."""
        with self._lock:
            self._map_solver.change_budget(budget_ms)
            self.core.change_budget(budget_ms, units_per_ms)

    @property
    def keeper(self) -> Keeper | None:
        """What writes the journal, if there is one."""
        return self._keeper

    def tick(self) -> None:
        """Time went by."""
        with self._lock:
            effects = self.core.tick(time.monotonic())
        self._perform(effects)

    def operator_stats(self) -> dict[str, Any]:
        """What admin/stats says of the map."""
        with self._lock:
            return self.core.operator_stats(time.monotonic()) | self.journal()

    def silent_s(self) -> float:
        """For how long the solver has not come to its next work, whichever thread it is on."""
        now = time.monotonic()
        with self._lock:
            running_s = self.core.running_s(now)
        return max(running_s, self._pulse.silent_s(now))

    def stop(self) -> None:
        """Take nothing new; Drained is performed when everything accepted is answered."""
        with self._lock:
            effects = self.core.stop(time.monotonic())
        self._perform(effects)

    def drop(self, revision: int | None = None) -> None:
        """The map is to go; Drained is performed when the solver is done with what it has.

        revision: only if it is there, and nothing is under way.  Raises MovedOn: then nothing has changed.
        """
        with self._lock:
            if revision is not None:
                self.core.check_at(revision)
            effects = self.core.drop(time.monotonic())
        self._perform(effects)

    def end(self, keep: bool = True) -> None:
        """End the solver's thread, which may still be sending its last delta, and then the journal's; after Drained.

        keep: the map is to come back, and quickly.
        """
        self._runs.put(None)
        self._thread.join()
        if self._keeper is not None:
            self._keeper.close(self._map_solver.dump if keep else None)

    @property
    def unwritable(self) -> str:
        """Why the journal cannot be written at the moment, and nothing is taken in; empty: it can."""
        return self._keeper.problem if self._keeper is not None else ""

    def journal(self) -> dict[str, Any]:
        """What ask/stats says of the journal, if there is one."""
        return {} if self._keeper is None else {"journal": self._keeper.stats(), **self.upstream_stats()}

    # ---- what becomes of the writing: on the journal's thread -------------------------------------------------------

    def kept(self, events: Events) -> None:
        """What came of an InsertBatch is safe."""
        with self._lock:
            effects = self.core.kept(events, time.monotonic())
        self._perform(effects)

    def unkept(self, problem: JournalFailed) -> None:
        """What was not kept did not happen."""
        with self._lock:
            effects = self.core.unkept(problem, time.monotonic())
        self._perform(effects)

    def blocked(self, problem: JournalFailed) -> None:
        """Nothing can be kept at the moment."""
        with self._lock:
            effects = self.core.block(problem, time.monotonic())
        self._perform(effects)

    def unblocked(self) -> None:
        """It can again."""
        with self._lock:
            effects = self.core.unblock()
        self._perform(effects)

    def _perform(self, effects: list[Effect]) -> None:
        if effects and isinstance(run := effects[-1], InsertBatch):
            self._runs.put(run)
            effects = effects[:-1]
        if effects:
            self._do(effects)

    def _solve_all(self) -> None:
        while (run := self._runs.get()) is not None:
            if isinstance(run, InsertBatch):
                self._solve(run, self._do)
            else:
                run()

    def _solve(self, run: InsertBatch, tell: Perform) -> None:
        try:
            if run.keep:
                run = self._with_removals(run)
            if self._keeper is not None:
                self._run_kept(run, self._keeper, tell)
                return
            if run.reads:
                self._read(run.reads)
            self._map_solver.allow(run.budget, run.budget_ms)
            events = self._map_solver.apply_batch(run.inserts, run.further)
            if not isinstance(events, SingleInsertResult):
                self._tell(events, tell)
                return
            (insert, answer, _), delta = events.outcome, events.stepped.delta
            answered = insert.askers[0]
            if tell is self._send:
                self._send_both(answered, answer, delta)
            else:
                tell([Answer(answered, answer), Publish("delta", delta)])
            with self._lock:
                effects = self.core.alone(events, answered)
            if effects:
                self._perform(effects)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: map %s has stopped", reference, self.core.name)
            with self._lock:
                effects = self.core.failed(Internal(reference), time.monotonic())
            self._perform(effects)

    def _with_removals(self, run: InsertBatch) -> InsertBatch:
        """With the map's own insert, which takes out poses that it has enough of, if there are any."""
        planned, inserts = self._map_solver.plan_removals()
        with self._lock:
            self.core.removals.planned(planned)
        return run._replace(inserts=inserts)

    def _tell(self, events: Iterable[Verdict | Stepped | Applied], tell: Perform) -> None:
        """What comes of an InsertBatch, step by step."""
        effects: list[Effect] = []
        for event in events:
            if isinstance(event, Applied):
                with self._lock:
                    effects += self.core.applied(event)
                self._perform(effects)
                return
            with self._lock:
                if isinstance(event, Verdict):
                    # Kept until the delta is made.  Sending wakes other threads, which on a busy machine run first;
                    # measured: an answer sent before its delta is encoded makes the delta 0.2 ms later.
                    effects += self.core.give_verdict(event)
                    continue
                effects += self.core.stepped(event)
            tell(effects)
            effects = []

    def _run_kept(self, run: InsertBatch, keeper: Keeper, tell: Perform) -> None:
        """The same with a journal: what comes of it is told when that is safe, or at once if it need not be."""
        if run.reload and self._keeping is not None:
            keeper.reloaded(self._keeping.reload(self._map_solver))
        if is_graft(run.reads):
            self._graft(run.reads[0], keeper)
        elif run.reads:
            self._read(run.reads)
        self._map_solver.allow(run.budget, run.budget_ms)
        events, applied = self._map_solver.apply_whole(run.inserts, run.further)
        keeper.hand(run.inserts, events, run.further, run.budget)
        if not keeper.waits:
            with self._lock:
                effects = self.core.kept(events, time.monotonic())
            tell(effects)
        replaced = any(isinstance(event, Stepped) and event.rebuilt for event in events)
        if replaced or ((run.inserts or run.further) and keeper.wants_checkpoint()):
            started = time.perf_counter()
            keeper.checkpoint(self._map_solver.dump(), time.perf_counter() - started)
        with self._lock:
            effects = self.core.applied(applied)
        self._perform(effects)

    def _graft(self, read: Read, keeper: Keeper) -> None:
        graft: Graft = read.question.ask
        try:
            if self._keeping is None:
                raise NotRecorded(self.core.name)
            reload, check = self._keeping.reload, self._check_numbers
            done = graft_records(self.core.name, graft, self._map_solver, keeper, reload, check)
        except (Problem, SolverError) as problem:
            self._refuse([read], problem)
            return
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: records of another journal are not taken into map %s", reference, self.core.name)
            self._refuse([read], Internal(reference))
            return
        for refused in done.refused:
            log.warning(
                "map %s: insert %d of client %s, accepted here before, is refused upstream: %s", self.core.name,
                refused.sequence, refused.client, refused.answer, extra={"map": self.core.name},
            )  # fmt: skip
        with self._lock:
            effects = self.core.grafted(done.inserts, done.steps, done.closures, time.monotonic())
        self._do(effects)
        graft.heard(done)
        place = JournalPlace(done.last.record, done.last.chain)
        answer = RecordsAnswer(self.core.epoch, place, same=done.same_outcomes)
        self._do([Answer(read.asker, encode_records_answer(answer))])

    def _check_numbers(self, inserts: Iterable[tuple[str, int]]) -> None:
        with self._lock:
            self.core.check_numbers(inserts)

    def _read(self, reads: Sequence[Read]) -> None:
        try:
            taken = self._map_solver.snapshot([read.question for read in reads])
        except (Problem, SolverError) as problem:
            self._refuse(reads, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: no copies of map %s", reference, self.core.name)
            self._refuse(reads, Internal(reference))
        else:
            self._answer_after(reads, taken)

    def _answer_after(self, reads: Sequence[Read], taken: QuestionCopies) -> None:
        """Nobody sees what a crash could take back, and a copy goes on from what is in the journal."""
        keeper = self._keeper
        if keeper is None:
            self._answer(reads, taken)
            return
        noted = replace(taken, record=keeper.records)
        wait = keeper.after if taken.copied is None else keeper.when_written
        wait(lambda: self._answer(reads, noted), lambda problem: self._refuse(reads, problem))

    def _refuse(self, reads: Sequence[Read], problem: Exception) -> None:
        self._do([Refuse(read.asker, problem) for read in reads if read.asker is not None])
