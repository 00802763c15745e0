"""A client that waits for a map to converge, against a service that does what it is told, over real zenoh."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from faulty.service import MAP, Service, endpoint_in, not_a_number

from factorbus.client import Draft, Map, NotConverged, Refused, Unavailable, aio, connect

# What reports and stats say: not there yet; there to a thousandth, and on the way to the optimum; at it.
CONVERGING = {"converged": False, "converging": True}
POLISHED = {"converged": True, "converging": True}
DONE = {"converged": True, "converging": False}


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    running = Service(tmp_path)
    yield running
    running.close()


@pytest.fixture
def kitchen(service: Service, tmp_path: Path) -> Iterator[Map]:
    with connect(endpoint_in(tmp_path), client="robot1") as bus, bus.map(MAP) as joined:
        yield joined


def point(n: int) -> Draft:
    return Draft().point2(f"l{n}", (n, 0))


def in_background(call: Callable[[], None]) -> tuple[threading.Thread, list[BaseException | None]]:
    """`call` on a thread of its own, and what came of it."""
    came: list[BaseException | None] = []

    def run() -> None:
        try:
            call()
            came.append(None)
        except BaseException as problem:
            came.append(problem)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, came


def test_it_returns_with_the_delta_that_says_so(service: Service, kitchen: Map) -> None:
    service.report = service.says = CONVERGING
    kitchen.insert(point(1))
    assert kitchen.estimate.converged is False
    thread, came = in_background(lambda: kitchen.wait_converged(50))
    for _ in range(20):
        service.step({1: (1.0, 2.0)})
    assert thread.is_alive()
    service.report = service.says = POLISHED
    service.step({1: (1.0, 2.5)})
    kitchen.estimate.wait_for(service.revision, 50)
    assert (kitchen.estimate.converged, kitchen.estimate.converging) == (True, True)
    assert thread.is_alive(), "more is to follow"
    service.says = service.report = DONE
    service.step({1: (1.0, 3.0)})
    thread.join(50)
    assert came == [None]
    assert kitchen.estimate.converged is True
    assert kitchen.estimate.revision == service.revision == 23
    kitchen.wait_converged(0.0)


@pytest.mark.parametrize("how", [CONVERGING, POLISHED, DONE])
def test_a_fresh_mirror_knows_what_the_service_does(service: Service, tmp_path: Path, how: dict[str, bool]) -> None:
    service.step({1: (1.0, 2.0)})
    service.says = how
    with connect(endpoint_in(tmp_path)) as bus:
        for create in (True, False):
            with bus.map(MAP, create=create) as joined:
                assert joined.estimate.revision == 1
                assert {"converged": joined.estimate.converged, "converging": joined.estimate.converging} == how


def test_a_mirror_that_is_told_of_another_revision_asks(service: Service, tmp_path: Path) -> None:
    """The map went on between the answer that let it in and the estimate: nothing that it was told is of this one."""
    service.says = CONVERGING
    asked = service.answered

    def step_first(question: str, payload: bytes) -> bytes | None:
        if question == "estimate" and service.revision == 0:
            service.mute, service.says = True, DONE
            service.step({1: (1.0, 2.0)})
            service.mute = False
        return asked(question, payload)

    service.answered = step_first
    with connect(endpoint_in(tmp_path)) as bus, bus.map(MAP) as joined:
        joined.wait_converged(50)
        assert (joined.estimate.revision, joined.estimate.converged) == (1, True)


def test_when_time_is_up_it_says_where_the_map_is(service: Service, kitchen: Map) -> None:
    service.report = service.says = CONVERGING
    kitchen.insert(point(1))
    with pytest.raises(
        NotConverged, match=r"not converged to its optimum at revision 1 after .* wait longer"
    ) as problem:
        kitchen.wait_converged(0.3)
    assert (problem.value.code, problem.value.detail["revision"]) == ("not_converged", 1)


def test_a_map_that_gave_up_is_not_waited_for(service: Service, kitchen: Map) -> None:
    service.report = CONVERGING
    service.says = {"converged": False, "converging": False, "gave_up": "3 further steps in a row changed nothing"}
    kitchen.insert(point(1))
    with pytest.raises(NotConverged, match="goes on no more by itself: 3 further steps") as problem:
        kitchen.wait_converged(50)
    assert problem.value.detail["gave_up"] == service.says["gave_up"]
    service.says = service.report = DONE
    kitchen.insert(point(2))
    kitchen.wait_converged(50)


def test_a_map_that_has_converged_and_gave_up_to_be_polished_is_as_good_as_it_gets(
    service: Service, kitchen: Map
) -> None:
    service.report = POLISHED
    service.says = DONE | {"gave_up": "20 further steps in a row did not lower χ²"}
    kitchen.insert(point(1))
    assert kitchen.estimate.converging is True
    kitchen.wait_converged(50)
    assert kitchen.estimate.converging is False
    assert kitchen.stats()["gave_up"] == "20 further steps in a row did not lower χ²", "how the caller learns of it"


@pytest.mark.parametrize("converged", [True, False])
def test_who_joins_later_is_told_with_the_estimate(service: Service, tmp_path: Path, converged: bool) -> None:
    """Only deltas carry a report; a mirror that began with the whole estimate has seen none."""
    service.step({1: (1.0, 2.0)})
    service.says = {"converged": converged, "converging": False, "gave_up": "" if converged else "it is told to"}
    with connect(endpoint_in(tmp_path), client="late") as bus, bus.map(MAP) as joined:
        assert joined.estimate.converged is converged
        if converged:
            joined.wait_converged(0)
        else:
            with pytest.raises(NotConverged, match="it is told to"):
                joined.wait_converged(50)


def test_what_the_stats_say_of_another_revision_does_not_count(service: Service, kitchen: Map) -> None:
    service.report = CONVERGING
    kitchen.insert(point(1))
    service.says = DONE
    service.mute = True
    service.step({1: (1.0, 2.0)})  # its delta is lost
    kitchen.wait_converged(50)
    assert kitchen.estimate.revision == 2


def test_what_was_sent_is_waited_for_first(service: Service, kitchen: Map) -> None:
    service.report = service.says = DONE  # the latter where a mirror that missed a delta asks
    kitchen.insert(point(1))
    service.faults.append("hold")
    kitchen.send(point(2))
    with pytest.raises(Unavailable, match="1 insert without an answer"):
        kitchen.wait_converged(0.2)
    kitchen.wait_converged(50)
    assert kitchen.estimate.revision == 2
    refused = kitchen.send(not_a_number("l3"))
    with pytest.raises(Refused):
        kitchen.wait_converged(50)
    assert refused.done()


def test_a_closed_map_ends_the_wait(service: Service, kitchen: Map) -> None:
    service.report = service.says = CONVERGING
    kitchen.insert(point(1))
    thread, came = in_background(lambda: kitchen.estimate.wait_converged(50))
    kitchen.close()
    thread.join(50)
    assert isinstance(came[0], Unavailable)


def test_without_a_mirror_there_is_nothing_to_wait_at(service: Service, tmp_path: Path) -> None:
    with connect(endpoint_in(tmp_path), client="robot1") as bus, bus.map(MAP, mirror=False) as joined:
        joined.insert(point(1))
        with pytest.raises(Unavailable, match="mirror=True"):
            joined.wait_converged(50)


def test_the_row_says_that_it_is_converging(service: Service, kitchen: Map, tmp_path: Path) -> None:
    with connect(endpoint_in(tmp_path), client="robot1") as bus:
        assert [row.converging for row in bus.maps()] == [False], "a service that does not say"
        service.says = {"converging": True}
        assert [row.converging for row in bus.maps()] == [True]


def test_with_asyncio_the_same(service: Service, tmp_path: Path) -> None:
    async def drive() -> None:
        async with aio.connect(endpoint_in(tmp_path), client="robot1") as bus, bus.map(MAP) as joined:
            service.report = service.says = CONVERGING
            await joined.insert(point(1))
            with pytest.raises(NotConverged):
                await joined.wait_converged(0.2)
            waiting = asyncio.create_task(joined.wait_converged(50))
            service.report = service.says = DONE
            service.step({1: (1.0, 2.0)})
            await waiting
            assert joined.estimate.revision == 2

    asyncio.run(drive())


def test_a_word_of_an_older_revision_does_not_count(service: Service, kitchen: Map) -> None:
    """The stats were on their way when the delta came."""
    service.report = CONVERGING
    kitchen.insert(point(1))
    service.says = {"revision": 0, **DONE}
    with pytest.raises(NotConverged):
        kitchen.wait_converged(0.5)
    assert service.asked.count("stats") > 0


def test_of_a_revision_without_a_report_nothing_is_known(service: Service, kitchen: Map) -> None:
    service.report = DONE
    kitchen.insert(point(1))
    assert kitchen.estimate.converged is True
    service.mute = True
    service.step({1: (1.0, 2.0)})  # its delta is lost, and the whole estimate asked for
    kitchen.estimate.wait_for(2, 50)
    assert kitchen.estimate.converged is None
