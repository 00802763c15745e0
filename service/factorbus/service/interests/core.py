"""The interests in one map: events in, effects out.  No bus, clock or thread.

    asked ─▶ the estimate is not here: Fetch ─▶ copied ─▶ Answer
    asked ─▶ it is: Answer, at once or when what was sent before is paid for
    delta ─▶ into the tables ─▶ tick, when it is due: Publish on the channel of every interest that it matters to

There is one copy of the estimate for all interests of a map, from the first that is asked for until the last has ended.
Nobody says that they leave: an interest that nobody has asked about for `limits.interest_lease_s` has ended.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from factorbus.proto.interest import channel_of
from factorbus.proto.messages import Delta, Variables
from factorbus.proto.problems import Busy, Problem, TooLarge
from factorbus.service.config import Limits
from factorbus.service.core.events import Asker, Effect, Follow, Refuse
from factorbus.service.interests.stream import InterestStream
from factorbus.service.interests.tables import InterestTables

_KEPT_ASIDE = 1024  # deltas, until the estimate is here that they go on from
_FETCH_AGAIN_S = 1.0
_FETCH_S = 60.0  # a copy that has not come by then was refused
_MARK_BYTES = 20  # of a variable in an interest


@dataclass(frozen=True, slots=True)
class FetchEstimate:
    """Copy the estimate; `copied` gets it, with this.  asker None: nobody waits for it."""

    asker: Asker
    asked: Follow | None


@dataclass(frozen=True, slots=True)
class EndChannel:
    """Nothing more is published on `channel`."""

    channel: str


class InterestCore:
    """Of one map.  Every method takes an event and returns effects, in order.

    new_stream: a number that no channel had before.  check: raises where there is no memory for that number of bytes.
    """

    def __init__(
        self, name: str, limits: Limits, new_stream: Callable[[], int], check: Callable[[int], None] = lambda _: None
    ) -> None:
        self._name, self._limits, self._new_stream, self._check = name, limits, new_stream, check
        self._tables = InterestTables()
        self._streams: dict[str, InterestStream] = {}
        self._aside: deque[Delta] = deque(maxlen=_KEPT_ASIDE)
        self.listening = False  # deltas are wanted
        self._fetched_at = 0.0

    def asked(self, asked: Follow, now: float) -> list[Effect | FetchEstimate | EndChannel]:
        """A question came in."""
        if self._tables.live:
            return self._answer(asked, now)
        self.listening, self._fetched_at = True, now
        return [FetchEstimate(asked.asker, asked)]

    def copied(
        self, fetched: FetchEstimate, epoch: int, revision: int, groups: Iterable[Variables], now: float
    ) -> list[Effect | FetchEstimate | EndChannel]:
        """The estimate that was asked for."""
        if not self.listening:  # it took so long that nobody counted on it: what came since was not heard
            return [] if fetched.asked is None else self.asked(fetched.asked, now)
        if not self._tables.live:
            self._replace(epoch, revision, groups)
            aside = list(self._aside)
            self._aside.clear()
            for delta in aside:
                if delta.epoch == epoch and self._tables.live:
                    self._apply(delta)
        if not self._tables.live:  # one is missing again; `tick` fetches
            behind = Busy(len(self._aside), _FETCH_AGAIN_S, "deltas came before the estimate that they go on from")
            return [] if fetched.asked is None else [Refuse(fetched.asker, behind)]
        return [] if fetched.asked is None else self._answer(fetched.asked, now)

    def delta(self, delta: Delta, now: float) -> list[Effect | FetchEstimate | EndChannel]:
        """The map made a step."""
        if not self.listening:
            return []
        if self._tables.live:
            self._apply(delta)
        else:
            self._aside.append(delta)
        if self._tables.live or now < self._fetched_at + _FETCH_AGAIN_S or not self._streams:
            return []
        return [self._fetch(FetchEstimate(None, None), now)]

    def lose(self) -> list[Effect | FetchEstimate | EndChannel]:
        """A delta is lost: the estimate has to be fetched again."""
        self._tables.live = False
        return []

    def next_due(self, now: float) -> float | None:
        """When `tick` has something to do; None: not until something happens."""
        if not self.listening:
            return None
        if not self._tables.live:
            return max(now, self._fetched_at + (_FETCH_AGAIN_S if self._streams else _FETCH_S))
        times = [stream.ends_at for stream in self._streams.values()]
        times += [due for stream in self._streams.values() if (due := stream.due(self._tables)) is not None]
        return min(times, default=None)

    def tick(self, now: float) -> list[Effect | FetchEstimate | EndChannel]:
        """Time went by."""
        effects: list[Effect | FetchEstimate | EndChannel] = []
        for channel, stream in list(self._streams.items()):
            if now >= stream.ends_at:
                del self._streams[channel]
                effects += [*stream.close(InterestEnded(channel)), EndChannel(channel)]
            elif self._tables.live:
                effects += stream.tick(self._tables, now)
        if not self._streams and (self._tables.live or now >= self._fetched_at + _FETCH_S):
            self._rest()
        elif not self._tables.live and self._streams and now >= self._fetched_at + _FETCH_AGAIN_S:
            effects.append(self._fetch(FetchEstimate(None, None), now))
        return effects

    def close(self, problem: Problem) -> list[Effect | FetchEstimate | EndChannel]:
        """The map goes."""
        effects: list[Effect | FetchEstimate | EndChannel] = []
        for channel, stream in self._streams.items():
            effects += [*stream.close(problem), EndChannel(channel)]
        self._streams = {}
        self._rest()
        return effects

    def rows(self) -> list[dict[str, Any]]:
        """What the statistics say of each."""
        return [stream.row() for stream in list(self._streams.values())]

    def _answer(self, asked: Follow, now: float) -> list[Effect | FetchEstimate | EndChannel]:
        asker, ask = asked.asker, asked.ask
        self._tables.learn(asked.row)
        channel = channel_of(ask.interest)
        stream = self._streams.get(channel)
        if stream is None:
            try:
                self._check_room()
            except Problem as problem:
                return [Refuse(asker, problem)]
            lease_s = self._limits.interest_lease_s
            stream = InterestStream(ask.interest, channel, self._new_stream(), lease_s, now)
            self._streams[channel] = stream
        return [*stream.asked(asker, ask, self._tables, now)]

    def _check_room(self) -> None:
        """Raises TooLarge, OutOfMemory."""
        if (count := len(self._streams)) >= self._limits.interests:
            mend = "ask for one that is there, end one, or raise limits.interests"
            raise TooLarge(f"map {self._name}", count + 1, self._limits.interests, "interests", mend)
        self._check(_MARK_BYTES * self._tables.count())

    def _fetch(self, fetched: FetchEstimate, now: float) -> FetchEstimate:
        self._fetched_at = now
        return fetched

    def _replace(self, epoch: int, revision: int, groups: Iterable[Variables]) -> None:
        is_new = epoch != self._tables.epoch
        moved = self._tables.replace(epoch, revision, groups)
        for stream in self._streams.values():
            stream.moved(moved, is_new, self._new_stream() if is_new else 0)

    def _apply(self, delta: Delta) -> None:
        moved = self._tables.try_apply(delta)
        if moved is not None:
            for stream in self._streams.values():
                stream.moved(moved, False, 0)
        if not self._tables.live:
            self._aside.append(delta)

    def _rest(self) -> None:
        """Nobody follows: hold nothing."""
        self._tables, self.listening = InterestTables(), False
        self._aside.clear()


class InterestEnded(Problem):
    """Nobody asked about it for the whole lease, though somebody waits: they are to ask again."""

    code = "busy"

    def __init__(self, channel: str) -> None:
        super().__init__(f"{channel} ended before what it carries was paid for; ask again", retry_after_s=0.1)
