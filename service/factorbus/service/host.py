"""One map at work: its core, its lock, its solver and the thread that the solver runs on.  Knows no bus.

Whoever brings an event takes the lock for the microseconds that the core needs; what the core wants done is done
after the lock is free again.

There is one Run at a time, and whoever has it has the solver.  It goes to the map's own thread, unless it is short:
then the thread that brought the insert does it at once, which saves waking two others (a tenth of a small exchange).
That thread is one of the few with which Zenoh receives, so only one may do so at a time, over all maps (the seat):
however wrong the guess was, only the client that sent the insert is not heard meanwhile.  A Run ends (Folded) when its
messages are sent or in the outbox, so deltas leave in order.
"""

import logging
import queue
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeAlias

from factorbus.proto.problems import Internal, Problem
from factorbus.service.core import MapCore
from factorbus.service.events import Arrived, Asked, Effect, Judged, Read, Refuse, Run, Stepped
from factorbus.service.fold import Folder
from factorbus.service.questions import Snapshot
from factorbus.solver.errors import SolverError

log = logging.getLogger(__name__)

# What a core wants done; answer(reads, snapshot) turns snapshots into answers, elsewhere.
Perform: TypeAlias = Callable[[list[Effect]], None]
AnswerReads: TypeAlias = Callable[[Sequence[Read], Snapshot], None]


class Host:
    """A map, running.  Its methods may be called from any thread and return at once; `insert` does after a short Run.

    perform: has done what the core wants done, in order, elsewhere; send: the same, at once if the order allows.
    seat: shared by all maps; who has it may do short Runs.
    """

    def __init__(
        self,
        core: MapCore,
        folder: Folder,
        perform: Perform,
        send: Perform,
        answer: AnswerReads,
        seat: threading.Lock,
    ) -> None:
        self.core = core
        self._folder, self._do, self._send, self._answer, self._seat = folder, perform, send, answer, seat
        self._lock = threading.Lock()
        self._runs: queue.SimpleQueue[Run | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._solve_all, name=f"solver {core.name}", daemon=True)
        self._thread.start()

    def created(self) -> None:
        """The map is on the bus."""
        self._perform(self.core.created())

    def insert(self, arrived: Arrived) -> None:
        """An insert came in."""
        with self._lock:
            effects = self.core.insert(arrived)
        if effects and isinstance(run := effects[-1], Run) and run.short and self._seat.acquire(blocking=False):
            try:
                self._perform(effects[:-1])
                self._solve(run, self._send)
            finally:
                self._seat.release()
        else:
            self._perform(effects)

    def ask(self, asked: Asked) -> None:
        """A question came in."""
        with self._lock:
            effects = self.core.ask(asked, time.monotonic())
        self._perform(effects)

    def tick(self) -> None:
        """Time went by."""
        with self._lock:
            effects = self.core.tick(time.monotonic())
        self._perform(effects)

    def stop(self) -> None:
        """Take nothing new; Drained is performed when everything accepted is answered."""
        with self._lock:
            effects = self.core.stop(time.monotonic())
        self._perform(effects)

    def drop(self) -> None:
        """The map is to go; Drained is performed when the solver is done with what it has."""
        with self._lock:
            effects = self.core.drop(time.monotonic())
        self._perform(effects)

    def end(self) -> None:
        """End the solver's thread, which may still be sending its last delta; after Drained."""
        self._runs.put(None)
        self._thread.join()

    def _perform(self, effects: list[Effect]) -> None:
        if effects and isinstance(run := effects[-1], Run):
            self._runs.put(run)
            effects = effects[:-1]
        if effects:
            self._do(effects)

    def _solve_all(self) -> None:
        while (run := self._runs.get()) is not None:
            self._solve(run, self._do)

    def _solve(self, run: Run, tell: Perform) -> None:
        try:
            self._run(run, tell)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: map %s has stopped", reference, self.core.name)
            with self._lock:
                effects = self.core.failed(Internal(reference), time.monotonic())
            self._perform(effects)

    def _run(self, run: Run, tell: Perform) -> None:
        if run.reads:
            self._read(run.reads)
        effects: list[Effect] = []
        for event in self._folder.fold(run.inserts):
            with self._lock:
                if isinstance(event, Judged):
                    # Kept until the delta is made.  Sending wakes other threads, which on a busy machine run first;
                    # measured: an answer sent before its delta is encoded makes the delta 0.2 ms later.
                    effects = self.core.judged(event)
                    continue
                stepped = isinstance(event, Stepped)
                effects += self.core.stepped(event) if stepped else self.core.folded(event)
            (tell if stepped else self._perform)(effects)
            effects = []

    def _read(self, reads: Sequence[Read]) -> None:
        try:
            taken = self._folder.snapshot([read.question for read in reads])
        except (Problem, SolverError) as problem:
            self._refuse(reads, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: no snapshot of map %s", reference, self.core.name)
            self._refuse(reads, Internal(reference))
        else:
            self._answer(reads, taken)

    def _refuse(self, reads: Sequence[Read], problem: Exception) -> None:
        self._do([Refuse(read.asker, problem) for read in reads if read.asker is not None])
