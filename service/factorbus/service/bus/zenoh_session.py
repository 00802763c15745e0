"""The one file of the service that touches Zenoh: open, listen, answer, publish, be seen.

Every callback is direct: it runs on Zenoh's receiving thread, in order of arrival over all keys of one peer, and
costs no Python thread that could keep the interpreter from exiting.  So what is passed in here may only hand over
and return, or at most reply and publish: while it runs, nothing more is heard of that peer.
"""

import json
import logging
import os
from collections.abc import Callable, Mapping
from typing import Any

import zenoh
from zenoh.handlers import Callback

from factorbus.proto import codec, keys, redact
from factorbus.proto.messages import Job
from factorbus.proto.ports import check_endpoints
from factorbus.proto.problems import BadConfigurationFile, Problem, Unavailable
from factorbus.proto.zenoh_file import check_zenoh_file
from factorbus.service.bus.bind_address_check import refuse_exposed
from factorbus.service.bus.key_files import refuse_unsafe_keys
from factorbus.service.bus.zenoh_config import RUNTIME, RUNTIME_VARIABLE, upstream_settings, zenoh_settings
from factorbus.service.config import BadConfig, Config
from factorbus.service.core.events import Asker
from factorbus.service.jobs.job_check import WrongAnswer

log = logging.getLogger(__name__)

_TIMED_OUT = b"Timeout"
# Below that of answers (data), which follow their query: deltas that pile up must not stand in an answer's way.
_PRIORITY = {
    "delta": zenoh.Priority.DATA_LOW,
    "event": zenoh.Priority.DATA_LOW,
    "snapshot": zenoh.Priority.BACKGROUND,
}


def check_zenoh_files(config: Config) -> None:
    """Before anything is compiled, and an upstream tried again and again.  Raises as `open_service_bus`."""
    _service_settings(config)
    if config.upstream:
        settings = _upstream_settings(config.upstream, config.upstream_zenoh)
        if not config.insecure:
            refuse_unsafe_keys(config.upstream_zenoh, _reader(settings))


def check_listening(config: Config) -> None:
    """The same of the addresses where it is to listen.  Raises PortTaken, CannotListen."""
    if config.mode != "client":
        check_endpoints(config.listen)


def open_service_bus(config: Config) -> "ServiceBus":
    """The bus as `config` describes it.  Raises BadConfig; Exposed and UnsafeKeys are such.  Raises
    BadConfigurationFile, PortTaken, CannotListen.
    """
    os.environ.setdefault(RUNTIME_VARIABLE, RUNTIME)  # read by Zenoh when the first session of a process is opened
    settings = _service_settings(config)
    try:
        return ServiceBus(zenoh.open(settings))
    except zenoh.ZError as error:
        check_listening(config)
        where = redact.endpoint(", ".join(config.listen if config.mode != "client" else config.connect))
        raise BadConfig(
            f"cannot open {where}: {redact.reason(error)}; is the address right, and its certificate there?"
        ) from None


def _service_settings(config: Config) -> zenoh.Config:
    settings = _settings(config.zenoh, zenoh_settings(config))
    if not config.insecure:
        refuse_unsafe_keys(config.zenoh, _reader(settings))
        if config.mode != "client":
            refuse_exposed(config.listen, _reader(settings))
    return settings


def _upstream_settings(endpoint: str, zenoh_file: str) -> zenoh.Config:
    return _settings(zenoh_file, upstream_settings(endpoint))


def _settings(file: str, ours: Mapping[str, Any]) -> zenoh.Config:
    if file:
        check_zenoh_file(file)
    try:
        settings = zenoh.Config.from_file(file) if file else zenoh.Config()
    except zenoh.ZError as error:
        # Not from `error`: a traceback would show the line of the file, and what secrets are on it.
        raise BadConfigurationFile(file, redact.reason(error)) from None
    try:
        for path, value in ours.items():
            settings.insert_json5(path, json.dumps(value))
    except zenoh.ZError as error:
        where = file or "built in"
        raise BadConfig(f"Zenoh does not take this configuration ({where}): {redact.reason(error)}") from None
    return settings


def _reader(settings: zenoh.Config) -> Callable[[str], Any]:
    return lambda path: json.loads(settings.get_json(path))


class ServiceBus:
    """The service's session and what it has declared."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._declared: list[Any] = []

    def endpoints(self) -> list[str]:
        """Where clients can connect: what the session listens on, with real port numbers."""
        for reply in self._session.get(f"@/{self._session.info.zid()}/*", timeout=2.0):
            if reply.ok is not None:
                return list(json.loads(reply.ok.payload.to_bytes()).get("locators", ()))
        return []

    def answer_on(self, key: str, take: Callable[[Asker], None]) -> None:
        """Every query on `key` goes to `take`."""

        def on_query(query: zenoh.Query) -> None:
            take(query)

        self._declared.append(self._session.declare_queryable(key, Callback(on_query, indirect=False)))

    def know(self, key: str) -> Callable[[], None]:
        """Declare `key`, so that Zenoh remembers the way of what comes on it; call what comes back to undo that."""
        declared = self._session.declare_keyexpr(key)
        return lambda: self._session.undeclare(declared)

    def announce(self, token: str) -> Callable[[], None]:
        """Declare a liveliness token; call what comes back to withdraw it."""
        return self._session.liveliness().declare_token(token).undeclare

    def watch(self, tokens: str, see: Callable[[str, bool], None]) -> None:
        """`see` gets (key, alive) for every liveliness token on `tokens`, those present first."""

        def on_change(sample: zenoh.Sample) -> None:
            see(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        liveliness = self._session.liveliness()
        self._declared.append(liveliness.declare_subscriber(tokens, Callback(on_change, indirect=False), history=True))

    def alive(self, tokens: str) -> list[str]:
        """The liveliness tokens there are on `tokens`."""
        return [str(r.ok.key_expr) for r in self._session.liveliness().get(tokens, timeout=2.0) if r.ok is not None]

    def place(self, name: str, service: str) -> "MapPlace":
        """Where map `name` publishes and is announced."""
        return MapPlace(self._session, name, service)

    def send_job(self, worker: str, job: Job, deadline_s: float, done: Callable[[Any], None]) -> None:
        """Send `job`; `done` gets a JobDone or a problem: the first reply or, without any, silence at the end."""
        answered = False
        silence = Unavailable(f"worker {worker}", deadline_s, "another one is tried")

        def finish(result: Any) -> None:
            nonlocal answered
            if not answered:
                answered = True
                done(result)

        def on_reply(reply: zenoh.Reply) -> None:
            finish(_job_result(reply, silence))

        callback = Callback(on_reply, drop=lambda: finish(silence), indirect=False)
        self._session.get(keys.job_key(worker), callback, payload=codec.encode_job(job), timeout=deadline_s)

    def withdraw(self) -> None:
        """Undeclare everything: no callback runs afterwards."""
        for declared in self._declared:
            declared.undeclare()
        self._declared.clear()

    def close(self) -> None:
        """End the session."""
        self._session.close()


class UpstreamBus:
    """A replica's session with its upstream: a client of it, as any other."""

    def __init__(self, session: zenoh.Session, see: Callable[[bool], None]) -> None:
        """see: called with whether somebody is there to ask."""
        self._session, self._keys = session, dict[str, zenoh.KeyExpr]()
        there: set[str] = set()

        def on_change(sample: zenoh.Sample) -> None:
            (there.add if sample.kind == zenoh.SampleKind.PUT else there.discard)(str(sample.key_expr))
            see(bool(there))

        self._watching = session.liveliness().declare_subscriber(
            keys.any_features_token(), Callback(on_change, indirect=False), history=True
        )

    def ask(self, key: str, payload: bytes, timeout_s: float, done: Callable[[Any], None]) -> None:
        """`done` gets the bytes of the first answer, or a Problem; None: nobody answered, False: not in time."""
        answered = False

        def finish(result: Any) -> None:
            nonlocal answered
            if not answered:
                answered = True
                done(result)

        def on_reply(reply: zenoh.Reply) -> None:
            finish(_answer_in(reply))

        callback = Callback(on_reply, drop=lambda: finish(None), indirect=False)
        if key not in self._keys:  # on the wire it is a number from then on
            self._keys[key] = self._session.declare_keyexpr(key)
        try:
            self._session.get(self._keys[key], callback, payload=payload, timeout=timeout_s)
        except zenoh.ZError as error:
            log.debug("not asked on %s: %s", key, error)
            finish(None)

    def close(self) -> None:
        """End the session."""
        self._watching.undeclare()
        self._session.close()


def open_upstream_bus(endpoint: str, zenoh_file: str, see: Callable[[bool], None]) -> UpstreamBus:
    """A session with the service or router at `endpoint`.  Raises Unavailable, BadConfig."""
    settings = _upstream_settings(endpoint, zenoh_file)
    try:
        return UpstreamBus(zenoh.open(settings), see)
    except zenoh.ZError as error:
        raise Unavailable(f"the upstream at {redact.endpoint(endpoint)}", 0.0, redact.reason(error)) from None


class MapPlace:
    """One map's publications, and its token."""

    def __init__(self, session: zenoh.Session, name: str, service: str) -> None:
        channels = {"delta": keys.delta_key, "event": keys.event_key, "snapshot": keys.snapshot_key}
        # DROP: one stuck subscriber must not hold up all others; a mirror that misses a delta sees the gap and asks.
        self._channels = {
            channel: session.declare_publisher(
                key(name), congestion_control=zenoh.CongestionControl.DROP, priority=_PRIORITY[channel]
            )
            for channel, key in channels.items()
        }
        self._token_key = keys.service_token(name, service)
        self._session, self._token, self._name, self._closed = session, None, name, False
        self.heard: Callable[[bytes], None] | None = None  # who wants every delta that is published, if anybody

    def publish(self, channel: str, message: bytes) -> None:
        """Publish on `channel` (delta, event, snapshot; that of an interest begins with its first message)."""
        publisher = self._channels.get(channel)
        try:
            if publisher is None:
                if self._closed:
                    return
                publisher = self._channels[channel] = self._session.declare_publisher(
                    keys.channel_key(self._name, channel),
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=_PRIORITY["delta"],
                )
            publisher.put(message)
        except zenoh.ZError as error:
            log.warning("not published on %s of map %s: %s", channel, self._name, error)
        if channel == "delta" and self.heard is not None:
            self.heard(message)

    def end_channel(self, channel: str) -> None:
        """Nothing more is published on it."""
        if (publisher := self._channels.pop(channel, None)) is not None:
            publisher.undeclare()

    def announce(self) -> None:
        """Declare the token, last of all: alive means askable."""
        self._token = self._session.liveliness().declare_token(self._token_key)

    def withdraw(self) -> None:
        """Undeclare the token: no new client finds the map."""
        if self._token is not None:
            self._token.undeclare()
            self._token = None

    def close(self) -> None:
        """Undeclare everything."""
        self._closed = True
        self.withdraw()
        for publisher in list(self._channels.values()):
            publisher.undeclare()


def key_of(query: zenoh.Query) -> str:
    """The key that was asked."""
    return str(query.key_expr)


def payload_of(query: zenoh.Query) -> bytes:
    """What was sent along."""
    payload = query.payload
    return payload.to_bytes() if payload is not None else b""


def received(query: zenoh.Query) -> tuple[str, bytes]:
    """Both."""
    payload = query.payload
    return str(query.key_expr), payload.to_bytes() if payload is not None else b""


def reply(query: zenoh.Query, message: bytes) -> None:
    """Answer, and end the query: who asked waits for that too."""
    with query:
        try:
            query.reply(query.key_expr, message)
        except zenoh.ZError as error:
            log.warning("not answered on %s: %s", query.key_expr, error)


def refuse(query: zenoh.Query, problem: Any, following: int | None = None) -> None:
    """Answer with a problem: anything with code, message and detail.  following: of an insert, `detail.next`."""
    with query:
        try:
            query.reply_err(codec.encode_problem(problem, following))
        except zenoh.ZError as error:
            log.warning("not refused on %s: %s", query.key_expr, error)


def ignore(query: zenoh.Query) -> None:
    """End the query without an answer: somebody else may have one."""
    query.drop()


def _answer_in(reply: zenoh.Reply) -> Any:
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    payload = reply.err.payload.to_bytes() if reply.err is not None else b""
    try:
        return False if payload == _TIMED_OUT else codec.decode_problem(payload)
    except Problem as unreadable:
        return unreadable


def _job_result(reply: zenoh.Reply, silence: Problem) -> Any:
    try:
        if reply.ok is not None:
            return codec.decode_job_done(reply.ok.payload.to_bytes())
        payload = reply.err.payload.to_bytes() if reply.err is not None else b""
        return silence if payload == _TIMED_OUT else codec.decode_problem(payload)
    except Problem as unreadable:
        return WrongAnswer(f"sent what cannot be read: {unreadable.message}")
