"""A live copy of a map's estimate: a thread that applies deltas, and readers that never wait for the bus."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from numbers import Integral
from typing import Any

from factorbus.client.arguments import checked_seconds, of_type
from factorbus.client.delta_callbacks import DeltaCallbacks
from factorbus.client.following import Following
from factorbus.client.held_values import HeldValues
from factorbus.client.key_numbers import key_number
from factorbus.client.link import Link
from factorbus.client.replies import AnswerReply, Reply, TimedOut, pause
from factorbus.client.snapshot import Snapshot
from factorbus.proto import fields, keys
from factorbus.proto.arrays import F64, I64
from factorbus.proto.codec import decode_delta, decode_estimate, encode_keys_asked
from factorbus.proto.fields import read_map
from factorbus.proto.limits import ANSWER_LIMITS
from factorbus.proto.messages import Delta
from factorbus.proto.problems import BadSymbol, ClosedHere, NotConverged, NotHeld, NotReached, Unavailable
from factorbus.proto.symbols import format_symbol

log = logging.getLogger("factorbus.client")

# Without deltas for this long the owner is asked for its revision: a last delta that got lost leaves no gap to see.
PROBE_S = 1.0
_ANSWER_S = 5.0
# A revision heard of by another way may be ahead of its delta by so much before the estimate is asked for.
_GRACE_S = 0.1
# Messages that may wait for this thread before they are given up for the whole estimate.
_BACKLOG = 4096
# A waiting reader has the owner asked this soon.
_IMPATIENT_S = 0.1


class Mirror:
    """A map's estimate, kept up to date in the background.  Every method may be called from any thread.

    Values are copies, bit for bit those of the service at `revision`; a reader never sees half a step.
    `stale` is true from the moment a gap, a restart or silence is noticed until the whole estimate has come
    again; the last values stay readable meanwhile.
    """

    def __init__(self, link: Link, map_name: str, timeout_s: float) -> None:
        self._link, self._map, self._timeout_s = link, map_name, timeout_s
        self._following: Any = Following()  # or that of a part
        self._lock = threading.RLock()  # entered itself, and not by its condition: see `interruptible_future.py`
        self._changed = threading.Condition(self._lock)
        self._callbacks = DeltaCallbacks(map_name)
        self._inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._owners: set[str] = set()
        self._deserted = False  # the map had an owner, and has none now
        self._expected, self._confirmed_at = 0, time.monotonic()
        self._held_of = f"map {map_name!r}"  # what is looked up in, for an error
        self._asking, self._probing, self._silences = False, False, 0
        self._ask_at = 0.0
        self._gave_up = ""  # why the map does not go on converging
        self._foretold: tuple[int, int, dict[str, Any]] = (0, 0, {})  # epoch, revision, and how far it had converged
        self._closing, self._received = False, 0
        self._thread = threading.Thread(target=self._run, name=f"factorbus-mirror-{map_name}", daemon=True)

    def __getitem__(self, key: str | int) -> F64:
        """The value of a variable, "x12" or its number: a copy.  Raises NotHeld, a KeyError."""
        return self.find(key)[1]

    def __contains__(self, key: str | int) -> bool:
        with suppress(KeyError):
            return self.find(key) is not None
        return False

    def __iter__(self) -> Iterator[str]:
        """The keys of all variables of one revision, such as "x12": kind by kind, and of a kind in their order."""
        return iter([format_symbol(key) for held, _ in self.snapshot().columns.values() for key in held.tolist()])

    def __len__(self) -> int:
        with self._lock:
            return self._following.values.count()

    @property
    def revision(self) -> int:
        """The revision the values are of."""
        return self._following.revision

    @property
    def epoch(self) -> int:
        """The epoch of the map the values are of; it changes when the map was restarted or created anew."""
        return self._following.epoch

    @property
    def stale(self) -> bool:
        """The service is known to be, or may be, ahead of these values."""
        return not self._following.live or self._following.revision < self._expected

    @property
    def converged(self) -> bool | None:
        """Whether the map had converged at `revision`; None: the service is being asked, after a resynchronization."""
        return self._following.converged

    @property
    def converging(self) -> bool | None:
        """Whether further revisions are to follow by themselves, unless an insert comes; None as for `converged`."""
        return self._following.converging

    @property
    def age_s(self) -> float:
        """Seconds since the service last confirmed these values: by a delta, or by answering that nothing changed."""
        return time.monotonic() - self._confirmed_at

    @property
    def waiting(self) -> int:
        """Variables that the service has yet to send; 0 but for an interest with a bound."""
        return 0

    @property
    def received_bytes(self) -> int:
        """Bytes of the messages and answers that have come to keep these values."""
        return self._received

    def find(self, key: str | int) -> tuple[str, F64]:
        """The kind of a variable, "x12" or its number, and its value: a copy.  Raises NotHeld, a KeyError."""
        try:
            number = key_number(key)
        except BadSymbol as bad:
            raise NotHeld(bad.message) from None
        with self._lock:
            found = self._following.values.find(number)
        if found is None:
            raise NotHeld(f"{format_symbol(number)} is not in {self._held_of} at revision {self.revision}")
        return found

    def stamp(self, key: str | int) -> int | None:
        """When a variable was, "x12" or its number: the nanoseconds that it came with, or None.  Raises NotHeld."""
        with self._lock:
            self[key]
            return self._following.values.stamp(key_number(key))

    def columns(self, kind: str) -> tuple[I64, F64]:
        """(keys (n,), values (n, size)) of all variables of `kind`, ordered by key: copies.  Raises NotHeld."""
        with self._lock:
            columns = self._following.values.columns_of(kind)
        if columns is None:
            raise NotHeld(f"no variables of kind {kind!r} in {self._held_of} at revision {self.revision}")
        return columns

    def snapshot(self) -> Snapshot:
        """Everything, at one revision."""
        with self._lock:
            return Snapshot(
                self.epoch, self.revision, self._following.values.columns(), self._following.values.stamps()
            )

    def wait_for(self, revision: int, timeout_s: float | None = None) -> None:
        """Until the values are of `revision` or later and not stale.

        Raises Unavailable, at once on a closed map; NotReached, one of these, where only the revision is missing.
        """
        timeout_s = checked_seconds("timeout_s", timeout_s, self._timeout_s)
        of_type("revision", revision, Integral, "a whole number")
        self._try_wait(lambda: self._there(revision), timeout_s)
        if self._there(revision):
            return
        self._check_open()
        if not self.stale:
            raise NotReached(self._map, revision, self.revision, timeout_s)
        hint = f"the mirror is stale at revision {self.revision}, {self.age_s:.1f} s after it last heard of the service"
        raise Unavailable(f"map {self._map!r}, waited for at revision {revision},", timeout_s, hint)

    def wait_converged(self, timeout_s: float | None = None) -> None:
        """Until the values are the latest, the map has converged at them, and no further steps are to follow.

        That is at its optimum to 1e-6 of χ², or within a thousandth where it gave up the rest (`gave_up` of its stats).
        Raises NotConverged when time is up, at once where it gave up before; Unavailable, at once, on a closed map.
        """
        timeout_s = checked_seconds("timeout_s", timeout_s, self._timeout_s)
        self._try_wait(lambda: self._is_at_rest, timeout_s)
        if self._is_at_rest and self.converged:
            return
        self._check_open()
        raise NotConverged(self._map, self.revision, timeout_s, self._gave_up)

    def catch_up(self, timeout_s: float) -> None:
        """Wait until every revision known to exist is here, or nobody is there to send it, or time is up."""
        self._try_wait(lambda: self._following.revision >= self._expected or self._deserted, timeout_s)

    def on_delta(self, callback: Callable[[Delta], None]) -> Callable[[], None]:
        """Have `callback` called with every delta after it is applied; returns what takes it off again.

        It runs on the mirror's thread: while it runs nothing new is applied.  After a resynchronization it gets
        one delta with `previous` 0 that holds the whole estimate.  A callback that raises is logged.  Raises BadOption.
        """
        return self._callbacks.add(callback)

    def start(self, stack: ExitStack) -> None:
        """Subscribe, then ask; `stack` gets what ends it.  Returns when the estimate is here.  Raises Unavailable."""
        stack.callback(self._stop)
        self._thread.start()
        for key, word in ((keys.delta_key(self._map), "delta"), (keys.snapshot_key(self._map), "snapshot")):
            stack.enter_context(self._link.listening(key, lambda data, word=word: self._hear(word, data)))
        self._inbox.put(("ask", None))
        self.wait_for(0)
        self._try_wait(lambda: self.converged is not None or not self._probing, _ANSWER_S)

    def owner(self, token: str, alive: bool) -> None:
        """A service came to own the map, or went: from the bus's thread."""
        self._inbox.put(("owner", (token, alive)))

    def expect(self, revision: int, epoch: int) -> None:
        """`revision` exists: until it is here, the values are stale."""
        if epoch == self._following.epoch:
            self._expected = max(self._expected, revision)

    def expect_convergence(self, epoch: int, revision: int, converged: bool, converging: bool) -> None:
        """What the service has said of a revision, before `start`: an estimate message does not say it."""
        self._foretold = (epoch, revision, {"converged": converged, "converging": converging})

    # From here on: callbacks of the bus, which only hand over, and the mirror's own thread.

    def _hear(self, word: str, data: bytes) -> None:
        self._received += len(data)
        if self._inbox.qsize() < _BACKLOG:
            self._inbox.put((word, data))
        # Otherwise it is lost, and the next one that fits shows the gap.

    def _try_wait(self, reached: Callable[[], bool], timeout_s: float) -> None:
        """Until `reached`, the mirror's end, or the end of time."""
        end = time.monotonic() + timeout_s
        with self._lock:
            if not self._changed.wait_for(lambda: self._closing or reached(), min(_IMPATIENT_S, timeout_s)):
                self._inbox.put(("probe", None))
                self._changed.wait_for(lambda: self._closing or reached(), max(end - time.monotonic(), 0.0))

    def _there(self, revision: int) -> bool:
        return self._following.live and self._following.revision >= revision

    @property
    def _is_at_rest(self) -> bool:
        return self._there(self._expected) and self.converging is False

    def _check_open(self) -> None:
        if self._closing:
            raise ClosedHere(f"map {self._map!r}", connection=self._link.closed)

    def _stop(self) -> None:
        self._inbox.put(("stop", None))
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while not self._closing:
            try:
                word, content = self._inbox.get(timeout=self._patience())
            except queue.Empty:
                word, content = "probe", None
            try:
                self._handle(word, content)
            except Exception:
                # Whatever it was, the mirror must not stop and look alive: start over from the whole estimate.
                log.exception("map %s: cannot follow after this %s; asking for the whole estimate", self._map, word)
                self._lose()
            if not self._following.live:
                self._ask()

    def _patience(self) -> float:
        if self._following.live:
            return _GRACE_S if self._following.revision < self._expected else PROBE_S
        if self._asking:
            return PROBE_S
        return min(max(self._ask_at - time.monotonic(), 0.0), PROBE_S)

    def _handle(self, word: str, content: Any) -> None:
        match word:
            case "delta":
                self._apply_delta(content)
            case "snapshot":
                self._adopt(content)
            case "estimate":
                self._take_estimate(content)
            case "probed":
                self._take_probe(content)
            case "owner":
                self._take_owner(*content)
            case "probe" if self._following.live:
                self._probe()
            case "stop":
                with self._lock:
                    self._closing = True
                    self._changed.notify_all()

    def _apply_delta(self, content: bytes) -> None:
        delta = decode_delta(content)
        with self._lock:
            news, self._gave_up = self._following.delta(delta), ""
            self._confirm()
        self._callbacks.tell(news)

    def _adopt(self, data: bytes) -> None:
        estimate = decode_estimate(data)
        if (estimate.epoch, estimate.revision) == (self.epoch, self.revision) and self._following.live:
            return
        values = HeldValues(estimate.variables)  # outside the lock: readers do not wait for it
        with self._lock:
            if estimate.epoch != self._following.epoch:
                self._expected = 0
            news = self._following.estimate(estimate, values)
            if self._foretold[:2] == (self.epoch, self.revision) and self.converged is None:
                self._following.take_convergence(self._foretold[2])
            if self._following.live and self.converged is None:
                self._probe()
            self._confirm()
        self._callbacks.tell(news)

    def _take_estimate(self, reply: Reply) -> None:
        self._asking = False
        self._silences += 1
        self._ask_at = time.monotonic() + pause(self._silences)  # unless this was it
        answered = isinstance(reply, AnswerReply)
        if answered:
            self._adopt(reply.payload)
        if answered and self._following.live:
            self._silences = 0

    def _probe(self) -> None:
        """Nothing came for a while: fetch the estimate if a revision is missing here; otherwise ask where the map is.

        The missing delta may be lost, or late: on a busy machine its sender, or we, may not have run for a while.  So
        following goes on; the delta still counts if it comes before the estimate.
        """
        if self._following.revision < self._expected:
            self._ask()
        elif not self._probing:
            self._probing = True
            self._query("stats", b"", "probed")

    def _take_probe(self, reply: Reply) -> None:
        with self._lock:
            self._probing = False
            if isinstance(reply, AnswerReply):
                self._compare(reply)
            elif not isinstance(reply, TimedOut):  # else the service is there and busy
                self._lose()
            self._changed.notify_all()

    def _compare(self, reply: AnswerReply) -> None:
        told = read_map("stats", reply.payload, ANSWER_LIMITS)
        epoch, revision = fields.integer("stats", told, "epoch"), fields.integer("stats", told, "revision")
        if epoch != self._following.epoch:
            self._following.lost()
        self._expected = max(self._expected, revision)
        if not self.stale:
            if revision == self.revision:
                self._take_convergence(told)
            self._confirm()

    def _take_convergence(self, told: Mapping[str, Any]) -> None:
        self._following.take_convergence(told)
        gave_up = told.get("gave_up")
        self._gave_up = gave_up if isinstance(gave_up, str) else ""

    def _take_owner(self, token: str, alive: bool) -> None:
        if alive:
            self._owners.add(token)
            self._ask_at = 0.0
            self._handle("probe", None)
        else:
            self._owners.discard(token)
            if not self._owners:
                self._lose()
        self._deserted = not self._owners
        with self._lock:
            self._changed.notify_all()

    def _lose(self) -> None:
        with self._lock:
            self._following.lost()

    def _confirm(self) -> None:
        """Under the lock, after a word from the service."""
        if self._following.live:
            self._confirmed_at = time.monotonic()
            self._changed.notify_all()

    def _ask(self) -> None:
        if not self._asking and time.monotonic() >= self._ask_at and not self._closing:
            self._asking = True
            self._query("estimate", encode_keys_asked(None), "estimate")

    def _query(self, question: str, payload: bytes, word: str) -> None:
        key = keys.ask_key(self._map, question)

        def hear(reply: Reply) -> None:
            self._received += len(getattr(reply, "payload", b""))
            self._inbox.put((word, reply))

        self._link.ask(key, payload, _ANSWER_S, hear)
