"""The interests of a service at work: one thread that filters and sends for all maps, from the first interest on.

A map without an interest pays for looking whether anybody listens, once a delta; the thread begins with the first
question about one.
"""

import logging
import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

from factorbus.proto import codec
from factorbus.proto.problems import Internal, UnknownMap
from factorbus.service.config import Limits
from factorbus.service.core.events import Answer, Asker, Follow, Publish, Read, Refuse
from factorbus.service.interests.core import EndChannel, FetchEstimate, InterestCore
from factorbus.service.process.memory import MemoryLimit
from factorbus.service.questions.answers import Question, QuestionCopies

log = logging.getLogger(__name__)

# Bytes of deltas that may wait for the thread; what is beyond is fetched again.
_MOST_BYTES = 64 << 20


class Channels(Protocol):
    """Where a map publishes."""

    heard: Callable[[bytes], None] | None

    def publish(self, channel: str, message: bytes) -> None: ...

    def end_channel(self, channel: str) -> None: ...


class Replies(Protocol):
    """How somebody gets an answer."""

    def answer(self, asker: Asker, message: bytes) -> None: ...

    def refuse(self, asker: Asker, problem: Any) -> None: ...


class Interests:
    """Of all maps of one service.  Its methods may be called from any thread and return at once."""

    def __init__(self, limits: Limits, memory: MemoryLimit, replies: Replies) -> None:
        self._limits, self._memory, self._replies = limits, memory, replies
        self._events: queue.SimpleQueue[tuple[MapInterests, Callable[[float], Iterable[Any]]] | None] = (
            queue.SimpleQueue()
        )
        self._maps: list[MapInterests] = []
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None

    def of_map(self, name: str, place: Channels, read: Callable[[Read], None]) -> "MapInterests":
        """Those in map `name`.  read: asks its solver."""
        core = InterestCore(name, self._limits, lambda: secrets.randbits(62) | 1, self._check)
        return MapInterests(self, name, core, place, read)

    def hand(self, interests: "MapInterests", event: Callable[[float], Iterable[Any]]) -> None:
        """Have `event(now)` called on the thread, and what it returns done."""
        if self._thread is None:
            with self._starting:
                if self._thread is None:
                    self._thread = threading.Thread(target=self._run, name="interests", daemon=True)
                    self._thread.start()
        self._events.put((interests, event))

    def rows(self) -> list[dict[str, Any]]:
        """What the statistics say of each interest, with its map."""
        return [{"map": each.name, **row} for each in list(self._maps) for row in each.core.rows()]

    def close(self) -> None:
        """Return when what was handed in is done."""
        if self._thread is not None:
            self._events.put(None)
            self._thread.join()

    def _check(self, size: int) -> None:
        if (full := self._memory.no_room(0, size)) is not None:
            raise full

    def _run(self) -> None:
        while True:
            try:
                item = self._events.get(timeout=self._patience())
            except queue.Empty:
                item = None
            else:
                if item is None:
                    return
                interests, event = item
                if interests not in self._maps:
                    self._maps.append(interests)
                self._do(interests, event)
                item = event = None  # a query kept alive keeps its asker waiting
            for interests in list(self._maps):
                due = interests.core.next_due(now := time.monotonic())
                if due is not None and due <= now:
                    self._do(interests, interests.core.tick)
                if not interests.core.listening:
                    self._maps.remove(interests)

    def _patience(self) -> float | None:
        now = time.monotonic()
        times = [due for each in self._maps if (due := each.core.next_due(now)) is not None]
        return max(min(times) - now, 0.0) if times else None

    def _do(self, interests: "MapInterests", event: Callable[[float], Iterable[Any]]) -> None:
        try:
            effects = event(time.monotonic())
            interests.place.heard = interests.hear if interests.core.listening else None
            for effect in effects:
                self._perform(interests, effect)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: interests in map %s end", reference, interests.name)
            for effect in interests.core.close(Internal(reference)):
                self._perform(interests, effect)
            interests.place.heard = None

    def _perform(self, interests: "MapInterests", effect: Any) -> None:
        if isinstance(effect, Publish):
            interests.place.publish(effect.channel, effect.message)
        elif isinstance(effect, Answer):
            self._replies.answer(effect.asker, effect.message)
        elif isinstance(effect, Refuse):
            self._replies.refuse(effect.asker, effect.problem)
        elif isinstance(effect, FetchEstimate):
            interests.fetch(effect)
        elif isinstance(effect, EndChannel):
            interests.place.end_channel(effect.channel)


class MapInterests:
    """Those in one map: what its host and its place call."""

    def __init__(
        self, all_: Interests, name: str, core: InterestCore, place: Channels, read: Callable[[Read], None]
    ) -> None:
        self.name, self.core, self.place = name, core, place
        self._all, self._read = all_, read
        self._waiting_bytes = 0

    def follow(self, asked: Follow) -> None:
        """Somebody asks for an interest."""
        self._all.hand(self, lambda now: self.core.asked(asked, now))

    def hear(self, delta: bytes) -> None:
        """A delta was published."""
        if self._waiting_bytes + len(delta) > _MOST_BYTES:
            self._all.hand(self, lambda _: self.core.lose())
            return
        self._waiting_bytes += len(delta)
        self._all.hand(self, lambda now: self._take(delta, now))

    def fetch(self, fetch: FetchEstimate) -> None:
        """Have the estimate copied."""
        self._read(Read(Question("interest", ask=_Copying(self, fetch)), fetch.asker))

    def copied(self, fetch: FetchEstimate, taken: QuestionCopies) -> None:
        """Here it is."""
        self._all.hand(self, lambda now: self.core.copied(fetch, taken.epoch, taken.revision, taken.variables, now))

    def close(self) -> None:
        """The map goes."""
        if self.core.listening:
            self._all.hand(self, lambda _: self.core.close(UnknownMap(self.name)))

    def _take(self, delta: bytes, now: float) -> Sequence[Any]:
        self._waiting_bytes -= len(delta)
        return self.core.delta(codec.decode_delta(delta), now)


class _Copying:
    """What the question for a copy carries: where the copy goes."""

    def __init__(self, interests: MapInterests, fetch: FetchEstimate) -> None:
        self._interests, self._fetch = interests, fetch

    def copied(self, taken: QuestionCopies) -> None:
        self._interests.copied(self._fetch, taken)


def hand_copy(question: Question, taken: QuestionCopies) -> None:
    """The estimate was copied for `question`."""
    question.ask.copied(taken)
