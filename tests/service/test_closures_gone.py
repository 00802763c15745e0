"""Closures that a map has no more are told as gone: removed by name, or with a pose that they were between."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from journal_ends import End
from tested_maps import between, corridor, right

from factorbus.proto.messages import Accepted, Batch, Change
from factorbus.proto.records import JournalPlace

LENGTH = 8
ACCEPTED, FALSE, OTHER = 16, 17, 18  # ids


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[End]:
    """A drive with a right closure and two false ones, of which events were looked at."""
    made = End(tmp_path / "robot", "test")
    for batch in corridor(LENGTH):
        assert isinstance(made.insert("robot", batch), Accepted)
    false = between(2, 15, [3.0, 0.0, 3.14]), between(3, 12, [9.0, 0.0, 3.14])
    assert isinstance(made.insert("robot", Batch((), (right(1, LENGTH), *false))), Accepted)
    assert made.solver.closure_counts() == {"accepted": 1, "suspect": 2, "rejected": 0, "restored": 0}
    made.events.clear()
    yield made
    made.close()


def told(end: End) -> list[dict[int, tuple[str, str]]]:
    """Of each event, what it says of which closure."""
    found = [event for event in end.events if event["event"] == "closures"]
    return [
        {f: (s, r) for f, s, r in zip(*(e[n] for n in ("factors", "states", "reasons")), strict=True)} for e in found
    ]


def changed(end: End, *changes: Change) -> Any:
    accepted = end.insert("robot", Batch(), changes)
    assert isinstance(accepted, Accepted), accepted
    return accepted


def ids(*numbers: int) -> np.ndarray:
    return np.array(numbers, np.int64)


def test_those_that_a_change_names(robot: End) -> None:
    accepted = changed(robot, Change("remove_factors", ids(FALSE, ACCEPTED)))
    assert told(robot) == [{ACCEPTED: ("gone", "removed"), FALSE: ("gone", "removed")}]
    assert robot.events[-1]["revision"] == accepted.revision == robot.deltas[-1].revision
    changed(robot, Change("remove_factors", ids(OTHER)))
    assert told(robot)[1:] == [{OTHER: ("gone", "removed")}]
    assert sum(robot.solver.closure_counts().values()) == 0


@pytest.mark.parametrize("change", ["remove_variables", "marginalize"])
def test_those_whose_pose_goes(robot: End, change: str) -> None:
    changed(robot, Change(change, keys=ids(15)) if change == "marginalize" else Change(change, keys=ids(15, 16)))
    wanted = {FALSE: ("gone", "pose_gone")}
    if change == "remove_variables":  # of the right one, too, which was in
        wanted = {ACCEPTED: ("gone", "pose_gone"), **wanted}
    assert told(robot) == [wanted]
    assert set(robot.solver.closure_counts().values()) <= {0, 1}


def test_a_change_that_takes_none_along_tells_nothing(robot: End) -> None:
    changed(robot, Change("fix", keys=ids(7)))
    changed(robot, Change("remove_factors", ids(3)), Change("fix", keys=ids(9)))
    assert told(robot) == []
    refused = robot.insert("robot", Batch(), (Change("remove_variables", keys=ids(99)),))
    assert refused.code == "unknown_variable"
    assert told(robot) == []


def test_who_follows_the_records_is_told_too_and_the_journal_gives_the_same(robot: End, tmp_path: Path) -> None:
    changed(robot, Change("remove_variables", keys=ids(15, 16)))
    base = End(tmp_path / "base", "test")
    robot.push_to(base, JournalPlace())
    (event,) = told(base)
    assert event == {ACCEPTED: ("gone", "pose_gone"), FALSE: ("gone", "pose_gone"), OTHER: ("suspect", "improbable")}
    assert base.solver.closure_counts() == robot.solver.closure_counts()
    base.close()
