"""Records of another journal put into a map's own: real maps, real journals, no bus."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from journal_ends import End, bits, drive, pose
from tested_maps import between, corridor, right

from factorbus.client import Draft
from factorbus.journal.problems import JournalFailed
from factorbus.journal.records import ACCEPTED
from factorbus.journal.store import open_store
from factorbus.proto.messages import Accepted, Batch, Change
from factorbus.proto.own_clients import JUDGE
from factorbus.proto.problems import Problem
from factorbus.proto.records import JournalPlace


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[Callable[[str], End]]:
    """Ends by name; closed, and their journals checked, at the end."""
    made: list[End] = []

    def make(name: str, closures: str = "trust") -> End:
        made.append(End(tmp_path / name, closures))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_what_is_pushed_gives_the_same_bits_and_is_taken_once(ends: Callable[[str], End]) -> None:
    robot, base = ends("robot"), ends("base")
    drive(robot, "x", 0, 12)
    done = robot.push_to(base, JournalPlace())
    assert base.place() == robot.place() == JournalPlace(done.last.record, done.last.chain)
    assert bits(base) == bits(robot)
    assert len(base.deltas) == 12, "who follows the upstream sees every step"
    with pytest.raises(Problem) as again:
        robot.push_to(base, JournalPlace())
    assert again.value.code == "records_moved_on"
    assert base.insert("robot-x", pose("x", 11), number=12).sequence == 12, "it has the answer, as to its own"
    robot.follow(base, JournalPlace())
    assert robot.place() == base.place()
    assert robot.keeper().upstream == base.place()


def corridor_with_closures(end: End, length: int) -> None:
    """There and back; of the closures the second is false."""
    false = between(2, 2 * length - 1, [3.0, 0.0, 3.14])
    for batch in [*corridor(length), *(Batch((), (factor,)) for factor in (right(1, length), false, right(3, length)))]:
        assert isinstance(end.insert("robot", batch), Accepted)


def test_verdicts_that_come_with_records_are_told_and_are_no_inserts(ends: Callable[..., End]) -> None:
    robot, base = ends("robot", "test"), ends("base", "test")
    corridor_with_closures(robot, 8)
    own = [event for event in robot.events if event["event"] == "closures"]
    states = {f: (s, r) for e in own for f, s, r in zip(e["factors"], e["states"], e["reasons"], strict=True)}
    assert states == {16: ("accepted", "passed"), 17: ("suspect", "improbable"), 18: ("accepted", "passed")}
    assert [event["factors"] for event in own] == [[16], [17], [18]]
    robot.push_to(base, JournalPlace())
    (told,) = [event for event in base.events if event["event"] == "closures"]
    columns = zip(told["factors"], told["states"], told["reasons"], strict=True)
    assert {factor: (state, reason) for factor, state, reason in columns} == states
    assert told["revision"] == base.deltas[-1].revision
    assert (bits(base), base.solver.closure_counts()) == (bits(robot), robot.solver.closure_counts())
    assert [entry.client for record in robot.records(17) for entry in record.entries] == ["robot", JUDGE] * 3
    store = open_store(base.folder, read_only=True)
    assert (store.counts()["inserts"], store.counts()["clients"]) == (20, 1)
    store.close()
    assert robot.keeper().stats()["inserts"] == 20


def test_closures_that_are_here_alone_are_no_more_inserts_than_came_and_are_judged_with_the_next(
    ends: Callable[..., End],
) -> None:
    robot, base = ends("robot", "test"), ends("base", "test")
    corridor_with_closures(robot, 8)
    robot.push_to(base, JournalPlace())
    same = base.place()
    assert isinstance(base.insert("desk", Batch((), (right(5, 8),))), Accepted)
    assert isinstance(robot.insert("robot", Batch((), (right(6, 8),))), Accepted)
    robot.events.clear()
    done = robot.follow(base, same)
    assert (done.rebased, done.behind) == (1, 1)
    (told,) = [event for event in robot.events if event["event"] == "closures"]
    assert (told["factors"], told["states"]) == ([19], ["accepted"])
    assert robot.solver.closure_counts() == {"accepted": 3, "suspect": 2, "rejected": 0, "restored": 0}
    assert isinstance(robot.insert("robot", Batch((), (right(7, 8),))), Accepted)
    assert robot.solver.closure_counts() == {"accepted": 5, "suspect": 1, "rejected": 0, "restored": 0}


def test_what_others_wrote_comes_first_and_what_is_here_alone_behind_it(ends: Callable[[str], End]) -> None:
    robot, base = ends("robot"), ends("base")
    drive(robot, "x", 0, 6)
    robot.push_to(base, JournalPlace())
    same = base.place()
    drive(base, "y", 0, 4)
    drive(robot, "x", 6, 9)
    before = robot.deltas[-1].revision
    done = robot.follow(base, same)
    assert (done.rebased, done.behind, done.refused) == (3, 3, ())
    assert done.same_bits
    delta = robot.deltas[-1]
    assert (delta.previous, delta.report["rebased"]) == (0, 3)
    assert delta.revision > before
    assert sum(len(group.keys) for group in delta.variables) == 13, "it has the whole estimate"
    robot.push_to(base, base.place())
    assert robot.place() == base.place()
    assert bits(robot) == bits(base)
    assert [e.client for r in robot.records() for e in r.entries] == ["robot-x"] * 6 + ["robot-y"] * 4 + ["robot-x"] * 3
    drive(robot, "x", 9, 11)
    assert robot.deltas[-1].previous == robot.deltas[-2].revision


def test_what_upstream_cannot_take_is_told_and_goes_here_too(ends: Callable[[str], End]) -> None:
    robot, base = ends("robot"), ends("base")
    drive(base, "x", 0, 3)
    drive(robot, "x", 0, 1)
    assert isinstance(robot.insert("robot-x", Draft().se2("x1", (5, 5, 0), fixed=True).batch()), Accepted)
    assert isinstance(robot.insert("tablet-1", Draft().se2("x2", (7, 7, 0), fixed=True).batch()), Accepted)
    before = robot.deltas[-1].revision
    done = robot.follow(base, JournalPlace())
    codes = {(told.client, told.sequence): told.answer.code for told in done.refused}
    assert codes == {("robot-x", 2): "number_taken", ("tablet-1", 1): "duplicate_variable"}
    assert robot.deltas[-1].revision > before, "who follows the map sees it, though there is less in it"
    again = robot.insert("tablet-1", Draft().se2("x2", (7, 7, 0), fixed=True).batch(), number=1)
    assert again.code == "duplicate_variable", "it is what the number is answered from now on"
    robot.push_to(base, base.place())
    assert robot.place() == base.place()
    assert bits(robot) == bits(base)


def test_a_change_of_factors_that_have_other_ids_now_is_refused(ends: Callable[[str], End]) -> None:
    robot, base = ends("robot"), ends("base")
    drive(robot, "x", 0, 4)
    robot.push_to(base, JournalPlace())
    same = base.place()
    drive(base, "y", 0, 3)
    loop = Draft().between_se2("x0", "x3", (3, 0, 0.3), sigmas=(0.1, 0.1, 0.1)).batch()
    first = robot.insert("robot-x", loop).first_factor
    removal = Change("remove_factors", factors=np.array([first]))
    assert isinstance(robot.insert("robot-x", Batch(), (removal,)), Accepted)
    done = robot.follow(base, same)
    assert [told.answer.code for told in done.refused] == ["factors_moved"]
    assert robot.solver.size[1] == 3 + 2 + 1, "no factor of another has gone"


def test_a_refusal_stays_a_refusal(ends: Callable[[str], End]) -> None:
    """Here the variable was not there; upstream it is.  Who was refused was told so, and that is final."""
    robot, base = ends("robot"), ends("base")
    drive(base, "y", 0, 3)
    drive(robot, "x", 0, 2)
    seen = Draft().between_se2("x1", "y2", (1, 0, 0), sigmas=(0.1, 0.1, 0.1)).batch()
    assert robot.insert("robot-x", seen).code == "unknown_variable"
    robot.follow(base, JournalPlace())
    assert robot.solver.size[1] == 2 + 1
    outcomes = [entry.outcome for record in robot.records() for entry in record.entries]
    assert outcomes.count(ACCEPTED) == len(outcomes) - 1


def test_a_disk_that_takes_nothing_leaves_all_as_it_was(
    ends: Callable[[str], End], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, base = ends("robot"), ends("base")
    drive(base, "y", 0, 3)
    drive(robot, "x", 0, 3)
    before, had = robot.place(), bits(robot)

    def full(*_: Any) -> None:
        raise JournalFailed(robot.folder, "no room")

    with monkeypatch.context() as patched:
        patched.setattr("factorbus.service.journal.keeping.rewrite", full)
        with pytest.raises(Problem) as raised:
            robot.follow(base, JournalPlace())
    assert raised.value.code == "journal_failed"
    assert (robot.place(), bits(robot)) == (before, had)
    robot.follow(base, JournalPlace())
    robot.push_to(base, base.place())
    assert bits(robot) == bits(base)
    drive(robot, "x", 3, 5)


def test_what_was_rebased_comes_back_after_a_restart(tmp_path: Path) -> None:
    robot, base = End(tmp_path / "robot"), End(tmp_path / "base")
    drive(robot, "x", 0, 4)
    drive(base, "y", 0, 4)
    robot.follow(base, JournalPlace())
    place, had = robot.place(), bits(robot)
    robot.close()
    robot = End(tmp_path / "robot")
    assert (robot.place(), bits(robot)) == (place, had)
    assert robot.insert("robot-x", pose("x", 3), number=4).sequence == 4
    robot.push_to(base, base.place())
    assert bits(robot) == bits(base)
    robot.close()
    base.close()
