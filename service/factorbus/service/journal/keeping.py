"""A map's journal at work: a thread that writes down what was applied, and says when it is safe.

    commit   what came of an InsertBatch is published when the disk has it: answers, deltas and estimates alike, so
             nobody ever sees what a crash could take back.  While the disk is busy the next inserts are applied; all
             that waits then goes into one transaction (group commit)
    group    published at once, written and safe no later than `group_s` afterwards
    none     published at once, written now and then, safe when the operating system pleases

When the disk takes nothing: with commit, what was not written did not happen; it is refused, the solver goes back to
what the journal has, and questions are answered from there.  Else it has been published, so it is kept here and tried
again.  In any case nothing new is applied until the disk takes something.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from factorbus.journal.checkpoints import file_of, write_checkpoint
from factorbus.journal.problems import JournalDamaged, JournalFailed, JournalUnreadable, JournalVersion, NoJournal
from factorbus.journal.records import Checkpoint, JournalRecord, Last
from factorbus.journal.rewriting import UpstreamPlace, note_upstream, rewrite
from factorbus.journal.store import Store, open_store
from factorbus.proto.own_clients import count_inserts
from factorbus.service.core.events import Arrived, Stepped
from factorbus.service.journal.checkpoint_plan import CheckpointPlan
from factorbus.service.journal.items import AfterWriting, HandedBatch, NotedCheckpoint, SolverReloaded
from factorbus.service.journal.listener import Events, Listener
from factorbus.service.journal.writing import written
from factorbus.service.solving.apply import MapSolver
from factorbus.solver.build import present_build
from factorbus.solver.state import FORMAT

log = logging.getLogger(__name__)

_NONE_S = 1.0  # durability none: how often what there is gets written
_PAUSES_S = (0.2, 5.0)  # between tries to write again
_KEPT_CHECKPOINTS = 2


class Keeping(Protocol):
    """What a host needs to have a journal."""

    def keeper(self, listener: Listener) -> "Keeper":
        """The keeper, not started yet."""
        ...

    def reload(self, map_solver: MapSolver) -> Last:
        """Bring `map_solver` back to where the journal ends.  Raises JournalDamaged, JournalDiffers."""
        ...


class Keeper:
    """One map's journal.  `hand` to `checkpoint`: on the solver's thread only."""

    def __init__(
        self, store: Store, last: Last, listener: Listener, durability: str, group_s: float, checkpoint: CheckpointPlan,
        begin: Callable[[Store], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self.store, self._listener = store, listener
        self.folder, self._durability = store.path.parent, durability
        self._pause_s = {"commit": 0.0, "group": group_s, "none": _NONE_S}[durability]
        self._begin, self._begun = begin, False
        self.last, self._number = last, last.record  # `last`: as it is on the disk
        self._items: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._problem: JournalFailed | None = None
        self._checkpoint = checkpoint
        self._life = 0  # counts how often the solver went back to where the journal ends
        # Called with records that are in the journal now; with None where it was rewritten.
        self.written: Callable[[Sequence[JournalRecord] | None], None] = lambda _: None
        self.upstream: UpstreamPlace | None = None  # of a replica: up to where its upstream has the same
        self._commits, self._commit_s, self._longest_s, self._inserts = 0, 0.0, 0.0, 0
        self._thread = threading.Thread(target=self._run, name=f"journal {self.folder.name}", daemon=True)

    @property
    def waits(self) -> bool:
        """Whether what is applied is published only when `Listener.kept` is called."""
        return self._durability == "commit"

    def start(self) -> JournalFailed | None:
        """Begin writing, with what `begin` writes; gives why that cannot be done: then `unblocked` tells when it is."""
        if (problem := self._try_to_begin()) is not None:
            log.error("%s", problem)
        self._problem = problem
        self._thread.start()
        return problem

    def hand(self, inserts: Sequence[Arrived], events: Events, further: bool = False, budget: float = 0.0) -> None:
        """Write down that `inserts` were applied, each step within `budget`, and what came of it; of none, a `further`
        step, which may have been refused."""
        if inserts or events or further:
            self._number += 1
            self._checkpoint.steps_s += sum(event.solver_ms for event in events if isinstance(event, Stepped)) * 1e-3
            self._items.put(HandedBatch(self._number, inserts, events, further, budget))

    def after(self, call: Callable[[], None], dropped: Callable[[JournalFailed], None]) -> None:
        """Do `call` when all that was handed in so far is published; `dropped` if it never will be."""
        if self.waits:
            self._items.put(AfterWriting(call, dropped))
        else:
            call()

    def when_written(self, call: Callable[[], None], dropped: Callable[[JournalFailed], None]) -> None:
        """Do `call` when all that was handed in so far is in the journal; `dropped` if it never will be."""
        self._items.put(AfterWriting(call, dropped))

    def settle(self) -> None:
        """Return when all that was handed in so far is in the journal.  Raises JournalFailed if it never will be."""
        self._on_journal(lambda: None)

    def rewrite(self, last: Last, records: Sequence[JournalRecord], place: UpstreamPlace | None) -> None:
        """After `last` the journal has `records` and nothing else, when this returns; all was settled before.

        place: see `rewriting.rewrite`.  Raises JournalFailed: then nothing has changed.
        """
        self._on_journal(lambda: self._rewrite(last, records, place))
        self._number = last.record + len(records)

    @property
    def records(self) -> int:
        """How many were handed in, with those that the journal began with."""
        return self._number

    def reloaded(self, last: Last) -> None:
        """The solver is where the journal ends."""
        self._number = last.record
        self._life += 1
        self._items.put(SolverReloaded())

    def wants_checkpoint(self) -> bool:
        """Whether a copy of the solver's state is to be handed in now."""
        return self._checkpoint.due() and self._problem is None

    def checkpoint(self, state: dict[str, Any], copying_s: float) -> None:
        """Write `state`, which is that after all that was handed in so far; on a thread of its own."""
        plan, record = self._checkpoint, self._number
        plan.steps_s, plan.copying_s = 0.0, copying_s
        args = (state, record, self._life)
        plan.thread = threading.Thread(target=self._write_checkpoint, args=args, name="checkpoint")
        plan.thread.daemon = True
        plan.thread.start()

    @property
    def problem(self) -> str:
        """Why nothing can be written at the moment; empty: it can."""
        return str(problem.detail["reason"]) if (problem := self._problem) is not None else ""

    def stats(self) -> dict[str, Any]:
        """What ask/stats says of the journal."""
        return {
            "durability": self._durability,
            "records": self.last.record,
            "revision": self.last.revision,
            "commits": self._commits,
            "inserts": self._inserts,
            "commit_ms": 1e3 * self._commit_s,
            "longest_commit_ms": 1e3 * self._longest_s,
            "checkpoint_record": self._checkpoint.record,
            "blocked": int(self._problem is not None),
            "problem": self._problem.message if self._problem else "",
        }

    def close(self, dump: Callable[[], dict[str, Any]] | None) -> None:
        """Write what is left, and the state that `dump` gives if a restart would take long without; then close."""
        self._ending.set()
        self._items.put(None)
        self._thread.join()
        if self._checkpoint.thread is not None:
            self._checkpoint.thread.join()
        if self._problem is None and self.store.writable:
            try:
                if dump is not None and self._checkpoint.steps_s > 0.1 * self._checkpoint.every_s:
                    self._write_checkpoint(dump(), self._number, self._life)
                self._note_checkpoints()
                note_upstream(self.store, self.upstream)
                self.store.end()
            except JournalFailed as problem:
                log.error("%s", problem)
        self.store.close()

    # ---- on the journal's thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        if self._problem is not None:
            self._wait_until_writable()
        while (batch := self._next_batch()) is not None:
            if (problem := self._write(batch)) is None:
                continue
            if self.waits:
                self._listener.unkept(problem)
                self._drop_until_reloaded(batch, problem)
                self._wait_until_writable()
            else:
                self._listener.blocked(problem)
                if not self._try_again(batch):
                    return

    def _next_batch(self) -> list[Any] | None:
        """All that waits; None: there is nothing, and nothing will come."""
        first = self._items.get()
        if first is None:
            return None
        if self._pause_s:
            self._ending.wait(self._pause_s)
        batch = [first]
        while True:
            try:
                item = self._items.get_nowait()
            except queue.Empty:
                return batch
            if item is None:
                self._items.put(None)
                return batch
            batch.append(item)

    def _write(self, batch: list[Any]) -> JournalFailed | None:
        """Write `batch` in one transaction and tell; with a problem nothing of it is written or told."""
        records, last = [], self.last
        for item in batch:
            if isinstance(item, HandedBatch):
                record = written(item.number, item.inserts, item.events, last, item.further, item.budget)
                records.append(record)
                last = Last(record.number, record.revision, record.chain)
        try:
            if records:
                self._append(records)
        except JournalFailed as problem:
            self._problem = problem
            log.error("%s", problem)
            return problem
        self.last = last
        if records:
            self.written(records)
        for item in batch:
            if isinstance(item, AfterWriting):
                item.call()
            elif isinstance(item, HandedBatch) and self.waits:
                self._listener.kept(item.events)
            elif isinstance(item, NotedCheckpoint):
                self._note(item)
        return None

    def _on_journal(self, call: Callable[[], None]) -> None:
        """Do `call` on the journal's thread, behind all that was handed in.  Raises JournalFailed."""
        done: queue.SimpleQueue[JournalFailed | None] = queue.SimpleQueue()

        def do() -> None:
            try:
                call()
            except JournalFailed as problem:
                done.put(problem)
            else:
                done.put(None)

        self.when_written(do, done.put)
        if (problem := done.get()) is not None:
            raise problem

    def _rewrite(self, last: Last, records: Sequence[JournalRecord], place: UpstreamPlace | None) -> None:
        gone = rewrite(self.store, last, records, place, present_build())
        for record in gone:
            file_of(self.folder, record).unlink(missing_ok=True)
        grew = last.record == self.last.record
        if not grew:
            self._life += 1
            self._checkpoint.record = min(self._checkpoint.record, last.record)
        if records:
            last = Last(records[-1].number, records[-1].revision, records[-1].chain)
        self.last, self.upstream = last, place or self.upstream
        self.written(records if grew else None)

    def _append(self, records: list[JournalRecord]) -> None:
        started = time.perf_counter()
        self.store.append(records)
        took = time.perf_counter() - started
        self._commits += 1
        self._commit_s += took
        self._longest_s = max(self._longest_s, took)
        self._inserts += sum(count_inserts(record.entries) for record in records)

    def _drop_until_reloaded(self, batch: list[Any], problem: JournalFailed) -> None:
        """Nothing of what comes before the solver is back where the journal is counts any more."""
        for item in batch:
            if isinstance(item, AfterWriting):
                item.dropped(problem)
        while not isinstance(item := self._items.get(), SolverReloaded):
            if item is None:
                self._items.put(None)
                return
            if isinstance(item, AfterWriting):
                item.dropped(problem)

    def _wait_until_writable(self) -> None:
        """Try again and again, and let questions through meanwhile."""
        pause_s, longest_s = _PAUSES_S
        while True:
            try:
                item = self._items.get(timeout=pause_s)
            except queue.Empty:
                if self._is_writable():
                    break
                pause_s = min(2 * pause_s, longest_s)
                continue
            if item is None:
                self._items.put(None)
                return
            if isinstance(item, AfterWriting):
                item.call()
        self._recovered()

    def _try_again(self, batch: list[Any]) -> bool:
        """What has been told has to be written, if there is any way; False: there is none, nor for what comes after."""
        pause_s, longest_s = _PAUSES_S
        while self._write(batch) is not None:
            if self._ending.wait(pause_s):
                lost = sum(len(item.inserts) for item in batch if isinstance(item, HandedBatch))
                log.error("%s: %d inserts and more that were answered are not written", self.store.path, lost)
                return False
            pause_s = min(2 * pause_s, longest_s)
        self._recovered()
        return True

    def _recovered(self) -> None:
        self._problem = None
        log.info("%s can be written again", self.store.path)
        self._listener.unblocked()

    def _is_writable(self) -> bool:
        try:
            if not self._begun:
                self._reopen()
            self.store.probe()
        except (JournalFailed, JournalDamaged, JournalUnreadable, JournalVersion, NoJournal) as problem:
            log.debug("still not: %s", problem)
            return False
        return self._try_to_begin() is None

    def _try_to_begin(self) -> JournalFailed | None:
        """Write what has to be there before anything else, unless it is; gives why that cannot be done."""
        if not self.store.writable:
            return JournalFailed(self.store.path, "it is read-only")
        if not self._begun:
            try:
                self._begin(self.store)
            except JournalFailed as problem:
                return problem
            self._begun = True
        return None

    def _reopen(self) -> None:
        # The old one is closed first: in one process, what is open for reading keeps all others from writing.
        self.store.close()
        self.store = open_store(self.folder, self._durability)
        if not self.store.writable:
            raise JournalFailed(self.store.path, "it is read-only")

    # ---- checkpoints ------------------------------------------------------------------------------------------------

    def _write_checkpoint(self, state: dict[str, Any], record: int, life: int) -> None:
        """On a thread of its own; the journal's thread notes it behind the record that it was made after."""
        started = time.perf_counter()
        path = file_of(self.folder, record)
        try:
            size = write_checkpoint(path, state)
        except OSError as error:
            log.warning("no checkpoint in %s: %s; a restart takes longer without it", path, error)
            return
        log.info("%s: %.1f MB in %.2f s", path, size / 1e6, time.perf_counter() - started)
        self._items.put(
            NotedCheckpoint(Checkpoint(record, FORMAT, present_build(), self._checkpoint.differs, size), life)
        )

    def _note(self, noted: NotedCheckpoint) -> None:
        """A checkpoint counts once it is noted; one of records that did not happen must not."""
        saved = noted.saved
        if noted.life != self._life:
            file_of(self.folder, saved.record).unlink(missing_ok=True)
            return
        try:
            old = self.store.add_checkpoint(saved, _KEPT_CHECKPOINTS, self.upstream.record if self.upstream else 0)
            note_upstream(self.store, self.upstream)
        except JournalFailed as problem:
            log.warning("checkpoint %d is not noted: %s", saved.record, problem)
            file_of(self.folder, saved.record).unlink(missing_ok=True)
            return
        self._checkpoint.record = saved.record
        for record in old:
            file_of(self.folder, record).unlink(missing_ok=True)

    def _note_checkpoints(self) -> None:
        """Those that were written while the journal's thread ended."""
        while not self._items.empty():
            if isinstance(item := self._items.get(), NotedCheckpoint):
                self._note(item)
