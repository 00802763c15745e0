"""A replica and its upstream over a link that loses, cuts, delays and repeats: nothing lost, nothing twice, one order.

The ends are models: a journal each, and what is done with records.  What decides is the core that the service has.
"""

from hashlib import blake2b
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test

from factorbus.proto.problems import Busy, Problem
from factorbus.proto.records import JournalPlace, RecordsAnswer, SentInsert, SentRecord
from factorbus.service.journal.record_problems import OtherRecords, RecordsMovedOn
from factorbus.service.replica.core import (
    COLLECTED_BYTES,
    AskUpstream,
    JoinUpstream,
    PutIn,
    SendUpstream,
    UpstreamCore,
)

MOST = 5  # records that one message of the models takes


class Journal:
    """Records in their order."""

    def __init__(self) -> None:
        self.records: list[SentRecord] = []

    def chain(self, record: int) -> bytes:
        chain = bytes(16)
        for each in self.records[:record]:
            chain = blake2b(chain + repr(each).encode(), digest_size=16).digest()
        return chain

    def end(self) -> JournalPlace:
        return JournalPlace(len(self.records), self.chain(len(self.records)))

    def inserts(self) -> list[tuple[str, int]]:
        return [(insert.client, insert.sequence) for record in self.records for insert in record.inserts]


def record_of(client: str, sequence: int) -> SentRecord:
    return SentRecord(0, (SentInsert(client, sequence, b"m", hash((client, sequence)) & 0xFFFF),))


def ask(upstream: Journal, after: JournalPlace) -> RecordsAnswer | Problem:
    if after.record > len(upstream.records) or upstream.chain(after.record) != after.chain:
        return OtherRecords("m", len(upstream.records), after.record)
    sent = tuple(upstream.records[after.record : after.record + MOST])
    at = after.record + len(sent)
    return RecordsAnswer(1, JournalPlace(at, upstream.chain(at)), sent, at < len(upstream.records))


def push(upstream: Journal, after: JournalPlace, records: list[SentRecord]) -> RecordsAnswer | Problem:
    if upstream.end() != after:
        return RecordsMovedOn("m", len(upstream.records), after.record)
    upstream.records += records
    return RecordsAnswer(1, upstream.end())


def put(here: Journal, effect: PutIn) -> None:
    """As `grafting` does: what is alike stays, the upstream's comes first, what is here alone behind it."""
    after = effect.after.record
    own = here.records[after:]
    alike = 0
    while alike < min(len(own), len(effect.records)) and own[alike] == effect.records[alike]:
        alike += 1
    there = {(i.client, i.sequence) for r in effect.records[alike:] for i in r.inserts}
    rest = [r for r in own[alike:] if not any((i.client, i.sequence) in there for i in r.inserts)]
    here.records[after + alike :] = [*effect.records[alike:], *rest]


class Link(RuleBasedStateMachine):
    """Any interleaving."""

    @initialize()
    def begin(self) -> None:
        self.now, self.upstream, self.here = 0.0, Journal(), Journal()
        self.counts = {"robot": 0, "other": 0}
        self.alive = False
        self.asked: list[tuple[int, Any, Any]] = []  # (number, effect, what is sent)
        self.told: list[tuple[int, Any]] = []
        self.old: list[tuple[int, Any]] = []  # answers that came already
        self.puts: list[PutIn] = []
        self.kept = JournalPlace()  # what the replica has on its disk of the place
        self.core = UpstreamCore(self.kept, 0, self.now)

    def do(self, effects: list[Any]) -> None:
        for effect in effects:
            if isinstance(effect, PutIn):
                self.puts.append(effect)
                continue
            sent = None
            if isinstance(effect, SendUpstream):
                after = effect.after.record
                sent = self.here.records[after : after + MOST]
                self.core.sent(effect.number, after + len(sent))
            self.asked.append((effect.number, effect, sent))

    @rule()
    def insert_here(self) -> None:
        self.counts["robot"] += 1
        self.here.records.append(record_of("robot", self.counts["robot"]))
        self.do(self.core.grew(len(self.here.records), self.now))

    @rule()
    def insert_upstream(self) -> None:
        self.counts["other"] += 1
        self.upstream.records.append(record_of("other", self.counts["other"]))

    @rule()
    def cut_or_mend(self) -> None:
        self.alive = not self.alive
        self.do(self.core.link(self.alive, self.now))

    @rule(late=st.booleans())
    def time_passes(self, late: bool) -> None:
        self.now += 1.1 if late else 0.15
        self.do(self.core.tick(self.now))

    @precondition(lambda self: self.asked)
    @rule()
    def upstream_hears(self) -> None:
        """Also what was sent before a cut may still come through."""
        number, effect, sent = self.asked.pop(0)
        if isinstance(effect, JoinUpstream):
            self.told.append((number, "row"))
        elif isinstance(effect, AskUpstream):
            self.told.append((number, ask(self.upstream, effect.after)))
        else:
            self.told.append((number, push(self.upstream, effect.after, sent)))

    @precondition(lambda self: self.asked)
    @rule(timed_out=st.booleans())
    def request_is_lost(self, timed_out: bool) -> None:
        number, _, _ = self.asked.pop(0)
        self.do(self.core.silent(number, timed_out, self.now))

    @precondition(lambda self: self.asked)
    @rule()
    def upstream_is_busy(self) -> None:
        number, _, _ = self.asked.pop(0)
        self.do(self.core.refused(number, Busy(1, 0.1), self.now))

    @precondition(lambda self: self.told)
    @rule(which=st.integers(0, 3))
    def answer_comes(self, which: int) -> None:
        number, answer = self.told.pop(which % len(self.told))
        self.old.append((number, answer))
        self.hear(number, answer)

    @precondition(lambda self: self.told)
    @rule()
    def answer_is_lost(self) -> None:
        number, _ = self.told.pop(0)
        self.do(self.core.silent(number, False, self.now))

    @precondition(lambda self: self.old)
    @rule(which=st.integers(0, 9))
    def answer_comes_again(self, which: int) -> None:
        self.hear(*self.old[which % len(self.old)])

    @precondition(lambda self: self.puts)
    @rule()
    def map_puts_in(self) -> None:
        effect = self.puts.pop(0)
        put(self.here, effect)
        self.kept = effect.place
        self.do(self.core.put(effect.number, effect.place, len(self.here.records), self.now))

    @precondition(lambda self: self.puts)
    @rule()
    def disk_is_full(self) -> None:
        self.do(self.core.refused(self.puts.pop(0).number, Busy(1, 0.1), self.now))

    @rule()
    def replica_is_killed(self) -> None:
        """What is on its disk stays: the journal, and a place that may be an older one."""
        self.puts.clear()
        self.old.clear()
        self.told.clear()
        self.core = UpstreamCore(self.kept, len(self.here.records), self.now)
        self.asked = [(-1, effect, sent) for _, effect, sent in self.asked]
        if self.alive:
            self.do(self.core.link(True, self.now))

    @rule()
    def upstream_is_killed(self) -> None:
        """It comes back with its journal."""
        self.asked.clear()
        self.told.clear()
        self.do(self.core.link(False, self.now))
        if self.alive:
            self.do(self.core.link(True, self.now))

    @precondition(lambda self: self.upstream.records)
    @rule()
    def upstream_loses_its_end(self) -> None:
        """Without durability `commit` a crash may."""
        if not any(insert.client == "other" for insert in self.upstream.records[-1].inserts):
            self.upstream.records.pop()

    def hear(self, number: int, answer: Any) -> None:
        if answer == "row":
            self.do(self.core.joined(number, self.now))
        elif isinstance(answer, Problem):
            self.do(self.core.refused(number, answer, self.now))
        else:
            self.do(self.core.answered(number, answer, self.now))

    def teardown(self) -> None:
        if not hasattr(self, "core"):
            return
        if not self.alive:
            self.cut_or_mend()
        for _ in range(500):
            while self.asked or self.told or self.puts:
                if self.puts:
                    self.map_puts_in()
                elif self.told:
                    self.answer_comes(0)
                else:
                    self.upstream_hears()
            if self.here.records == self.upstream.records and not self.core._must_ask:
                break
            self.now += 1.1
            self.do(self.core.tick(self.now))
        assert self.here.records == self.upstream.records
        every = {(client, n + 1) for client, count in self.counts.items() for n in range(count)}
        assert set(self.here.inserts()) == every, "nothing is lost"
        assert len(self.here.inserts()) == len(every), "nothing is there twice"
        robots = [sequence for client, sequence in self.here.inserts() if client == "robot"]
        assert robots == sorted(robots), "in the order of their client"
        assert self.core.place == self.upstream.end()


def test_any_interleaving_ends_with_equal_histories() -> None:
    run_state_machine_as_test(Link, settings=settings(max_examples=120, stateful_step_count=50, deadline=None))


def test_nothing_is_sent_before_it_is_known_where_both_are_the_same() -> None:
    core = UpstreamCore(JournalPlace(), 3, 0.0)
    assert core.tick(9.0) == [], "nobody is there"
    (join,) = core.link(True, 10.0)
    assert isinstance(join, JoinUpstream)
    (asked,) = core.joined(join.number, 10.0)
    assert isinstance(asked, AskUpstream)
    assert asked.unsure == 3, "what is here may be there"
    assert core.answered(asked.number, RecordsAnswer(1, JournalPlace()), 10.0) == [], "just heard of"
    assert core.due_s(10.0) is not None
    (sent,) = core.tick(10.2)
    assert isinstance(sent, SendUpstream)
    assert core.connected


def three(begin: int) -> tuple[SentRecord, ...]:
    return tuple(record_of("other", begin + n) for n in range(3))


def joined(head: int) -> tuple[UpstreamCore, AskUpstream]:
    core = UpstreamCore(JournalPlace(), head, 0.0)
    (join,) = core.link(True, 0.0)
    (asked,) = core.joined(join.number, 0.0)
    assert isinstance(asked, AskUpstream)
    return core, asked


def test_what_is_here_alone_is_made_again_once_however_much_comes() -> None:
    core, asked = joined(head=4)
    places = [JournalPlace(3 * n, bytes([n]) * 16) for n in range(1, 4)]
    (asked,) = core.answered(asked.number, RecordsAnswer(1, places[0], three(1), more=True), 0.0)
    assert isinstance(asked, AskUpstream)
    assert asked.after == places[0], "it goes on from where it is, and has put in nothing"
    core.silent(asked.number, False, 0.1)
    (asked,) = core.tick(2.0)
    assert isinstance(asked, AskUpstream)
    assert asked.after == places[0], "and begins nothing anew after silence"
    (asked,) = core.answered(asked.number, RecordsAnswer(1, places[1], three(4), more=True), 2.0)
    (put,) = core.answered(asked.number, RecordsAnswer(1, places[2], three(7)), 2.0)
    assert isinstance(put, PutIn)
    assert (put.after, put.place) == (JournalPlace(), places[2])
    assert put.records == (*three(1), *three(4), *three(7))
    core.put(put.number, places[2], 13, 2.0)
    assert core.place == places[2]


def test_where_nothing_is_here_alone_what_comes_is_put_in_as_it_comes() -> None:
    core, asked = joined(head=0)
    (put,) = core.answered(asked.number, RecordsAnswer(1, JournalPlace(3, b"a" * 16), three(1), more=True), 0.0)
    assert isinstance(put, PutIn)
    assert put.records == three(1)


def test_what_was_collected_from_an_upstream_that_is_another_one_since_is_not_used() -> None:
    core, asked = joined(head=4)
    (asked,) = core.answered(asked.number, RecordsAnswer(1, JournalPlace(3, b"a" * 16), three(1), more=True), 0.0)
    (asked,) = core.refused(asked.number, OtherRecords("m", 0, 3), 0.0)
    assert isinstance(asked, AskUpstream)
    assert asked.after == JournalPlace()
    (put,) = core.answered(asked.number, RecordsAnswer(1, JournalPlace(3, b"b" * 16), three(9)), 0.0)
    assert isinstance(put, PutIn)
    assert put.records == three(9)


def test_what_cannot_be_put_in_is_tried_again_later_and_later_and_is_not_asked_for_again() -> None:
    """While the disk is full the link is not used for what is here already."""
    core, asked = joined(head=0)
    (put,) = core.answered(asked.number, RecordsAnswer(1, JournalPlace(3, b"a" * 16), three(1)), 0.0)
    now, pauses = 0.0, []
    for _ in range(12):
        assert isinstance(put, PutIn)
        assert put.records == three(1)
        assert core.refused(put.number, Busy(1, 0.1), now) == []
        assert core.problem is not None
        due = core.due_s(now)
        assert due is not None
        assert core.tick(now + 0.9 * due) == []
        core.link(False, now)
        assert core.link(True, now) == [], "a link that comes back makes no room on the disk"
        now += due
        pauses.append(round(due, 3))
        (put,) = core.tick(now)
    assert pauses == [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0]
    core.put(put.number, JournalPlace(3, b"a" * 16), 3, now)
    assert (core.problem, core.place.record) == (None, 3)


def test_what_comes_to_another_end_here_is_asked_for_again_from_an_upstream_that_may_be_mended() -> None:
    core, asked = joined(head=0)
    (put,) = core.answered(asked.number, RecordsAnswer(1, JournalPlace(3, b"a" * 16), three(1)), 0.0)
    assert core.refused(put.number, OtherRecords("m", 0, 3), 0.0) == []
    assert core.tick(4.9) == []
    (asked,) = core.tick(5.0)
    assert isinstance(asked, AskUpstream)
    (put,) = core.answered(asked.number, RecordsAnswer(1, JournalPlace(3, b"a" * 16), three(1)), 5.0)
    core.refused(put.number, OtherRecords("m", 0, 3), 5.0)
    assert core.tick(14.9) == []
    assert core.tick(15.0) != []


def test_what_is_collected_has_a_bound() -> None:
    core, asked = joined(head=4)
    large = SentRecord(0, (SentInsert("other", 1, bytes(COLLECTED_BYTES), 1),))
    (put,) = core.answered(asked.number, RecordsAnswer(1, JournalPlace(1, b"a" * 16), (large,), more=True), 0.0)
    assert isinstance(put, PutIn)


def test_a_slow_link_gets_smaller_messages_and_silence_longer_pauses() -> None:
    core = UpstreamCore(JournalPlace(), 3, 0.0)
    (join,) = core.link(True, 0.0)
    (asked,) = core.joined(join.number, 0.0)
    sizes, now = [asked.most_bytes], 0.0  # type: ignore[union-attr]
    for _ in range(4):
        core.silent(asked.number, True, now)
        assert core.tick(now + 0.05) == [], "after a pause"
        now += 1.5
        (asked,) = core.tick(now)
        sizes.append(asked.most_bytes)  # type: ignore[union-attr]
    assert sizes == [256 << 10, 64 << 10, 16 << 10, 4 << 10, 4 << 10]
    assert not core.connected
