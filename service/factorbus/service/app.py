"""The service at work: what comes over the bus goes to the maps, what they want done is done.

threads   Zenoh's own      run the callbacks: read, judge (microseconds), hand over; one of them at a time may
                           apply an insert instead, and send what comes of it, when that is soon done
          solver <map>     records and steps, and encodes what comes of it
          outbox           answers to inserts, and publications, in order
          refusals         of inserts and questions
          control          maps that come and go, jobs for workers
          answers 0..3     answers to questions, which can be large
          computed 0, 1    answers to questions that take long to compute: covariances of many, repair, files
          in-place <kind>  jobs when there is no worker
          records          answers replicas; upstream: follows the service that this one is a replica of
          interests        filters what changed for those who follow a part of a map, and sends it
          features         questions of filters: small ones done, large ones cut up and put together
          core 1..         worker threads of eliminations that take long
"""

import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

from factorbus.proto import keys
from factorbus.proto.messages import Insert
from factorbus.proto.problems import Busy, Problem
from factorbus.proto.protocol import known
from factorbus.proto.version import __version__
from factorbus.service.administration import Administration
from factorbus.service.bus.delivery import Delivery
from factorbus.service.bus.senders import Senders
from factorbus.service.bus.zenoh_session import (
    ServiceBus,
    UpstreamBus,
    check_listening,
    check_zenoh_files,
    ignore,
    key_of,
    open_service_bus,
    open_upstream_bus,
    payload_of,
    received,
    refuse,
    reply,
)
from factorbus.service.config import BadConfig, Config, checked_config
from factorbus.service.core.events import ArrivedQuestion, Asker, Refuse
from factorbus.service.interests.running import Interests
from factorbus.service.jobs.features import FeatureLimits, FeatureQuestions
from factorbus.service.jobs.optima import Optima
from factorbus.service.jobs.running import Jobs
from factorbus.service.jobs.worker_latency import WorkerLatency
from factorbus.service.journal.library import Library, log_owner, open_library
from factorbus.service.maps.serial_executor import SerialExecutor
from factorbus.service.operations.health_report import HealthReport
from factorbus.service.operations.metrics import check_metrics, open_metrics
from factorbus.service.operations.start import ready_to_compute
from factorbus.service.process.health import Health
from factorbus.service.process.worker_threads import WorkerThreads
from factorbus.service.questions.answers import Question, QuestionCopies
from factorbus.service.questions.question_memory import Room
from factorbus.service.registry import Maps
from factorbus.service.replica.running import Replicas
from factorbus.service.replica.serving import RecordServing
from factorbus.service.solving.arrival import read_insert
from factorbus.solver.graph.own_kinds import bytes_to_compile

log = logging.getLogger(__name__)

_TICK_S = 0.25
_ADMIN_WAITING = 1024
_TOKEN_S = 10.0
_LONGER = "*/*/**"  # two chunks or more
_FIRST = 1  # the number that is wanted of a client that is not known


def serve(
    config: Config,
    on_ready: Callable[[list[str]], None],
    stop: threading.Event,
    on_look: Callable[[Health], None] = lambda _: None,
) -> None:
    """Keep maps until `stop` is set, then answer everything accepted and return.

    `on_ready` gets the endpoints that clients can connect to, once they can.  `on_look` gets the service's health,
    several times a second: for a supervisor.  Raises BadConfig, Problem.
    """
    checked_config(config)
    check_zenoh_files(config)
    # Who only waits for the folder has everything ready by then; who cannot have it says so before compiling.
    library = open_library(config, log_owner, stop) if config.journal and not config.standby else None
    try:
        if not config.standby:  # the owner that it waits for may have its addresses, too
            check_listening(config)
            check_metrics(config.metrics)
        with ready_to_compute(config.warm):
            if config.standby:
                library = open_library(config, log_owner, stop)
            if not stop.is_set():
                with closing(WorkerThreads(config.cores, config.cores_from_bytes)) as cores:
                    _serve(config, library, cores, on_ready, stop, on_look)
    finally:
        if library is not None:
            library.close()


def _serve(
    config: Config,
    library: Library | None,
    cores: WorkerThreads,
    on_ready: Callable[[list[str]], None],
    stop: threading.Event,
    on_look: Callable[[Health], None],
) -> None:
    bus = open_service_bus(config)
    try:
        shell = Shell(bus, config, library)
        shell.health_report.chapters["cores"] = cores.counts
        try:
            shell.maps.create_all(config.create)
            shell.health_report.health.open = True
            shell.tick()  # so that the first who asks is told of all maps
            endpoints = bus.endpoints()
            if library is not None:
                library.say(f"process {os.getpid()} on {socket.gethostname()}, {' '.join(endpoints)}")
            on_ready(endpoints)
            while not stop.wait(_TICK_S):
                shell.tick()
                cores.tick(shell.maps.largest_bytes)
                on_look(shell.health_report.health)
        finally:
            shell.close()
    finally:
        bus.close()


class Shell:
    """Everything a running service has declared on the bus, and the threads behind it."""

    def __init__(self, bus: ServiceBus, config: Config, library: Library | None = None) -> None:
        self._bus, self._config = bus, config
        self._service = config.name or f"s{secrets.token_hex(4)}"
        self._decoding = config.limits.message()
        self._control = SerialExecutor("control")
        self._senders = Senders(self._control, bus.know)
        self._delivery = Delivery(config.limits.questions, self._about, self._find_optimum, self._fork)
        executors = {"outbox": self._delivery.outbox, "refusals": self._delivery.refusals, "control": self._control}
        self.health_report = HealthReport(config, self._service, executors, lambda: self.maps.hosts())
        self._delivery.interests = Interests(config.limits, self.health_report.memory, self._delivery)
        self.health_report.chapters["interests"] = self._delivery.interests.rows
        self.maps = Maps(bus, config, self._service, library, self._delivery, self._control, self.health_report.memory)
        self.maps.on_gone = self._senders.forget
        stats, at_router = self.health_report.read, bool(config.connect)
        self._administration = Administration(self._service, self.maps, self._delivery, stats, at_router)
        self.health_report.chapters["protocol"] = known
        self.health_report.chapters["unopened"] = self.maps.unopened
        if library is not None:
            self.health_report.chapters["disk"] = library.disk
        self._replicas = _follow(config, self._service, self.maps) if config.upstream else None
        self._worker_rows: list[dict[str, Any]] = []
        self.health_report.chapters["workers"] = lambda: self._worker_rows
        self._records = RecordServing(
            config.limits, self._delivery.answer, self._delivery.refuse, self.health_report.memory.no_room
        )
        self._stuck: set[str] = set()
        self._jobs = Jobs(self._control, bus.send_job)
        self.health_report.chapters["wrong_answers"] = lambda: self._jobs.wrong_answers
        self._latencies = WorkerLatency(self._control, bus.send_job, self._jobs)
        limits, deadline_s = config.limits, config.job_deadline_s
        self._optima = Optima(self._jobs, self._delivery.answer, self._delivery.refuse, deadline_s, limits.jobs)
        self._features = FeatureQuestions(
            self._control,
            self._jobs,
            self._latencies,
            reply,
            refuse,
            FeatureLimits(
                self._decoding, limits.jobs, deadline_s, Room(self.health_report.memory, limits.answer_bytes)
            ),
        )
        if config.warm:
            rates = self._features.measure()
            log.info(
                "computing features for filters takes %.0f µs a question, %.2f µs a feature, %.2f ns a number answered",
                1e6 * rates.fixed_s, 1e6 * rates.feature_s, 1e9 * rates.number_s,
            )  # fmt: skip
        chunk = config.maps.replace("*", "$*") if config.maps != "*" else "*"
        root = f"{keys.PREFIX}/map/{chunk}"
        self._refuse_if_kept_elsewhere(f"{root}/live/service/*")
        # Before anybody can ask for one of them: it would be told that there is none.
        self.maps.open_kept()
        bus.answer_on(f"{root}/in/*", self._on_insert)
        bus.answer_on(f"{root}/ask/*", self._on_question)
        bus.answer_on(f"{root}/records/*", self._on_records)
        bus.answer_on(keys.admin_key("*"), self._on_admin)
        # Too many chunks, as in ask/estimate/x, are refused as well, and not met with silence.
        bus.answer_on(f"{root}/in/{_LONGER}", self._on_insert)
        bus.answer_on(f"{root}/ask/{_LONGER}", self._on_question)
        bus.answer_on(keys.admin_key(_LONGER), self._on_admin)
        bus.answer_on(keys.features_key(self._service), self._on_features)
        bus.watch(keys.any_worker_token(), self._on_worker)
        self._metrics = open_metrics(config.metrics, self.health_report)
        self.maps.announce()
        self._withdraw_features = bus.announce(keys.features_token(self._service))

    def tick(self) -> None:
        """Time went by."""
        for host in self.maps.hosts().values():
            host.tick()
        if self._replicas is not None:
            self._replicas.tick()
        stuck = self.health_report.look()
        if stuck != self._stuck:
            self._control.hand(self.maps.show, stuck ^ self._stuck, stuck)
            self._stuck = stuck
        self._control.hand(self._jobs.tick)
        self._control.hand(self._look_for_workers)

    def close(self) -> None:
        """Withdraw, finish everything accepted, answer it, and undeclare."""
        self.health_report.health.open = False
        self._withdraw_features()
        if self._replicas is not None:
            self._replicas.close()
        self._records.close()
        self.maps.finish()
        self._delivery.settle()
        self._features.stop()
        self._control.hand(self._jobs.close)
        self._control.close()
        self._features.close()
        self._delivery.close()
        self._metrics.close()
        self._bus.withdraw()
        self.maps.close()

    # ---- callbacks: on Zenoh's threads; they must not raise, nor ask Zenoh for anything but to send ----------------

    def _on_insert(self, query: Asker) -> None:
        key, payload = received(query)
        try:
            name, client = sender = self._senders.find(key)
        except Problem as problem:
            self._delivery.refusals.hand(refuse, query, problem, _FIRST)
            return
        found = self.maps.get(name)
        if found is None:
            self._delivery.refusals.hand(self._no_map, query, name, self._on_insert, _FIRST)
            return
        read = read_insert(query, client, payload, self._decoding, time.monotonic())
        if isinstance(read, Refuse):
            found.host.unread(client, read)
            return
        self._senders.remember(key, sender)
        content = read.content
        code = bytes_to_compile(group.kind for group in content.batch.factors) if isinstance(content, Insert) else 0
        if (full := self.health_report.memory.no_room(read.size, code)) is not None:
            read = read._replace(content=full, message=b"")
        found.host.insert(read)

    def _on_question(self, query: Asker) -> None:
        name, question = keys.below_map(key_of(query))
        found = self.maps.get(name)
        if found is None:
            self._delivery.refusals.hand(self._no_map, query, name, self._on_question)
        elif question == "records":
            self._records.ask(query, found.host, payload_of(query))
        else:
            found.host.ask(ArrivedQuestion(query, question, payload_of(query)))

    def _on_records(self, query: Asker) -> None:
        name, _ = keys.below_map(key_of(query))
        found = self.maps.get(name)
        if found is None:
            self._delivery.refusals.hand(self._no_map, query, name, self._on_records)
        else:
            self._records.take(query, found.host, payload_of(query))

    def _on_admin(self, query: Asker) -> None:
        if (waiting := self._control.waiting) < _ADMIN_WAITING:
            self._control.hand(self._administration.answer, query)
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
            self._control.hand(self._jobs.joined, worker, slots)
            self._control.hand(self._latencies.joined, worker)
        else:
            self._control.hand(self._jobs.left, worker)
            self._control.hand(self._latencies.left, worker)

    def _about(self) -> dict[str, Any]:
        from factorbus.service.operations.warm import seconds_compiling

        return {
            "service": self._service,
            "version": __version__,
            "protocol": known(),
            "kernels_compiled_s": seconds_compiling(),
            "workers": self._worker_rows,
        }

    def _find_optimum(self, asker: Asker, question: Question, taken: QuestionCopies) -> None:
        self._control.hand(self._optima.batch, asker, question, taken)

    def _fork(self, asker: Asker, question: Question, taken: QuestionCopies) -> None:
        self._control.hand(self.maps.forked, asker, question, taken)

    def _no_map(self, query: Asker, name: str, again: Callable[[Asker], None], following: int | None = None) -> None:
        """again: takes the query anew, once the map is open."""
        if self.maps.is_new_on_disk(name):
            if (waiting := self._control.waiting) < _ADMIN_WAITING:
                self._control.hand(self._open_new, query, name, again, following)
            else:
                refuse(query, Busy(waiting, 0.1), following)
        else:
            self._refuse_missing(query, name, following)

    def _refuse_missing(self, query: Asker, name: str, following: int | None) -> None:
        if problem := self.maps.missing(name):
            refuse(query, problem, following)
        else:
            ignore(query)

    # ---- on the control thread, which sends nothing itself to a peer that may not read -----------------------------

    def _open_new(self, query: Asker, name: str, again: Callable[[Asker], None], following: int | None) -> None:
        try:
            found = self.maps.find(name)
        except Problem as problem:
            self._delivery.refusals.hand(refuse, query, problem, following)
            return
        if found is not None:
            again(query)
        else:
            self._delivery.refusals.hand(self._refuse_missing, query, name, following)

    def _look_for_workers(self) -> None:
        self._latencies.look_for(self._jobs.suspects, self._jobs.distrusted)
        self._worker_rows = [row | self._latencies.row(row["name"]) for row in self._jobs.workers()]

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


def _follow(config: Config, service: str, maps: Maps) -> Replicas:
    def open_session(see: Callable[[bool], None]) -> UpstreamBus:
        return open_upstream_bus(config.upstream, config.upstream_zenoh, see)

    return Replicas(config.upstream, service, maps.hosts, open_session)
