"""What is given to the client and is of another type, or comes when all is closed: refused by name, nothing is sent."""

import asyncio
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from faulty.service import MAP, Service, endpoint_in

from factorbus.client import Bus, Camera, Changes, Draft, Map, Unavailable, aio, connect
from factorbus.client.changes import some_of
from factorbus.client.draft import batch_of
from factorbus.client.merging import fit_into
from factorbus.client.uncertainty import association_question, factors_of, paired, why_question
from factorbus.proto.asking import CovarianceGroup, Covariances
from factorbus.proto.messages import Accepted, Batch, Estimate, MapGraph
from factorbus.proto.problems import BadLoss, BadOption, BadShape, ClosedHere, Problem
from factorbus.proto.symbols import symbol

ANY: Any = "no"  # a str, whatever the signature says
CAMERA = Camera("pinhole", (500.0, 500.0, 320.0, 240.0), 640, 480)
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
        (lambda: connect(cast("Any", None)), "endpoint: None (NoneType); wanted an address such as"),
        (lambda: connect(cast("Any", 5)), "endpoint: 5 (int); wanted an address such as"),
        (lambda: connect(cast("Any", ["tcp/127.0.0.1:1", 5])), "endpoint: 5 (int); wanted an address such as"),
        (lambda: connect([]), "endpoint: an empty list; wanted an address such as"),
        (lambda: connect("tcp/127.0.0.1:1", settings=cast("Any", 5)), "settings: 5 (int); wanted a mapping of path"),
        (lambda: connect("tcp/127.0.0.1:1", zenoh=cast("Any", 5)), "zenoh: 5 (int); wanted the path of a file"),
        (
            lambda: Draft().se2("x2", **cast("Any", {"fixd": ANY})),
            "se2 x2: there is no keyword 'fixd'; wanted fixed, stamp",
        ),
        (
            lambda: fit_into(Estimate(1, 1, ()), MapGraph(1, 1, Batch()), letters=cast("Any", np.zeros(2))),
            "letters: an object of type ndarray; wanted a mapping of letters",
        ),
        (
            lambda: fit_into(Estimate(1, 1, ()), MapGraph(1, 1, Batch()), letters=ANY),
            "letters: 'no' (str); wanted a mapping of letters",
        ),
        (
            lambda: association_question("x1", "landmark_se2", (1, 1), np.eye(2), None, ANY),
            "probability: 'no' (str); wanted",
        ),
    ],
)
def test_without_a_bus(call: Callable[[], object], said: str) -> None:
    with pytest.raises(BadOption) as refused:
        call()
    assert said in refused.value.message


@pytest.mark.parametrize(
    ("call", "code"),
    [
        (lambda: Draft().se2("x0", (0, math.nan, 0)), "not_finite"),
        (lambda: Draft().point2("l0", (math.inf, 0)), "not_finite"),
        (lambda: Draft().heading_se2("x0", math.nan, sigmas=1.0), "not_finite"),
        (lambda: Draft().between_se2("x0", "x1", (1, math.nan, 0), sigmas=(1, 1, 1)), "not_finite"),
        (lambda: Draft().heading_se2("x0", 0.0, information=[math.nan]), "bad_information"),
        (lambda: Draft().range_se2("x0", "l0", cast("Any", "2.5"), sigmas=1.0), "bad_shape"),
        (lambda: Draft().se2("x0", cast("Any", ["1", "2", "3"])), "bad_shape"),
        (lambda: Draft().prior_se2("x0", np.array(["1", "2", "3"]), sigmas=[1] * 3), "bad_shape"),
        (lambda: Draft().heading_se2("x0", 0.0, sigmas=cast("Any", "1")), "bad_shape"),
        (lambda: Draft().between_se2("x0", "x1", (1, 0, 0), information=np.full((3, 3), np.inf)), "bad_information"),
        (
            lambda: Draft().linear(["x0"], [(0, 0, math.nan)], [np.eye(3)], np.zeros(3), kinds=["se2"], sigmas=[1] * 3),
            "not_finite",
        ),
        (
            lambda: Draft().linear(
                ["x0"], [(0, 0, 0)], [np.nan * np.eye(3)], np.zeros(3), kinds=["se2"], sigmas=[1] * 3
            ),
            "not_finite",
        ),
        (
            lambda: Draft().linear(["x0"], [(0, 0, 0)], [np.eye(3)], np.full(3, np.nan), kinds=["se2"], sigmas=[1] * 3),
            "not_finite",
        ),
        (
            lambda: Draft().linear(["x0"], [("a", 0, 0)], [np.eye(3)], np.zeros(3), kinds=["se2"], sigmas=[1] * 3),
            "bad_shape",
        ),
        (lambda: Draft().variable(cast("Any", []), "x0"), "unknown_kind"),
        (lambda: Changes().weigh([1], math.nan), "not_finite"),
        (lambda: association_question("x1", "landmark_se2", ANY, np.eye(2), None, 0.9), "bad_shape"),
        (lambda: association_question("x1", "landmark_se2", (math.nan, 0), np.eye(2), None, 0.9), "not_finite"),
        (lambda: association_question("x1", "landmark_se2", (1, 0), ANY, None, 0.9), "bad_shape"),
        (lambda: paired(cast("Any", 5)), "bad_shape"),
        (lambda: paired(cast("Any", [None])), "bad_shape"),
        (lambda: why_question(None, cast("Any", [])), "bad_shape"),
        (lambda: symbol("x", cast("Any", "1")), "bad_symbol"),
        (lambda: symbol(cast("Any", 5), 1), "bad_symbol"),
        (lambda: Draft().linear(["x0"], cast("Any", 5), [np.eye(3)], (0, 0, 0), sigmas=[1] * 3), "bad_option"),
        (
            lambda: Draft().linear(["x0"], [(0, 0, 0)], [np.eye(3)], (0, 0, 0), kinds=cast("Any", 5), sigmas=[1] * 3),
            "bad_option",
        ),
    ],
)
def test_numbers_are_refused_before_they_are_sent(call: Callable[[], object], code: str) -> None:
    with pytest.raises(Problem) as refused:
        call()
    assert refused.value.code == code


@pytest.mark.parametrize("none", ["", "none"])
def test_no_loss_has_the_word_of_the_command_line(none: str) -> None:
    (change,) = Changes().loss([13], none, 0).listed()
    assert change.loss == ""


def test_a_loss_that_does_not_exist_is_said_in_a_sentence() -> None:
    with pytest.raises(BadLoss, match=r"^changes: the loss 'foo'; wanted none, or one of huber"):
        Changes().loss([13], "foo", 1.0)
    (group,) = Draft().heading_se2("x0", 0.0, sigmas=1.0, loss="none").batch().factors
    assert group.loss == ""


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
        (lambda m: m.send(POINT, convert_below=""), "convert_below: '' (str); wanted a finite number, 0 or more"),
        (lambda m: m.insert(POINT, convert_below=math.nan), "convert_below: nan (float); wanted a finite number, 0"),
        (lambda m: m.insert(POINT, convert_below=-1), "convert_below: -1 (int); wanted a finite number, 0 or more"),
        (lambda m: m.insert(POINT, convert_below=np.zeros(2)), "convert_below: an object of type ndarray; wanted"),
        (lambda m: m.repair(probability=10**400), "wanted a number between 0 and 1"),
        (lambda m: m.send(POINT, settle="no"), "settle: 'no' (str); wanted True or False"),
        (lambda m: m.insert(POINT, changes=POINT), "changes: an object of type Draft; wanted a Changes"),
        (lambda m: m.change("no"), "changes: 'no' (str); wanted a Changes"),
        (lambda m: m.merge("other"), "other: 'other' (str); wanted a Map, or the MapGraph of one"),
        (lambda m: m.chi2("no"), "batch: 'no' (str); wanted True or False"),
        (lambda m: m.chi2(True, values="no"), "values: 'no' (str); wanted True or False"),
        (lambda m: m.export(strict="no"), "strict: 'no' (str); wanted True or False"),
        (lambda m: m.estimate.wait_for("1"), "revision: '1' (str); wanted a whole number"),
        (lambda m: m.estimate.on_delta(None), "callback: None (NoneType); wanted a function of a delta"),
        (lambda m: m.repair(probability="0.9"), "probability: '0.9' (str); wanted a number between 0 and 1"),
        (lambda m: m.uncertainty.gate(Draft(), "0.9"), "probability: '0.9' (str); wanted a number between 0 and 1"),
        (lambda m: m.uncertainty.gate(Draft(), 1), "probability: 1 (int); wanted a number between 0 and 1"),
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
        (lambda: strange.map(MAP, window=True), "window: True; wanted a whole number, 1 or more"),
        (lambda: strange.map(MAP, client=0), "client: 0 (int); wanted a name, or an empty text for that of the conn"),
        (lambda: strange.features(CAMERA, rho="1"), "rho: '1' (str); wanted a finite number"),
        (lambda: strange.features(CAMERA, sigma_pixel=math.nan), "sigma_pixel: nan (float); wanted a finite number"),
        (lambda: strange.features(CAMERA, service=5), "service: 5 (int); wanted the name of a service"),
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


def test_what_is_looked_up_and_not_there_is_a_problem_and_a_key_error(kitchen: Map) -> None:
    kitchen.insert(POINT)
    calls: list[tuple[Callable[[], object], str]] = [
        (lambda: kitchen.estimate["x99"], "x99 is not in map 'kitchen'"),
        (lambda: kitchen.estimate["no key"], "variable key 'no key' cannot be read"),
        (lambda: kitchen.estimate.stamp("x99"), "x99 is not in map 'kitchen'"),
        (lambda: kitchen.estimate.columns("se3"), "no variables of kind 'se3' in map 'kitchen'"),
        (lambda: Covariances(1, 1, "diagonal")["x0"], "the answer has no covariance of x0"),
    ]
    for call, said in calls:
        with pytest.raises(KeyError) as missing:
            call()
        assert isinstance(missing.value, Problem)
        assert missing.value.code == "unknown_variable"
        assert str(missing.value).startswith(said)


def test_an_estimate_and_covariances_have_their_keys(kitchen: Map) -> None:
    kitchen.insert(POINT)
    assert list(kitchen.estimate) == ["l1"]
    assert [kitchen.estimate[key].tolist() for key in kitchen.estimate] == [[1.0, 0.0]]
    keys = np.array([symbol("x", 1), symbol("l", 2), 7])
    answer = Covariances(1, 1, "diagonal", (CovarianceGroup("point2", keys, np.ones((3, 2, 2))),))
    assert list(answer) == ["x1", "l2", "7"]
    assert all(key in answer for key in answer)
    for missing in ("x9", "no key"):
        assert missing not in answer
        assert missing not in kitchen.estimate
        with pytest.raises(KeyError):
            answer[missing]


def test_a_revision_that_has_not_come_is_no_silence(kitchen: Map) -> None:
    kitchen.insert(POINT)
    with pytest.raises(Unavailable) as missing:
        kitchen.estimate.wait_for(revision=1000, timeout_s=0.2)
    assert missing.value.message.startswith("map 'kitchen' is at revision 1, and has not reached 1000 within 0.2 s")


def test_a_map_without_a_mirror_says_so(bus: Bus) -> None:
    with bus.map(MAP, mirror=False) as joined, pytest.raises(Unavailable) as missing:
        joined.estimate["x0"]
    assert missing.value.message == "map 'kitchen' was opened without a mirror; open it with mirror=True"


def test_a_map_that_was_left_says_so(kitchen: Map) -> None:
    kitchen.close()
    for call in (lambda: kitchen.insert(POINT), kitchen.rejoin, kitchen.open_mirror):
        with pytest.raises(ClosedHere, match=f"map '{MAP}': it was closed here; open it again"):
            call()
