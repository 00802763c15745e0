"""Maps whose steps have a budget, in real processes: killed with work deferred, forked, followed, asked, settled.

FACTORBUS_KILLS says how often a service is killed; here fewer, to save time.
"""

import asyncio
import os
import queue
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh
from bare import bare
from journalled import Services, Stream, rows
from processes import PATIENCE_S
from replicas import MAP, Link, check_equal, replica_settings, wait_until_level
from zenoh.handlers import Callback

from factorbus.client import Map, Refused, aio, connect
from factorbus.journal.store import open_store
from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch
from factorbus.proto.problems import BadOption, Problem
from factorbus.service.config import Limits
from factorbus.service.core.budget import LARGE
from factorbus.service.journal.library import make_map_solver
from factorbus.service.journal.recovery import verify
from factorbus.service.questions.answers import Question
from factorbus.simulate import manhattan
from factorbus.solver import Solver

KILLS = int(os.environ.get("FACTORBUS_KILLS", "6"))
POSES = 700
TIGHT_MS = 0.05  # so that a map of hundreds of poses has what one of tens of thousands has with 10 ms


def driven_batches(poses: int = POSES, seed: int = 3) -> list[Batch]:
    return [step.batch for step in manhattan(poses, seed)]


def optimum(batches: list[Batch]) -> float:
    solver = Solver()
    for batch in batches:
        solver.stage(batch)
        solver.step()
    return solver.step(settle=True).chi2


def wait_finished(services: Services, joined: Map) -> dict[str, Any]:
    """Until nothing is left, and no further step is of use."""
    return services.eventually(joined.stats, lambda seen: seen["complete"] and not seen["converging"])


def replayed(folder: Path) -> tuple[dict[int, tuple[bytes, int]], list[float]]:
    """The values that a journal leads to, every record of which has the same bits again; the budgets of its records."""
    store = open_store(folder, read_only=True)
    try:
        header = store.header()
        map_solver = make_map_solver(header.mode, header.options, header.epoch, Limits())
        assert all(same for _, same in verify(store, map_solver))
        return rows(map_solver.snapshot([Question("estimate")]).variables), [r.budget for r in store.records()]
    finally:
        store.close()


def last_is_insert(folder: Path) -> bool:
    """Of a map that has work deferred after most of its inserts: no further step has been taken since the last."""
    store = open_store(folder, read_only=True)
    try:
        return not list(store.records())[-1].further
    finally:
        store.close()


@pytest.mark.timeout(1800)
def test_killed_with_work_deferred_it_is_the_same_map_and_goes_on(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    chance, batches = random.Random(5), driven_batches()
    running = services(tmp_path / "j", "checkpoint_s=0.1", f"budget_ms={TIGHT_MS}")
    deferred = 0
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m", window=8) as driven:
        assert bus.maps()[0].budget_ms == TIGHT_MS
        stream = Stream(driven, batches)
        stream.start()
        for kill in range(KILLS):
            before, after = ((POSES - 100) * n // KILLS for n in (kill, kill + 1))
            stream.allow(after - before)
            if kill % 2:  # all is answered, and further steps go on
                stream.wait_for(after)
                time.sleep(chance.uniform(0.0, 0.6))  # the moments are what this is about
            else:  # inserts come
                stream.wait_for((before + after) // 2)
            answered = set(stream.acknowledged)
            running.end(signal.SIGKILL)
            deferred += last_is_insert(tmp_path / "j" / "m")
            running.start()
            there = {int(key) for group in driven.ask_estimate().variables for key in group.keys}
            assert {int(k) for n in answered for g in batches[n - 1].variables for k in g.keys} <= there
        stream.allow(POSES)
        stream.wait_for(POSES)
        assert not stream.fault
        stats = wait_finished(running, driven)
        estimate = driven.ask_estimate()
    running.end(signal.SIGTERM)
    values, budgets = replayed(tmp_path / "j" / "m")
    assert rows(estimate.variables) == values
    assert sum(budget > 0.0 for budget in budgets) > 0.9 * len(budgets)
    assert deferred, "no kill came while anything was deferred"
    assert stats["chi2"] <= optimum(batches) * (1.0 + 1e-6)
    ran = subprocess.run(
        [sys.executable, "-m", "factorbus.cli", "journal", "verify", "m", "--journal", str(tmp_path / "j")],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr


def test_what_is_told_and_settled(services: Callable[..., Services], tmp_path: Path) -> None:
    batches = driven_batches(400)
    running = services(tmp_path / "j")
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus:
        row = bus.create("tight", budget_ms=TIGHT_MS)
        assert (row.budget_ms, row.complete, bus.create("free").budget_ms) == (TIGHT_MS, True, 0.0)
        assert bus.create("tight").budget_ms == TIGHT_MS, "whichever it has"
        with pytest.raises(Refused, match="budget") as refused:
            bus.create("tight", budget_ms=3.0)
        assert refused.value.code == "other_budget"
        for wrong in (-1.0, 1e6, float("nan")):
            with pytest.raises(Refused) as refused:
                bus.create("wrong", budget_ms=wrong)
            assert refused.value.code == "bad_option"
        with pytest.raises(Refused) as refused:
            bus.create("wrong", "inc-l", budget_ms=5.0)
        assert refused.value.code == "no_budget"
        with bus.map("tight") as driven:
            reports = [driven.insert(batch).report for batch in batches]
            left = [report for report in reports if not report["complete"]]
            assert left
            assert all({"deferred_relinearizations", "unsolved", "step_ms"} <= set(report) for report in left)
            assert {report["budget_ms"] for report in reports} == {TIGHT_MS}
            told = driven.stats()["budget"]
            assert told["budget_ms"] == TIGHT_MS
            assert told["units_per_ms"] > 0.0
            settled = driven.settle()
            assert settled.report["converged"]
            assert "complete" not in settled.report, "it had no budget"
            assert settled.report["complete"], "so nothing is left"
            assert settled.report["chi2"] <= optimum(batches) * (1.0 + 1e-6)
            assert driven.stats()["complete"]
        with bus.map("free") as driven:
            report = driven.insert(batches[0]).report
            assert not {"budget", "budget_ms", "deferred_relinearizations"} & set(report)
            assert "budget" not in driven.stats()


def test_a_large_correction_is_said_to_come_and_to_have_arrived(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    """In turn, by events behind the deltas of their steps; at the end, when nothing is left, it has arrived."""
    endpoint = services(tmp_path / "j", f"budget_ms={TIGHT_MS}").start()
    told: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()

    def hear(sample: zenoh.Sample) -> None:
        told.put(codec.decode_map(sample.payload.to_bytes()))

    with bare(endpoint) as client, connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus:
        client.session.declare_subscriber(keys.event_key("m"), Callback(hear, indirect=False))
        with bus.map("m") as driven:
            reports = {done.revision: done.report for done in map(driven.insert, driven_batches(400))}
            assert any(not r["complete"] and r["unsolved"] >= LARGE for r in reports.values())
            driven.settle()
        states: list[str] = []
        while states[-1:] != ["arrived"] or not told.empty():
            event = told.get(timeout=PATIENCE_S)
            if event["event"] != "correction":
                continue
            states.append(event["state"])
            if event["state"] == "coming" and event["revision"] in reports:
                assert event["unsolved"] == reports[event["revision"]]["unsolved"] >= LARGE
    assert states == ["coming", "arrived"] * (len(states) // 2)


def test_a_fork_in_the_middle_goes_on_with_the_same_budget(services: Callable[..., Services], tmp_path: Path) -> None:
    batches = driven_batches(500)
    running = services(tmp_path / "j", f"budget_ms={TIGHT_MS}")
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m") as driven:
        for batch in batches[:450]:
            driven.send(batch)
        driven.flush(PATIENCE_S)
        row = bus.fork("m", "what-if")
        assert row.budget_ms == TIGHT_MS
        with bus.map("what-if", create=False) as fork:
            for batch in batches[450:]:
                fork.insert(batch)
                driven.insert(batch)
            ends = [wait_finished(running, each)["chi2"] for each in (driven, fork)]
            estimates = [rows(each.ask_estimate().variables) for each in (driven, fork)]
    running.end(signal.SIGTERM)
    assert ends == pytest.approx([optimum(batches)] * 2, rel=1e-6)
    for name, estimate in zip(("m", "what-if"), estimates, strict=True):
        values, budgets = replayed(tmp_path / "j" / name)
        assert values == estimate
        assert any(budgets)


def test_a_replica_makes_the_same_steps(services: Callable[..., Services], tmp_path: Path) -> None:
    """Each end has a budget of its own; the end that makes a record first says what its steps had."""
    batches = driven_batches(400)
    base = services(tmp_path / "base", 'name="base"')
    base_endpoint = base.start()
    link = Link(base_endpoint)
    robot = services(tmp_path / "robot", *replica_settings(link), f"budget_ms={TIGHT_MS}")
    with (
        connect(robot.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        connect(base_endpoint, client="tablet", timeout_s=PATIENCE_S) as other,
    ):
        driven = bus.map(MAP)
        for n, batch in enumerate(batches):
            driven.send(batch)
            if n == 200:
                driven.flush(PATIENCE_S)
                link.cut(0.3, noticed=True)
        driven.flush(PATIENCE_S)
        at_base = other.map(MAP)
        wait_until_level(driven, at_base, len(batches))
        assert (driven.stats()["budget_ms"], at_base.stats().get("budget_ms")) == (TIGHT_MS, None)
        assert rows(driven.ask_estimate().variables) == rows(at_base.ask_estimate().variables)
    robot.end(signal.SIGTERM)
    base.end(signal.SIGTERM)
    link.relay.close()
    check_equal(tmp_path / "base", tmp_path / "robot", len(batches))
    values = [replayed(tmp_path / end / MAP) for end in ("base", "robot")]
    assert values[0] == values[1]
    assert sum(budget > 0.0 for budget in values[0][1]) > 20


@pytest.mark.timeout(900)
def test_changed_and_killed_it_has_the_same_budget_and_the_same_bits(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    batches = driven_batches(400)
    running = services(tmp_path / "j")
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m") as driven:
        reports = []
        for n, batch in enumerate(batches[:300]):
            if n == 100:
                assert bus.set_budget("m", TIGHT_MS).budget_ms == TIGHT_MS
            if n == 250:
                assert bus.set_budget("m", 2 * TIGHT_MS).budget_ms == 2 * TIGHT_MS
            reports.append(driven.insert(batch).report)
        assert [r.get("budget_ms") for r in reports] == [None] * 100 + [TIGHT_MS] * 150 + [2 * TIGHT_MS] * 50
        assert all(("budget" in r) == (n >= 100) for n, r in enumerate(reports))
        assert not all(report["complete"] for report in reports[100:])
        assert bus.set_budget("m", TIGHT_MS).budget_ms == TIGHT_MS
        running.end(signal.SIGKILL)  # nothing was inserted since
        running.start()
        assert bus.maps()[0].budget_ms == driven.stats()["budget"]["budget_ms"] == TIGHT_MS
        row = bus.fork("m", "what-if")
        assert row.budget_ms == TIGHT_MS
        assert driven.insert(batches[300]).report["budget_ms"] == TIGHT_MS
        for batch in batches[301:]:
            driven.send(batch)
        driven.flush(PATIENCE_S)
        assert bus.set_budget("m", None).budget_ms == 0.0
        stats = services_finish(running, driven)
        assert not {"budget", "budget_ms", "complete"} & set(stats)
        assert stats["chi2"] <= optimum(batches) * (1.0 + 1e-6)
        running.end(signal.SIGKILL)
        running.start()
        assert [row.budget_ms for row in sorted(bus.maps(), key=lambda row: row.name)] == [0.0, TIGHT_MS]
        estimate = rows(driven.ask_estimate().variables)
    running.end(signal.SIGTERM)
    values, budgets = replayed(tmp_path / "j" / "m")
    assert values == estimate
    assert budgets[:100] == [0.0] * 100
    assert all(budgets[100:300])


def services_finish(running: Services, joined: Map) -> dict[str, Any]:
    """Until no further step follows, of a map without a budget."""
    return running.eventually(joined.stats, lambda seen: not seen["converging"])


def test_a_change_that_cannot_be_is_refused_whole(services: Callable[..., Services], tmp_path: Path) -> None:
    endpoint = services(tmp_path / "j").start()
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus:
        bus.create("yard", budget_ms=3.0)
        bus.create("plain", "inc-l")
        for name, budget_ms, code in (("plain", 2.0, "no_budget"), ("yrad", 2.0, "unknown_map")):
            with pytest.raises(Problem) as refused:
                bus.set_budget(name, budget_ms)
            assert refused.value.code == code
        for wrong in (-1.0, 1e6, float("nan"), "3", True):
            with pytest.raises(BadOption):
                bus.set_budget("yard", wrong)  # type: ignore[arg-type]
        assert bus.set_budget("plain", 0.0).budget_ms == 0.0
        assert {row.name: row.budget_ms for row in bus.maps()} == {"m": 0.0, "yard": 3.0, "plain": 0.0}
        assert asyncio.run(changed_async(endpoint)) == [7.0, 0.0]
        for budget, said in (("4", "a budget of 4 ms"), ("none", "no bound")):
            ran = factorbus("budget", "yard", budget, "--connect", endpoint)
            assert (ran.returncode, ran.stdout) == (0, f"steps of yard have {said}\n")
        assert factorbus("budget", "yard", "soon", "--connect", endpoint).returncode == 2
        assert factorbus("budget", "yard", "nan", "--connect", endpoint).returncode != 0


async def changed_async(endpoint: str) -> list[float]:
    async with aio.connect(endpoint, client="robot") as bus:
        return [(await bus.set_budget("yard", budget_ms)).budget_ms for budget_ms in (7.0, None)]


def factorbus(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "factorbus.cli", *arguments], capture_output=True, text=True, timeout=120
    )


def test_without_a_journal_it_is_changed_at_once_and_forked(services: Callable[..., Services]) -> None:
    batches = driven_batches(60)
    with connect(services("").start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m") as driven:
        driven.insert(batches[0])
        bus.set_budget("m", TIGHT_MS)
        assert driven.insert(batches[1]).report["budget_ms"] == TIGHT_MS
        assert driven.stats()["options"]["budget_ms"] == TIGHT_MS
        assert bus.fork("m", "what-if").budget_ms == TIGHT_MS
        bus.set_budget("m", None)
        assert "budget" not in driven.insert(batches[2]).report
        assert "budget_ms" not in driven.stats()["options"]
