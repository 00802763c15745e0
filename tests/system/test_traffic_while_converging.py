"""Inserts, changes, questions and time stamps of others while a map goes on by itself, on a service that is killed."""

import signal
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from journalled import SIGMAS, Services, rows
from processes import PATIENCE_S
from turned import LONG, prepare, turn

from factorbus.cli.commands.journal import verify
from factorbus.client import Changes, Draft, connect
from factorbus.client.map import Map
from factorbus.proto.messages import Batch, Delta

STAMPS = (-(2**63) + 1, -1, 0, 2**63 - 1, 1_700_000_000_123_456_789)
KILLS = 3


def assert_contiguous(deltas: list[Delta]) -> None:
    """Each follows the one before, or has everything; one that a mirror missed while it was away it has made good."""
    for before, after in pairwise(deltas):
        assert after.epoch == before.epoch
        whole = after.previous == 0  # all of an estimate, which may be what there was
        assert after.revision >= before.revision if whole else after.previous == before.revision


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
def test_killed_amid_the_traffic_of_others_it_comes_to_the_same_bits(
    services: Callable[..., Services], tmp_path: Path, mode: str
) -> None:
    folder = tmp_path / "journal"
    prepare(folder, "m2", mode)
    running = services(folder, "checkpoint_s=0.2")
    with (
        connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        bus.map("m2", create=False) as robot,
        bus.map("m2", create=False) as other,
    ):
        deltas = turn(robot, LONG)
        loop = robot.graph().batch.factors[-1]
        wanted: dict[str, int] = {}
        passed: list[int] = []
        factors = int(np.concatenate([g.ids for g in robot.graph().batch.factors if g.ids is not None]).max()) + 1
        assert loop.ids is not None
        for kill in range(KILLS):
            if kill == 0 and mode != "bayes-tree":  # the tree may have finished in the step of the loop
                deltas.wait_for_further(1)
            passed += traffic(robot, other, kill, wanted)
            late = [
                other.send(Batch(), changes=Changes().weigh([factors - 1], 2.0), timeout_s=PATIENCE_S),
                robot.send(Draft().se2(f"k{kill}", (1, 1, 0)).prior_se2(f"k{kill}", (1, 1, 0), sigmas=SIGMAS)),
            ]
            running.end(signal.SIGKILL)
            running.start()
            for each in late:
                each.result(PATIENCE_S)
        robot.wait_converged(PATIENCE_S)
        assert np.median(passed) <= 2, f"{passed} steps were made between an insert and its answer"
        estimate, graph = robot.ask_estimate(), robot.graph()
        other.estimate.wait_for(estimate.revision)
        for mirror in (robot.estimate, other.estimate):
            assert rows(mirror.snapshot().variables()) == rows(estimate.variables)
            assert {key: mirror.stamp(key) for key in wanted} == wanted
        assert_contiguous(deltas.all)
        weights = {int(i): row for g in graph.batch.factors for i, row in zip(g.ids, g.information, strict=True)}
        was = {int(i): loop.information[n] for n, i in enumerate(loop.ids)}[factors - 1]
        np.testing.assert_array_equal(weights[factors - 1], was * 2.0**KILLS)
        assert estimate.revision == robot.stats()["revision"]
    running.end(signal.SIGKILL)
    assert verify.callback(("m2",), folder, as_json=False) == 0, "from the beginning, to the bit"
    again = services(folder)
    with connect(again.start(), client="viewer", timeout_s=PATIENCE_S) as bus, bus.map("m2", create=False) as viewer:
        found = viewer.ask_estimate()
        assert (found.revision, rows(found.variables)) == (estimate.revision, rows(estimate.variables))


def traffic(robot: Map, other: Map, kill: int, wanted: dict[str, int]) -> list[int]:
    """Of two clients in turn; gives how many steps passed each insert."""
    passed: list[int] = []
    for n, stamp in enumerate(STAMPS):
        name = f"s{10 * kill + n}"
        before = other.stats()["revision"]
        step = Draft().se2(name, stamp=stamp).between_se2("x0", name, (0.1, 0, 0), sigmas=SIGMAS)
        accepted = other.insert(step)
        passed.append(accepted.revision - before - 1)
        wanted[name] = stamp
        assert robot.chi2().revision >= accepted.revision
        robot.uncertainty.covariance([name])
        if n % 2:
            robot.change(Changes().undo(step, accepted))
            del wanted[name]
    return passed
