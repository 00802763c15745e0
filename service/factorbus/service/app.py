"""The service at work: what comes over the bus goes to the maps, what they want done is done.

    threads   Zenoh's own      run the callbacks: read, judge (microseconds), hand over; one of them at a time may
                               fold an insert in instead, and send what comes of it, when that is soon done
              solver <map>     folds and steps, and encodes what comes of it
              outbox           answers to inserts, and publications, in order
              desk             maps that come and go, jobs for workers
              answers 0..3     answers to questions, which can be large
              in-place <kind>  jobs when there is no worker
              features         questions of filters: small ones done, large ones cut up and put together

A SIGSTOPped client cannot hold up the others: deltas to it are dropped (lower priority than answers, so that they do
not stand in their way), and answers to it wait in its own queue; a large one that fills it costs one of the answering
lanes a second, then Zenoh closes that client's transport.
"""

import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from factorbus.journal.problems import JournalFailed
from factorbus.proto import codec, keys
from factorbus.proto.problems import Busy, Internal, Problem, ShuttingDown, TooLarge, UnknownMap
from factorbus.proto.version import __version__
from factorbus.service.admin import NotHere, OtherMode, ours, read_create, read_drop, settled_mode
from factorbus.service.arrival import read_insert
from factorbus.service.bus import Bus, Place, ignore, key_of, open_bus, payload_of, received, refuse, reply
from factorbus.service.config import BadConfig, Config, checked
from factorbus.service.core import MapCore
from factorbus.service.events import Answer, Asked, Asker, Drained, Effect, Publish, Read, Refuse, Tell
from factorbus.service.features import Features
from factorbus.service.fold import Folder
from factorbus.service.health import Health
from factorbus.service.host import Host
from factorbus.service.jobs import Jobs
from factorbus.service.lane import Lane, Lanes
from factorbus.service.library import Kept, Library, log_owner, make_folder, open_library
from factorbus.service.memory import give_back
from factorbus.service.metrics import open_metrics
from factorbus.service.optima import Optima
from factorbus.service.questions import Snapshot, answer
from factorbus.service.start import get_ready_to_compute
from factorbus.service.trips import Trips
from factorbus.service.vitals import Vitals
from factorbus.solver.errors import SolverError

log = logging.getLogger(__name__)

_TICK_S = 0.25
_SENDERS = 4096
_AT_ONCE_BYTES = 64 << 10
_MESSAGES = (Answer, Publish)
_ANSWERERS = 4
_ADMIN_WAITING = 1024
_TOKEN_S = 10.0


def serve(
    config: Config,
    on_ready: Callable[[list[str]], None],
    stop: threading.Event,
    on_look: Callable[[Health], None] = lambda _: None,
) -> None:
    """Keep maps until `stop` is set, then answer everything accepted and return.

    `on_ready` gets the endpoints that clients can connect to, once they can.  `on_look` gets the service's health,
    several times a second: for whoever watches over it.  Raises BadConfig, Problem.
    """
    checked(config)
    # Who only waits for the folder has everything ready by then; who cannot have it says so before compiling.
    library = open_library(config, log_owner, stop) if config.journal and not config.standby else None
    try:
        get_ready_to_compute(config.warm)
        if config.standby:
            library = open_library(config, log_owner, stop)
        if not stop.is_set():
            _serve(config, library, on_ready, stop, on_look)
    finally:
        if library is not None:
            library.close()


def _serve(
    config: Config,
    library: Library | None,
    on_ready: Callable[[list[str]], None],
    stop: threading.Event,
    on_look: Callable[[Health], None],
) -> None:
    bus = open_bus(config)
    try:
        shell = Shell(bus, config, library)
        try:
            for name in config.create:
                shell.create(name, None)
            shell.vitals.health.open = True
            shell.tick()  # so that the first who asks is told of all maps
            endpoints = bus.endpoints()
            if library is not None:
                library.say(f"process {os.getpid()} on {socket.gethostname()}, {' '.join(endpoints)}")
            on_ready(endpoints)
            while not stop.wait(_TICK_S):
                shell.tick()
                on_look(shell.vitals.health)
        finally:
            shell.close()
    finally:
        bus.close()


class _Map:
    """A map, its place on the bus, the options of its solver, and the end of it."""

    def __init__(self, host: Host, place: Place, options: dict[str, Any]) -> None:
        self.host, self.place, self.options = host, place, options
        self.drained = threading.Event()
        self.on_drained: Callable[[], None] = self.drained.set


class Shell:
    """Everything a running service has declared on the bus, and the threads behind it."""

    def __init__(self, bus: Bus, config: Config, library: Library | None = None) -> None:
        self._bus, self._config, self._library = bus, config, library
        self._unopened: dict[str, Problem] = {}  # maps that are there and cannot be trusted
        self._service = config.name or f"s{secrets.token_hex(4)}"
        self._decoding = config.limits.message()
        self._maps: dict[str, _Map] = {}
        self._leaving: list[_Map] = []
        self._senders: dict[str, tuple[str, str]] = {}  # keys of inserts taken apart before
        self._stopping = False
        self._outbox, self._desk, self._answers = Lane("outbox"), Lane("desk"), Lanes("answers", _ANSWERERS)
        self.vitals = Vitals(config, self._service, {"outbox": self._outbox, "desk": self._desk}, self._hosts)
        self._worker_rows: list[dict[str, Any]] = []
        self.vitals.chapters["workers"] = lambda: self._worker_rows
        self._stuck: set[str] = set()
        self._seat = threading.Lock()  # of the one callback that may solve
        self._jobs = Jobs(self._desk, bus.send_job)
        self._trips = Trips(self._desk, bus.send_job, self._jobs.heard)
        limits, deadline_s = config.limits, config.job_deadline_s
        self._optima = Optima(self._jobs, self._reply, self._refuse, deadline_s, limits.jobs)
        self._features = Features(
            self._desk, self._jobs, self._trips, reply, refuse, self._decoding, limits.jobs, deadline_s
        )
        if config.warm:
            log.info("features: %s", self._features.measure())
        chunk = config.maps.replace("*", "$*") if config.maps != "*" else "*"
        root = f"{keys.PREFIX}/map/{chunk}"
        self._refuse_if_kept_elsewhere(f"{root}/live/service/*")
        # Before anybody can ask for one of them: it would be told that there is none.
        self._open_kept()
        bus.answer_on(f"{root}/in/*", self._on_insert)
        bus.answer_on(f"{root}/ask/*", self._on_question)
        bus.answer_on(keys.admin_key("*"), self._on_admin)
        bus.answer_on(keys.features_key(self._service), self._on_features)
        bus.watch(keys.any_worker_token(), self._on_worker)
        self._metrics = open_metrics(config.metrics, self.vitals)
        # Last of all: alive means askable.
        for found in self._maps.values():
            found.place.announce()
            found.host.created()
        self._withdraw_features = bus.announce(keys.features_token(self._service))

    def create(self, name: str, mode: str | None) -> dict[str, Any]:
        """The row of map `name`, made if it is not there.  On the desk, or before it has work.  Raises Problem.

        mode: None for whichever it has.
        """
        if found := self._maps.get(name):
            if mode is not None and found.host.core.mode != settled_mode(mode):
                raise OtherMode(name, found.host.core.mode, settled_mode(mode))
            return found.host.core.row()
        if not ours(self._config.maps, keys.checked_name("map", name)):
            raise NotHere(name, self._config.maps)
        if self._stopping:
            raise ShuttingDown
        if len(self._maps) >= self._config.limits.maps:
            raise TooLarge("the service", len(self._maps) + 1, self._config.limits.maps, "maps")
        if (full := self.vitals.memory.no_room(0)) is not None:
            raise full
        made = self._make(name, settled_mode(mode or "auto"))
        self._maps[name] = made
        made.place.announce()
        made.host.created()
        core = made.host.core
        log.info(
            "map %s, mode %s, epoch %d, revision %d", name, core.mode, core.epoch, core.revision, extra={"map": name}
        )
        return core.row()

    def tick(self) -> None:
        """Time went by."""
        for found in list(self._maps.values()):
            found.host.tick()
        stuck = self.vitals.look()
        if stuck != self._stuck:
            self._desk.hand(self._show, stuck ^ self._stuck, stuck)
            self._stuck = stuck
        self._desk.hand(self._jobs.tick)
        self._desk.hand(self._look_for_workers)

    def _hosts(self) -> dict[str, Host]:
        return {name: found.host for name, found in list(self._maps.items())}

    def close(self) -> None:
        """Withdraw, finish everything accepted, answer it, and undeclare."""
        self.vitals.health.open = False
        self._withdraw_features()
        self._desk.hand(self._stop_creating)
        for found in self._wait_for_desk():
            found.place.withdraw()
            found.host.stop()
        for found in [*self._leaving, *self._maps.values()]:
            found.drained.wait()
            found.host.end()
        self._answers.settle()
        self._features.stop()
        self._desk.hand(self._jobs.close)
        self._desk.close()
        self._features.close()
        self._answers.close()
        self._outbox.close()
        self._metrics.close()
        self._bus.withdraw()
        for found in self._maps.values():
            found.place.close()

    # ---- callbacks: on Zenoh's threads; they must not raise, nor ask Zenoh for anything but to send ----------------

    def _on_insert(self, query: Asker) -> None:
        key, payload = received(query)
        place = self._senders.get(key)
        try:
            name, client = place or self._sender(key)
        except Problem as problem:
            self._outbox.hand(refuse, query, problem)
            return
        found = self._maps.get(name)
        if found is None:
            self._outbox.hand(self._no_map, query, name)
            return
        read = read_insert(query, client, payload, self._decoding, time.monotonic())
        if isinstance(read, Refuse):
            self._outbox.hand(refuse, query, read.problem)
            return
        if (full := self.vitals.memory.no_room(read.size)) is not None:
            read = read._replace(content=full, message=b"")
        found.host.insert(read)

    def _sender(self, key: str) -> tuple[str, str]:
        """(map, client) of the key of an insert.  Raises BadName."""
        parts = key.split("/")
        sender = keys.checked_name("map", parts[3]), keys.checked_name("client", parts[-1])
        if len(self._senders) >= _SENDERS:
            self._senders.clear()
        self._senders[key] = sender
        return sender

    def _on_question(self, query: Asker) -> None:
        name, question = _chunks(query)
        found = self._maps.get(name)
        if found is None:
            self._outbox.hand(self._no_map, query, name)
        else:
            found.host.ask(Asked(query, question, payload_of(query)))

    def _on_admin(self, query: Asker) -> None:
        if (waiting := self._desk.waiting) < _ADMIN_WAITING:
            self._desk.hand(self._administer, query)
        else:
            refuse(query, Busy(waiting, 0.1))

    def _on_features(self, query: Asker) -> None:
        self._features.ask(query, payload_of(query))

    def _on_worker(self, token: str, alive: bool) -> None:
        try:
            worker, slots = keys.worker_of(token)
        except ValueError:
            log.warning("a worker's token without a number of slots: %s", token)
            return
        if alive:
            self._desk.hand(self._jobs.joined, worker, slots)
            self._desk.hand(self._trips.joined, worker)
        else:
            self._desk.hand(self._jobs.left, worker)
            self._desk.hand(self._trips.left, worker)

    # ---- effects of the maps ----------------------------------------------------------------------------------------

    def _open_kept(self) -> None:
        """The maps that were here before.  One that cannot be trusted does not keep the others from coming back."""
        names = self._library.names() if self._library else []
        for name in names:
            if ours(self._config.maps, name):
                try:
                    self._maps[name] = self._make(name, None)
                except Problem as problem:
                    log.error("map %s does not come back: %s", name, problem)
                    self._unopened[name] = problem

    def _make(self, name: str, mode: str | None) -> _Map:
        """mode: None for that of the map which is there.  Raises Problem."""
        core, folder, kept = self._begin(name, mode)

        def perform(effects: list[Effect]) -> None:
            self._perform(made, effects)

        def send(effects: list[Effect]) -> None:
            # On this thread, unless something else has to go before, or it is more than surely fits into Zenoh's
            # queue.  That might wait in vain to be emptied: this thread may be the one that does it.
            size = 0
            for effect in effects:
                if isinstance(effect, _MESSAGES):
                    size += len(effect.message)
            hand = self._outbox.hand_or_do if size <= _AT_ONCE_BYTES else self._outbox.hand
            hand(self._send, made.place, effects)

        def send_both(asker: Asker, answer: bytes, delta: bytes) -> None:
            self._outbox.hand_or_do(_send_both, made.place, asker, answer, delta)

        def answer_reads(reads: Sequence[Read], taken: Snapshot) -> None:
            for read in reads:
                self._answers.hand(self._answer_read, made, read, taken)

        host = Host(core, folder, perform, send, answer_reads, self._seat, send_both, kept)
        made = _Map(host, self._bus.place(name, self._service), folder.options())
        return made

    def _begin(self, name: str, mode: str | None) -> tuple[MapCore, Folder, Kept | None]:
        """What a map is made of, as it was or new.  Raises Problem."""
        limits, library, now = self._config.limits, self._library, time.monotonic()
        if problem := self._unopened.get(name):
            raise problem
        if library is not None and library.has(name):
            if mode is not None and (had := library.mode(name)) != mode:
                raise OtherMode(name, had, mode)
            kept = library.open(name, limits)
        elif library is not None:
            kept = library.make(name, mode or settled_mode("auto"), limits)
        else:
            epoch, mode = secrets.randbits(62) | 1, mode or settled_mode("auto")
            return MapCore(name, mode, epoch, limits, now), make_folder(mode, {}, epoch, limits), None
        core = MapCore(name, kept.header.mode, kept.header.epoch, limits, now)
        kept.restore(core)
        return core, kept.folder, kept

    def _perform(self, found: _Map, effects: list[Effect]) -> None:
        """Hand on what a map wants done: what is to be sent in one piece to the outbox, in order."""
        sending: list[Effect] = []
        for effect in effects:
            if isinstance(effect, Tell):
                content = {**effect.content, "options": found.options, **found.host.journal()}
                self._answers.hand(self._tell, effect.asker, content)
            elif isinstance(effect, Drained):
                found.on_drained()
            else:
                sending.append(effect)
        if sending:
            self._outbox.hand(self._send, found.place, sending)

    def _send(self, place: Place, effects: list[Effect]) -> None:
        """On the outbox, or on the thread that made the step."""
        for effect in effects:
            if isinstance(effect, Answer):
                reply(effect.asker, effect.message)
            elif isinstance(effect, Publish):
                place.publish(effect.channel, effect.message)
            elif isinstance(effect, Refuse):
                refuse(effect.asker, effect.problem)

    def _no_map(self, query: Asker, name: str) -> None:
        if problem := self._unopened.get(name):
            refuse(query, problem)
        elif self._config.connect:
            ignore(query)  # another service at the router may have it
        else:
            refuse(query, UnknownMap(name))

    # ---- on the answering lanes: who does not take an answer holds up one of them for a second ----------------------

    def _answer_read(self, found: _Map, read: Read, taken: Snapshot) -> None:
        try:
            if read.question.name == "keyframe":
                # Behind the delta of the same revision: a mirror that had the keyframe first would skip the delta.
                self._outbox.hand(found.place.publish, "keyframe", answer(read.question, taken))
            elif read.question.batch:
                self._desk.hand(self._optima.batch, read.asker, read.question, taken)
            else:
                reply(read.asker, answer(read.question, taken))
        except (Problem, SolverError) as problem:
            refuse(read.asker, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: answering %s", reference, read.question.name)
            if read.asker is not None:
                refuse(read.asker, Internal(reference))

    def _tell(self, asker: Asker, content: dict[str, Any]) -> None:
        from factorbus.solver import compiled_seconds

        own = {
            "service": self._service,
            "version": __version__,
            "kernels_compiled_s": compiled_seconds(),
            "workers": self._worker_rows,
        }
        reply(asker, codec.encode_map({**content, **own}))

    # ---- on the desk, which sends nothing itself to whoever might not take it ---------------------------------------

    def _reply(self, asker: Asker, message: bytes) -> None:
        self._answers.hand(reply, asker, message)

    def _refuse(self, asker: Asker, problem: Any) -> None:
        self._answers.hand(refuse, asker, problem)

    def _administer(self, query: Asker) -> None:
        operation, payload = str(query.key_expr).rpartition("/")[2], payload_of(query)
        try:
            if operation == "maps":
                rows = [found.host.core.row() for found in self._maps.values()]
                self._reply(query, codec.encode_map({"maps": rows, "service": self._service, "version": __version__}))
            elif operation == "stats":
                self._reply(query, codec.encode_map(self.vitals.account()))
            elif operation == "create":
                self._reply(query, codec.encode_map(self.create(*read_create(payload))))
            elif operation == "drop":
                self._drop(query, read_drop(payload))
            else:
                ignore(query)  # somebody else's key
        except NotHere as problem:
            if self._config.connect:
                ignore(query)  # for another service at the router
            else:
                self._refuse(query, problem)
        except Problem as problem:
            self._refuse(query, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: admin/%s", reference, operation)
            self._refuse(query, Internal(reference))

    def _drop(self, query: Asker, name: str) -> None:
        found = self._maps.pop(name, None)
        if found is None:
            self._no_map(query, name)
            return

        def on_drained() -> None:
            self._desk.hand(self._dropped, query, found)
            found.drained.set()

        self._leaving.append(found)
        found.on_drained = on_drained
        found.place.withdraw()
        found.host.drop()

    def _dropped(self, query: Asker, found: _Map) -> None:
        self._leaving.remove(found)
        found.host.end(keep=False)
        self._outbox.hand(found.place.close)  # behind the map's last publications
        self._desk.hand(give_back)
        if self._library is not None:
            try:
                self._library.remove(found.host.core.name)
            except JournalFailed as problem:
                log.error("the journal of map %s stays: %s", found.host.core.name, problem)
                self._refuse(query, problem)
                return
        self._desk.hand(self._reply, query, codec.encode_map({}))
        log.info("map %s dropped", found.host.core.name, extra={"map": found.host.core.name})

    def _look_for_workers(self) -> None:
        self._trips.look_for(self._jobs.suspects)
        self._worker_rows = [row | self._trips.row(row["name"]) for row in self._jobs.workers()]

    def _show(self, changed: set[str], stuck: set[str]) -> None:
        """Alive means askable: while its solver is stuck, a map has no token."""
        for found in [self._maps[name] for name in changed if name in self._maps]:
            name = found.host.core.name
            if name in stuck:
                log.error("map %s: its solver has been silent for %.0f s", name, found.host.silent_s())
                found.place.withdraw()
            else:
                log.warning("map %s: its solver goes on", name)
                found.place.announce()

    def _stop_creating(self) -> None:
        self._stopping = True

    def _wait_for_desk(self) -> list[_Map]:
        """The maps there are once the desk is done with what it had: no map is created after this."""
        reached = threading.Event()
        self._desk.hand(reached.set)
        reached.wait()
        return list(self._maps.values())

    def _refuse_if_kept_elsewhere(self, tokens: str) -> None:
        """Two processes must not keep one map: at a router, look who is there.  Raises BadConfig."""
        # The token of one that was killed goes a moment after its lock.
        patience = time.monotonic() + (_TOKEN_S if self._config.standby else 0.0)
        while self._config.connect and (others := self._bus.alive(tokens)):
            if time.monotonic() < patience:
                continue
            raise BadConfig(
                f"{others[0]} is alive: another service keeps maps named {self._config.maps}; "
                "give each service a pattern of its own with maps ="
            )


def _send_both(place: Place, asker: Asker, answer: bytes, delta: bytes) -> None:
    """What was written in one piece is small enough to be sent at once."""
    reply(asker, answer)
    place.publish("delta", delta)


def _chunks(query: Asker) -> tuple[str, str]:
    """(map, last chunk) of a key below map/<map>/."""
    parts = key_of(query).split("/")
    return parts[3], parts[-1]
