"""The steps that a map has made are kept for who comes late: the newest all, the older ones the more sparsely."""

import numpy as np
import pytest

from factorbus.proto.problems import BadMessage
from factorbus.proto.step_history import StepHistory, decode_step_history, encode_step_history
from factorbus.service.core.events import Stepped
from factorbus.service.core.kept_steps import KeptSteps


def step(revision: int) -> Stepped:
    return Stepped(revision, b"", "tree", 0.5 * revision, 3.0, changed=2, step_ms=0.25 * revision, eliminated=7)


def test_a_new_map_has_none() -> None:
    told = decode_step_history(KeptSteps().answer("asker", 7, 0).message)
    assert (told.epoch, told.revision, told.revisions.size, told.chi2.size) == (7, 0, 0, 0)


def test_all_are_there_while_there_is_room() -> None:
    steps = KeptSteps()
    for revision in range(1, 101):
        steps.add(step(revision))
    told = decode_step_history(steps.answer("asker", 7, 100).message)
    np.testing.assert_array_equal(told.revisions, np.arange(1, 101))
    np.testing.assert_array_equal(told.chi2, 0.5 * told.revisions)
    np.testing.assert_array_equal(told.step_ms, 0.25 * told.revisions)
    assert (set(told.eliminated.tolist()), set(told.changed.tolist())) == ({7}, {2})


def test_a_long_drive_is_there_from_its_beginning() -> None:
    steps = KeptSteps(most=64)
    for revision in range(1, 5001):
        steps.add(step(revision))
    kept = steps.history(7, 5000).revisions
    assert len(kept) <= 64
    assert (kept[0], kept[-1]) == (1, 5000)
    np.testing.assert_array_equal(kept[-30:], np.arange(4971, 5001))
    gaps = np.diff(kept)
    assert (gaps > 0).all()
    assert gaps[0] > 100, "long ago there are few"


def test_steps_that_do_not_count_any_more_are_replaced() -> None:
    """A replica goes back to what is upstream, and on from there."""
    steps = KeptSteps()
    for revision in (1, 2, 3, 4, 3, 4):
        steps.add(step(revision))
    np.testing.assert_array_equal(steps.history(7, 4).revisions, [1, 2, 3, 4])


@pytest.mark.parametrize("revisions", [[3, 2], [2, 2], [2**63 - 1, -(2**63)]])
def test_revisions_that_cannot_be_are_refused(revisions: list[int]) -> None:
    steps = np.zeros(2)
    told = encode_step_history(StepHistory(7, 5, np.array(revisions), steps, steps, steps, steps))
    with pytest.raises(BadMessage, match="revisions: some out of order; wanted ascending ones"):
        decode_step_history(told)
