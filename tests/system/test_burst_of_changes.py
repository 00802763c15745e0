"""One client changes a map again and again: others hardly wait for it, and a killed service loses none of it."""

import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from journalled import Services, check_journal, rows
from processes import PATIENCE_S

from factorbus.cli.commands.journal import verify
from factorbus.cli.driving.columns import merged
from factorbus.client import Changes, Draft, connect
from factorbus.client.map import Map
from factorbus.proto.messages import Batch
from factorbus.simulate import manhattan

BURST = 150
SIGMAS = (0.1, 0.1, 0.05)


def fill(joined: Map, poses: int) -> list[int]:
    """A drive in a few inserts; gives the factors that close its loops."""
    loops, variables, factors = list[int](), [], []
    for n, step in enumerate(manhattan(poses, 1)):
        variables += step.batch.variables
        factors += step.batch.factors
        if n % 100 == 99 or n == poses - 1:
            first = joined.insert(Batch(tuple(variables), tuple(factors)), timeout_s=PATIENCE_S).first_factor
            for group in factors:
                if group.keys.shape[1] > 1:
                    loops += (first + np.flatnonzero(np.abs(group.keys[:, 1] - group.keys[:, 0]) > 1)).tolist()
                first += len(group.keys)
            variables, factors = [], []
    return loops


def tiny(number: int) -> Draft:
    return Draft().se2(f"t{number}").between_se2("x0", f"t{number}", (0.1, 0, 0), sigmas=SIGMAS)


def passed_by(bystander: Map, inserts: int) -> list[int]:
    """For each of these inserts how many other steps the map took before it."""
    passed = []
    for n in range(inserts):
        before = bystander.stats()["revision"]
        passed.append(bystander.insert(tiny(n)).revision - before - 1)
    return passed


@pytest.mark.timeout(900)
def test_a_bystander_waits_for_no_more_than_the_change_under_way(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    """Each of these changes is made anew, which takes longer than an exchange: they are told apart by revisions."""
    endpoint = services(tmp_path / "journal", "checkpoint_s=1000", 'durability="group"').start()
    with (
        connect(endpoint, client="changer", timeout_s=PATIENCE_S) as one,
        connect(endpoint, client="bystander", timeout_s=PATIENCE_S) as two,
        one.map("large", window=BURST) as changer,
        two.map("large") as bystander,
    ):
        fill(changer, 2000)
        changes = [Changes().fix("x900") if n % 2 == 0 else Changes().free("x900") for n in range(BURST)]
        pending_inserts = [changer.send(Batch(), changes=each) for each in changes]
        pending_inserts[0].result(PATIENCE_S)
        passed = passed_by(bystander, 10)
        assert not pending_inserts[-1].done(), "else nothing was waited for"
        # The one under way; and those between the answer to the question and the arrival of the insert.
        assert np.median(passed) <= 2, f"{passed} changes were made between an insert and its answer"
        for pending_insert in pending_inserts:
            pending_insert.result(10 * PATIENCE_S)
        stats = bystander.stats()
        assert stats["inserts"]["accepted"] == 20 + BURST + 10
        assert stats["inserts"]["busy"] > 0, "of the burst no more than `limits.changes` wait at a time"
        assert stats["journal"]["checkpoint_record"] == 0, "no change has a checkpoint of its own"


@pytest.mark.timeout(900)
def test_on_twenty_thousand_poses_150_losses_of_one_factor_keep_nobody_waiting(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    """Another client's tiny insert took up to 18.7 s, behind passes over all of the map; now one change comes first."""
    steps = list(manhattan(20_000, 1))
    drive, true = (merged(each) for each in ([s.batch for s in steps], [Batch(tuple(s.truth)) for s in steps]))
    endpoint = services(tmp_path / "journal").start()
    with (
        connect(endpoint, client="changer", timeout_s=PATIENCE_S) as one,
        connect(endpoint, client="bystander", timeout_s=PATIENCE_S) as two,
        one.map("large", window=BURST, mirror=False) as changer,
        two.map("large", mirror=False) as bystander,
    ):
        changer.insert(Batch(true.variables, drive.factors), settle=True)
        (edges,) = drive.factors
        loop = int(np.flatnonzero(np.abs(edges.keys[:, 1] - edges.keys[:, 0]) > 1)[7])
        changes = [Changes().loss([loop], "huber", 1.0 + n % 3) for n in range(BURST)]
        pending_inserts = [changer.send(Batch(), changes=each) for each in changes]
        pending_inserts[0].result(PATIENCE_S)
        passed = passed_by(bystander, 5)
        assert not pending_inserts[-1].done(), "else nothing was waited for"
        assert np.median(passed) <= 2, f"{passed} changes were made between an insert and its answer"
        reports = [pending_insert.result(PATIENCE_S).report for pending_insert in pending_inserts]
        assert {each["strategy"] for each in reports} <= {"tree", "extend"}, "none is a pass over the whole map"
        assert np.median([each["eliminated"] for each in reports]) < 2000


@pytest.mark.timeout(900)
def test_changes_of_factors_tell_what_moved_and_write_no_checkpoints(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    endpoint = services(tmp_path / "journal", "checkpoint_s=1000").start()
    with (
        connect(endpoint, client="changer", timeout_s=PATIENCE_S) as one,
        connect(endpoint, client="viewer", timeout_s=PATIENCE_S) as two,
        one.map("large", window=BURST) as changer,
        two.map("large", create=False) as viewer,
    ):
        loops = fill(changer, 2000)
        begun = changer.stats()["revision"]
        chosen = np.resize(loops, BURST).tolist()
        pending_inserts = [changer.send(Batch(), changes=Changes().loss([each], "huber", 1.5)) for each in chosen]
        reports = [pending_insert.result(PATIENCE_S) for pending_insert in pending_inserts]
        revisions = np.array([begun, *(each.revision for each in reports)])
        assert (np.diff(revisions) > 0).all(), "each is a step of its own; further steps may lie between"
        assert {each.report["strategy"] for each in reports} <= {"tree", "extend"}
        assert np.median([each.report["changed"] for each in reports]) < 1000
        viewer.estimate.wait_for(reports[-1].revision)
        asked = viewer.ask_estimate()
        assert asked.revision >= reports[-1].revision, "further steps may lie between"
        for group in asked.variables:
            for key, row in zip(group.keys.tolist(), group.values, strict=True):
                assert viewer.estimate[key].tobytes() == row.tobytes()
        assert viewer.stats()["journal"]["checkpoint_record"] == 0


@pytest.mark.timeout(900)
def test_killed_in_the_middle_of_changes_none_that_was_answered_is_lost_and_none_is_made_twice(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    """Each change doubles or halves one weight, which two of them would tell from one; loops are given losses, too."""
    chance = random.Random(5)
    running = services(tmp_path / "journal", "checkpoint_s=0.1")
    with (
        connect(running.start(), client="changer", timeout_s=PATIENCE_S) as bus,
        bus.map("m", window=16) as changer,
    ):
        loops = fill(changer, 400)
        base = {int(i): g.information[n] for g in changer.graph().batch.factors for n, i in enumerate(g.ids)}
        gone = loops[::7]
        plan = [Changes().remove_factors([each]) for each in gone]
        times = dict.fromkeys([each for each in loops if each not in gone], 1.0)
        for n, each in enumerate(list(times) * 8):
            weight = 2.0 if chance.random() < 0.6 else 0.5
            times[each] *= weight
            change = Changes().weigh([each], weight)
            plan.append(change.loss([each], "huber", 2.0) if n % 3 == 0 else change)
        chance.shuffle(plan)
        pending_inserts, sent = [], 0
        for kill in range(6):
            for each in plan[sent : sent + len(plan) // 6 + 1]:
                pending_inserts.append(changer.send(Batch(), changes=each, timeout_s=PATIENCE_S))
                if len(pending_inserts) % 11 == 10:
                    pending_inserts.append(changer.send(tiny(len(pending_inserts)), timeout_s=PATIENCE_S))
            sent += len(plan) // 6 + 1
            time.sleep(chance.uniform(0.0, 0.1))  # the moments are what this is about
            answered = [pending_insert for pending_insert in pending_inserts if pending_insert.done()]
            running.end(signal.SIGKILL)
            running.start()
            revision = changer.ask_estimate().revision
            assert all(pending_insert.result(0).revision <= revision for pending_insert in answered), f"kill {kill}"
        changer.flush(PATIENCE_S)
        found = {int(i): g.information[n] for g in changer.graph().batch.factors for n, i in enumerate(g.ids)}
        assert not set(gone) & set(found)
        for each, factor in times.items():
            np.testing.assert_array_equal(found[each], base[each] * factor)
        changer.wait_converged(PATIENCE_S)  # no further step comes between the two answers
        estimate, count = changer.ask_estimate(), len(pending_inserts) + 4
        stats = changer.stats()
        assert stats["variables"] == 400 + sum(n % 11 == 10 for n in range(count))
    running.end(signal.SIGKILL)
    check_journal(tmp_path / "journal" / "m", count)
    assert verify.callback(("m",), tmp_path / "journal", as_json=False) == 0, "from the beginning, to the bit"
    again = services(tmp_path / "journal")
    with connect(again.start(), client="viewer", timeout_s=PATIENCE_S) as bus, bus.map("m", create=False) as viewer:
        assert rows(viewer.ask_estimate().variables) == rows(estimate.variables)
