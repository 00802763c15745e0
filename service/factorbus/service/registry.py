"""The maps of a service: found on disk, made, dropped, each with its host and its place on the bus.

Made and dropped on the control thread only; what is on disk is opened before it has work.  Looked up from any thread.
"""

import logging
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from factorbus.journal.problems import JournalFailed
from factorbus.proto import codec, keys
from factorbus.proto.problems import Problem, ShuttingDown, TooLarge, UnknownMap
from factorbus.proto.protocol import known
from factorbus.service.bus.delivery import Delivery
from factorbus.service.bus.zenoh_session import MapPlace, ServiceBus
from factorbus.service.config import Config
from factorbus.service.core.events import Asker, Read
from factorbus.service.core.map_state import MapCore
from factorbus.service.journal.library import CopiedAt, Kept, Library, made_as_of
from factorbus.service.maps.budget_change import change_budget
from factorbus.service.maps.host import Host
from factorbus.service.maps.making import MapMaker
from factorbus.service.maps.serial_executor import SerialExecutor
from factorbus.service.process.heap import give_back
from factorbus.service.process.memory import MemoryLimit, OutOfMemory
from factorbus.service.questions.admin import (
    BudgetChange,
    Drop,
    Fork,
    KeptElsewhere,
    MadeAs,
    MapExists,
    NotDamaged,
    NotHere,
    check_budget,
    check_made_as,
    ours,
    settled_mode,
)  # fmt: skip
from factorbus.service.questions.answers import Copied, Question, QuestionCopies
from factorbus.service.questions.question_memory import Room
from factorbus.service.solving.apply import MapSolver

log = logging.getLogger(__name__)

_WHICHEVER = MadeAs()
_STATES = {"journal_damaged": "damaged", "journal_differs": "differs", "journal_version": "other_version"}


@dataclass(frozen=True, slots=True)
class _Forking:
    """A fork on its way.  epoch: of the original, which must still be there; room: bytes that it may take."""

    fork: Fork
    epoch: int
    room: int


class OpenMap:
    """A map, its place on the bus, and the end of it."""

    def __init__(self, host: Host, place: MapPlace, options: Callable[[], dict[str, Any]]) -> None:
        self.host, self.place, self.options = host, place, options
        self.drained = threading.Event()
        self.on_drained: Callable[[], None] = self.drained.set


class Maps:
    """All maps of one service.  named: of the service, in tokens."""

    def __init__(
        self, bus: ServiceBus, config: Config, named: str, library: Library | None, delivery: Delivery,
        control: SerialExecutor, memory: MemoryLimit,
    ) -> None:  # fmt: skip
        self._bus, self._config, self._service, self._library = bus, config, named, library
        self._delivery, self._control, self._memory = delivery, control, memory
        self._maps: dict[str, OpenMap] = {}
        self._leaving: list[OpenMap] = []
        self._unopened: dict[str, Problem] = {}  # that are on disk and do not open
        self._forks: dict[str, Fork] = {}  # what maps were forked from, since this service began
        self._stopping = False
        self._inline_run = threading.Lock()  # of the one callback that may solve
        self._maker = MapMaker(config, library)
        self.on_gone: Callable[[str], None] = lambda _: None  # what else there is of a map that was dropped

    def get(self, name: str) -> OpenMap | None:
        """Map `name`, if it is here."""
        return self._maps.get(name)

    def hosts(self) -> dict[str, Host]:
        """All there are, by name."""
        return {name: found.host for name, found in list(self._maps.items())}

    def largest_bytes(self) -> int:
        """What the solver of the largest map has in use."""
        return max((host.memory_bytes() for host in self.hosts().values()), default=0)

    def rows(self) -> list[dict[str, Any]]:
        """What admin/maps says: of those that are open, and of those that are on disk and do not open."""
        return [host.core.row() for host in self.hosts().values()] + self.unopened()

    def unopened(self) -> list[dict[str, Any]]:
        """Rows of the maps that are on disk and do not open; `code` and `problem` say why."""
        nothing = {"mode": "", "epoch": 0, "revision": 0, "variables": 0, "factors": 0}
        return [
            {"name": name, **nothing, "state": _state(problem), "code": problem.code, "problem": problem.message}
            for name, problem in list(self._unopened.items())
        ]

    def missing(self, name: str) -> Problem | None:
        """What to say of a map that is not here; None: at a router, somebody else may have it."""
        if problem := self._unopened.get(name):
            return problem
        return None if self._config.connect else UnknownMap(name)

    def open_kept(self) -> None:
        """The maps that were here before.  One that cannot be trusted does not keep the others from coming back."""
        for name in self._library.names() if self._library else []:
            if ours(self._config.maps, name):
                try:
                    self._maps[name] = self._make(name)
                except Problem as problem:
                    log.error("map %s does not come back: %s", name, problem)
                    self._unopened[name] = problem

    def is_new_on_disk(self, name: str) -> bool:
        """Whether map `name` came to the disk while this service was at work (`factorbus import`).  For any thread."""
        if self._library is None or not keys.is_name(name) or not ours(self._config.maps, name):
            return False
        return name not in self._known() and self._library.has(name)

    def find(self, name: str) -> OpenMap | None:
        """Map `name`, opened first if it is new on disk, as at the start beyond `limits.maps` too.  Raises Problem."""
        if self.is_new_on_disk(name):
            if self._stopping:
                raise ShuttingDown
            try:
                self._open(name, self._make(name))
            except Problem as problem:
                log.error("map %s, new on disk, does not open: %s", name, problem)
                self._unopened[name] = problem
                raise
        return self._maps.get(name)

    def open_new(self) -> None:
        """Open all that are new on disk; of one that does not, `unopened` tells."""
        if self._library is None or self._stopping:
            return
        for name in self._library.names(self._known()):
            with suppress(Problem):
                self.find(name)

    def _known(self) -> set[str]:
        """Names that are open, do not open, or are on their way out."""
        return {*list(self._maps), *list(self._unopened), *(gone.host.core.name for gone in list(self._leaving))}

    def announce(self) -> None:
        """Last of all: alive means askable."""
        for found in self._maps.values():
            found.place.announce()
            found.host.created()

    def create(self, name: str, asked: MadeAs = _WHICHEVER) -> dict[str, Any]:
        """The row of map `name`, made if it is not there.  Raises Problem."""
        asked = asked._replace(mode=asked.mode and settled_mode(asked.mode))
        if found := self._maps.get(name):
            check_made_as(name, made_as_of(found.host.core.mode, found.options()), asked)
            return found.host.core.row()
        if not ours(self._config.maps, keys.checked_name("map", name)):
            raise NotHere(name, self._config.maps)
        self._check_room()
        return self._open(name, self._make(name, asked))

    def create_all(self, names: Iterable[str]) -> None:
        """Have maps of these names; one that is on disk and does not open keeps the others from nothing."""
        for name in names:
            if name not in self._unopened:
                self._control.do(self.create, name)  # clients, which are heard by now, may ask for it as well

    def fork(self, asker: Asker, fork: Fork) -> None:
        """Have a new map begin as another one is, and answer with its row: `forked` goes on.  Raises Problem."""
        found = self._there(fork.source)
        if self._answered_again(asker, fork):
            return
        self._check_new(fork.target)
        asked = _Forking(fork, found.host.core.epoch, self._memory.room())
        found.host.read(Read(Question("copy", ask=asked), asker))

    def forked(self, asker: Asker, question: Question, taken: QuestionCopies) -> None:
        """The original is copied: make the other map of it."""
        asked: _Forking = question.ask
        try:
            if self._answered_again(asker, asked.fork):
                return
            self._check_new(asked.fork.target)
            row = self._open(asked.fork.target, self._split(asked, taken))
        except Problem as problem:
            self._delivery.refuse(asker, problem)
            return
        self._forks[asked.fork.target] = asked.fork
        self._delivery.answer(asker, codec.encode_map(row | {"protocol": known()}))
        self._control.hand(give_back)

    def change_budget(self, asker: Asker, asked: BudgetChange) -> None:
        """Give the steps of a map another budget, and answer with its row when the journal has it.  Raises Problem."""
        host = self._there(asked.name).host
        check_budget(host.core.mode, asked.budget_ms)
        if self._stopping:
            raise ShuttingDown

        def done(problem: Problem | None) -> None:
            if problem is not None:
                self._delivery.refuse(asker, problem)
            else:
                self._delivery.answer(asker, codec.encode_map(host.core.row() | {"protocol": known()}))

        change_budget(host, asked.budget_ms, self._maker.units_per_ms, done)

    def drop(self, asker: Asker, drop: Drop) -> None:
        """Drop a map as `drop` says, and answer when it is gone.

        Raises MovedOn, NotDamaged, JournalFailed; what is `missing`.
        """
        name, revision, damaged = drop
        try:
            found = self.find(name)
        except Problem:
            if not damaged:
                raise
            found = None
        if damaged and found is not None:
            raise NotDamaged(name)
        if damaged and name in self._unopened and self._library is not None:
            self._give_up(asker, name, self._library)
            return
        if found is None:
            raise self.missing(name) or NotHere(name, self._config.maps)

        def on_drained() -> None:
            self._control.hand(self._dropped, asker, found)
            found.drained.set()

        before, found.on_drained = found.on_drained, on_drained
        try:
            found.host.drop(revision)
        except Problem:
            found.on_drained = before
            raise
        del self._maps[name]
        self._forks.pop(name, None)
        self._leaving.append(found)
        found.place.withdraw()

    def _give_up(self, asker: Asker, name: str, library: Library) -> None:
        """Remove what is on disk of a map that does not open.  Raises JournalFailed."""
        library.remove(name)
        problem = self._unopened.pop(name)
        log.warning("map %s given up: %s", name, problem, extra={"map": name})
        self._delivery.answer(asker, codec.encode_map({}))

    def show(self, changed: set[str], stuck: set[str]) -> None:
        """Alive means askable: while its solver is stuck, a map has no token."""
        for found in [self._maps[name] for name in changed if name in self._maps]:
            name = found.host.core.name
            if name in stuck:
                log.error("map %s: its solver has been silent for %.0f s", name, found.host.silent_s())
                found.place.withdraw()
            else:
                log.warning("map %s: its solver goes on", name)
                found.place.announce()

    def finish(self) -> None:
        """Withdraw all, and return when everything accepted is answered and kept."""
        for found in self._no_more():
            found.place.withdraw()
            found.host.stop()
        for found in [*self._leaving, *self._maps.values()]:
            found.drained.wait()
            found.host.end()

    def close(self) -> None:
        """Undeclare what they have on the bus."""
        for found in self._maps.values():
            found.place.close()

    def _there(self, name: str) -> OpenMap:
        """Map `name`, which is ours and open.  Raises Problem."""
        if not ours(self._config.maps, name):
            raise NotHere(name, self._config.maps)
        if (found := self.find(name)) is None:
            raise self._unopened.get(name) or UnknownMap(name)
        return found

    def _make(self, name: str, asked: MadeAs = _WHICHEVER) -> OpenMap:
        """Raises Problem."""
        if problem := self._unopened.get(name):
            raise problem
        return self._at_work(*self._maker.begin(name, asked))

    def _at_work(self, core: MapCore, map_solver: MapSolver, kept: Kept | None) -> OpenMap:
        name = core.name
        map_solver.bound(Room(self._memory, self._config.limits.answer_bytes))
        place = self._bus.place(name, self._service)

        def more() -> dict[str, Any]:
            return {"options": map_solver.options(), **made.host.journal()}

        by = self._delivery.of_map(place, more, lambda: made.on_drained())
        host = Host(core, map_solver, by.perform, by.send, by.answer_reads, self._inline_run, by.send_both, kept)
        by.interests = self._delivery.interests.of_map(name, place, host.read)
        made = OpenMap(host, place, map_solver.options)
        return made

    def _open(self, name: str, made: OpenMap) -> dict[str, Any]:
        """A map is made: let others see it.  Its row."""
        self._maps[name] = made
        made.place.announce()
        made.host.created()
        core = made.host.core
        log.info(
            "map %s, mode %s, epoch %d, revision %d", name, core.mode, core.epoch, core.revision, extra={"map": name}
        )
        return core.row()

    def _check_room(self) -> None:
        """Raises ShuttingDown, TooLarge, OutOfMemory where no map can be added."""
        if self._stopping:
            raise ShuttingDown
        if len(self._maps) >= self._config.limits.maps:
            mend = "drop one, or raise the limit"
            raise TooLarge("the service", len(self._maps) + 1, self._config.limits.maps, "maps", mend)
        if (full := self._memory.no_room(0)) is not None:
            raise full

    def _check_new(self, name: str) -> None:
        """The same, and KeptElsewhere, MapExists where none of this name can."""
        if not ours(self._config.maps, name):
            raise KeptElsewhere(name, self._config.maps)
        if problem := self._unopened.get(name):
            raise MapExists(name, _state(problem))
        if name in self._maps or any(name == gone.host.core.name for gone in self._leaving):
            raise MapExists(name)
        if self._library is not None and self._library.is_taken(name):
            raise MapExists(name)
        self._check_room()

    def _answered_again(self, asker: Asker, fork: Fork) -> bool:
        """Whether this very fork has been made: a repeated request is answered again."""
        done = bool(fork.request) and self._forks.get(fork.target) == fork
        if done:
            row = self._maps[fork.target].host.core.row()
            self._delivery.answer(asker, codec.encode_map(row | {"protocol": known()}))
        return done

    def _split(self, asked: _Forking, taken: QuestionCopies) -> OpenMap:
        """A map of its own from the copy `taken`.  Raises Problem."""
        fork, copied, found = asked.fork, taken.copied or Copied(None, 0), self._maps.get(asked.fork.source)
        if copied.state is None:
            raise OutOfMemory(self._memory.resident, self._memory.limit, copied.bytes)
        if found is None or found.host.core.epoch != asked.epoch:
            raise UnknownMap(fork.source)
        copy = CopiedAt(taken.record, copied.state, found.host.core.differs or "")
        return self._at_work(*self._maker.fork(fork, found.host.core, found.options(), copy))

    def _dropped(self, asker: Asker, found: OpenMap) -> None:
        name = found.host.core.name
        self._leaving.remove(found)
        found.host.end(keep=False)
        self.on_gone(name)
        self._delivery.outbox.hand(found.place.close)  # behind the map's last publications
        self._control.hand(give_back)
        if self._library is not None:
            try:
                self._library.remove(name)
            except JournalFailed as problem:
                log.error("the journal of map %s stays: %s", name, problem)
                self._delivery.refuse(asker, problem)
                return
        self._control.hand(self._delivery.answer, asker, codec.encode_map({}))
        log.info("map %s dropped", name, extra={"map": name})

    def _no_more(self) -> list[OpenMap]:
        """The maps there are once the control is done with what it had: no map is created after this."""
        reached = threading.Event()

        def stop() -> None:
            self._stopping = True
            reached.set()

        self._control.hand(stop)
        reached.wait()
        return list(self._maps.values())


def _state(problem: Problem) -> str:
    """In a word, why a map does not open."""
    return _STATES.get(problem.code, "unreadable")
