"""Interests without a bus: the part that was asked for is published, at its rate, and no client keeps what left."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from interests import Follower, Service, World, part

from factorbus.proto.interest import Interest, channel_of, filter_of
from factorbus.proto.problems import Busy, TooLarge
from factorbus.proto.symbols import symbol
from factorbus.service.interests.stream import CARRIED_BYTES
from factorbus.service.operations.metrics import of_interests

FAST = Interest(period_ms=10)
INTERESTS = (
    FAST,
    Interest(letters="x", period_ms=50),
    Interest(box=(-5.0, -5.0, 5.0, 5.0), period_ms=20),
    Interest(kinds=("se2", "point2"), box=(0.0, -9.0, -9.0, 9.0, 9.0, 9.0), period_ms=1000),
    Interest(letters=("x", ""), box=(-5.0, -5.0, 5.0, 5.0), period_ms=100, bytes_per_s=1500),
    Interest(period_ms=500, bytes_per_s=1000),
)
numbers = st.floats(-10, 10, width=16)


def pose(x: float, y: float = 0.0) -> tuple[float, ...]:
    return (x, y, 0.5)


@st.composite
def changes(draw: st.DrawFn) -> dict[tuple[str, int], tuple[float, ...]]:
    found = {}
    for _ in range(draw(st.integers(1, 12))):
        kind, size = draw(st.sampled_from([("se2", 3), ("se3", 7), ("point2", 2), ("vector1", 1)]))
        key = symbol(draw(st.sampled_from(["x", "l", ""])), draw(st.integers(0, 20)))
        found[kind, key] = tuple(draw(numbers) for _ in range(size))
    return found


ACTIONS = st.one_of(
    st.tuples(st.just("step"), changes()),
    st.tuples(st.just("remove"), st.integers(0, 9)),
    st.tuples(st.just("wait"), st.sampled_from([0.004, 0.05, 0.4, 1.5])),
    st.tuples(st.just("ask"), st.integers(0, 7)),
    st.tuples(st.just("join"), st.sampled_from(INTERESTS)),
    st.tuples(st.just("miss"), st.integers(0, 7)),
    st.tuples(st.just("lose"), st.none()),
    st.tuples(st.just("anew"), st.none()),
)


def check(service: Service, follower: Follower) -> None:
    """What a mirror has is the part of the estimate at its revision; what waits may be older."""
    following, world = follower.following, service.world
    if not following.live or following.epoch != world.epoch:
        return
    if not following.waiting:
        assert follower.values == part(follower.interest, world.history[following.revision])
    for key, value in follower.values.items():
        assert any(values.get(key) == value for values in world.history[: following.revision + 1])


@settings(max_examples=300)
@given(actions=st.lists(ACTIONS, max_size=40))
def test_a_mirror_has_the_part_of_the_estimate_at_its_revision_at_all_times(actions: list) -> None:
    world = World()
    service = Service(world)
    service.ask(service.join(FAST))
    for word, what in actions:
        if word == "step":
            service.step(world.step(what))
        elif word == "remove" and world.values:
            service.step(world.without([each for n, each in enumerate(world.values) if (n + what) % 3 == 0]))
        elif word == "wait":
            service.wait(what)
        elif word == "ask":
            service.ask(service.followers[what % len(service.followers)])
        elif word == "join" and len(service.followers) < 8:
            service.ask(service.join(what))
        elif word == "miss":
            service.followers[what % len(service.followers)].deaf += 1
        elif word == "lose":
            service.core.lose()
        elif word == "anew":
            world.begin_anew()
        for follower in service.followers:
            check(service, follower)
    for follower in service.followers:
        follower.deaf = 0
    service.step(world.step({("se2", symbol("x", 1)): pose(1.0)}))
    service.settle()
    for follower in service.followers:
        assert service.has_all(follower)
        assert follower.values == part(follower.interest, world.values)


def following(service: Service, interest: Interest) -> Follower:
    """A client that follows, with all there is."""
    follower = service.join(interest)
    service.ask(follower)
    service.ask(follower)
    return follower


def drive(world: World, count: int, first: int = 0) -> dict[tuple[str, int], tuple[float, ...]]:
    return {("se2", symbol("x", i)): pose(float(i)) for i in range(first, first + count)}


def test_what_leaves_the_box_is_told_to_have_left() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(world, 10)))
    near = following(service, Interest(box=(0, -1, 4, 1), period_ms=10))
    assert sorted(near.values) == [("se2", symbol("x", i)) for i in range(5)]
    service.step(world.step({("se2", symbol("x", 0)): pose(20.0), ("se2", symbol("x", 9)): pose(2.5)}))
    service.wait(0.02)
    assert sorted(near.values) == sorted([*(("se2", symbol("x", i)) for i in range(1, 5)), ("se2", symbol("x", 9))])


def test_changes_of_a_period_are_one_message_with_the_last_values() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(world, 3)))
    follower = following(service, Interest(period_ms=1000))
    service.step(world.step({("se2", symbol("x", 0)): pose(0.5)}))
    service.wait(0.01)
    for n in range(100):
        service.step(world.step({("se2", symbol("x", 1)): pose(float(n))}))
        service.wait(0.005)
    assert len(service.sent) == 2, "the answer, and the first change, which nothing went before"
    service.wait(1.0)
    assert len(service.sent) == 3
    assert follower.values["se2", symbol("x", 1)] == pose(99.0)


def test_what_is_in_no_interest_is_not_sent() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(world, 3)))
    follower = following(service, Interest("l", period_ms=10))
    for n in range(5):
        service.step(world.step({("se2", symbol("x", 1)): pose(float(n))}))
        service.wait(0.1)
    assert service.sent == []
    service.ask(follower)
    assert follower.following.revision == world.revision, "and the answer says that nothing is missing"


@pytest.mark.parametrize("bound", [1000, 3000, 20_000])
def test_any_second_carries_the_bound_and_one_message_at_most(bound: int) -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(world, 400)))
    interest = Interest(period_ms=100, bytes_per_s=bound)
    followers = [following(service, interest) for _ in range(3)]
    for n in range(60):
        service.step(world.step(drive(world, 400, n * 5)))
        service.wait(0.13)
        if n % 20 == 7:
            followers[n % 3].deaf = 1
        for follower in followers:
            if not follower.following.live:
                service.ask(follower)
    times, sizes = np.array([at for at, *_ in service.sent]), np.array([size for *_, size in service.sent])
    assert len(times) > 8
    for begin in times:
        inside = sizes[(times >= begin) & (times < begin + 1.0)]
        assert inside.sum() <= bound + inside.max()
    used = sizes.sum() / (times[-1] - times[0])
    assert used > 0.8 * bound, "and what there is room for is used"


def test_where_the_bound_does_not_suffice_the_newest_poses_come_first_and_the_mirror_says_what_waits() -> None:
    world = World()
    service = Service(world)
    follower = following(service, Interest(period_ms=100, bytes_per_s=2000))
    for n in range(3):
        service.step(world.step(drive(world, 300)))
        service.wait(1.0)
        newest = symbol("x", 299)
        assert ("se2", newest) in follower.values
        assert follower.following.waiting > 0
        world.values = {each: (value[0] + n, *value[1:]) for each, value in world.values.items()}
    assert 0 < len(follower.values) < 300
    oldest = [symbol("x", i) for i in range(5)]
    assert all(("se2", key) in follower.values for key in oldest), "those that wait longest have their share"
    service.settle()
    assert follower.values == part(follower.interest, world.history[-1])


def test_a_message_that_was_missed_is_asked_for_and_nothing_else() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(world, 200)))
    follower = following(service, FAST)
    service.step(world.step({("se2", symbol("x", 7)): pose(70.0)}))
    follower.deaf = 1
    service.wait(0.1)
    service.step(world.step({("se2", symbol("x", 8)): pose(80.0)}))
    service.wait(0.1)
    assert not follower.following.live
    service.sent.clear()
    service.ask(follower)
    assert (follower.following.live, follower.values == world.values) == (True, True)
    ((_, _, size),) = service.sent
    assert size < 500


def test_equal_interests_share_a_channel_and_others_do_not() -> None:
    world = World()
    service = Service(world)
    one = following(service, Interest(letters=("x", "l"), box=(0, 0, 1, 1)))
    two = following(service, Interest(letters="lxl", box=(-0.0, 0, 1.0, 1)))
    three = following(service, Interest(letters="lx", box=(0, 0, 1, 1), period_ms=99))
    assert one.following.channel == two.following.channel != three.following.channel
    assert len(service.core.rows()) == 2
    assert channel_of(one.interest) == one.following.channel


def test_a_client_that_is_gone_without_a_word_costs_nothing_after_its_lease() -> None:
    world = World()
    service = Service(world, interest_lease_s=5.0)
    gone, stays = following(service, FAST), following(service, Interest("x"))
    service.wait(4.0)
    service.ask(stays)
    service.wait(4.0)
    assert service.ended == [gone.following.channel]
    service.wait(10.0)
    assert len(service.ended) == 2
    assert not service.core.listening
    service.step(world.step(drive(world, 3)))
    assert service.core.next_due(service.now) is None


def test_a_map_without_interests_is_not_listened_to_and_copied_once_for_all_of_them() -> None:
    world = World()
    service = Service(world)
    assert not service.core.listening
    for letter in "abc":
        following(service, Interest(letter))
    assert service.copies == 1


def test_one_more_interest_than_the_limit_is_refused() -> None:
    service = Service(World(), interests=2)
    for letter in "ab":
        following(service, Interest(letter))
    refused = service.join(Interest("c"))
    service.ask(refused)
    (problem,) = service.refused
    assert isinstance(problem, TooLarge)
    assert "limits.interests" in problem.message


def test_those_who_wait_for_their_answer_are_a_few_and_the_others_are_to_come_back() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(world, 100)))
    interest = Interest(bytes_per_s=1000)
    followers = [service.join(interest) for _ in range(8)]
    for follower in followers:
        service.ask(follower)
        service.ask(follower)
    assert [type(problem) for problem in service.refused] == [Busy] * 3
    assert service.refused[0].detail["retry_after_s"] > 0
    for follower in followers:
        service.ask(follower)
    service.settle()
    assert all(follower.values == world.values for follower in followers)


def test_positions_are_those_of_each_kind() -> None:
    mask = filter_of(Interest(box=(0, 0, 0, 10, 10, 10))).mask
    one = np.array([1])
    assert mask("se2", one, np.array([[1.0, 1.0, -9.0]])).all(), "an angle is no coordinate"
    assert not mask("se3", one, np.array([[1.0, 1.0, -1.0, 0, 0, 0, 1]])).any()
    assert not mask("so3", one, np.array([[0.0, 0, 0, 1]])).any(), "what has no place is in no box"
    straight = [1.0, 1.0, 0.0, 0.0, 0.0]
    assert mask("idp", one, np.array([[*straight, 0.2]])).all(), "5 m ahead"
    assert not mask("idp", one, np.array([[*straight, 0.05]])).any(), "20 m ahead"
    assert not mask("idp", one, np.array([[*straight, 0.0]])).any(), "at infinity"


def test_what_carries_a_message_is_counted() -> None:
    world = World()
    service = Service(world)
    follower = following(service, FAST)
    service.step(world.step(drive(world, 1)))
    service.wait(0.1)
    (row,) = service.core.rows()
    answers = row["bytes"] - sum(size for *_, size in service.sent)
    assert (row["channel"], row["messages"]) == (follower.following.channel, 1)
    assert 0 < answers - CARRIED_BYTES < 300
    assert math.isclose(row["period_ms"], 10)


def test_metrics_count_interests_by_map() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(world, 3)))
    for letter in "ab":
        following(service, Interest(letter))
    rows = [{"map": "m", **row} for row in service.core.rows()]
    samples = {family.name: family.samples for family in of_interests(rows)}
    assert samples["map_interests"] == [(("m",), 2)]
    assert samples["map_interest_bytes"] == [(("m",), sum(row["bytes"] for row in rows))]
    assert samples["map_interest_waiting"] == [(("m",), 0)]


def test_who_missed_that_something_left_is_told_so() -> None:
    world = World()
    service = Service(world)
    service.step(world.step(drive(world, 5)))
    follower = following(service, Interest(box=(0, -1, 9, 1), period_ms=10))
    follower.deaf = 1
    service.step(world.step({("se2", symbol("x", 2)): pose(50.0)}))
    service.wait(0.1)
    assert ("se2", symbol("x", 2)) in follower.values
    service.ask(follower)
    assert follower.values == part(follower.interest, world.values)
