"""A service that is a replica, at work: one thread follows the upstream for all maps.

It asks and sends; what comes is put in by the map's own thread.  A link that is down costs nothing but an attempt to
open a session now and then; clients here never wait for it.
"""

import logging
import queue
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple, Protocol

from factorbus.journal.problems import JournalDamaged
from factorbus.journal.records import JournalRecord
from factorbus.journal.rewriting import UpstreamPlace, upstream_of
from factorbus.journal.store import open_store
from factorbus.proto import codec, keys
from factorbus.proto.own_clients import count_inserts
from factorbus.proto.problems import Internal, Problem, Unavailable
from factorbus.proto.records import (
    MOST_NAMED,
    MOST_RECORDS,
    JournalPlace,
    RecordsAsk,
    RecordsPush,
    decode_records_answer,
    encode_records_ask,
    encode_records_push,
    with_messages,
)
from factorbus.service.journal.grafting import Graft, Grafted, sent_records
from factorbus.service.journal.keeping import Keeper
from factorbus.service.maps.host import Host
from factorbus.service.replica.core import (
    AskUpstream,
    JoinUpstream,
    PutIn,
    SendUpstream,
    UpstreamCore,
    UpstreamEffect,
)
from factorbus.service.replica.tail import JournalTail
from factorbus.service.solving.arrival import message_digest

log = logging.getLogger(__name__)

_PATIENCE_S = 10.0  # for one answer
_SOON_S = 0.001  # a clock that stands still for so long does not make the thread spin
_OPENING_S = 1.0  # between attempts to open a session
_NOTHING: frozenset[int] = frozenset()


class UpstreamSession(Protocol):
    """The bus of the upstream.  Calls back on its own threads."""

    def ask(self, key: str, payload: bytes, timeout_s: float, done: Callable[[Any], None]) -> None:
        """`done` gets the bytes of the answer, a Problem, or None (nobody answered) or False (not in time)."""
        ...

    def close(self) -> None:
        """End it."""
        ...


class _LocalAsker:
    """Stands for a query where the service itself asks: gets a Problem, or what the map made of a graft."""

    key_expr = ""

    def __init__(self, done: Callable[[Any], None]) -> None:
        self._done = done

    def __enter__(self) -> "_LocalAsker":
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def reply(self, _key: str, _message: bytes) -> None:
        """`Graft.heard` has told."""

    def reply_err(self, message: bytes) -> None:
        """It is refused."""
        self._done(codec.decode_problem(message))


class _Sent(NamedTuple):
    """What went with a query: inserts, up to a chain; had: messages of inserts that were named, by digest."""

    inserts: int = 0
    chain: bytes = b""
    had: Mapping[int, bytes] = {}


class _Followed:
    """One map of this service."""

    def __init__(self, host: Host, keeper: Keeper, core: UpstreamCore) -> None:
        self.host, self.keeper, self.core = host, keeper, core
        self.tail = JournalTail(keeper)
        self.behind = self.rebased = self.refused = 0
        self.same_bits = True
        self.sent_bytes = self.received_bytes = 0
        self._said = ""

    def say(self, text: str, *of: object) -> None:
        """Log what is wrong, unless it is what was said last."""
        if (said := text % of) != self._said:
            log.warning("%s", said, extra={"map": self.host.core.name})
        self._said = said


class Replicas:
    """All maps of a service that is a replica.

    hosts: the maps there are.  open_session: opens the bus of the upstream; it calls what it is given with whether
    somebody is there.  Raises Problem.
    """

    def __init__(
        self,
        endpoint: str,
        name: str,
        hosts: Callable[[], dict[str, Host]],
        open_session: Callable[[Callable[[bool], None]], UpstreamSession],
    ) -> None:
        self._endpoint, self._name, self._hosts, self._open_session = endpoint, name, hosts, open_session
        self._maps: dict[str, _Followed] = {}
        self._session: UpstreamSession | None = None
        self._alive, self._open_at = False, 0.0
        self._events: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._ticking = False
        self._no_session = self._said_of_session = ""  # why there is none, beyond that nobody answers; what was logged
        self._unfollowed: dict[str, str] = {}  # maps that cannot be followed, and why
        self._thread = threading.Thread(target=self._run, name="upstream", daemon=True)
        self._thread.start()

    def tick(self) -> None:
        """Time went by."""
        if not self._ticking:
            self._ticking = True
            self._events.put(self._tick)

    def row(self, name: str) -> dict[str, Any]:
        """What ask/stats of map `name` says, if it follows."""
        followed = self._maps.get(name)
        return {} if followed is None else {"upstream": self._row(followed)}

    def close(self) -> None:
        """Follow no more."""
        self._events.put(None)
        self._thread.join()
        if self._session is not None:
            self._session.close()

    def _row(self, followed: _Followed) -> dict[str, Any]:
        core, problem = followed.core, followed.core.problem
        return {
            "endpoint": self._endpoint,
            "connected": core.connected,
            "since_s": time.monotonic() - core.since,
            "behind": followed.behind,
            "record": core.place.record,
            "rebased": followed.rebased,
            "refused": followed.refused,
            "same_bits": followed.same_bits,
            "sent_bytes": followed.sent_bytes,
            "received_bytes": followed.received_bytes,
            "code": problem.code if problem is not None else "",
            "problem": str(problem.message) if problem is not None else self._no_session,
        }

    # ---- on the thread ----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            try:
                event = self._events.get(timeout=self._due_s())
            except queue.Empty:
                event = self._tick_all
            if event is None:
                return
            try:
                event()
            except Exception:
                log.exception("upstream %s: %r failed", self._endpoint, event)

    def _due_s(self) -> float | None:
        now = time.monotonic()
        due = [wait_s for followed in self._maps.values() if (wait_s := followed.core.due_s(now)) is not None]
        return min(due) + _SOON_S if due else None

    def _tick(self) -> None:
        self._ticking = False
        now = time.monotonic()
        if self._session is None and now >= self._open_at:
            try:
                self._session = self._open_session(lambda alive: self._events.put(lambda: self._seen(alive)))
                self._no_session = ""
            except Problem as problem:
                if self._said_of_session != problem.message:
                    log.warning("going on alone, and trying again: %s", problem)
                self._said_of_session, self._open_at = problem.message, time.monotonic() + _OPENING_S
                self._no_session = "" if isinstance(problem, Unavailable) else problem.message
        hosts = self._hosts()
        for name in [name for name, followed in self._maps.items() if hosts.get(name) is not followed.host]:
            del self._maps[name]
        for name, host in hosts.items():
            if name not in self._maps and (keeper := host.keeper) is not None:
                self._begin(name, host, keeper)
        self._tick_all()

    def _tick_all(self) -> None:
        now = time.monotonic()
        for followed in list(self._maps.values()):
            self._do(followed, followed.core.tick(now))

    def _begin(self, name: str, host: Host, keeper: Keeper) -> None:
        """Follow one more map, from where its journal says that both were the same."""
        # Set first: what is written from here on is heard of, if only when this has been done.
        keeper.written = lambda records: self._events.put(lambda: self._wrote(name, keeper, records))
        try:
            place, last = _place_of(keeper), keeper.last
            if place.record > last.record:  # the end of the journal was lost in a crash
                place = UpstreamPlace(*JournalPlace())
            followed = _Followed(host, keeper, UpstreamCore(JournalPlace(*place), last.record, time.monotonic()))
            followed.behind = followed.tail.inserts(place.record, last.record)
        except Problem as problem:
            self._cannot_follow(name, problem)
            return
        keeper.upstream = place
        host.upstream_stats = lambda: self.row(name)
        self._maps[name] = followed
        self._unfollowed.pop(name, None)
        if self._alive:
            self._do(followed, followed.core.link(True, time.monotonic()))

    def _cannot_follow(self, name: str, problem: Problem) -> None:
        """It is tried again with every tick, and said once."""
        if self._unfollowed.get(name) != problem.message:
            log.error("map %s follows nobody: %s", name, problem)
        self._unfollowed[name] = problem.message

    def _seen(self, alive: bool) -> None:
        if alive != self._alive:
            log.info("upstream %s is %s", self._endpoint, "there" if alive else "out of reach; going on alone")
        self._alive = alive
        for followed in list(self._maps.values()):
            self._do(followed, followed.core.link(alive, time.monotonic()))

    def _wrote(self, name: str, keeper: Keeper, records: Sequence[JournalRecord] | None) -> None:
        followed = self._maps.get(name)
        if followed is None or followed.keeper is not keeper:
            return
        if records is None:
            followed.tail.forget()
            return
        records = [record for record in records if record.number > followed.core.head]
        if not records:
            return  # known since the journal was read
        followed.behind += sum(count_inserts(record.entries) for record in records)
        followed.tail.wrote(records)
        self._do(followed, followed.core.grew(records[-1].number, time.monotonic()))

    def _do(self, followed: _Followed, effects: Sequence[UpstreamEffect]) -> None:
        for effect in effects:
            try:
                self._perform(followed, effect)
            except Exception as fault:  # a journal that cannot be read, say: it is tried again after a while
                if not isinstance(fault, Problem):
                    reference = secrets.token_hex(4)
                    log.exception("fault %s: map %s and its upstream", reference, followed.host.core.name)
                    fault = Internal(reference)
                self._told(followed, effect.number, fault, None)

    def _perform(self, followed: _Followed, effect: UpstreamEffect) -> None:
        match effect:
            case JoinUpstream():
                self._join(followed, effect)
            case AskUpstream():
                self._ask(followed, effect)
            case SendUpstream():
                self._send(followed, effect)
            case PutIn():
                self._put(followed, effect)

    def _join(self, followed: _Followed, effect: JoinUpstream) -> None:
        core = followed.host.core
        made_as = {"mode": core.mode, "closures": core.closures} | core.removals.row()
        payload = codec.encode_map({"map": core.name} | made_as)
        self._query(followed, effect.number, keys.admin_key("create"), payload)

    def _ask(self, followed: _Followed, effect: AskUpstream) -> None:
        had: dict[int, bytes] = {}
        if effect.unsure > effect.after.record:
            own = [record for record in followed.tail.after(effect.after.record) if record.number <= effect.unsure]
            entries = islice((entry for record in own for entry in record.entries), MOST_NAMED)
            had = {message_digest(entry.message): entry.message for entry in entries}
        payload = encode_records_ask(RecordsAsk(effect.after, tuple(had), effect.most_bytes))
        key = keys.ask_key(followed.host.core.name, "records")
        self._query(followed, effect.number, key, payload, _Sent(had=had))

    def _send(self, followed: _Followed, effect: SendUpstream) -> None:
        own = followed.tail.after(effect.after.record)
        records, last, _ = sent_records(own, _NOTHING, effect.most_bytes, MOST_RECORDS)
        if last is None:
            folder = followed.keeper.folder
            raise JournalDamaged(folder, f"it ends before record {effect.after.record + 1}, which was written")
        followed.core.sent(effect.number, last.record)
        payload = encode_records_push(RecordsPush(effect.after, records))
        inserts = sum(count_inserts(record.inserts) for record in records)
        key = keys.records_key(followed.host.core.name, self._name)
        self._query(followed, effect.number, key, payload, _Sent(inserts, last.chain))

    def _query(self, followed: _Followed, number: int, key: str, payload: bytes, sent: "_Sent | None" = None) -> None:
        followed.sent_bytes += len(payload)
        if self._session is None:
            return

        def done(result: Any) -> None:
            self._events.put(lambda: self._told(followed, number, result, sent))

        self._session.ask(key, payload, _PATIENCE_S, done)

    def _told(self, followed: _Followed, number: int, result: Any, sent: "_Sent | None") -> None:
        core, now = followed.core, time.monotonic()
        if self._maps.get(followed.host.core.name) is not followed:
            return  # the map was dropped meanwhile, and there may be another one of its name
        if isinstance(result, Problem):
            if result.code not in ("records_moved_on", "busy"):
                followed.say("map %s: upstream %s: %s", followed.host.core.name, self._endpoint, result)
            before = core.place.record
            self._do(followed, core.refused(number, result, now))
            if core.place.record < before:  # upstream is another one since, and has less of it
                followed.behind = followed.tail.inserts(core.place.record, core.head)
            return
        if not isinstance(result, bytes):
            self._do(followed, core.silent(number, result is False, now))
            return
        followed.received_bytes += len(result)
        if core.joining(number):
            self._do(followed, core.joined(number, now))
            return
        try:
            answer = decode_records_answer(result, message_digest)
            answer = answer._replace(records=with_messages(answer.records, sent.had if sent is not None else {}))
        except Problem as problem:
            self._do(followed, core.refused(number, problem, now))
            return
        before = core.place
        effects = core.answered(number, answer, now)
        if sent is not None and core.place != before:
            followed.keeper.upstream = UpstreamPlace(*core.place)
            followed.behind -= sent.inserts
            self._compare(followed, sent.chain == core.place.chain)
        self._do(followed, effects)

    def _put(self, followed: _Followed, effect: PutIn) -> None:
        def heard(grafted: Grafted) -> None:
            self._events.put(lambda: self._grafted(followed, effect, grafted))

        def refused(problem: Any) -> None:
            self._events.put(lambda: self._not_put_in(followed, effect, problem))

        graft = Graft(effect.after, effect.records, effect.place, heard)
        followed.host.graft(_LocalAsker(refused), graft)

    def _not_put_in(self, followed: _Followed, effect: PutIn, problem: Any) -> None:
        name, upstream = followed.host.core.name, self._endpoint
        followed.say("map %s: what came from upstream %s is not put in: %s", name, upstream, problem)
        self._do(followed, followed.core.refused(effect.number, problem, time.monotonic()))

    def _grafted(self, followed: _Followed, effect: PutIn, grafted: Grafted) -> None:
        followed.rebased += bool(grafted.rebased)
        followed.refused += len(grafted.refused)
        followed.tail.forget()
        followed.behind = grafted.behind
        self._compare(followed, grafted.same_bits)
        now = time.monotonic()
        self._do(followed, followed.core.put(effect.number, effect.place, grafted.last.record, now))

    def _compare(self, followed: _Followed, same: bool) -> None:
        if followed.same_bits and not same:
            log.warning(
                "map %s: values have other bits than upstream: another version or machine made them",
                followed.host.core.name,
            )
        followed.same_bits = same


def _place_of(keeper: Keeper) -> UpstreamPlace:
    """The last one that both were known to have, when the journal was written.  Raises JournalUnreadable."""
    store = open_store(keeper.folder, read_only=True)
    try:
        return upstream_of(store)
    finally:
        store.close()
