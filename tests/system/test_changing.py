"""A map that is changed over the bus: viewers see what is gone, a restart has it again, the command line does it."""

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from processes import Process

from factorbus.client import Changes, Draft, Map, Refused, aio, connect
from factorbus.client.changes import FactorsOfAnother
from factorbus.proto.messages import Accepted, Factors
from factorbus.simulate import LoopClosures, manhattan

SIGMAS = (0.1, 0.1, 0.02)


def drive(joined: Map, first: int, last: int) -> list[tuple[Draft, Accepted]]:
    """Round and round a square."""
    done = []
    for i in range(first, last):
        step = Draft().se2("x0", (0, 0, 0), fixed=True) if i == 0 else Draft().se2(f"x{i}")
        if i:
            step.between_se2(f"x{i - 1}", f"x{i}", (1, 0, 1.6), sigmas=SIGMAS)
        if i >= 4:
            step.between_se2(f"x{i - 4}", f"x{i}", (0.01 * i, 0, 0), sigmas=SIGMAS)
        done.append((step, joined.insert(step)))
    return done


@pytest.fixture
def square(endpoint: str, request: pytest.FixtureRequest) -> Iterator[Map]:
    name = "".join(letter if letter.isalnum() else "-" for letter in request.node.name)[:60]
    with connect(endpoint, client="changer", timeout_s=60) as bus, bus.map(name) as joined:
        yield joined


def test_an_insert_is_undone_and_everybody_sees_it(endpoint: str, square: Map) -> None:
    drive(square, 0, 9)
    square.settle()
    before = square.ask_estimate()
    with connect(endpoint, client="viewer", timeout_s=60) as bus, bus.map(square.name, create=False) as viewer:
        wrong = Draft().se2("x9").between_se2("x8", "x9", (1, 0, 1.6), sigmas=SIGMAS)
        wrong.between_se2("x2", "x9", (5, 5, 0), sigmas=SIGMAS)
        accepted = square.insert(wrong)
        viewer.estimate.wait_for(accepted.revision)
        assert "x9" in viewer.estimate
        undone = square.change(Changes().undo(wrong, accepted), settle=True)
        assert (undone.report["removed_variables"], undone.report["removed_factors"]) == (1, 2)
        viewer.estimate.wait_for(undone.revision)
        assert "x9" not in viewer.estimate
        assert "x9" not in square.estimate
        for name in ("x1", "x8"):
            np.testing.assert_allclose(viewer.estimate[name], square.estimate[name], rtol=0, atol=0)
    after = square.ask_estimate()
    for old, new in zip(before.variables, after.variables, strict=True):
        assert old.keys.tolist() == new.keys.tolist()
        np.testing.assert_allclose(new.values, old.values, rtol=0, atol=1e-9)


def test_ids_of_one_map_are_not_taken_for_those_of_another(endpoint: str, square: Map) -> None:
    drive(square, 0, 6)
    loop = Draft().between_se2("x1", "x5", (4, 0, 0), sigmas=SIGMAS)
    accepted, found = square.insert(loop), square.repair()
    found = replace(found, factors=np.array([accepted.first_factor]))
    with connect(endpoint, client="changer", timeout_s=60) as bus, bus.map(f"{square.name}-2") as other:
        drive(other, 0, 9)
        revision = other.stats()["revision"]
        for changes in (Changes().undo(loop, accepted), Changes().fix("x2").repair(found)):
            with pytest.raises(FactorsOfAnother, match=f"epoch {accepted.epoch}; map '{other.name}' has") as refused:
                other.change(changes)
            assert (refused.value.code, refused.value.detail["epoch"]) == ("wrong_epoch", other.epoch)
        assert other.stats()["revision"] == revision
        bus.fork(square.name, f"{square.name}-3")
        with bus.map(f"{square.name}-3", create=False) as fork:
            gone = fork.change(Changes().undo(loop, replace(accepted, epoch=fork.epoch)))
            assert gone.report["removed_factors"] == 1
    square.change(Changes().undo(loop, accepted))


def test_refusals_are_whole_and_have_their_codes(square: Map) -> None:
    (first, accepted), *_ = drive(square, 0, 6)[1:]
    square.wait_converged()
    revision = square.stats()["revision"]
    for changes, code in (
        (Changes().undo(first, accepted), "in_use"),
        (Changes().remove_factors([1000]), "unknown_factor"),
        (Changes().fix("y7"), "unknown_variable"),
        (Changes().fix("x1").weigh([0], -1.0), "bad_weight"),
        (Changes().free("x0"), "underconstrained"),
    ):
        with pytest.raises(Refused) as refused:
            square.change(changes)
        assert refused.value.code == code
    assert square.stats()["revision"] == revision
    assert all(not group.fixed or group.keys.size == 1 for group in square.ask_estimate().variables)


def test_ids_in_the_graph_are_what_changes_and_why_call_factors_by(square: Map) -> None:
    drive(square, 0, 8)
    square.change(Changes().remove_factors([4]).loss([6], "huber", 1.5).weigh([5], 0.5))
    groups = square.graph().batch.factors
    ids = sorted(int(each) for group in groups for each in group.ids)
    assert ids == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10]
    robust = [group for group in groups if group.loss]
    assert [(g.loss, g.ids.tolist(), g.scale.tolist()) for g in robust] == [("huber", [6], [1.5])]
    assert square.uncertainty.why(factor=5).factor["factor"] == 5
    with pytest.raises(Refused, match="removed"):
        square.uncertainty.why(factor=4)
    batch = square.insert(Draft().between_se2("x0", "x7", (0, 0, 0), sigmas=SIGMAS))
    assert batch.first_factor == 11


def test_asyncio_changes_and_repairs(endpoint: str) -> None:
    async def run() -> tuple[int, int]:
        async with aio.connect(endpoint, client="aio", timeout_s=60) as bus, bus.map("changed-by-aio") as joined:
            for i in range(5):
                step = Draft().se2(f"x{i}", (i, 0, 0) if i == 0 else None, fixed=i == 0)
                if i:
                    step.between_se2(f"x{i - 1}", f"x{i}", (1, 0, 0), sigmas=SIGMAS)
                await joined.insert(step)
            wrong = await joined.insert(Draft().between_se2("x0", "x4", (0, 9, 0), sigmas=SIGMAS))
            found = await joined.repair()
            assert found.factors.tolist() == [wrong.first_factor]
            changed = await joined.change(Changes().repair(found), settle=True)
            return changed.report["removed_factors"], changed.report["placed_variables"]

    assert asyncio.run(run()) == (1, 5)


def test_a_restart_after_a_kill_has_the_changes(spawn: Callable[..., Process], tmp_path: Path) -> None:
    serve = ("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--journal", str(tmp_path / "journal"))
    service = spawn(*serve)
    with connect(service.ready()[0], client="robot", timeout_s=60) as bus, bus.map("m") as joined:
        done = drive(joined, 0, 8)
        joined.change(Changes().undo(*done[-1]).fix("x3").weigh([2], 0.25))
        drive(joined, 7, 10)
        joined.wait_converged()
        before, graph, row = joined.ask_estimate(), joined.graph(), joined.stats()
    service.signal(signal.SIGKILL)
    service.wait()
    again = spawn(*serve)
    with connect(again.ready()[0], client="robot", timeout_s=60) as bus, bus.map("m", create=False) as joined:
        after, new = joined.ask_estimate(), joined.graph()
        assert (after.epoch, after.revision) == (before.epoch, before.revision)
        assert joined.stats()["factors"] == row["factors"]
        for old, now in zip(before.variables, after.variables, strict=True):
            assert (old.keys.tobytes(), old.values.tobytes(), old.fixed) == (
                now.keys.tobytes(),
                now.values.tobytes(),
                now.fixed,
            )
        assert [g.ids.tolist() for g in new.batch.factors] == [g.ids.tolist() for g in graph.batch.factors]
        assert joined.insert(Draft().between_se2("x0", "x9", (0, 0, 0), sigmas=SIGMAS)).first_factor == 17


def test_a_marginal_of_many_poses_is_there_again_after_a_kill(spawn: Callable[..., Process], tmp_path: Path) -> None:
    serve = ("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--journal", str(tmp_path / "journal"))
    service = spawn(*serve)
    with connect(service.ready()[0], client="robot", timeout_s=60) as bus, bus.map("window") as joined:
        drive(joined, 0, 12)
        joined.settle()
        settled = {name: joined.estimate[name] for name in ("x5", "x8", "x11")}
        done = joined.change(Changes().marginalize("x1", "x2", "x3", "x4"), settle=True)
        assert done.report["added_factors"] == 1
        for name, value in settled.items():
            np.testing.assert_allclose(joined.estimate[name], value, rtol=0, atol=1e-9)
        (joining,) = [g for g in joined.graph().batch.factors if g.kind.startswith("linear")]
        assert joining.keys.shape[1] >= 3
        drive(joined, 12, 14)
        joined.wait_converged()
        before, graph = joined.ask_estimate(), joined.graph()
    service.signal(signal.SIGKILL)
    service.wait()
    again = spawn(*serve)
    with connect(again.ready()[0], client="robot", timeout_s=60) as bus, bus.map("window", create=False) as joined:
        after, new = joined.ask_estimate(), joined.graph()
        assert (after.epoch, after.revision) == (before.epoch, before.revision)
        for old, now in zip(before.variables, after.variables, strict=True):
            assert (old.keys.tobytes(), old.values.tobytes()) == (now.keys.tobytes(), now.values.tobytes())
        for old, now in zip(graph.batch.factors, new.batch.factors, strict=True):
            assert (old.measured.tobytes(), old.information.tobytes()) == (
                now.measured.tobytes(),
                now.information.tobytes(),
            )
        # What ask/graph gives makes the same map elsewhere.
        bus.map("copy").insert(new.batch)
        copied = bus.map("copy", create=False)
        copied.settle()
        joined.settle()
        for old, now in zip(joined.ask_estimate().variables, copied.ask_estimate().variables, strict=True):
            np.testing.assert_allclose(now.values, old.values, rtol=0, atol=1e-9)


def ran(*arguments: str, code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "factorbus.cli", *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == code, done.stderr
    return done.stdout


def test_the_command_line_changes_and_repairs(endpoint: str, square: Map) -> None:
    at = ("--connect", endpoint, "--json")
    rng = np.random.default_rng(1)
    false = []
    for number, step in enumerate(manhattan(120, 4, loops=LoopClosures(gap=20))):
        groups, batch = step.batch.factors, step.batch
        if number > 40 and number % 10 == 0:
            last = int(groups[0].keys[0].max())
            ends = np.array([[last - 30, last]])
            z = np.array([[*rng.normal(0, 1, 2), rng.uniform(-3, 3)]])
            wrong = Factors("between_se2", ends, z, groups[0].information[:1])
            batch = batch._replace(factors=(*groups, wrong))
        accepted = square.insert(batch)
        if batch is not step.batch:
            false.append(accepted.first_factor + batch.factor_count - 1)
    told = json.loads(ran("ask", "repair", square.name, *at))
    assert set(false) <= {row["factor"] for row in told["false"]}
    assert square.chi2().chi2 > told["after"] - 100
    told = json.loads(ran("ask", "repair", square.name, "--apply", *at))
    assert told["applied"]
    left = json.loads(ran("ask", "repair", square.name, *at))
    assert len(left["false"]) <= 1
    fixed = json.loads(ran("change", "fix", square.name, "x7", *at))
    assert fixed["fixed_variables"] == 1
    json.loads(ran("change", "free", square.name, "x7", *at))
    assert json.loads(ran("change", "loss", square.name, "dcs", "1.0", "3", *at))["edited_factors"] == 1
    assert json.loads(ran("change", "weigh", square.name, "0.5", "3", *at))["edited_factors"] == 1
    last = max(int(k) for g in square.ask_estimate().variables for k in g.keys)
    refused = json.loads(ran("change", "remove", square.name, str(last), f"x{last & 0xFFFF}", *at, code=5))
    assert refused["problem"]["code"] == "unknown_factor"
    assert json.loads(ran("change", "remove", square.name, f"x{last & 0xFFFF}", *at))["removed_variables"] == 1
