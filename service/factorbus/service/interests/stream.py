"""One interest of one map: what its channel carries, and when.  Pure: time comes with the events.

A message goes out a period after the last one, when something has changed.  Where the bytes per second are bounded, it
goes out when those before it are paid for: a message of s bytes is, after s / bytes_per_s seconds.  So the channel
carries at most the bound and one message in any second.  Answers with values count as messages do.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

from factorbus.proto.interest import Interest, filter_of
from factorbus.proto.interest_codec import (
    AskInterest,
    InterestAnswer,
    InterestDelta,
    encode_interest_answer,
    encode_interest_delta,
)
from factorbus.proto.messages import Variables
from factorbus.proto.problems import Busy
from factorbus.service.core.events import Answer, Asker, Effect, Publish, Refuse
from factorbus.service.interests.marks import GROUP_BYTES, KEY_BYTES, InterestMarks, Rows, values_of
from factorbus.service.interests.tables import InterestTables

# Bytes of a message beside its groups of variables, and of what carries it: measured on TCP, `docs/decisions`.
_HEAD_BYTES, CARRIED_BYTES = 160, 100
_MOST_BYTES = 16 << 20  # of one message, where the rate is not bounded
_LEAST_BYTES = 4096  # of one message, where a second's worth is no less
_MOST_WAITING = 4  # askers whose answers are not paid for


class _Waiting(NamedTuple):
    asker: Asker
    ask: AskInterest


@dataclass(slots=True)
class StreamCounts:
    """What a channel has carried."""

    messages: int = 0
    bytes: int = 0
    answers: int = 0
    waiting: int = 0  # variables, as seen last


class InterestStream:
    """One life of the channel of one interest; `stream` names it."""

    def __init__(self, interest: Interest, channel: str, stream: int, lease_s: float, now: float) -> None:
        self.interest, self.channel, self.stream = interest, channel, stream
        self.ends_at, self._lease_s = now + lease_s, lease_s
        self.counts = StreamCounts()
        self._marks = InterestMarks(filter_of(interest))
        self._number, self._revision = 0, 0  # of the last message
        self._followed = self._left_over = False  # left_over: the bound, not the period, keeps what waits
        self._next_at = self._paid_at = now
        self._askers: deque[_Waiting] = deque()
        self._answered_last = False

    def asked(self, asker: Asker, ask: AskInterest, tables: InterestTables, now: float) -> list[Effect]:
        """Somebody wants to know of it, or what they lack."""
        self.ends_at = now + self._lease_s
        self._marks.look(tables, self._number)
        if not ask.following:
            return [self._answer(asker, tables)]
        if self._followed and (ask.stream, ask.number) == (self.stream, self._number):
            return [self._answer(asker, tables)]
        if now >= self._paid_at:
            return [self._bring(_Waiting(asker, ask), tables, now)]
        if len(self._askers) < _MOST_WAITING:
            self._askers.append(_Waiting(asker, ask))
            return []
        others = "clients wait for what they lack of this interest"
        return [Refuse(asker, Busy(len(self._askers), round(self._paid_at - now, 3) + 1.0, others))]

    def moved(self, moved: Any, epoch_is_new: bool, stream: int) -> None:
        """The whole estimate came anew.  epoch_is_new: it is another map; the channel begins another life, `stream`."""
        if epoch_is_new:
            self.stream, self._number, self._revision = stream, 0, 0
            self._marks.forget()
        else:
            self._marks.moved(moved, self._number)

    def due(self, tables: InterestTables) -> float | None:
        """When something is to be sent; None: not unless something changes."""
        if not self._followed:
            return self._paid_at if self._askers else None
        if self._askers or self._marks.waiting():
            return self._paid_at if self._askers or self._left_over else max(self._next_at, self._paid_at)
        return None if self._marks.has_seen(tables) else max(self._next_at, self._paid_at)

    def tick(self, tables: InterestTables, now: float) -> list[Effect]:
        """Send what is due."""
        effects: list[Effect] = []
        while (due := self.due(tables)) is not None and due <= now:
            self._marks.look(tables, self._number)
            waits = self._followed and self._marks.waiting()
            if self._askers and not (waits and self._answered_last):
                effects.append(self._bring(self._askers.popleft(), tables, now))
                self._answered_last = True
                continue
            self._answered_last = self._left_over = False
            self._next_at = now + self.interest.period_ms * 1e-3
            if waits and (message := self._message(tables)):
                self._pay(len(message), now)
                effects.append(Publish(self.channel, message))
            else:
                self._revision = tables.revision
        return effects

    def close(self, problem: Exception) -> list[Effect]:
        """It ends: those who wait are told why."""
        refused: list[Effect] = [Refuse(each.asker, problem) for each in self._askers]
        self._askers.clear()
        return refused

    def row(self) -> dict[str, Any]:
        """What the statistics say of it."""
        interest, counts = self.interest, self.counts
        return {
            "channel": self.channel,
            "letters": list(interest.letters),
            "kinds": list(interest.kinds),
            "box": list(interest.box),
            "period_ms": interest.period_ms,
            "bytes_per_s": interest.bytes_per_s,
            "messages": counts.messages,
            "answers": counts.answers,
            "bytes": counts.bytes,
            "waiting": counts.waiting,
        }

    @property
    def _message_bytes(self) -> int:
        """How large a message may be: what is paid for in a period, or a little more, and in a second at most."""
        bound = self.interest.bytes_per_s
        if not bound:
            return _MOST_BYTES
        return min(bound, max(int(bound * self.interest.period_ms * 1e-3), _LEAST_BYTES)) - CARRIED_BYTES

    def _pay(self, size: int, now: float) -> None:
        self.counts.bytes += size + CARRIED_BYTES
        if bound := self.interest.bytes_per_s:
            self._paid_at = max(now, self._paid_at) + (size + CARRIED_BYTES) / bound
            self._left_over = self._marks.waiting() > 0

    def _bring(self, waiting: _Waiting, tables: InterestTables, now: float) -> Answer:
        """Answer with what the asker lacks, as far as there is room; the rest comes on the channel."""
        marks, (asker, ask) = self._marks, waiting
        marks.look(tables, self._number)
        number, room = ask.number, self._message_bytes - _HEAD_BYTES
        whole = not (self._followed and ask.stream == self.stream and marks.repairs_from <= number <= self._number)
        gone: tuple[Variables, ...] = ()
        if not whole:
            gone = marks.missed_gone(number, tables)
            size = sum(GROUP_BYTES + KEY_BYTES * len(group.keys) for group in gone)
            whole, room = (True, room) if size > room // 2 else (False, room - size)
            gone = () if whole else gone
        wanted = marks.inside() if whole else marks.missed(number)
        rows = marks.choose(wanted, tables, room)
        if self._followed:
            marks.given(rows, wanted, self._number)
        else:
            self._followed = True
            marks.sent(rows, self._number)
        answer = self._answer(asker, tables, whole, values_of(rows, tables), gone)
        self._pay(len(answer.message), now)
        return answer

    def _answer(
        self,
        asker: Asker,
        tables: InterestTables,
        whole: bool = False,
        variables: tuple[Variables, ...] = (),
        gone: tuple[Variables, ...] = (),
    ) -> Answer:
        self.counts.answers += 1
        waiting = self.counts.waiting = self._marks.waiting() if self._followed else 0
        return Answer(
            asker,
            encode_interest_answer(
                InterestAnswer(
                    tables.epoch,
                    tables.revision,
                    self.channel,
                    self.stream,
                    self._number,
                    self._lease_s,
                    whole,
                    variables,
                    gone,
                    waiting,
                    tables.converged,
                    tables.converging,
                )
            ),
        )

    def _message(self, tables: InterestTables) -> bytes | None:
        """The next message, of what waits as much as there is room for."""
        marks, room, number = self._marks, self._message_bytes - _HEAD_BYTES, self._number + 1
        stale = marks.stale()
        has_values = any(rows.size for rows in stale.values())
        gone = marks.take_gone(tables, number, room // KEY_BYTES // (2 if has_values else 1) - GROUP_BYTES // KEY_BYTES)
        room -= sum(GROUP_BYTES + KEY_BYTES * len(group.keys) for group in gone)
        rows: Rows = marks.choose(stale, tables, room)
        if not gone and not any(chosen.size for chosen in rows.values()):
            return None
        marks.sent(rows, number)
        previous, self._number, self._revision = self._revision, number, tables.revision
        self.counts.messages += 1
        self.counts.waiting = marks.waiting()
        return encode_interest_delta(
            InterestDelta(
                tables.epoch,
                tables.revision,
                previous,
                self.stream,
                number,
                values_of(rows, tables),
                gone,
                self.counts.waiting,
                tables.converged,
                tables.converging,
            )
        )
