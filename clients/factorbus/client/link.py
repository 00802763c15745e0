"""The only file of the client that touches zenoh: open, ask, listen, be seen.

Every callback is direct (it runs on zenoh's receiving thread, in order of arrival, and costs no Python thread that
could keep the interpreter from exiting), so what is passed in here may only hand over and return.
"""

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import zenoh
from zenoh.handlers import Callback

from factorbus.client.listening import heard, unresolved
from factorbus.client.replies import AnswerReply, Failure, Reply, Silence, TimedOut
from factorbus.proto import keys, redact
from factorbus.proto.endpoints import checked_endpoint
from factorbus.proto.problems import BadConfigurationFile, BadSetting, ClosedHere, NobodyListens, Unavailable
from factorbus.proto.zenoh_file import check_zenoh_file

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.05, 0.5
_TIMED_OUT = b"Timeout"
_DECLARED = 64
_VARIABLE = "ZENOH_CONFIG"  # which the command line takes for --zenoh


class Link:
    """One session on the bus, as a client."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self.closed = False
        self._declared: dict[str, zenoh.KeyExpr | str] = {}

    def ask(self, key: str, payload: bytes, timeout_s: float, done: Callable[[Reply], None]) -> None:
        """Query `key`; `done` is called once, from zenoh's thread or this one, with whatever came of it.

        The first reply counts and is handed on without waiting for the end of the query.
        """
        answered = False

        def finish(reply: Reply) -> None:
            nonlocal answered
            if not answered:
                answered = True
                done(reply)

        def on_reply(reply: zenoh.Reply) -> None:
            finish(_read(reply))

        self._query(self._short(key), payload, timeout_s, on_reply, lambda: finish(Silence()))

    def _short(self, key: str) -> zenoh.KeyExpr | str:
        """`key`, declared: where it leads from here is worked out once.  A tenth of an insert's way.

        A declaration stays until the session ends, so there are not more of them than a front end has use for.
        """
        if key not in self._declared and len(self._declared) < _DECLARED:
            self._declared[key] = self._session.declare_keyexpr(key)
        return self._declared.get(key, key)

    def ask_all(self, key: str, payload: bytes, timeout_s: float, done: Callable[[list[Reply]], None]) -> None:
        """Query `key`; `done` is called once, when the query has ended, with what everybody who answered said."""
        replies: list[Reply] = []

        def on_reply(reply: zenoh.Reply) -> None:
            replies.append(_read(reply))

        self._query(key, payload, timeout_s, on_reply, lambda: done(replies))

    def ask_versions(self, timeout_s: float, done: Callable[[set[str]], None]) -> None:
        """Which versions of the protocol do services speak that are there?  `done` is called once."""
        self.ask_tokens(
            keys.ANY_SERVICE_OF_ANY_VERSION, timeout_s, lambda found: done(set(map(keys.version_of, found)))
        )

    def ask_tokens(self, token: str, timeout_s: float, done: Callable[[set[str]], None]) -> None:
        """Which liveliness tokens that `token` matches are alive?  `done` is called once."""
        found: set[str] = set()

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                found.add(str(reply.ok.key_expr))

        with suppress(zenoh.ZError):  # it is closed
            self._session.liveliness().get(
                token, Callback(on_reply, drop=lambda: done(found), indirect=False), timeout=timeout_s
            )

    def _query(
        self,
        key: zenoh.KeyExpr | str,
        payload: bytes,
        timeout_s: float,
        on_reply: Callable[[zenoh.Reply], None],
        on_end: Callable[[], None],
    ) -> None:
        """Query `key`; `on_end` is called once, after the last reply.  If the session is closed, that is at once.

        Only others are asked.  Were this session asked as well, its own share of the query would now and then be the
        last to end: within `get`, on the thread that asks.  When that is the main thread, Python handles signals in
        `on_end`, and zenoh discards what their handlers raise: a Ctrl-C would be lost.
        """
        with suppress(zenoh.ZError):  # it is closed
            self._session.get(
                key,
                Callback(on_reply, drop=on_end, indirect=False),
                payload=payload,
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
                allowed_destination=zenoh.Locality.REMOTE,
            )

    @contextmanager
    def listening(self, key: str, hear: Callable[[bytes], None]) -> Iterator[None]:
        """While inside, every publication on `key` goes to `hear`."""

        def on_sample(sample: zenoh.Sample) -> None:
            hear(sample.payload.to_bytes())

        subscriber = self._session.declare_subscriber(key, Callback(on_sample, indirect=False))
        try:
            yield
        finally:
            subscriber.undeclare()

    @contextmanager
    def watching(self, token: str, see: Callable[[str, bool], None]) -> Iterator[None]:
        """While inside, `see` gets (key, alive) for every liveliness token below `token`, those present first."""

        def on_change(sample: zenoh.Sample) -> None:
            see(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        subscriber = self._session.liveliness().declare_subscriber(
            token, Callback(on_change, indirect=False), history=True
        )
        try:
            yield
        finally:
            subscriber.undeclare()

    @contextmanager
    def present(self, token: str) -> Iterator[None]:
        """While inside, `token` is alive."""
        declared = self._session.liveliness().declare_token(token)
        try:
            yield
        finally:
            declared.undeclare()

    def close(self) -> None:
        """End the session; questions still out end in silence."""
        self.closed = True
        self._session.close()

    def check_open(self, what: str) -> None:
        """Raises ClosedHere, of `what` was to go over it."""
        if self.closed:
            raise ClosedHere(what, connection=True)


def open_link(
    endpoints: Sequence[str],
    timeout_s: float,
    settings: Mapping[str, Any],
    file: str = "",
    listening_s: float | None = None,
) -> Link:
    """A link to the first of `endpoints` that takes us; as `open_session`."""
    return Link(open_session(endpoints, timeout_s, settings, file, listening_s))


def open_session(
    endpoints: Sequence[str],
    timeout_s: float,
    settings: Mapping[str, Any],
    file: str = "",
    listening_s: float | None = None,
) -> zenoh.Session:
    """A session with the first of `endpoints` that takes us, trying until `timeout_s` has passed.

    settings: further zenoh configuration, path to value, such as {"transport/auth/usrpwd": {...}}.  file: path of a
    zenoh configuration file that comes before all this.  listening_s: give up after so long, not `timeout_s`, where no
    endpoint has anybody who listens.
    Raises BadEndpoint, BadSetting and BadConfigurationFile at once, Unavailable (NobodyListens) when time is up.
    """
    config = _config(endpoints, settings, file)
    start, pause = time.monotonic(), _FIRST_PAUSE_S
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            waited_s = time.monotonic() - start
            if listening_s is not None and waited_s >= min(listening_s, timeout_s) and not heard(endpoints):
                raise NobodyListens(redact.endpoint(" and ".join(endpoints)), unresolved(endpoints)) from None
            if waited_s + pause > timeout_s:
                raise Unavailable(
                    redact.endpoint(" and ".join(endpoints)),
                    timeout_s,
                    "start a service there with `factorbus serve`, or check the address; one that asks for a "
                    "certificate or a password, and does not get the right one, does not answer either",
                ) from None
        time.sleep(pause)  # there is nothing to wait on: nobody is there yet who could say that they are
        pause = min(2 * pause, _LONGEST_PAUSE_S)


def _config(endpoints: Sequence[str], settings: Mapping[str, Any], file: str) -> zenoh.Config:
    for endpoint in endpoints:
        checked_endpoint(endpoint)
    variable = _VARIABLE if os.environ.get(_VARIABLE) == file else ""
    if file:
        check_zenoh_file(file, variable)
    try:
        config = zenoh.Config.from_file(file) if file else zenoh.Config()
    except zenoh.ZError as error:
        raise BadConfigurationFile(file, redact.reason(error), variable) from None
    for path, value in (session_settings(endpoints) | dict(settings)).items():
        try:
            config.insert_json5(path, json.dumps(value))
        except (zenoh.ZError, TypeError) as error:
            raise BadSetting(path, redact.reason(error)) from None
    return config


def session_settings(endpoints: Sequence[str]) -> dict[str, Any]:
    return {
        "mode": "client",
        "connect/endpoints": list(endpoints),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # On by default, and drops a large message silently when its receiver is descheduled for 100 ms (zenoh #2628).
        "transport/shared_memory/enabled": False,
        # A frozen service is noticed after 3 s, not 10; a restarted one is found within half a second, not four.
        "transport/link/tx/lease": 3000,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        "transport/link/rx/max_message_size": 256 << 20,
    }


def _read(reply: zenoh.Reply) -> Reply:
    if (answer := reply.ok) is not None:
        return AnswerReply(answer.payload.to_bytes())
    error = reply.err
    payload = error.payload.to_bytes() if error is not None else b""
    return TimedOut() if payload == _TIMED_OUT else Failure(payload)
