"""How a map follows its upstream: what is asked, sent and put in next.  Pure: events in, effects out; one at a time.

    joins ──▶ asks what came after the last place known to be the same, all of it ──▶ puts it in ──▶ ...
                 ▲                                                            │ nothing came
                 │ upstream moved on, or nobody knows whether it was taken    ▼
                 └───────────────────────────────────────── sends what is here alone ──▶ ...

What is here alone is made again behind what comes, so that is collected first, as far as memory allows, and put in at
once.  A place is known to be the same only when upstream has said so.  After silence it is asked for, so what was sent
and not answered is neither lost nor there twice.  Events carry the number of what they answer; that of an earlier one
is dropped.
"""

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

from factorbus.proto.records import MOST_BYTES, JournalPlace, RecordsAnswer, SentRecord

SEND_S = 0.1  # between what is sent: inserts of that time go together, in fewer bytes
POLL_S = 1.0  # with nothing to send, upstream is asked so often
PAUSES_S = (0.1, 1.0)  # after silence, doubling
REFUSED_S = 5.0  # after a refusal that time alone will not mend
PUT_PAUSES_S = (0.2, 10.0, 60.0)  # after what came could not be put in, doubling; where time alone will not mend it
LEAST_BYTES = 4 << 10
COLLECTED_BYTES = 64 << 20  # of what came from upstream and is not yet put in; the next answer goes beyond it
_RECORD_BYTES = 200  # of a record without its messages
_RETRIED = ("busy", "shutting_down", "journal_failed", "out_of_memory", "unavailable")


@dataclass(frozen=True, slots=True)
class JoinUpstream:
    """Ask for the map upstream; it is made there if it is not."""

    number: int


@dataclass(frozen=True, slots=True)
class AskUpstream:
    """Ask what came after `after`.  unsure: up to this record upstream may have what is here."""

    number: int
    after: JournalPlace
    unsure: int
    most_bytes: int


@dataclass(frozen=True, slots=True)
class SendUpstream:
    """Send what is here after `after`."""

    number: int
    after: JournalPlace
    most_bytes: int


@dataclass(frozen=True, slots=True)
class PutIn:
    """Put `records` behind `after`; `place` is where upstream is with them."""

    number: int
    after: JournalPlace
    records: tuple[SentRecord, ...]
    place: JournalPlace


UpstreamEffect: TypeAlias = JoinUpstream | AskUpstream | SendUpstream | PutIn


class UpstreamCore:
    """One map's replica.  place: the last that is known to be the same at both ends; head: the last record here."""

    def __init__(self, place: JournalPlace, head: int, now: float) -> None:
        self.place, self.head = place, head
        self.connected, self.since = False, now
        self.problem: Any = None  # why upstream takes nothing though it is there
        self._alive = False
        self._joined, self._must_ask = False, True
        self._unsure = head  # records up to here may be upstream, though it has not said so
        self._number, self._doing = 0, ""
        self._more = False
        self._coming: list[SentRecord] = []  # from upstream, up to `_come`
        self._come, self._coming_bytes = place, 0
        self._put_again, self._put_at, self._put_pause_s = False, -math.inf, PUT_PAUSES_S[0]
        self._not_before, self._pause_s, self._heard = -math.inf, PAUSES_S[0], -math.inf
        self._most_bytes = MOST_BYTES

    def link(self, alive: bool, now: float) -> list[UpstreamEffect]:
        """Upstream is seen, or not any more."""
        self._alive = alive
        if not alive:
            self._lost(now)
            return []
        self._not_before, self._pause_s = now, PAUSES_S[0]
        return self._go_on(now)

    def grew(self, head: int, now: float) -> list[UpstreamEffect]:
        """The journal here ends at `head`."""
        self.head = head
        return self._go_on(now)

    def tick(self, now: float) -> list[UpstreamEffect]:
        """Time went by."""
        return self._go_on(now)

    def due_s(self, now: float) -> float | None:
        """In how many seconds `tick` is to be called; None: only something that happens will change anything."""
        if not self._alive or self._doing:
            return None
        if self._put_again:
            return max(self._put_at - now, 0.0)
        wait_s = SEND_S if self.head > self.place.record and not self._must_ask else POLL_S
        at = self._heard + wait_s if self._joined and not self._must_ask else now
        return max(at, self._not_before, now) - now

    def joined(self, number: int, now: float) -> list[UpstreamEffect]:
        """The map is there."""
        if not self.joining(number):
            return []
        self._heard_from(now)
        self._joined = True
        return self._go_on(now)

    def joining(self, number: int) -> bool:
        """Is it the map's row that this answers with?"""
        return number == self._number and self._doing == "join"

    def sent(self, number: int, until: int) -> None:
        """What was to be sent is on its way, up to record `until`."""
        if number == self._number:
            self._unsure = max(self._unsure, until)

    def answered(self, number: int, answer: RecordsAnswer, now: float) -> list[UpstreamEffect]:
        """Upstream answered what it was asked or sent."""
        if number != self._number or self._doing not in ("ask", "send"):
            return []
        doing = self._doing
        self._heard_from(now)
        self._most_bytes = min(2 * self._most_bytes, MOST_BYTES)
        if doing == "ask":
            self._more = answer.more and bool(answer.records)
            if answer.records:
                self._coming += answer.records
                self._come = answer.place
                self._coming_bytes += sum(map(_bytes_of, answer.records))
            if self._more and self.head > self.place.record and self._coming_bytes < COLLECTED_BYTES:
                return self._go_on(now)
            if self._coming:
                return self._put_in()
            self._must_ask, self._unsure = False, self.place.record
        elif answer.same:
            self.place, self._must_ask = answer.place, False
        else:
            self._must_ask = True
        return self._go_on(now)

    def put(self, number: int, place: JournalPlace, head: int, now: float) -> list[UpstreamEffect]:
        """What came from upstream is in the journal, up to `place`, and the journal ends at `head`."""
        if number != self._number or self._doing != "put":
            return []
        self._doing = ""
        self.place, self.head, self._must_ask = place, head, self._more
        self._put_pause_s, self.problem = PUT_PAUSES_S[0], None
        self._forget_what_comes()
        self._unsure = max(self._unsure, head) if self._more else place.record
        return self._go_on(now)

    def refused(self, number: int, problem: Any, now: float) -> list[UpstreamEffect]:
        """Upstream refused; or what came from it could not be put in."""
        if number != self._number or not self._doing:
            return []
        doing, self._doing, self._must_ask = self._doing, "", True
        if doing == "put":
            self._not_put_in(problem, now)
            return []
        self._heard_from(now)
        collected = bool(self._coming)
        if problem.code == "other_records":
            self._forget_what_comes()
        if problem.code == "records_moved_on" and doing == "send":
            return self._go_on(now)
        if problem.code == "other_records" and doing == "ask" and collected:  # upstream is another one since
            return self._go_on(now)
        if problem.code == "other_records" and self.place.record:
            self.place, self._unsure = JournalPlace(), self.head
            return self._go_on(now)
        if problem.code == "unknown_map":
            self._joined = False
        if problem.code in _RETRIED or (problem.code == "unknown_map" and doing != "join"):
            self._wait(now)
        else:
            self.problem, self._not_before = problem, now + REFUSED_S
        return []

    def silent(self, number: int, timed_out: bool, now: float) -> list[UpstreamEffect]:
        """No answer came.  timed_out: none in time; the link may be slow."""
        if number != self._number or not self._doing:
            return []
        self._lost(now)
        if timed_out:
            self._most_bytes = max(self._most_bytes // 4, LEAST_BYTES)
        self._wait(now)
        return []

    def _go_on(self, now: float) -> list[UpstreamEffect]:
        if not self._alive or self._doing or now < self._not_before:
            return []
        if self._put_again:
            return self._put_in() if now >= self._put_at else []
        if not self._joined:
            self._begin("join")
            return [JoinUpstream(self._number)]
        if self._must_ask or (self.head <= self.place.record and now - self._heard >= POLL_S):
            self._begin("ask")
            after = self._come if self._coming else self.place
            return [AskUpstream(self._number, after, self._unsure, self._most_bytes)]
        if self.head > self.place.record and now - self._heard >= SEND_S:
            self._begin("send")
            return [SendUpstream(self._number, self.place, self._most_bytes)]
        return []

    def _put_in(self) -> list[UpstreamEffect]:
        self._put_again = False
        self._begin("put")
        return [PutIn(self._number, self.place, tuple(self._coming), self._come)]

    def _not_put_in(self, problem: Any, now: float) -> None:
        """What time may mend is tried again with what is here; else upstream is asked again, which may be another."""
        _, longest_s, unmended_s = PUT_PAUSES_S
        if problem.code in _RETRIED:
            self._put_again = True
        else:
            longest_s = unmended_s
            self._forget_what_comes()
            self._put_pause_s = max(self._put_pause_s, REFUSED_S)
        self.problem = problem
        self._put_at = self._not_before = now + self._put_pause_s
        self._put_pause_s = min(2 * self._put_pause_s, longest_s)

    def _forget_what_comes(self) -> None:
        self._coming, self._come, self._coming_bytes = [], self.place, 0

    def _begin(self, doing: str) -> None:
        self._number += 1
        self._doing = doing

    def _heard_from(self, now: float) -> None:
        self._doing, self._heard, self._pause_s, self.problem = "", now, PAUSES_S[0], None
        if not self.connected:
            self.connected, self.since = True, now

    def _lost(self, now: float) -> None:
        """What is under way may have come through, or not."""
        if self.connected:
            self.connected, self.since = False, now
        if self._doing != "put":  # which needs no link
            self._doing = ""
            self._number += 1
        self._must_ask = True

    def _wait(self, now: float) -> None:
        self._not_before = now + self._pause_s
        self._pause_s = min(2 * self._pause_s, PAUSES_S[1])


def _bytes_of(record: SentRecord) -> int:
    return _RECORD_BYTES + sum(len(insert.message) for insert in record.inserts)
