"""Connecting, joining and ending: addresses, names, settings and threads, over real zenoh on a local socket."""

import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from faulty.service import MAP, Service, point, same

from factorbus.cli.process.bus import joined_when_there
from factorbus.client import Unavailable, connect
from factorbus.proto import codec
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.problems import BadEndpoint, BadName, BadSetting, TooLarge, UnknownMap


def test_nobody_there_is_said_within_the_time_given(endpoint: str) -> None:
    with pytest.raises(Unavailable, match=r"did not answer within 0.2 s; start a service there"):
        connect(endpoint, timeout_s=0.2)


def test_connecting_waits_for_a_service_that_comes_later(start: Callable[..., Service], endpoint: str) -> None:
    timer = threading.Timer(0.2, start)
    timer.start()
    with connect(endpoint, timeout_s=60) as bus, bus.map(MAP) as kitchen:
        assert kitchen.insert(point("l1", 1)).revision == 1
    timer.join()


def test_a_map_nobody_owns_is_unavailable(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    with connect(endpoint, timeout_s=0.3) as bus:
        with pytest.raises(UnknownMap, match="attic"):
            bus.map("attic", create=False)
        service.ask_fault = "silence"
        with pytest.raises(Unavailable, match=r"asked for its stats, did not answer.*nobody replies"):
            bus.map(MAP, mirror=False).stats()
        with pytest.raises(Unavailable, match="mirror=True"):
            _ = bus.map(MAP, mirror=False).estimate
        with pytest.raises(Unavailable, match=r"the mirror is stale"):
            bus.map(MAP)


def test_a_map_that_comes_while_it_is_looked_for_is_not_its_own_correction(
    start: Callable[..., Service], endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    start()
    with connect(endpoint, timeout_s=5) as bus:
        found = bus.maps()
        monkeypatch.setattr(bus, "maps", lambda _timeout_s: [replace(row, name="attic") for row in found])
        with pytest.raises(UnknownMap) as caught:
            bus.map("attic", create=False)
    assert "did you mean" not in caught.value.message


def test_who_waits_for_a_map_goes_on_when_it_comes_between_two_of_the_questions(
    start: Callable[..., Service], endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not there when it is asked, and there when those that are there are listed: `record` and `watch` wait on."""
    start()
    waited = list[float]()

    def stopped(seconds: float) -> bool:
        waited.append(seconds)
        return len(waited) > 1

    with connect(endpoint, timeout_s=5) as bus:
        monkeypatch.setattr(bus, "maps", lambda _timeout_s: [replace(bus.create(MAP), name="attic")])
        with joined_when_there(bus, "attic", stopped) as joined:
            assert joined is None
    assert len(waited) == 2


@pytest.mark.parametrize("bad", ["127.0.0.1:7447", "", "tcp", "tcp/"])
def test_an_address_that_cannot_be_read_is_refused_at_once(bad: str) -> None:
    with pytest.raises(BadEndpoint, match=r"tcp/127\.0\.0\.1:7447"):
        connect(bad)


@pytest.mark.parametrize("setting", [{"no/such/thing": 1}, {"mode": "king"}, {"mode": object()}])
def test_a_setting_the_bus_does_not_take_is_refused_at_once(endpoint: str, setting: dict[str, Any]) -> None:
    with pytest.raises(BadSetting, match=next(iter(setting))):
        connect(endpoint, settings=setting)


def test_a_setting_reaches_the_bus(start: Callable[..., Service], endpoint: str) -> None:
    start()
    with connect(endpoint, settings={"transport/link/tx/lease": 2000}) as bus:
        assert [row.name for row in bus.maps()] == [MAP]


def test_an_insert_the_bus_would_drop_is_refused_here_and_uses_up_no_number(
    start: Callable[..., Service], endpoint: str
) -> None:
    start()
    large = Batch((Variables("point2", np.arange(2_800_000), np.zeros((2_800_000, 2))),))
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        with pytest.raises(TooLarge, match="67200073 bytes, the limit is 67108864;"):
            kitchen.insert(large)
        assert kitchen.insert(point("l1", 1)).sequence == 1


@pytest.mark.parametrize("junk", [b"", b"\xc1", codec.encode_map({"epoch": 1, "revision": 2, "previous": 1})[:-1]])
def test_a_delta_nobody_can_read_costs_the_whole_estimate_and_no_more(
    start: Callable[..., Service], endpoint: str, junk: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    service = start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        kitchen.insert(point("l1", 1))
        whole = threading.Event()
        kitchen.estimate.on_delta(lambda delta: whole.set() if delta.previous == 0 else None)
        service.publish_raw(junk)
        service.step({2: (2, 2)})
        kitchen.estimate.wait_for(2)
        assert whole.wait(60)
        assert same(kitchen.estimate, service)
    assert "cannot follow after this delta" in caplog.text


def test_names_are_checked(start: Callable[..., Service], endpoint: str) -> None:
    with pytest.raises(BadName, match="client"):
        connect(endpoint, client="a/b")
    for given in ("my robot", "", "r" * 56):
        with pytest.raises(BadName, match=f"client name '{given}' will not do: wanted 1 to 55 of"):
            connect(endpoint, client=given)
    start()
    with connect(endpoint) as bus, pytest.raises(BadName, match="map"):
        bus.map("a b")


def test_closing_ends_the_wait_of_another_thread(start: Callable[..., Service], endpoint: str) -> None:
    start()
    with connect(endpoint) as bus, bus.map(MAP) as kitchen:
        kitchen.insert(point("l1", 1))
        ended: queue.Queue[str] = queue.Queue()

        def wait() -> None:
            try:
                kitchen.estimate.wait_for(9, timeout_s=600)
            except Unavailable as gone:
                ended.put(gone.message)

        waiting = threading.Thread(target=wait)
        waiting.start()
        bus.close()
        message = ended.get(timeout=60)
        # By the wait, or as it begins: whichever of the two threads is first.
        assert "closed here" in message or "this connection is closed" in message
        waiting.join()


def test_two_threads_insert_through_one_handle(start: Callable[..., Service], endpoint: str) -> None:
    service = start()
    with connect(endpoint) as bus, bus.map(MAP, window=4) as kitchen:

        def drive(start_at: int) -> None:
            for i in range(100):
                kitchen.send(point(f"l{start_at + i}", i))

        threads = [threading.Thread(target=drive, args=(at,)) for at in (0, 1000)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        kitchen.flush()
        kitchen.estimate.wait_for(200)
        assert same(kitchen.estimate, service)


def test_a_process_that_forgets_to_close_ends_all_the_same(start: Callable[..., Service], endpoint: str) -> None:
    start()
    code = (
        "from factorbus.client import connect, Draft\n"
        f"kitchen = connect({endpoint!r}).map({MAP!r})\n"
        "print(kitchen.insert(Draft().point2('l1', (1, 2))).revision, kitchen.estimate['l1'].tolist())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20, check=True)
    assert done.stdout == "1 [1.0, 2.0]\n"
