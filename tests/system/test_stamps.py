"""Time stamps in a map of a real service: every client sees the same ones, whatever becomes of the map."""

import asyncio
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from journalled import SIGMAS, T0, Services, drafts, rows
from processes import PATIENCE_S

from factorbus.cli.main import main
from factorbus.client import Changes, Draft, Map, Problem, aio, connect
from factorbus.proto.messages import Variables
from factorbus.proto.stamps import NO_STAMP


@pytest.fixture
def joined(endpoint: str, request: pytest.FixtureRequest) -> Iterator[Map]:
    name = "".join(letter if letter.isalnum() else "-" for letter in request.node.name)[:60]
    with connect(endpoint, client="timed", timeout_s=PATIENCE_S) as bus, bus.map(name) as made:
        yield made


def stamps(groups: tuple[Variables, ...]) -> dict[str, int]:
    """Those that there are, by key."""
    return {
        f"{chr(key >> 56)}{key & 0xFFFF}": stamp
        for group in groups
        if group.stamps is not None
        for key, stamp in zip(group.keys.tolist(), group.stamps.tolist(), strict=True)
        if stamp != NO_STAMP
    }


def everywhere(endpoint: str, joined: Map, wanted: dict[str, int]) -> None:
    """In every answer, in the mirror that has followed all the way, and in one that joins now."""
    revision = joined.stats()["revision"]
    joined.estimate.wait_for(revision)
    assert stamps(joined.ask_estimate().variables) == wanted
    assert stamps(joined.graph().batch.variables) == wanted
    with connect(endpoint, client="late", timeout_s=PATIENCE_S) as bus, bus.map(joined.name, create=False) as late:
        late.estimate.wait_for(revision)
        for mirror in (joined.estimate, late.estimate):
            seen = mirror.snapshot()
            assert stamps(seen.variables()) == wanted
            assert {key: mirror.stamp(key) for key in wanted} == wanted
        assert rows(late.estimate.snapshot().variables()) == rows(joined.estimate.snapshot().variables())


def driven(count: int) -> dict[str, int]:
    """The stamps of that many of `drafts`."""
    return {f"x{n}": T0 + n for n in range(count) if n == 0 or n % 7 != 3}


def test_every_reader_has_the_stamps_that_came_in(
    endpoint: str, joined: Map, capsys: pytest.CaptureFixture[str]
) -> None:
    for batch in drafts(30):
        joined.insert(batch)
    joined.insert(Draft().point2("l1", stamp=-1).landmark_se2("x5", "l1", (2, 1), sigmas=(0.1, 0.1)))
    wanted = driven(30) | {"l1": -1}
    everywhere(endpoint, joined, wanted)
    assert joined.estimate.stamp("x3") is None
    with pytest.raises(KeyError):
        joined.estimate.stamp("x99")
    some = joined.ask_estimate(["x4", "x3", "l1"]).variables
    assert stamps(some) == {"x4": T0 + 4, "l1": -1}
    assert [group.stamps for group in joined.ask_estimate("x3").variables] == [None]
    assert joined.uncertainty.why("x4").variable["stamp"] == T0 + 4
    assert "stamp" not in joined.uncertainty.why("x3").variable
    for key, said in (("x4", True), ("x3", False)):
        assert main(["ask", "why", joined.name, key, "--connect", endpoint]) == 0
        assert (f"{T0 + 4} ns" in capsys.readouterr().out) == said


def test_many_in_one_insert_and_large_ones_are_as_small_ones(endpoint: str, joined: Map) -> None:
    draft = Draft().se2("x0", (0, 0, 0), fixed=True, stamp=0)
    for n in range(1, 1500):
        draft.se2(f"x{n}", stamp=n * n if n % 2 else None)
        draft.between_se2(f"x{n - 1}", f"x{n}", (1, 0, 0), sigmas=SIGMAS)
    joined.insert(draft)
    everywhere(endpoint, joined, {"x0": 0} | {f"x{n}": n * n for n in range(1, 1500, 2)})


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
def test_undone_marginalized_removed_and_brought_back(endpoint: str, mode: str) -> None:
    with (
        connect(endpoint, client="timed", timeout_s=PATIENCE_S) as bus,
        bus.map(f"edited-stamps-{mode}", mode) as joined,
    ):
        sent = [(batch, joined.insert(batch)) for batch in drafts(12)]
        wanted = driven(12)
        joined.change(Changes().undo(*sent[-1]))
        del wanted["x11"]
        everywhere(endpoint, joined, wanted)
        joined.change(Changes().marginalize(["x4", "x5"]))
        del wanted["x4"], wanted["x5"]
        everywhere(endpoint, joined, wanted)
        again = Draft().se2("x11", stamp=5).between_se2("x10", "x11", (1, 0, 0), sigmas=SIGMAS)
        joined.insert(again, changes=Changes().fix("x2").weigh([0], 0.5))
        everywhere(endpoint, joined, wanted | {"x11": 5})
        joined.insert(
            Draft().se2("x11").between_se2("x10", "x11", (1, 0, 0), sigmas=SIGMAS),
            changes=Changes().remove_variables("x11"),
        )
        everywhere(endpoint, joined, wanted)


def test_what_is_refused_brings_no_stamp(endpoint: str, joined: Map) -> None:
    for batch in drafts(5):
        joined.insert(batch)
    with pytest.raises(Problem, match="x1"):
        joined.insert(Draft().se2("x1", (1, 0, 0), fixed=True, stamp=99))
    with pytest.raises(Problem):
        joined.insert(Draft().se2("x5", (1, 0, 0), stamp=99))  # nothing holds it
    everywhere(endpoint, joined, driven(5))
    joined.insert(Draft().se2("x5", (1, 0, 0), fixed=True))
    assert joined.estimate.stamp("x5") is None


def test_a_fork_and_a_merged_map_have_them(endpoint: str, joined: Map) -> None:
    for batch in drafts(9):
        joined.insert(batch)
    wanted = driven(9)
    with connect(endpoint, client="other", timeout_s=PATIENCE_S) as bus:
        bus.fork(joined.name, f"{joined.name[:50]}-fork")
        with bus.map(f"{joined.name[:50]}-fork", create=False) as fork:
            everywhere(endpoint, fork, wanted)
        with bus.map("merged-stamps") as into:
            into.insert(Draft().se2("y0", (5, 0, 0), fixed=True, stamp=-9))
            anchor = Draft().between_se2("y0", "z0", (1, 0, 0), sigmas=SIGMAS)
            into.merge(joined, anchors=anchor, letters={"x": "z"})
            everywhere(endpoint, into, {"y0": -9} | {f"z{key[1:]}": stamp for key, stamp in wanted.items()})


@pytest.mark.parametrize("settings", [("checkpoint_s=1000",), ("checkpoint_s=0.01",)])
def test_killed_and_started_again_they_are_there(
    services: Callable[..., Services], tmp_path: Path, settings: tuple[str, ...]
) -> None:
    """From the journal alone, and from a checkpoint and what came after it."""
    running = services(tmp_path / "journal", *settings)
    batches, wanted = drafts(60), driven(60)
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m") as joined:
        sent = [joined.insert(batch) for batch in batches[:50]]
        joined.change(Changes().undo(batches[49], sent[49]).fix("x20"))
        joined.insert(batches[49])
        bus.fork("m", "m2")
        before = rows(joined.ask_estimate().variables)
        running.end(signal.SIGKILL)
        endpoint = running.start()
        assert rows(joined.ask_estimate().variables) == before
        for batch in batches[50:]:
            joined.insert(batch)
        everywhere(endpoint, joined, wanted)
        with bus.map("m2", create=False) as fork:
            everywhere(endpoint, fork, driven(50))


def test_asyncio_gives_them_too(endpoint: str) -> None:
    async def run() -> tuple[list[dict[str, int]], dict[str, int], int | None]:
        async with (
            aio.connect(endpoint, client="a", timeout_s=PATIENCE_S) as bus,
            bus.map("aio-stamps") as joined,
        ):
            deltas = joined.deltas()
            coming = asyncio.ensure_future(anext(deltas))
            await asyncio.sleep(0)
            accepted = await joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True, stamp=np.int64(T0)))
            seen = [stamps((await coming).variables)]
            await joined.wait_for(accepted.revision)
            asked = await joined.ask_estimate()
            await deltas.aclose()
            return seen, stamps(asked.variables), joined.estimate.stamp("x0")

    assert asyncio.run(run()) == ([{"x0": T0}], {"x0": T0}, T0)


def test_a_trajectory_has_its_nanoseconds(
    endpoint: str, joined: Map, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for batch in drafts(3):
        joined.insert(batch)
    lines = joined.export("tum").splitlines()
    assert [line.split()[0] for line in lines] == [f"1403636579.{763555584 + n}" for n in range(3)]
    assert main(["save", joined.name, str(tmp_path / "out.tum"), "--connect", endpoint]) == 0
    assert (tmp_path / "out.tum").read_text().splitlines() == lines
    joined.insert(drafts(4)[3])
    exported = joined.ask.export("tum", None).result()
    assert exported.text.splitlines()[-1].split()[0] == lines[-1].split()[0]
    assert exported.notes == ("1 pose left out: x3 has no time stamp, and others have one",)
    g2o = joined.ask.export("g2o", None).result()
    assert any("time stamps left out" in note for note in g2o.notes)
