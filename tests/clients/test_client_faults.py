"""The client against a service that fails in every way the bus allows, over real zenoh on a local socket."""

import threading
import time
from collections.abc import Callable

import pytest
from faulty.service import MAP, Service, not_a_number, point, same

from factorbus.client import NoAnswerYet, Refused, Unavailable, connect, request_sender


def test_inserts_are_answered_and_seen_in_the_mirror(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    started = time.monotonic()
    with connect(endpoint, client="robot1") as bus, bus.map(MAP) as kitchen:
        accepted = kitchen.insert(point("l1", 1.5))
        assert (accepted.sequence, accepted.revision) == (1, 1)
        assert kitchen.estimate["l1"].tolist() == [1.5, 0]
        assert "l1" in kitchen.estimate
        assert "l2" not in kitchen.estimate
        assert len(kitchen.estimate) == 1
        assert kitchen.client.startswith("robot1-")
        pending_inserts = [kitchen.send(point(f"l{i}", i / 3)) for i in range(2, 200)]
        kitchen.flush()
        assert [pending_insert.result().sequence for pending_insert in pending_inserts] == list(range(2, 200))
        elapsed_s = time.monotonic() - started
        assert all(0 < pending_insert.round_trip_s <= elapsed_s for pending_insert in pending_inserts)
        kitchen.estimate.wait_for(199)
        assert same(kitchen.estimate, service)
        assert not kitchen.estimate.stale
        assert kitchen.estimate.age_s <= time.monotonic() - started
        assert kitchen.stats()["revision"] == 199
        assert [row.name for row in bus.maps()] == [MAP]
        with pytest.raises(KeyError, match="x7 is not in map 'kitchen'"):
            kitchen.estimate["x7"]


@pytest.mark.parametrize("fault", ["silence", "busy", "answer lost"])
def test_an_insert_is_sent_again_with_its_number_and_taken_once(
    start: Callable[..., Service], endpoint: str, fault: str
) -> None:
    service = start()
    service.faults.extend([fault, fault, "", fault])
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        assert kitchen.insert(point("l1", 1)).revision == 1
        assert kitchen.insert(point("l2", 2)).revision == 2
        assert service.revision == 2
        assert service.tries == {1: 3, 2: 2}
        assert same(kitchen.estimate, service)


def test_an_insert_nobody_answers_in_time_is_sent_again(
    start: Callable[..., Service], endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(request_sender, "TRY_S", 0.1)
    service = start()
    service.faults.append("hold")
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        assert kitchen.insert(point("l1", 1)).revision == 1
    assert service.tries[1] == 2


def test_inserts_that_overtook_are_sent_again_behind_the_first(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    service.faults.extend(["silence", "parked too long", "parked too long"])
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        pending_inserts = [kitchen.send(point(f"l{i}", i)) for i in range(3)]
        kitchen.flush()
        assert [pending_insert.result().revision for pending_insert in pending_inserts] == [1, 2, 3]
        assert same(kitchen.estimate, service)


def test_a_refusal_reaches_every_reader(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        with pytest.raises(Refused, match="NaN"):
            kitchen.insert(not_a_number("l1"))
        kitchen.flush()  # it has been seen
        kitchen.send(not_a_number("l1"))
        kitchen.send(point("l2", 2))
        with pytest.raises(Refused, match="NaN"):
            kitchen.flush()
        kitchen.flush()
        assert service.revision == 1
        assert kitchen.insert(point("l3", 3)).sequence == 4


def test_a_refusal_nobody_saw_comes_out_of_with(start: Callable[..., Service], endpoint: str) -> None:
    start()
    with connect(endpoint) as bus:
        kitchen = bus.map(MAP)
        with pytest.raises(Refused, match="NaN"), kitchen:
            kitchen.send(not_a_number("l1"))


def test_a_full_window_blocks_and_says_so(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    service.faults.extend(["hold", "hold"])
    with connect(endpoint) as bus:
        kitchen = bus.map(MAP, window=2)
        first = kitchen.send(point("l1", 1))
        kitchen.send(point("l2", 2))
        with pytest.raises(Unavailable, match=r"window=2.*not sent"):
            kitchen.send(point("l3", 3), timeout_s=0.05)
        with pytest.raises(NoAnswerYet) as caught:
            first.result(0.05)
        assert caught.value.pending_insert is first
        with pytest.raises(Unavailable, match="2 inserts without an answer"):
            kitchen.flush(0.05)
        with pytest.raises(Unavailable, match="closed first") as closing:
            kitchen.close()
        assert not closing.value.others  # that the first one had no answer was said before
        with pytest.raises(Unavailable, match="closed first"):
            first.result()
        with pytest.raises(Unavailable, match="open it again"):
            kitchen.send(point("l3", 3))


def test_a_lost_delta_is_noticed_by_the_next(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        heard: list[tuple[int, int]] = []
        kitchen.estimate.on_delta(lambda delta: heard.append((delta.previous, delta.revision)))
        service.step({1: (1, 1)})
        kitchen.estimate.wait_for(1)
        service.mute = True
        service.step({2: (2, 2)})
        service.mute = False
        service.step({3: (3, 3)})
        kitchen.estimate.wait_for(3)
        assert same(kitchen.estimate, service)
        assert heard == [(0, 1), (0, 3)]  # the second is the whole estimate


def test_a_lost_last_delta_is_noticed_by_asking(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    service.mute = True
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        accepted = kitchen.send(point("l1", 1)).result()
        assert kitchen.estimate.stale  # the answer told of a revision that is not here
        kitchen.estimate.wait_for(accepted.revision)
        assert same(kitchen.estimate, service)
        changed = threading.Event()
        kitchen.estimate.on_delta(lambda _: changed.set())
        service.step({5: (5, 5)})  # nobody tells: found by the mirror's own asking
        assert changed.wait(60)
        assert same(kitchen.estimate, service)


def test_a_late_delta_counts_although_the_estimate_was_asked_for(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        heard: list[tuple[int, int]] = []
        kitchen.estimate.on_delta(lambda delta: heard.append((delta.previous, delta.revision)))
        kitchen.insert(point("l1", 1))
        service.mute = True
        service.before_estimate = lambda: service.publish_last(service.values)
        assert kitchen.send(point("l2", 2)).result().revision == 2
        assert kitchen.estimate.stale
        kitchen.estimate.wait_for(2)
        assert service.before_estimate is None
        service.mute = False
        service.step({3: (3, 3)})
        kitchen.estimate.wait_for(3)
        assert heard == [(0, 1), (1, 2), (2, 3)]  # each is one step: no whole estimate, which would be (0, 2)
        assert same(kitchen.estimate, service)


def test_a_mirror_nobody_confirms_is_stale(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        kitchen.insert(point("l1", 1))
        service.ask_fault = "silence"
        with pytest.raises(Unavailable, match="revision 9"):
            kitchen.estimate.wait_for(9, timeout_s=0.5)
        assert kitchen.estimate.stale
        assert kitchen.estimate["l1"].tolist() == [1, 0]
        service.ask_fault = ""
        service.step({2: (2, 2)})
        kitchen.estimate.wait_for(2)
        assert same(kitchen.estimate, service)


def test_a_callback_that_raises_stops_nothing(
    start: Callable[..., Service], endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        forget = kitchen.estimate.on_delta(lambda _: 1 / 0)
        kitchen.insert(point("l1", 1))
        kitchen.insert(point("l2", 2))
        forget()
        assert kitchen.estimate.revision == 2
    assert "on_delta callback failed at revision 1" in caplog.text


def test_the_same_map_after_a_loss_of_the_link(start: Callable[..., Service], endpoint: str) -> None:
    """The service goes and comes back with its state: what was sent meanwhile arrives, once."""
    before = start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        kitchen.insert(point("l1", 1))
        before.close()
        pending_inserts = [kitchen.send(point(f"l{i}", i)) for i in range(2, 6)]
        with pytest.raises(NoAnswerYet):
            pending_inserts[0].result(0.3)
        assert kitchen.estimate.stale
        after = start()
        after.values, after.revision = before.values, before.revision
        after.answers, after.next = before.answers, before.next
        assert [pending_insert.result().sequence for pending_insert in pending_inserts] == [2, 3, 4, 5]
        kitchen.estimate.wait_for(5)
        assert same(kitchen.estimate, after)


def test_a_new_map_is_followed_but_not_written_to_until_joined(start: Callable[..., Service], endpoint: str) -> None:
    before = start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        kitchen.insert(point("l1", 1))
        before.close()
        after = start(epoch=2)
        with pytest.raises(Refused) as caught:
            kitchen.insert(point("l2", 2))
        assert (caught.value.code, caught.value.detail["epoch"]) == ("wrong_epoch", 2)
        after.step({9: (9, 9)})
        kitchen.estimate.wait_for(1)
        assert (kitchen.estimate.epoch, kitchen.epoch) == (2, 1)
        assert same(kitchen.estimate, after)
        assert kitchen.rejoin() == 2
        assert kitchen.insert(point("l2", 2)).sequence == 1
        assert same(kitchen.estimate, after)


def test_joining_anew_gives_up_what_was_not_answered(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    service.faults.append("hold")
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        pending_insert = kitchen.send(point("l1", 1))
        kitchen.rejoin()
        with pytest.raises(Unavailable, match="joined the map anew"):
            pending_insert.result()
        assert kitchen.insert(point("l2", 1)).sequence == 1
