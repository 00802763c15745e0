"""Maps with their journals, as services have them, without a bus: for tests of what goes from one to the other."""

import queue
import threading
import time
from pathlib import Path
from typing import Any

from factorbus.client import Draft
from factorbus.journal.records import JournalRecord
from factorbus.journal.store import open_store
from factorbus.proto import codec
from factorbus.proto.messages import Accepted, Batch, Change, Delta, Insert
from factorbus.proto.problems import Problem
from factorbus.proto.records import JournalPlace
from factorbus.service.config import Config, Limits
from factorbus.service.core.events import Answer, Effect, Publish, Refuse
from factorbus.service.core.map_state import MapCore
from factorbus.service.journal.grafting import Graft, Grafted, sent_records
from factorbus.service.journal.keeping import Keeper
from factorbus.service.journal.library import Library, log_owner, open_library
from factorbus.service.maps.host import Host
from factorbus.service.questions.admin import MadeAs
from factorbus.service.solving.arrival import read_insert

PATIENCE_S = 60.0


class End:
    """A map with its journal, as one service has it."""

    def __init__(self, folder: Path, closures: str = "trust") -> None:
        config = Config(journal=str(folder), warm=False)
        library = open_library(config, log_owner, threading.Event())
        assert isinstance(library, Library)
        self.library, self.folder = library, folder / "m"
        made = MadeAs("bayes-tree", closures)
        kept = library.open("m", Limits()) if library.has("m") else library.make("m", made, Limits())
        core = MapCore("m", kept.header.mode, kept.header.epoch, Limits(), 0.0, closures)
        kept.restore(core)
        self.told: queue.SimpleQueue[Effect] = queue.SimpleQueue()
        self.deltas: list[Delta] = []
        self.events: list[dict[str, Any]] = []
        self.numbers: dict[str, int] = {}
        self.solver = kept.map_solver
        self.host = Host(core, kept.map_solver, self._take, self._take, _no_reads, threading.Lock(), _no_both, kept)

    def insert(self, client: str, content: Batch, changes: tuple[Change, ...] = (), number: int = 0) -> Any:
        """Its answer: an Accepted, or the problem."""
        number = number or self.numbers.get(client, 0) + 1
        self.numbers[client] = max(number, self.numbers.get(client, 0))
        message = codec.encode_insert(Insert(number, content, changes=changes))
        arrived = read_insert(object(), client, message, Limits().message(), time.monotonic())
        assert not isinstance(arrived, Refuse)
        self.host.insert(arrived)
        return self._answer()

    def graft(self, graft: Graft) -> Grafted:
        """Raises the problem that it was refused with."""
        done: list[Grafted] = []
        self.host.graft(object(), graft._replace(heard=done.append))
        if isinstance(answer := self._answer(raw=True), Problem):
            raise answer
        return done[0]

    def follow(self, upstream: "End", after: JournalPlace) -> Grafted:
        """Take what `upstream` has after a place."""
        records = sent_records(upstream.records(after.record), frozenset(), 1 << 30, 1 << 30)[0]
        return self.graft(Graft(after, records, upstream.place()))

    def push_to(self, upstream: "End", after: JournalPlace) -> Grafted:
        """Send what is here after a place."""
        records = sent_records(self.records(after.record), frozenset(), 1 << 30, 1 << 30)[0]
        return upstream.graft(Graft(after, records))

    def keeper(self) -> Keeper:
        assert self.host.keeper is not None
        return self.host.keeper

    def place(self) -> JournalPlace:
        self.keeper().settle()
        return JournalPlace(self.keeper().last.record, self.keeper().last.chain)

    def records(self, after: int = 0) -> list[JournalRecord]:
        self.keeper().settle()
        store = open_store(self.folder, read_only=True)
        try:
            return list(store.records(after))
        finally:
            store.close()

    def close(self) -> None:
        drained = threading.Event()
        self.drained = drained.set
        self.host.stop()
        assert drained.wait(PATIENCE_S)
        self.host.end()
        self.library.close()
        store = open_store(self.folder, read_only=True)
        assert list(store.check()) == []
        store.close()

    def _take(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Publish) and effect.channel == "delta":
                self.deltas.append(codec.decode_delta(effect.message))
            elif isinstance(effect, Publish):
                self.events.append(codec.decode_map(effect.message))
            elif isinstance(effect, Answer | Refuse):
                self.told.put(effect)
            elif type(effect).__name__ == "Drained":
                self.drained()

    def _answer(self, raw: bool = False) -> Any:
        effect = self.told.get(timeout=PATIENCE_S)
        if isinstance(effect, Refuse):
            return effect.problem
        assert isinstance(effect, Answer)
        return effect.message if raw else codec.decode_accepted(effect.message)


def _no_reads(*_: Any) -> None:
    raise AssertionError("no question was asked")


def _no_both(*_: Any) -> None:
    raise AssertionError("with a journal nothing is sent in one")


def pose(letter: str, n: int) -> Batch:
    draft = Draft()
    if n == 0:
        return draft.se2(f"{letter}0", (0, 0, 0), fixed=True).batch()
    draft.se2(f"{letter}{n}").between_se2(f"{letter}{n - 1}", f"{letter}{n}", (1, 0, 0.1), sigmas=(0.1, 0.1, 0.1))
    return draft.batch()


def drive(end: End, letter: str, first: int, last: int) -> None:
    for n in range(first, last):
        assert isinstance(end.insert(f"robot-{letter}", pose(letter, n)), Accepted)


def bits(end: End) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    for group in end.solver.solver.estimate():
        found |= dict(zip(group.keys.tolist(), (row.tobytes() for row in group.values), strict=True))
    return found
