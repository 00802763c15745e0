"""Services with a journal that are killed and started again, a client that streams into them, and what is right."""

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from processes import PATIENCE_S, Process

from factorbus.client import Draft
from factorbus.client.map import Map
from factorbus.client.pending_insert import PendingInsert
from factorbus.journal.store import open_store
from factorbus.proto.messages import Batch
from factorbus.proto.stamps import NO_STAMP
from factorbus.solver import Options, Solver

NURSERY = str(Path(__file__).parent / "system" / "journal_nursery.py")
SIGMAS = (0.1, 0.1, 0.05)
T0 = 1_403_636_579_763_555_584  # nanoseconds
T = TypeVar("T")


class Services:
    """Services with one journal, one after the other, at one endpoint."""

    def __init__(self, nursery: Process, journal: Path, settings: tuple[str, ...]) -> None:
        self._nursery, self._endpoint, self.pid = nursery, "tcp/127.0.0.1:0", 0
        self._how = json.dumps({"journal": str(journal), **{n: json.loads(v) for n, v in map(_pair, settings)}})

    def start(self) -> str:
        """A new one is ready; where."""
        self.bear()
        return self.ready()

    def ready(self) -> str:
        """It answers; where."""
        self._endpoint = [*self._nursery.ready(), self._endpoint][0]
        return self._endpoint

    def bear(self, endpoint: str = "") -> None:
        """A new one begins."""
        self._endpoint = endpoint or self._endpoint
        self._nursery.tell(f"start {self._endpoint} {self._how}")
        self.pid = int(self._nursery.line("born")[0])

    def forget(self) -> None:
        """Nothing that was said by now is waited for any more."""
        self._nursery.tell("quiet")
        self._nursery.line("quiet")

    def refused(self) -> str:
        """It does not start; why."""
        return self._nursery.line("cannot")[0]

    def eventually(self, look: Callable[[], T], wanted: Callable[[T], bool]) -> T:
        """What `look` sees once it is `wanted`."""
        end = time.monotonic() + PATIENCE_S
        while not wanted(seen := look()):
            assert time.monotonic() < end, f"it stays {seen}"
        return seen

    def end(self, number: signal.Signals) -> None:
        """It is gone."""
        if not self.pid:
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)
        end = time.monotonic() + PATIENCE_S
        while os.path.exists(f"/proc/{self.pid}"):
            assert time.monotonic() < end, "it does not go"
            os.sched_yield()
        self.pid = 0


def _pair(setting: str) -> tuple[str, str]:
    name, _, value = setting.partition("=")
    return name, value


def drafts(count: int) -> list[Batch]:
    """A robot that goes round and round a noisy loop, and sees where it was."""
    noise, made = np.random.default_rng(7), [Draft().se2("x0", (0, 0, 0), fixed=True, stamp=T0).batch()]
    for n in range(1, count):
        draft = Draft().se2(f"x{n}", stamp=None if n % 7 == 3 else T0 + n)
        draft.between_se2(f"x{n - 1}", f"x{n}", noise.normal((1, 0, 0.3), 0.02), sigmas=SIGMAS)
        if n >= 21 and n % 5 == 0:
            draft.between_se2(f"x{n - 21}", f"x{n}", noise.normal((0, 0, 0.02), 0.02), sigmas=SIGMAS)
        made.append(draft.batch())
    return made


class Stream(threading.Thread):
    """Sends drafts into a map until told to stop; `acknowledged` are the numbers of those that were answered."""

    def __init__(self, driven: Map, batches: list[Batch]) -> None:
        super().__init__(daemon=True)
        self._driven, self._batches = driven, batches
        self.stop, self.pending_inserts, self.fault = threading.Event(), list[PendingInsert](), list[BaseException]()
        self.acknowledged: set[int] = set()
        self._allowed, self._more = threading.Semaphore(0), threading.Condition()

    def allow(self, more: int) -> None:
        """Let it send that number more."""
        self._allowed.release(more)

    def wait_for(self, answered: int) -> None:
        """Until that number is answered."""
        with self._more:
            enough = self._more.wait_for(lambda: len(self.acknowledged) >= answered or self.fault, PATIENCE_S)
        assert enough, f"{len(self.acknowledged)} of {answered} answered in {PATIENCE_S} s"

    def run(self) -> None:
        try:
            for batch in self._batches:
                self._allowed.acquire()
                if self.stop.is_set():
                    break
                pending_insert = self._driven.send(batch, timeout_s=PATIENCE_S)
                pending_insert.future.add_done_callback(lambda done, n=pending_insert.sequence: self._answered(done, n))
                self.pending_inserts.append(pending_insert)
        except BaseException as fault:
            self.fault.append(fault)

    def _answered(self, done: Any, number: int) -> None:
        if done.exception() is None:
            with self._more:
                self.acknowledged.add(number)
                self._more.notify_all()


def check_journal(folder: Path, sent: int) -> list[list[int]]:
    """Nothing is wrong with it, every insert is there once, in order; gives those that were applied together."""
    store = open_store(folder, read_only=True)
    try:
        assert list(store.check()) == []
        groups = [[entry.sequence for entry in record.entries] for record in store.records()]
    finally:
        store.close()
    assert [number for group in groups for number in group] == list(range(1, sent + 1))
    return groups


def uninterrupted(mode: str, batches: list[Batch], groups: list[list[int]]) -> dict[int, tuple[bytes, int]]:
    """The estimate of a solver that was never stopped, after the same steps."""
    solver = Solver(Options(mode=mode))
    for group in groups:
        for number in group:
            solver.stage(batches[number - 1])
        solver.step()
    return rows(solver.estimate())


def rows(groups: Any) -> dict[int, tuple[bytes, int]]:
    """The value of each variable, bit for bit, and its time stamp."""
    found: dict[int, tuple[bytes, int]] = {}
    for group in groups:
        stamps = np.full(group.keys.size, NO_STAMP) if group.stamps is None else group.stamps
        columns = zip(group.keys.tolist(), group.values, stamps.tolist(), strict=True)
        found |= {key: (row.tobytes(), stamp) for key, row, stamp in columns}
    return found
