"""A replica's thread: its upstream is played by a map in this process, and what fails on the thread is tried again."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from journal_ends import End, drive, pose

from factorbus.client import Unavailable
from factorbus.journal.problems import JournalUnreadable
from factorbus.journal.store import Store
from factorbus.proto.problems import Problem
from factorbus.proto.records import (
    JournalPlace,
    RecordsAnswer,
    decode_records_ask,
    decode_records_push,
    encode_records_answer,
)
from factorbus.service.config import BadConfig, Limits
from factorbus.service.journal.grafting import Graft, sent_records
from factorbus.service.journal.record_problems import OtherRecords
from factorbus.service.replica import core, running
from factorbus.service.replica.running import Replicas
from factorbus.service.replica.tail import JournalTail
from factorbus.service.solving.arrival import message_digest

PATIENCE_S = 60.0
Done = Callable[[Any], None]


class Played:
    """The bus of an upstream that has one map.  most: records in an answer."""

    def __init__(self, base: End, most: int = 256) -> None:
        self.base, self.most = base, most
        self.asked: list[str] = []

    def ask(self, key: str, payload: bytes, _timeout_s: float, done: Done) -> None:
        self.asked.append(key)
        try:
            done(self._answer(key, payload))
        except Problem as problem:
            done(problem)

    def close(self) -> None:
        """Nothing is open."""

    def _answer(self, key: str, payload: bytes) -> bytes:
        base = self.base
        if key.endswith("/create"):
            return b"\x80"
        if key.endswith("/robot1"):
            push = decode_records_push(payload, message_digest, 1 << 30)
            done = base.graft(Graft(push.after, push.records))
            return encode_records_answer(RecordsAnswer(1, JournalPlace(done.last.record, done.last.chain)))
        asked, end = decode_records_ask(payload, Limits().message()), base.place()
        after = asked.after.record
        here = base.records()
        chain = here[after - 1].chain if 0 < after <= end.record else bytes(16)
        if after > end.record or chain != asked.after.chain:
            raise OtherRecords("m", end.record, after)
        named = frozenset(asked.named)
        records, last, more = sent_records(here[after:], named, asked.most_bytes, self.most)
        place = end if last is None else JournalPlace(last.record, last.chain)
        return encode_records_answer(RecordsAnswer(1, place, records, more))


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[tuple[End, End]]:
    robot, base = End(tmp_path / "robot"), End(tmp_path / "base")
    yield robot, base
    robot.close()
    base.close()


class Following:
    """The thread, at work."""

    def __init__(self, robot: End, upstream: Any) -> None:
        self.robot = robot
        self.replicas = Replicas("tcp/base:7447", "robot1", lambda: {"m": robot.host}, self._open)
        self._upstream = upstream

    def __enter__(self) -> "Following":
        return self

    def __exit__(self, *_: object) -> None:
        self.replicas.close()

    def _open(self, see: Callable[[bool], None]) -> Any:
        upstream = self._upstream(self) if callable(self._upstream) else self._upstream
        see(True)
        return upstream

    def until(self, look: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE_S
        while not look():
            assert time.monotonic() < end, self.replicas.row("m")
            self.replicas.tick()
            threading.Event().wait(0.01)  # the thread tells nobody what it has done


def level(robot: End, base: End) -> Callable[[], bool]:
    return lambda: robot.place() == base.place()


def test_a_journal_that_cannot_be_read_once_is_read_again(
    ends: tuple[End, End], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, base = ends
    monkeypatch.setattr(core, "REFUSED_S", 0.05)
    drive(robot, "x", 0, 5)
    after, faults = JournalTail.after, [JournalUnreadable(robot.folder, "too many open files"), ValueError("of no use")]

    def fails(tail: JournalTail, record: int) -> Any:
        if faults:
            raise faults.pop()
        return after(tail, record)

    monkeypatch.setattr(JournalTail, "after", fails)
    with Following(robot, Played(base)) as following:
        following.until(level(robot, base))
        assert faults == []
        following.until(lambda: following.replicas.row("m")["upstream"]["behind"] == 0)
        assert following.replicas.row("m")["upstream"]["code"] == ""


def test_what_is_written_while_following_begins_is_counted_once(
    ends: tuple[End, End], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, base = ends
    drive(robot, "x", 0, 5)
    records, grows = Store.records, threading.Event()

    def grown(store: Store, after: int = 0) -> Any:
        if threading.current_thread().name == "upstream" and not grows.is_set():
            grows.set()
            drive(robot, "x", 5, 8)
        return records(store, after)

    monkeypatch.setattr(Store, "records", grown)
    with Following(robot, Played(base)) as following:
        following.until(lambda: grows.is_set() and robot.place() == base.place())
        following.until(lambda: following.replicas.row("m")["upstream"]["behind"] == 0)


def test_what_comes_in_many_answers_is_put_in_once_and_named_inserts_are_found(ends: tuple[End, End]) -> None:
    """Both have the first ones, which are named; then each goes its own way."""
    robot, base = ends
    drive(robot, "x", 0, 6)
    robot.push_to(base, JournalPlace())
    drive(base, "y", 0, 20)
    drive(robot, "x", 6, 10)
    with Following(robot, Played(base, most=3)) as following:
        following.until(level(robot, base))
        following.until(lambda: following.replicas.row("m")["upstream"]["behind"] == 0)
        row = following.replicas.row("m")["upstream"]
    assert (row["rebased"], row["refused"], row["behind"]) == (1, 0, 0)


def test_why_there_is_no_upstream_is_said(
    ends: tuple[End, End], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, base = ends
    monkeypatch.setattr(running, "_OPENING_S", 0.01)
    nobody = Unavailable("the upstream at tcp/base:7447", 0.0, "nothing listens there")
    faults: list[Problem] = [BadConfig("Zenoh does not take certificate.json5")] * 3 + [nobody] * 3
    goes_on = threading.Event()

    def open_session(_: Following) -> Played:
        if faults and (len(faults) != 1 or goes_on.is_set()):
            raise faults.pop()
        if faults:
            raise faults[0]
        return Played(base)

    drive(robot, "x", 0, 2)
    with Following(robot, open_session) as following:
        following.until(lambda: "certificate" in following.replicas.row("m").get("upstream", {}).get("problem", ""))
        goes_on.set()
        following.until(level(robot, base))
        following.until(lambda: following.replicas.row("m")["upstream"]["problem"] == "")
    said = [record.message for record in caplog.records if "going on alone, and trying again" in record.message]
    assert ["nothing listens" in each for each in said] == [True, False], "each once"


def test_what_a_map_that_is_gone_had_asked_is_not_gone_on_with(ends: tuple[End, End]) -> None:
    robot, base = ends
    drive(robot, "x", 0, 2)
    waiting: list[Done] = []

    class Late(Played):
        def ask(self, key: str, payload: bytes, timeout_s: float, done: Done) -> None:
            if key.endswith("/create"):
                waiting.append(done)
            else:
                super().ask(key, payload, timeout_s, done)

    late, hosts = Late(base), {"m": robot.host}
    replicas = Replicas("tcp/base:7447", "robot1", lambda: hosts, lambda see: (see(True), late)[1])
    try:
        following = Following.__new__(Following)
        following.replicas, following.robot = replicas, robot
        following.until(lambda: bool(waiting))
        hosts.clear()
        following.until(lambda: replicas.row("m") == {})
        waiting[0](b"\x80")
        hosts["m"] = robot.host
        following.until(lambda: len(waiting) == 2)
        assert late.asked == []
        waiting[1](b"\x80")
        following.until(level(robot, base))
    finally:
        replicas.close()
    assert isinstance(base.insert("tablet", pose("y", 0)), object)


def test_how_far_an_upstream_made_anew_is_behind(ends: tuple[End, End], tmp_path: Path) -> None:
    """It has nothing of what the one before had, so all of it is to be sent once more."""
    robot, base = ends
    drive(robot, "x", 0, 5)
    anew, said = End(tmp_path / "anew"), list[int]()
    played = Played(base)
    try:
        with Following(robot, played) as following:

            def behind() -> int:
                return following.replicas.row("m")["upstream"]["behind"]

            following.until(lambda: level(robot, base)() and behind() == 0)
            ask = played.ask

            def heard(key: str, payload: bytes, timeout_s: float, done: Done) -> None:
                if key.endswith("/robot1"):
                    said.append(behind())
                ask(key, payload, timeout_s, done)

            played.base, played.ask = anew, heard  # type: ignore[method-assign]
            following.until(lambda: level(robot, anew)() and behind() == 0)
        assert said[0] == 5, "before the first of it is sent"
    finally:
        anew.close()
