"""What is given to the client and is of another type, or comes when all is closed: refused by name, nothing is sent."""

import asyncio
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from faulty.service import MAP, Service, endpoint_in

from factorbus.client import Bus, Changes, Draft, Map, Unavailable, aio, connect
from factorbus.client.changes import some_of
from factorbus.client.draft import batch_of
from factorbus.client.merging import fit_into
from factorbus.client.uncertainty import factors_of
from factorbus.proto.messages import Accepted, Batch, Estimate, MapGraph
from factorbus.proto.problems import BadOption, BadShape, ClosedHere

pytestmark = pytest.mark.timeout(60)

ANY: Any = "no"  # a str, whatever the signature says
POINT = Draft().point2("l1", (1, 0))


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    running = Service(tmp_path)
    yield running
    running.close()


@pytest.fixture
def bus(service: Service, tmp_path: Path) -> Iterator[Bus]:
    with connect(endpoint_in(tmp_path), client="robot1") as connected:
        yield connected


@pytest.fixture
def kitchen(bus: Bus) -> Iterator[Map]:
    with bus.map(MAP) as joined:
        yield joined


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: Draft().se2("x0", (0, 0, 0), fixed=ANY), "se2 x0: fixed: 'no' (str); wanted True or False"),
        (lambda: Draft().se2("x0", fixed=cast("Any", 1)), "se2 x0: fixed: 1 (int); wanted True or False"),
        (lambda: Draft().point_seen("x0", "l1", ANY, (1, 2)), "camera: 'no' (str); wanted a Camera"),
        (lambda: Changes().undo(cast("Any", 1), ANY), "changes: undo: 1 (int); wanted a Draft or a Batch"),
        (lambda: Changes().undo(POINT, cast("Any", 2)), "undo: 2 (int); wanted the answer to the insert, an Accepted"),
        (lambda: Changes().remove_variables("x1", alone=ANY), "changes: alone: 'no' (str); wanted True or False"),
        (lambda: Changes().place((), carry=ANY), "changes: carry: 'no' (str); wanted True or False"),
        (lambda: Changes().place(cast("Any", 3)), "changes: place: 3 (int); wanted groups of variables"),
        (lambda: Changes().place(cast("Any", [POINT])), "place: an object of type Draft; wanted groups of variables"),
        (lambda: Changes().adopt(ANY), "changes: adopt: 'no' (str); wanted an answer of chi2(batch=True"),
        (lambda: Changes().repair(ANY), "changes: repair: 'no' (str); wanted an answer of `Map.repair`"),
        (lambda: factors_of(ANY), "candidates: 'n' (str); wanted a Draft, a Batch, or a sequence of Factors"),
        (lambda: factors_of(cast("Any", None)), "candidates: None (NoneType); wanted a Draft, a Batch"),
        (
            lambda: fit_into(Estimate(1, 1, ()), MapGraph(1, 1, Batch()), anchors=ANY),
            "anchors: 'no' (str); wanted a Draft or a Batch",
        ),
        (lambda: connect("tcp/127.0.0.1:1", timeout_s=ANY), "timeout_s: 'no' (str); wanted seconds"),
        (lambda: connect("tcp/127.0.0.1:1", listening_s=-1), "listening_s: -1 (int); wanted seconds"),
    ],
)
def test_without_a_bus(call: Callable[[], object], said: str) -> None:
    with pytest.raises(BadOption) as refused:
        call()
    assert said in refused.value.message


@pytest.mark.parametrize(
    "put_together",
    [
        lambda c: c.fix(),
        lambda c: c.free([]),
        lambda c: c.remove_variables(),
        lambda c: c.marginalize(),
        lambda c: c.remove_factors([]),
        lambda c: c.loss([], "dcs"),
        lambda c: c.weigh([], 0.5),
        some_of,
    ],
)
def test_a_change_of_nothing_is_refused(put_together: Callable[[Changes], object]) -> None:
    with pytest.raises(BadShape, match=r"changes: .*(no key|no id of a factor|none)"):
        put_together(Changes())
    assert Changes().undo(Batch(), Accepted(1, 1, 1, 0, True)).listed() == ()


def test_true_and_false_of_numpy_will_do() -> None:
    (group,) = Draft().se2("x0", (0, 0, 0), fixed=cast("Any", np.bool_(True))).batch().variables
    assert group.fixed is True
    assert batch_of("batch", Batch()) == Batch()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda m: m.insert("hello"), "batch: 'hello' (str); wanted a Draft or a Batch"),
        (lambda m: m.insert(Changes()), "batch: an object of type Changes; wanted a Draft or a Batch"),
        (lambda m: m.send(POINT, settle="no"), "settle: 'no' (str); wanted True or False"),
        (lambda m: m.insert(POINT, changes=POINT), "changes: an object of type Draft; wanted a Changes"),
        (lambda m: m.change("no"), "changes: 'no' (str); wanted a Changes"),
        (lambda m: m.merge("other"), "other: 'other' (str); wanted a Map, or the MapGraph of one"),
        (lambda m: m.chi2("no"), "batch: 'no' (str); wanted True or False"),
        (lambda m: m.chi2(True, values="no"), "values: 'no' (str); wanted True or False"),
        (lambda m: m.export(strict="no"), "strict: 'no' (str); wanted True or False"),
        (lambda m: m.estimate.wait_for("1"), "revision: '1' (str); wanted a whole number"),
    ],
)
def test_of_a_map(service: Service, kitchen: Map, call: Callable[[Any], object], said: str) -> None:
    asked = list(service.asked)
    with pytest.raises(BadOption) as refused:
        call(kitchen)
    assert said in refused.value.message
    assert service.asked == asked
    assert kitchen.insert(POINT).revision == 1, "nothing was sent before"


@pytest.mark.parametrize("timeout_s", ["5", math.nan, -1, math.inf, True, [1]])
def test_times_of_every_call(bus: Bus, kitchen: Map, timeout_s: Any) -> None:
    pending_insert = kitchen.send(POINT)
    calls: list[Callable[..., object]] = [
        lambda **t: kitchen.insert(Draft(), **t), lambda **t: kitchen.send(Draft(), **t), kitchen.settle,
        lambda **t: kitchen.change(Changes().fix("x0"), **t), kitchen.flush, kitchen.wait_converged, kitchen.stats,
        kitchen.chi2, kitchen.graph, kitchen.clients, kitchen.export, kitchen.ask_estimate, kitchen.repair,
        kitchen.estimate.wait_converged, lambda **t: kitchen.estimate.wait_for(1, **t), pending_insert.result,
        kitchen.uncertainty.covariance, lambda **t: kitchen.uncertainty.why("x1", **t), bus.maps, bus.stats,
        lambda **t: bus.create("attic", **t), lambda **t: bus.drop("attic", **t),
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(BadOption, match=r"timeout_s: .*; wanted seconds: a finite number, 0 or more"):
            call(timeout_s=timeout_s)
    assert pending_insert.result(cast("Any", np.float32(20.0))).revision == 1


def test_of_a_bus(bus: Bus) -> None:
    strange: Any = bus
    for call, said in (
        (lambda: strange.map(MAP, window="many"), "window: 'many' (str); wanted a whole number, 1 or more"),
        (lambda: strange.map(MAP, window=0), "window: 0; wanted a whole number, 1 or more"),
        (lambda: strange.map(MAP, mirror="no"), "mirror: 'no' (str); wanted True or False"),
        (lambda: strange.map(MAP, create="no"), "create: 'no' (str); wanted True or False"),
        (lambda: strange.drop(MAP, missing_ok="no"), "missing_ok: 'no' (str); wanted True or False"),
        (lambda: strange.drop(MAP, damaged="no"), "damaged: 'no' (str); wanted True or False"),
        (lambda: strange.features("no"), "camera: 'no' (str); wanted a Camera"),
    ):
        with pytest.raises(BadOption) as refused:
            call()
        assert said in refused.value.message


def test_with_asyncio_nothing_is_sent_either(service: Service, tmp_path: Path) -> None:
    async def drive() -> None:
        async with aio.connect(endpoint_in(tmp_path), client="robot1") as connected, connected.map(MAP) as joined:
            strange: Any = joined
            with pytest.raises(BadOption, match="timeout_s: '5'"):
                await strange.insert(POINT, timeout_s="5")
            with pytest.raises(BadOption, match="batch: 'hello'"):
                await strange.insert("hello")
            with pytest.raises(BadOption, match="other: 'other'"):
                await strange.merge("other")
            assert (await joined.insert(POINT)).revision == 1

    asyncio.run(drive())


def test_everything_on_a_closed_connection_says_so(bus: Bus, kitchen: Map) -> None:
    bus.close()
    calls: list[Callable[[], object]] = [
        bus.maps, bus.stats, lambda: bus.create("attic"), lambda: bus.fork(MAP, "attic"), lambda: bus.drop(MAP),
        lambda: bus.map(MAP), lambda: kitchen.insert(POINT), lambda: kitchen.send(POINT), kitchen.settle,
        kitchen.chi2, kitchen.stats, kitchen.graph, kitchen.clients, kitchen.export, kitchen.uncertainty.last,
        lambda: kitchen.estimate.wait_for(9), kitchen.rejoin,
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(ClosedHere, match="this connection is closed; connect again") as refused:
            call()
        assert isinstance(refused.value, Unavailable)
        assert "did not answer" not in refused.value.message
        assert refused.value.code == "unavailable"


def test_a_map_that_was_left_says_so(kitchen: Map) -> None:
    kitchen.close()
    with pytest.raises(ClosedHere, match=f"map '{MAP}': it was closed here; open it again"):
        kitchen.insert(POINT)
