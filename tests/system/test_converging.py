"""A map that is left alone before it is at its optimum finishes by itself: real processes, killed, forked, asked."""

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from journalled import Services, rows
from processes import PATIENCE_S
from turned import LONG, SHORT, Deltas, closing, in_one, optimum, prepare, turn

from factorbus.client import Bus, Draft, Map, aio, connect
from factorbus.journal.records import JournalRecord
from factorbus.journal.store import open_store
from factorbus.service.config import Limits
from factorbus.service.journal.library import make_map_solver
from factorbus.service.journal.recovery import verify
from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver

# With this number of further steps, and more, for the map that is LONG and only goes downhill.
MODES = {"all-batch": 20, "inc-l": 20, "bayes-tree": 0}


def state(joined: Map) -> tuple[int, dict[int, bytes]]:
    estimate = joined.ask_estimate()
    return estimate.revision, rows(estimate.variables)


@contextmanager
def alone(services: Callable[..., Services], folder: Path, mode: str, *settings: str) -> Iterator[tuple[Bus, Map]]:
    """A map that only goes downhill, on a service of its own."""
    prepare(folder, "m2", mode)
    running = services(folder, *settings)
    with (
        connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        bus.map("m2", create=False) as joined,
    ):
        yield bus, joined


def check_left_alone(joined: Map, deltas: Deltas) -> None:
    """What is told until nothing is left to do."""
    reports = [delta.report for delta in deltas.all]
    assert [report["converged"] for report in reports] == sorted(report["converged"] for report in reports)
    assert [report["converging"] for report in reports] == [True] * (len(reports) - 1) + [False]
    assert (joined.estimate.converged, joined.estimate.converging) == (True, False)
    stats = joined.stats()
    assert (stats["converged"], stats["converging"], stats["gave_up"]) == (True, False, "")
    assert stats["further_steps"] == len(deltas.further())


@pytest.mark.parametrize("mode", MODES)
def test_a_map_left_alone_comes_to_its_optimum(services: Callable[..., Services], tmp_path: Path, mode: str) -> None:
    with alone(services, tmp_path / "j", mode) as (_, joined):
        deltas = turn(joined, LONG)
        joined.wait_converged(PATIENCE_S)
        assert not (mode != "bayes-tree" and deltas.all[0].report["converged"])
        check_left_alone(joined, deltas)
        assert [delta.previous for delta in deltas.all] == [delta.revision - 1 for delta in deltas.all]
        assert deltas.further() == deltas.all[1:]
        for delta in deltas.further():
            assert (delta.report["new_variables"], delta.report["new_factors"]) == (0, 0)
        revision, values = state(joined)
        keys, mirrored = joined.estimate.columns("se2")
        assert {int(k): row.tobytes() for k, row in zip(keys, mirrored, strict=True)} == {
            key: value for key, (value, _) in values.items()
        }
        assert joined.estimate.revision == revision == deltas.all[-1].revision
        assert len(deltas.further()) >= MODES[mode]
        assert joined.chi2().chi2 == pytest.approx(optimum(*LONG), rel=1e-6)


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
@pytest.mark.parametrize("world", ["manhattan", "sphere"])
def test_a_map_that_has_converged_is_polished_when_it_is_left_alone(endpoint: str, mode: str, world: str) -> None:
    """To a millionth of χ²; `converged` allows a thousandth."""
    judge, name = Solver(Options(mode="all-batch")), f"polished-{mode}-{world}"
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map(name, mode) as joined:
        deltas, report, inserted = Deltas(joined), {}, 0
        for step in WORLDS[world](200, 7):
            answer = joined.insert(step.batch)
            report, inserted = answer.report, answer.revision
            judge.stage(step.batch)
        judge.step(settle=True)
        joined.wait_converged(PATIENCE_S)
        left = [delta for delta in deltas.all if delta.revision > inserted]
        assert all(delta in deltas.further() for delta in left)
        assert (report["converged"], report["converging"], bool(left)) == (True, True, True)
        assert [delta.report["converging"] for delta in left] == [True] * (len(left) - 1) + [False]
        assert len(left) <= 3
        print(f"{name}: {len(left)} further steps, {sum(delta.report['solver_ms'] for delta in left):.1f} ms")
        assert joined.chi2().chi2 == pytest.approx(judge.chi2(), rel=1e-6)
        revision = joined.estimate.revision
        assert joined.settle(PATIENCE_S).revision == revision + 1, "nothing has happened since"


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l"])
def test_killed_before_it_is_polished_it_comes_to_the_same_bits(
    services: Callable[..., Services], tmp_path: Path, mode: str
) -> None:
    ends = []
    for name in ("whole", "stopped"):
        running = services(tmp_path / name)
        with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m2", mode) as joined:
            inserted = 0
            for step in WORLDS["manhattan"](120, 7):
                inserted = joined.insert(step.batch).revision
            if name == "stopped":
                running.end(signal.SIGKILL)
                running.start()
            joined.wait_converged(PATIENCE_S)
            ends.append(state(joined))
            assert ends[-1][0] > inserted
            running.end(signal.SIGKILL)
            running.start()
            joined.wait_converged(PATIENCE_S)
            assert state(joined) == ends[-1], "it was at rest, and is"
        running.end(signal.SIGTERM)
        assert all(same for _, same in again(tmp_path / name / "m2"))
    assert ends[0][1] == ends[1][1]


def test_other_maps_are_served_in_between(services: Callable[..., Services], tmp_path: Path) -> None:
    with alone(services, tmp_path / "j", "all-batch") as (bus, joined), bus.map("other") as other:
        deltas = turn(joined, LONG)
        deltas.wait_for_further(1)
        for n in range(10):
            other.insert(Draft().point2(f"l{n}", (n, 0)).prior_point2(f"l{n}", (n, 0), sigmas=(1, 1)))
        begun = len(deltas.further())
        assert not joined.estimate.converged
        deltas.wait_for_further(begun + 1)
        joined.wait_converged(PATIENCE_S)
        assert joined.chi2().chi2 == pytest.approx(optimum(*LONG), rel=1e-6)


def test_while_it_goes_on_it_says_so_and_answers_of_its_latest_revision(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    with alone(services, tmp_path / "j", "all-batch") as (bus, joined):
        deltas = turn(joined, LONG)
        deltas.wait_for_further(1)
        seen, asked = joined.stats(), 0
        assert (seen["converged"], seen["converging"]) == (False, True)
        assert [row.converging for row in bus.maps() if row.name == "m2"] == [True]
        answers = []
        while joined.estimate.converging:
            known = joined.estimate.revision
            answers.append((known, joined.chi2(), joined.uncertainty.last()))
            asked += 1
        assert asked > 3
        joined.wait_converged(PATIENCE_S)
        chi2 = {delta.revision: delta.report["chi2"] for delta in deltas.all}
        for known, found, last in answers:
            assert known <= found.revision <= last.revision
            assert found.chi2 == pytest.approx(chi2[found.revision], rel=1e-9)
        assert [row.converging for row in bus.maps() if row.name == "m2"] == [False]


def test_an_insert_that_comes_in_between_goes_first(services: Callable[..., Services], tmp_path: Path) -> None:
    """An insert waits for the one step under way; after it, the map is left alone again."""
    with alone(services, tmp_path / "j", "all-batch") as (_, joined):
        deltas = turn(joined, LONG)
        deltas.wait_for_further(3)
        before = joined.stats()["revision"]
        accepted = joined.insert(closing(900))
        assert accepted.report["new_factors"] == 1
        between = [d for d in deltas.further() if before + 1 < d.revision < accepted.revision]
        print(f"{len(between)} further steps from before it was sent until it was taken in")
        assert not joined.estimate.converged
        joined.wait_converged(PATIENCE_S)
        last = deltas.all[-1]
        assert last.revision > accepted.revision
        assert last.report["converged"]


@pytest.mark.parametrize(("mode", "durability"), [("all-batch", "commit"), ("inc-l", "commit"), ("inc-l", "none")])
def test_killed_while_it_goes_on_it_comes_to_the_same_bits(
    services: Callable[..., Services], tmp_path: Path, mode: str, durability: str
) -> None:
    """Against one that was never stopped. With durability none it is stopped in order: a crash may take steps back."""
    end = signal.SIGKILL if durability == "commit" else signal.SIGTERM
    settings = ("checkpoint_s=0.2", f'durability="{durability}"')
    ends: list[tuple[int, dict[int, bytes]]] = []
    written: list[int] = []  # further steps, whenever it was stopped
    for name in ("whole", "stopped"):
        prepare(tmp_path / name, "m2", mode)
        running = services(tmp_path / name, *settings)
        with (
            connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus,
            bus.map("m2", create=False) as joined,
        ):
            deltas = turn(joined, LONG)
            if name == "stopped":
                deltas.wait_for_further(1)
                for _ in range(3):
                    running.end(end)
                    written.append(further_in(tmp_path / name / "m2"))
                    running.start()  # and stopped once more as soon as it is there
                assert joined.stats()["epoch"] == joined.epoch, "the same map, at the same place"
            joined.wait_converged(PATIENCE_S)
            ends.append(state(joined))
        running.end(signal.SIGTERM)
    assert ends[0] == ends[1]
    records = again(tmp_path / "stopped" / "m2")
    assert all(same for _, same in records), "from the first insert on, too"
    total = sum(record.further for record, _ in records)
    assert total == ends[0][0] - 2
    assert 0 < written[0] <= written[1] <= written[2]
    assert written[0] < total, "it was stopped in the middle"


def further_in(journal: Path) -> int:
    store = open_store(journal, read_only=True)
    try:
        return sum(record.further for record in store.records())
    finally:
        store.close()


def again(journal: Path) -> list[tuple[JournalRecord, bool]]:
    """All that is in a journal, applied again; each with whether it had the same bits."""
    store = open_store(journal, read_only=True)
    try:
        header = store.header()
        return list(verify(store, make_map_solver(header.mode, header.options, header.epoch, Limits())))
    finally:
        store.close()


def test_a_fork_goes_on_by_itself_to_the_same_bits(services: Callable[..., Services], tmp_path: Path) -> None:
    prepare(tmp_path / "journal", "m2", "all-batch")
    running = services(tmp_path / "journal")
    with (
        connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        bus.map("m2", create=False) as joined,
    ):
        deltas = turn(joined, LONG)
        deltas.wait_for_further(5)
        row = bus.fork("m2", "fork")
        assert row.converging
        joined.wait_converged(PATIENCE_S)
        with bus.map("fork", create=False) as fork:
            fork.wait_converged(PATIENCE_S)
            assert state(fork) == state(joined)
        running.end(signal.SIGKILL)
        running.start()
        with bus.map("fork", create=False) as fork:
            assert state(fork) == state(joined)
            fork.wait_converged(PATIENCE_S)
            assert [each.converging for each in bus.maps()] == [False] * 3


def test_with_asyncio_it_is_waited_for_too(endpoint: str) -> None:
    async def drive() -> Any:
        async with (
            aio.connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus,
            bus.map("awaited", "all-batch") as joined,
        ):
            await joined.insert(in_one(*SHORT))
            await joined.insert(closing(SHORT[0]))
            await joined.wait_converged(PATIENCE_S)
            return await joined.chi2(), joined.estimate.converged

    found, converged = asyncio.run(drive())
    assert converged
    assert np.isclose(found.chi2, optimum(*SHORT), rtol=1e-6)
