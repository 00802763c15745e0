"""A service that is killed again and again loses nothing it has answered, and does nothing twice.

FACTORBUS_KILLS says how often it is killed (`make crash`: more than a hundred times); here fewer, to save time.
"""

import contextlib
import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import PATIENCE_S, Process

from factorbus.client import Draft, connect
from factorbus.client.map import Map
from factorbus.client.ticket import Ticket
from factorbus.journal.store import open_store
from factorbus.proto.messages import Batch, Estimate
from factorbus.solver import Options, Solver

HERE = Path(__file__).parent
KILLS = int(os.environ.get("FACTORBUS_KILLS", "12"))
EACH = 120  # inserts let loose before a kill
SIGMAS = (0.1, 0.1, 0.05)


class Services:
    """Services with one journal, one after the other, at one endpoint."""

    def __init__(self, nursery: Process) -> None:
        self._nursery, self._endpoint, self.pid = nursery, "tcp/127.0.0.1:0", 0
        nursery.line("nursery", 300)

    def start(self) -> str:
        """A new one is ready; where."""
        self.bear()
        (self._endpoint,) = self._nursery.ready()
        return self._endpoint

    def bear(self) -> None:
        """A new one begins."""
        self._nursery.tell(f"start {self._endpoint}")
        self.pid = int(self._nursery.line("born")[0])

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


@pytest.fixture
def services(spawn: Callable[..., Process], tmp_path: Path) -> Iterator[Callable[..., Services]]:
    started: list[Services] = []

    def start(*settings: str) -> Services:
        started.append(Services(spawn(str(HERE / "journal_nursery.py"), str(tmp_path / "journal"), *settings)))
        return started[-1]

    try:
        yield start
    finally:
        for each in started:
            each.end(signal.SIGKILL)


def drafts(count: int) -> list[Batch]:
    """A robot that goes round and round a noisy loop, and sees where it was."""
    noise, made = np.random.default_rng(7), [Draft().se2("x0", (0, 0, 0), fixed=True).batch()]
    for n in range(1, count):
        draft = Draft().se2(f"x{n}")
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
        self.stop, self.tickets, self.fault = threading.Event(), list[Ticket](), list[BaseException]()
        self.acknowledged: set[int] = set()
        self._allowed = threading.Semaphore(0)

    def allow(self, more: int) -> None:
        """Let it send so many more."""
        self._allowed.release(more)

    def run(self) -> None:
        try:
            for batch in self._batches:
                self._allowed.acquire()
                if self.stop.is_set():
                    break
                ticket = self._driven.send(batch, timeout_s=PATIENCE_S)
                ticket.future.add_done_callback(lambda done, n=ticket.sequence: self._answered(done, n))
                self.tickets.append(ticket)
        except BaseException as fault:
            self.fault.append(fault)

    def _answered(self, done: Any, number: int) -> None:
        if done.exception() is None:
            self.acknowledged.add(number)


@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("mode", "window", "kills"), [("inc-l", 32, KILLS), ("tree", 32, KILLS // 3), ("inc-l", 1, 4)])
def test_killed_at_any_moment_nothing_answered_is_lost_and_nothing_is_done_twice(
    services: Callable[..., Services], tmp_path: Path, mode: str, window: int, kills: int
) -> None:
    chance, batches = random.Random(kills), drafts(EACH * kills + 1)
    running = services("snapshot_s=0.15")
    with (
        connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        bus.map("m2", mode, window=window) as driven,
    ):
        stream = Stream(driven, batches)
        stream.start()
        for kill in range(kills):
            stream.allow(EACH)
            time.sleep(chance.uniform(0.0, 0.25))  # the moments are what this is about
            running.end(signal.SIGKILL)
            answered = set(stream.acknowledged)
            if kill % 4 == 0:
                tear_last_page(tmp_path / "journal" / "m2", chance)
            if kill % 5 == 4:
                running.bear()  # and killed while it starts, reads its journal, or is just ready
                time.sleep(chance.uniform(0.0, 0.3))
                running.end(signal.SIGKILL)
            running.start()
            there = {int(key) for group in driven.ask_estimate().variables for key in group.keys}
            wanted = {int(k) for n in answered for g in batches[n - 1].variables for k in g.keys}
            assert wanted <= there, f"kill {kill}: {len(wanted - there)} answered inserts are gone"
        stream.stop.set()
        stream.allow(1)
        stream.join(PATIENCE_S)
        driven.flush(PATIENCE_S)
        assert not stream.fault
        assert stream.acknowledged == {ticket.sequence for ticket in stream.tickets}
        sent, estimate = len(stream.tickets), driven.ask_estimate()
        stats = driven.stats()
        assert stats["epoch"] == driven.epoch, "the map is the one that was joined"
        assert stats["variables"] == sent
        assert stats["factors"] == sum(batch.factor_count for batch in batches[:sent])
        mirrored = tuple(column.tobytes() for column in driven.estimate.columns("se2"))
    running.end(signal.SIGTERM)
    groups = check_journal(tmp_path / "journal" / "m2", sent)
    whole = uninterrupted(mode, batches, groups)
    assert rows(estimate.variables) == whole, "to the bit what a run without interruption gives"
    assert mirrored == sorted_columns(estimate)


def tear_last_page(folder: Path, chance: random.Random) -> None:
    """What a write leaves behind that was under way when the power went: a part of it, and nonsense."""
    with (folder / "journal.db-wal").open("ab") as log:
        log.write(chance.randbytes(chance.randrange(1, 4096)))


def check_journal(folder: Path, sent: int) -> list[list[int]]:
    """Nothing is wrong with it, every insert is there once, in order; gives those that were folded together."""
    store = open_store(folder, read_only=True)
    try:
        assert list(store.check()) == []
        groups = [[entry.sequence for entry in fold.entries] for fold in store.folds()]
    finally:
        store.close()
    assert [number for group in groups for number in group] == list(range(1, sent + 1))
    return groups


def uninterrupted(mode: str, batches: list[Batch], groups: list[list[int]]) -> dict[int, bytes]:
    """The estimate of a solver that was never stopped, after the same steps."""
    solver = Solver(Options(mode=mode))
    for group in groups:
        for number in group:
            solver.stage(batches[number - 1])
        solver.step()
    return rows(solver.estimate())


def rows(groups: Any) -> dict[int, bytes]:
    return {int(key): row.tobytes() for g in groups for key, row in zip(g.keys, g.values, strict=True)}


def sorted_columns(estimate: Estimate) -> tuple[bytes, bytes]:
    keys = np.concatenate([group.keys for group in estimate.variables])
    values = np.concatenate([group.values for group in estimate.variables if group.values is not None])
    order = np.argsort(keys)
    return keys[order].tobytes(), values[order].tobytes()
