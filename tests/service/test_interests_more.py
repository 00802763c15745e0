"""Interests where something is late, lost or too large: who waits for what, what is said of it, and nobody starves."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from interests import Follower, Service, World, groups, part

from factorbus.proto.interest import Interest, filter_of
from factorbus.proto.interest_codec import AskInterest, decode_interest_answer, decode_interest_delta
from factorbus.proto.messages import Delta
from factorbus.proto.problems import TooLarge, UnknownMap
from factorbus.proto.symbols import symbol
from factorbus.service.config import Limits
from factorbus.service.core.events import Follow, Refuse
from factorbus.service.interests import marks as marks_module
from factorbus.service.interests.core import FetchEstimate, InterestCore
from factorbus.service.interests.marks import InterestMarks, Rows
from factorbus.service.interests.tables import InterestTables

FAST = Interest(period_ms=10)
FOLLOWS = {"epoch": 7, "revision": 0, "converged": True, "converging": False}


def drive(count: int, first: int = 0, y: float = 0.0) -> dict[tuple[str, int], tuple[float, ...]]:
    return {("se2", symbol("x", i)): (float(i), y, 0.5) for i in range(first, first + count)}


def following(service: Service, interest: Interest) -> Follower:
    follower = service.join(interest)
    service.ask(follower)
    service.ask(follower)
    return follower


class Slow(Service):
    """Its solver takes its time to copy: `release` has it done."""

    fetches: list[FetchEstimate]

    def perform(self, effects: Iterable[Any]) -> None:
        self.fetches = getattr(self, "fetches", [])
        for effect in effects:
            if isinstance(effect, FetchEstimate):
                self.fetches.append(effect)
            else:
                super().perform([effect])

    def release(self, revision: int | None = None) -> None:
        world, revision = self.world, self.world.revision if revision is None else revision
        values = groups(world.history[revision])
        self.perform(self.core.copied(self.fetches.pop(0), world.epoch, revision, values, self.now))


@pytest.fixture
def slow() -> tuple[World, Slow, Follower]:
    world = World()
    service = Slow(world)
    service.step(world.step(drive(10)))
    follower = service.join(FAST)
    service.ask(follower)
    service.release()
    service.ask(follower)
    service.wait(5.0)
    assert follower.values == world.values
    return world, service, follower


def test_an_estimate_that_is_missing_is_fetched_once_a_second(slow: tuple[World, Slow, Follower]) -> None:
    world, service, _ = slow
    service.core.lose()
    for n in range(30):
        service.step(world.step({("se2", symbol("x", 1)): (float(n), 0.0, 0.0)}))
        service.wait(0.01)
    assert len(service.fetches) == 1
    service.wait(2.0)
    assert len(service.fetches) == 3


def test_while_the_first_copy_is_on_its_way_nothing_is_due_until_nobody_counts_on_it() -> None:
    """What is due at once again and again keeps a core busy."""
    world = World()
    service = Slow(world)
    service.ask(service.join(FAST))
    for _ in range(30):
        service.wait(1.0)
    due = service.core.next_due(service.now)
    assert due is not None
    assert due > service.now + 10.0
    assert service.core.listening
    service.wait(60.0)
    assert not service.core.listening


def test_a_copy_that_comes_too_late_is_not_used_but_asked_for_again() -> None:
    world = World()
    service = Slow(world)
    follower = service.join(FAST)
    service.ask(follower)
    service.wait(100.0)
    service.step(world.step(drive(3)))  # which nobody listens to
    service.release(revision=0)
    assert follower.asking
    assert service.core.listening
    service.release()
    service.ask(follower)
    assert follower.values == world.values


def test_a_delta_that_does_not_follow_waits_for_the_copy_that_it_goes_on_from(
    slow: tuple[World, Slow, Follower],
) -> None:
    world, service, follower = slow
    world.step(drive(10, 10))  # this one is lost
    service.step(world.step(drive(10, 20)))
    service.release(world.revision - 1)
    service.wait(0.1)
    assert follower.values == world.values


def test_there_is_no_new_interest_where_there_is_no_memory() -> None:
    asked = []

    def check(size: int) -> None:
        asked.append(size)
        raise TooLarge("memory", size, 0, "bytes")

    core = InterestCore("m", Limits(), lambda: 1, check)
    asker = object()
    (fetch,) = core.asked(Follow(asker, AskInterest(FAST), FOLLOWS), 0.0)
    assert isinstance(fetch, FetchEstimate)
    (refused,) = core.copied(fetch, 7, 1, groups(drive(10)), 0.0)
    assert isinstance(refused, Refuse)
    assert refused.problem.code == "too_large"
    assert asked == [200]
    assert core.rows() == []


def waiting_asker(service: Service, world: World) -> Follower:
    """One whose answer is not paid for."""
    service.step(world.step(drive(100)))
    interest = Interest(bytes_per_s=1000)
    following(service, interest)
    late = following(service, interest)
    assert late.asking
    return late


def test_who_waits_when_the_interest_ends_is_to_ask_again() -> None:
    world = World()
    service = Service(world, interest_lease_s=0.2)
    late = waiting_asker(service, world)
    service.wait(0.3)
    assert not late.asking
    (problem,) = service.refused
    assert problem.code == "busy"
    assert "ended before" in problem.message


def test_who_waits_when_the_map_goes_is_told_so() -> None:
    world = World()
    service = Service(world)
    late = waiting_asker(service, world)
    service.perform(service.core.close(UnknownMap("m")))
    assert not late.asking
    assert [problem.code for problem in service.refused] == ["unknown_map"]
    assert len(service.ended) == 1
    assert (service.core.rows(), service.core.listening) == ([], False)


def test_those_who_always_ask_for_all_do_not_keep_messages_from_the_others() -> None:
    class Greedy(Follower):
        def question(self) -> AskInterest:
            return AskInterest(self.interest, True)

        def answered(self, message: bytes) -> None:
            self.asking = False

    world = World()
    service = Service(world)
    service.step(world.step(drive(200)))
    interest = Interest(bytes_per_s=2000, period_ms=100)
    honest = following(service, interest)
    greedy = [Greedy(interest) for _ in range(3)]
    for n in range(120):
        service.step(world.step(drive(5, 195, float(n))))
        for each in greedy:
            service.ask(each)
        service.wait(0.25)
    (row,) = service.core.rows()
    assert row["messages"] >= 5
    assert honest.values["se2", symbol("x", 199)][1] > 100


def test_where_more_has_gone_than_a_message_tells_all_is_told() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(420)))
    bound = 2000
    follower = following(service, Interest(bytes_per_s=bound, period_ms=10))
    service.settle()
    follower.deaf = 100
    service.step(world.without(list(drive(400))))
    service.wait(10.0)
    follower.deaf = 0
    service.sent.clear()
    service.step(world.step(drive(1, 410, 9.0)))
    service.settle()
    assert follower.values == world.values
    assert max(size for _, _, size in service.sent) <= bound


def test_what_is_no_more_and_was_forgotten_is_repaired_by_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(marks_module, "_MOST_REMOVED", 10)
    world = World()
    service = Service(world)
    service.step(world.step(drive(40)))
    follower = following(service, FAST)
    follower.deaf = 1
    service.step(world.without(list(drive(15))))
    service.wait(0.1)
    service.step(world.step(drive(1, 20, 3.0)))
    service.wait(0.1)
    assert not follower.following.live
    service.ask(follower)
    assert follower.values == world.values


def test_of_an_estimate_that_comes_anew_only_what_changed_is_sent() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(200)))
    follower = following(service, FAST)
    service.sent.clear()
    service.step(world.without([("se2", symbol("x", 7))]))
    service.wait(0.1)
    assert follower.values == world.values
    assert [size < 500 for *_, size in service.sent] == [True]


def test_what_has_gone_and_came_back_is_not_told_to_be_gone() -> None:
    """Both before anything was told of it, and to one who has missed that it was told."""
    world = World()
    service = Service(world)
    service.step(world.step(drive(10)))
    early, late = following(service, Interest(period_ms=1000)), following(service, FAST)
    service.step(world.step({("se2", symbol("x", 9)): (9.0, 1.0, 0.0)}))
    service.wait(0.01)
    late.deaf = 2
    service.step(world.without([("se2", symbol("x", 3))]))
    service.wait(0.02)
    service.step(world.step({("se2", symbol("x", 3)): (3.0, 5.0, 0.0)}))
    answers = []
    late.answered = lambda message: answers.append(decode_interest_answer(message))  # type: ignore[method-assign]
    service.wait(0.02)
    service.ask(late)
    (answer,) = answers
    assert answer.gone == ()
    assert [symbol("x", 3) in group.keys for group in answer.variables] == [True]
    service.wait(1.0)
    assert early.values == part(early.interest, world.values)


def test_what_came_back_and_was_brought_to_somebody_is_not_told_to_be_gone() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(10)))
    slow = Interest(period_ms=1000)
    following(service, slow)
    service.step(world.step({("se2", symbol("x", 9)): (9.0, 1.0, 0.0)}))
    service.wait(0.01)
    service.step(world.without([("se2", symbol("x", 3))]))
    service.step(world.step({("se2", symbol("x", 3)): (3.0, 5.0, 0.0)}))
    joined, messages = following(service, slow), []
    joined.hear = lambda _channel, message: messages.append(decode_interest_delta(message))  # type: ignore[method-assign]
    service.wait(1.1)
    (message,) = messages
    assert message.gone == ()
    assert [symbol("x", 3) in group.keys for group in message.variables] == [True]


def marked(values: dict[tuple[str, int], tuple[float, ...]]) -> tuple[InterestTables, InterestMarks]:
    tables, marks = InterestTables(), InterestMarks(filter_of(FAST))
    tables.replace(7, 1, groups(values))
    marks.look(tables, 0)
    return tables, marks


def oldest(rows: Rows, kind: str = "se2") -> int:
    return int(rows[kind][0])


ONE_OLD = 80 + 4 * 32 + 1  # bytes: three of the newest, and one of those that wait longest


def test_what_changes_again_while_it_waits_waits_since_the_first_time() -> None:
    tables, marks = marked(drive(20))
    marks.sent({"se2": np.delete(np.arange(20), 5)}, 1)
    tables.try_apply(Delta(7, 2, 1, groups(drive(20, 0, 1.0)), {}))
    marks.look(tables, 7)
    assert oldest(marks.choose(marks.stale(), tables, ONE_OLD)) == 5


def test_what_one_follower_is_owed_waits_since_it_is() -> None:
    tables, marks = marked(drive(20))
    marks.sent({"se2": np.arange(20)}, 1)
    tables.try_apply(Delta(7, 2, 1, groups(drive(1, 11, 1.0)), {}))
    marks.look(tables, 3)
    marks.given({}, {"se2": np.arange(10)}, 9)
    assert 11 in marks.choose(marks.stale(), tables, 80 + 32 + 1)["se2"]
    tables.try_apply(Delta(7, 3, 2, groups(drive(8, 12, 1.0)), {}))
    marks.look(tables, 10)
    assert oldest(marks.choose(marks.stale(), tables, ONE_OLD)) == 11


def test_where_kinds_do_not_fit_the_one_that_waits_longest_comes_first_and_then_poses() -> None:
    numbers = {("vector1", symbol("v", n)): (float(n),) for n in range(50)}
    tables, marks = marked({**numbers, ("point2", symbol("l", 0)): (1.0, 2.0), **drive(50)})
    marks.sent({"vector1": np.arange(50), "se2": np.arange(50)}, 1)
    moved = {key: (each[0] + 1, *each[1:]) for key, each in (numbers | drive(50)).items()}
    tables.try_apply(Delta(7, 2, 1, groups(moved), {}))
    marks.look(tables, 4)
    assert set(marks.choose(marks.stale(), tables, 500)) == {"point2", "se2"}
    assert set(marks.choose(marks.stale(), tables, 400)) == {"point2"}


def test_whether_a_revision_has_converged_is_what_its_delta_said() -> None:
    tables = InterestTables()
    tables.replace(7, 1, groups(drive(2)))
    row = {"epoch": 7, "revision": 1, "converged": True, "converging": False}
    tables.learn(row)
    assert (tables.converged, tables.converging) == (True, False)
    tables.try_apply(Delta(7, 2, 1, groups(drive(1)), {"converged": False, "converging": True}))
    tables.learn(row | {"revision": 2})
    assert (tables.converged, tables.converging) == (False, True)
