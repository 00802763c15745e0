"""The service at work: what comes over the bus goes to the maps, what they want done is done.

    threads   Zenoh's own      run the callbacks: read, judge (microseconds), hand over; one of them at a time may
                               fold an insert in instead, and send what comes of it, when that is soon done
              solver <map>     folds and steps, and encodes what comes of it
              outbox           answers to inserts, and publications, in order
              desk             large answers, maps that come and go, jobs for workers
              in-place <kind>  jobs when there is no worker
              features         questions of filters: small ones done, large ones cut up and put together

A SIGSTOPped client cannot hold up the others: deltas to it are dropped (lower priority than answers, so that they do
not stand in their way), and answers to it wait in its own queue; a large one that fills it costs the desk a second,
then Zenoh closes that client's transport.
"""

import gc
import logging
import secrets
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from factorbus.proto import codec, keys
from factorbus.proto.problems import Internal, Problem, ShuttingDown, TooLarge, UnknownMap
from factorbus.proto.version import __version__
from factorbus.service.admin import NotHere, OtherMode, ours, read_create, read_drop, settled_mode
from factorbus.service.arrival import read_insert
from factorbus.service.bus import Bus, Place, ignore, key_of, open_bus, payload_of, refuse, reply
from factorbus.service.config import BadConfig, Config, checked
from factorbus.service.core import MapCore
from factorbus.service.events import Answer, Asked, Asker, Drained, Effect, Publish, Read, Refuse, Tell
from factorbus.service.features import Features
from factorbus.service.fold import Folder
from factorbus.service.host import Host
from factorbus.service.jobs import Jobs
from factorbus.service.lane import Lane
from factorbus.service.optima import Optima
from factorbus.service.questions import Snapshot, answer
from factorbus.service.trips import Trips

log = logging.getLogger(__name__)

_TICK_S = 0.25
_SENDERS = 4096
_AT_ONCE_BYTES = 64 << 10


def serve(config: Config, on_ready: Callable[[list[str]], None], stop: threading.Event) -> None:
    """Keep maps until `stop` is set, then answer everything accepted and return.

    `on_ready` gets the endpoints that clients can connect to, once they can.  Raises BadConfig, Problem.
    """
    checked(config)
    _get_ready_to_compute(config)
    if stop.is_set():
        return
    # Callbacks and the solver's Python share one interpreter lock; the default of 5 ms is longer than most steps.
    sys.setswitchinterval(0.0005)
    bus = open_bus(config)
    try:
        shell = Shell(bus, config)
        try:
            for name in config.create:
                shell.create(name, "auto")
            on_ready(bus.endpoints())
            while not stop.wait(_TICK_S):
                shell.tick()
        finally:
            shell.close()
    finally:
        bus.close()


def _get_ready_to_compute(config: Config) -> None:
    if config.warm:
        from factorbus.idp import warm as warm_idp
        from factorbus.solver import compiled_seconds, warm

        seconds = sum(make(lambda name: _announce(name, compiled_seconds())) for make in (warm, warm_idp))
        log.info("kernels ready after %.1f s", seconds)
    # The compiler leaves some hundred thousand objects that live on: not walking them again saves pauses of 0.1 s.
    gc.collect()
    gc.freeze()
    # Inserts leave no cycles; looking for them after every 700 objects put 1 ms on top of every 50th exchange.
    gc.set_threshold(20_000, 50, 100)


def _announce(kernels: str, compiled_s: float) -> None:
    """On a cold start, say what is being compiled; loading what was compiled before takes no time worth a line."""
    if compiled_s:
        log.info("compiling kernels: %s", kernels)


class _Map:
    """A map, its place on the bus, the options of its solver, and the end of it."""

    def __init__(self, host: Host, place: Place, options: dict[str, Any]) -> None:
        self.host, self.place, self.options = host, place, options
        self.drained = threading.Event()
        self.on_drained: Callable[[], None] = self.drained.set


class Shell:
    """Everything a running service has declared on the bus, and the threads behind it."""

    def __init__(self, bus: Bus, config: Config) -> None:
        self._bus, self._config = bus, config
        self._service = config.name or f"s{secrets.token_hex(4)}"
        self._decoding = config.limits.message()
        self._maps: dict[str, _Map] = {}
        self._leaving: list[_Map] = []
        self._senders: dict[str, tuple[str, str]] = {}  # keys of inserts taken apart before
        self._stopping = False
        self._outbox, self._desk = Lane("outbox"), Lane("desk")
        self._seat = threading.Lock()  # of the one callback that may solve
        self._jobs = Jobs(self._desk, bus.send_job)
        self._trips = Trips(self._desk, bus.send_job, self._jobs.heard)
        limits, deadline_s = config.limits, config.job_deadline_s
        self._optima = Optima(self._jobs, reply, refuse, deadline_s, limits.jobs)
        self._features = Features(
            self._desk, self._jobs, self._trips, reply, refuse, self._decoding, limits.jobs, deadline_s
        )
        if config.warm:
            log.info("features: %s", self._features.measure())
        chunk = config.maps.replace("*", "$*") if config.maps != "*" else "*"
        root = f"{keys.PREFIX}/map/{chunk}"
        self._refuse_if_kept_elsewhere(f"{root}/live/service/*")
        bus.answer_on(f"{root}/in/*", self._on_insert)
        bus.answer_on(f"{root}/ask/*", self._on_question)
        bus.answer_on(keys.admin_key("*"), self._on_admin)
        bus.answer_on(keys.features_key(self._service), self._on_features)
        bus.watch(keys.any_worker_token(), self._on_worker)
        # Last of all: alive means askable.
        self._withdraw_features = bus.announce(keys.features_token(self._service))

    def create(self, name: str, mode: str) -> dict[str, Any]:
        """The row of map `name`, made if it is not there.  On the desk, or before it has work.  Raises Problem."""
        mode = settled_mode(mode)
        if found := self._maps.get(name):
            if found.host.core.mode != mode:
                raise OtherMode(name, found.host.core.mode, mode)
            return found.host.core.row()
        if not ours(self._config.maps, keys.checked_name("map", name)):
            raise NotHere(name, self._config.maps)
        if self._stopping:
            raise ShuttingDown
        if len(self._maps) >= self._config.limits.maps:
            raise TooLarge("the service", len(self._maps) + 1, self._config.limits.maps, "maps")
        made = self._make(name, mode)
        self._maps[name] = made
        made.place.announce()
        made.host.created()
        log.info("map %s created, mode %s, epoch %d", name, mode, made.host.core.epoch)
        return made.host.core.row()

    def tick(self) -> None:
        """Time went by."""
        for found in list(self._maps.values()):
            found.host.tick()
        self._desk.hand(self._jobs.tick)
        self._desk.hand(self._look_for_suspects)

    def close(self) -> None:
        """Withdraw, finish everything accepted, answer it, and undeclare."""
        self._withdraw_features()
        self._desk.hand(self._stop_creating)
        for found in self._wait_for_desk():
            found.place.withdraw()
            found.host.stop()
        for found in [*self._leaving, *self._maps.values()]:
            found.drained.wait()
            found.host.end()
        self._features.stop()
        self._desk.hand(self._jobs.close)
        self._desk.close()
        self._features.close()
        self._outbox.close()
        self._bus.withdraw()
        for found in self._maps.values():
            found.place.close()

    # ---- callbacks: on Zenoh's threads; they must not raise, nor ask Zenoh for anything but to send ----------------

    def _on_insert(self, query: Asker) -> None:
        key = key_of(query)
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
        read = read_insert(query, client, payload_of(query), self._decoding, time.monotonic())
        if isinstance(read, Refuse):
            self._outbox.hand(refuse, query, read.problem)
        else:
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
        self._desk.hand(self._administer, query)

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

    def _make(self, name: str, mode: str) -> _Map:
        from factorbus.solver import Options, Solver

        options = Options(mode=mode, clock=time.perf_counter)
        core = MapCore(name, mode, secrets.randbits(62) | 1, self._config.limits, time.monotonic())
        folder = Folder(lambda: Solver(options), core.epoch, self._config.limits)

        def perform(effects: list[Effect]) -> None:
            self._perform(made, effects)

        def send(effects: list[Effect]) -> None:
            self._send_now(made.place, effects)

        def answer_reads(reads: Sequence[Read], taken: Snapshot) -> None:
            self._desk.hand(self._answer_reads, made, reads, taken)

        host = Host(core, folder, perform, send, answer_reads, self._seat)
        made = _Map(host, self._bus.place(name, self._service), options.as_dict())
        return made

    def _perform(self, found: _Map, effects: list[Effect]) -> None:
        """Hand on what a map wants done: what is to be sent in one piece to the outbox, in order."""
        sending: list[Effect] = []
        for effect in effects:
            if isinstance(effect, Tell):
                self._desk.hand(self._tell, effect.asker, {**effect.content, "options": found.options})
            elif isinstance(effect, Drained):
                found.on_drained()
            else:
                sending.append(effect)
        if sending:
            self._outbox.hand(self._send, found.place, sending)

    def _send_now(self, place: Place, effects: list[Effect]) -> None:
        """On this thread, unless something else has to go before, or it is more than surely fits into Zenoh's queue.

        The queue might wait in vain to be emptied: this thread may be the one that does it.
        """
        size = sum([len(effect.message) for effect in effects if isinstance(effect, Answer | Publish)])
        hand = self._outbox.hand_or_do if size <= _AT_ONCE_BYTES else self._outbox.hand
        hand(self._send, place, effects)

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
        if self._config.connect:
            ignore(query)  # another service at the router may have it
        else:
            refuse(query, UnknownMap(name))

    # ---- on the desk ------------------------------------------------------------------------------------------------

    def _answer_reads(self, found: _Map, reads: Sequence[Read], taken: Snapshot) -> None:
        for read in reads:
            try:
                if read.question.name == "keyframe":
                    # Behind the delta of the same revision: a mirror that had the keyframe first would skip the delta.
                    self._outbox.hand(found.place.publish, "keyframe", answer(read.question, taken))
                elif read.question.batch:
                    self._optima.batch(read.asker, read.question, taken)
                else:
                    reply(read.asker, answer(read.question, taken))
            except Problem as problem:
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
            "workers": [row | self._trips.row(row["name"]) for row in self._jobs.workers()],
        }
        reply(asker, codec.encode_map({**content, **own}))

    def _administer(self, query: Asker) -> None:
        operation, payload = str(query.key_expr).rpartition("/")[2], payload_of(query)
        try:
            if operation == "maps":
                rows = [found.host.core.row() for found in self._maps.values()]
                reply(query, codec.encode_map({"maps": rows, "service": self._service, "version": __version__}))
            elif operation == "create":
                reply(query, codec.encode_map(self.create(*read_create(payload))))
            elif operation == "drop":
                self._drop(query, read_drop(payload))
            else:
                ignore(query)  # somebody else's key
        except NotHere as problem:
            if self._config.connect:
                ignore(query)  # for another service at the router
            else:
                refuse(query, problem)
        except Problem as problem:
            refuse(query, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: admin/%s", reference, operation)
            refuse(query, Internal(reference))

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
        found.host.end()
        self._outbox.hand(found.place.close)  # behind the map's last publications
        reply(query, codec.encode_map({}))
        log.info("map %s dropped", found.host.core.name)

    def _look_for_suspects(self) -> None:
        self._trips.look_for(self._jobs.suspects)

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
        if self._config.connect and (others := self._bus.alive(tokens)):
            raise BadConfig(
                f"{others[0]} is alive: another service keeps maps named {self._config.maps}; "
                "give each service a pattern of its own with maps ="
            )


def _chunks(query: Asker) -> tuple[str, str]:
    """(map, last chunk) of a key below map/<map>/."""
    parts = key_of(query).split("/")
    return parts[3], parts[-1]
