"""The pure parts of the client: what a reply means, numbering, following deltas, drafting."""

import math
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.client.draft import Draft
from factorbus.client.following import Following
from factorbus.client.held_values import HeldValues
from factorbus.client.pending_insert import PendingInsert, raise_unseen
from factorbus.client.replies import Again, AnswerReply, Failure, Silence, TimedOut, interpret_reply
from factorbus.client.window import Window
from factorbus.proto.codec import encode_problem
from factorbus.proto.messages import Delta, Estimate, Variables
from factorbus.proto.problems import (
    BadInformation,
    BadSequence,
    BadShape,
    BadStamp,
    BadSymbol,
    Busy,
    Problem,
    Refused,
    ShuttingDown,
    UnknownKind,
    WrongEpoch,
)
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol
from factorbus.proto.table import Table


def test_an_answer_is_handed_on() -> None:
    assert interpret_reply(AnswerReply(b"x"), 1) == b"x"


def test_silence_is_asked_again_ever_more_slowly() -> None:
    pauses = [again.pause_s for n in range(1, 7) if isinstance(again := interpret_reply(Silence(), n), Again)]
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]


def test_a_timeout_is_asked_again_at_once() -> None:
    again = interpret_reply(TimedOut(), 3)
    assert isinstance(again, Again)
    assert again.pause_s == 0.0


def test_busy_is_asked_again_when_it_says() -> None:
    again = interpret_reply(Failure(encode_problem(Busy(256, 0.37))), 1)
    assert isinstance(again, Again)
    assert again.pause_s == 0.37


@pytest.mark.parametrize("seconds", [-1.0, 1e9, float("nan"), None, "soon"])
def test_busy_with_a_senseless_time_is_asked_again_soon(seconds: object) -> None:
    busy = Busy(1, 1.0)
    busy.detail["retry_after_s"] = seconds
    again = interpret_reply(Failure(encode_problem(busy)), 1)
    assert isinstance(again, Again)
    assert 0 < again.pause_s < 1


def test_a_service_that_stops_is_asked_again() -> None:
    assert isinstance(interpret_reply(Failure(encode_problem(ShuttingDown())), 1), Again)


def test_other_problems_are_final_unless_they_pass() -> None:
    epoch = interpret_reply(Failure(encode_problem(WrongEpoch(1, 2))), 1)
    assert isinstance(epoch, Refused)
    assert (epoch.code, epoch.detail["epoch"]) == ("wrong_epoch", 2)
    parked = Failure(encode_problem(BadSequence("c", 7, "6 first", 6)))
    assert isinstance(interpret_reply(parked, 1), Refused)
    assert isinstance(interpret_reply(parked, 1, lambda refused: refused.detail["next"] == 6), Again)


def test_a_failure_nobody_can_read_is_a_problem() -> None:
    problem = interpret_reply(Failure(b"\xc1"), 1)
    assert isinstance(problem, Problem)
    assert problem.code == "bad_message"


def test_numbers_go_up_by_one_and_the_window_fills() -> None:
    window: Window[str] = Window(2)
    assert window.next == 1
    window.sent("a")
    window.sent("b")
    assert (window.full, window.idle, window.next, window.unanswered) == (True, False, 3, ["a", "b"])
    window.answered(1, None)
    window.answered(1, None)
    assert not window.full
    refusal = Problem("no")
    window.answered(2, refusal)
    assert window.idle
    assert window.take_refused() == [("b", refusal)]
    assert window.take_refused() == []


def test_of_several_refusals_the_first_is_raised_with_the_others() -> None:
    def pending(seen: bool) -> PendingInsert:
        made = PendingInsert(cast("Any", None), 1, 1.0)
        made.seen = seen
        return made

    known, first, second, third = (Refused(code, code, {}) for code in ("looked_at", "a", "b", "b"))
    raise_unseen([(pending(True), known)])
    with pytest.raises(Refused) as raised:
        raise_unseen([(pending(True), known), *((pending(False), each) for each in (first, second, third))])
    assert raised.value is first
    assert first.others == (second, third)
    assert raised.value.__notes__ == ["2 further inserts refused: 2 b; the first of them: b [b]"]


def test_an_insert_waits_only_for_one_that_is_still_being_sent() -> None:
    window: Window[str] = Window(4)
    for item in "abc":
        window.sent(item)
    window.answered(1, None)
    assert window.waits_for(3, 2)
    assert not window.waits_for(3, 1)
    assert not window.waits_for(2, 3)


def refused(following: int) -> Problem:
    return Problem("no", next=following)


def test_a_number_that_was_refused_and_used_up_is_not_used_again() -> None:
    window: Window[str] = Window(4)
    window.sent("a")
    window.answered(1, refused(2))
    assert (window.full, window.next) == (False, 2)


def test_a_number_that_was_refused_and_not_used_up_is_used_again_when_nothing_is_in_flight() -> None:
    window: Window[str] = Window(4)
    for item in "abcd":
        window.sent(item)
    window.answered(1, None)
    window.answered(3, refused(2))
    assert window.full, "what would be sent now would be refused as well"
    window.answered(2, refused(2))
    window.answered(4, refused(2))
    assert (window.full, window.idle, window.next) == (False, True, 2)


def test_a_window_holds_at_least_one() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Window(0)


# ---- following ----------------------------------------------------------------------------------------------------


def column(keys: list[int], at: float) -> tuple[Variables, ...]:
    return (Variables("point2", np.array(keys), np.array([[at, float(key)] for key in keys])),)


def follow(following: Following, estimate: Estimate) -> list[Delta]:
    return following.estimate(estimate, HeldValues(estimate.variables))


def started(revision: int = 3) -> Following:
    following = Following()
    follow(following, Estimate(7, revision, column([1, 2], 0.0)))
    return following


def test_deltas_in_order_are_applied() -> None:
    following = started()
    delta = Delta(7, 4, 3, column([2, 3], 4.0))
    assert following.delta(delta) == [delta]
    assert (following.live, following.revision, following.values.count()) == (True, 4, 3)
    keys, values = following.values.columns()["point2"]
    assert keys.tolist() == [1, 2, 3]
    assert values.tolist() == [[0, 1], [4, 2], [4, 3]]


def test_a_gap_is_noticed_and_mended_by_the_estimate_and_what_came_meanwhile() -> None:
    following = started()
    assert following.delta(Delta(7, 5, 4, column([1], 5.0))) == []
    assert not following.live
    assert following.delta(Delta(7, 6, 5, column([3], 6.0))) == []
    assert following.values.find(1)[1].tolist() == [0, 1]  # the old value stays readable
    news = follow(following, Estimate(7, 5, column([1, 2], 5.0)))
    assert [(delta.previous, delta.revision) for delta in news] == [(0, 5), (5, 6)]
    assert (following.live, following.revision) == (True, 6)
    assert following.values.find(3)[1].tolist() == [6, 3]


def test_an_estimate_older_than_the_gap_is_not_enough() -> None:
    following = started()
    following.delta(Delta(7, 9, 8, column([1], 9.0)))
    follow(following, Estimate(7, 5, column([1, 2], 5.0)))
    assert not following.live
    follow(following, Estimate(7, 8, column([1, 2], 8.0)))
    assert (following.live, following.revision) == (True, 9)


def test_what_is_older_than_we_are_changes_nothing() -> None:
    following = started(revision=6)
    assert following.delta(Delta(7, 5, 4, column([1], 5.0))) == []
    assert following.live
    assert follow(following, Estimate(7, 6, column([1], 9.0))) == []
    following.lost()
    assert follow(following, Estimate(7, 5, column([1], 9.0))) == []
    assert not following.live
    assert following.values.find(1)[1].tolist() == [0, 1]


def test_another_epoch_starts_over() -> None:
    following = started(revision=100)
    assert following.delta(Delta(8, 1, 0, column([1], 1.0))) == []
    assert not following.live
    follow(following, Estimate(8, 1, column([1], 1.0)))
    assert (following.live, following.epoch, following.revision, following.values.count()) == (True, 8, 1, 1)


@given(
    losses=st.lists(st.booleans(), min_size=1, max_size=30),
    answers=st.lists(st.integers(0, 3), min_size=30, max_size=30),
)
def test_whatever_is_lost_a_live_mirror_is_bitwise_the_map(losses: list[bool], answers: list[int]) -> None:
    truth: dict[int, float] = {}
    following = Following()
    follow(following, Estimate(1, 0, ()))
    history = [Estimate(1, 0, ())]
    for revision, lost in enumerate(losses, start=1):
        keys = [revision, max(1, revision - 3)]
        truth |= dict.fromkeys(keys, float(revision))
        delta = Delta(1, revision, revision - 1, column(sorted(set(keys)), float(revision)))
        columns = Variables("point2", np.array(list(truth)), np.array([[at, float(k)] for k, at in truth.items()]))
        history.append(Estimate(1, revision, (columns,)))
        if not lost:
            following.delta(delta)
        if not following.live:  # the answer may be some steps old
            follow(following, history[max(0, revision - answers[revision - 1])])
        if following.live and following.revision == revision:
            keys_now, values = following.values.columns()["point2"]
            assert dict(zip(keys_now.tolist(), values[:, 0].tolist(), strict=True)) == truth


@given(st.lists(st.lists(st.integers(0, 40), min_size=1, max_size=20, unique=True), max_size=12), st.booleans())
def test_a_table_is_a_dictionary(puts: list[list[int]], stamped: bool) -> None:
    """Every third has a time stamp, if any: it comes with the first value, and may be told again or not."""
    table, truth = Table(2), {}
    for turn, keys in enumerate(puts):
        values = np.array([[turn, key] for key in keys], float)
        stamps = np.array([NO_STAMP if key % 3 else -key for key in keys]) if stamped else None
        table.put(np.array(keys), values, None if turn % 2 and set(keys) <= set(truth) else stamps)
        truth |= {key: value.tolist() for key, value in zip(keys, values, strict=True)}
    keys, values = table.columns()
    assert keys.tolist() == sorted(truth)
    assert {key: value.tolist() for key, value in zip(keys.tolist(), values, strict=True)} == truth
    assert all(table.get(key).tolist() == value for key, value in truth.items())
    assert table.get(99) is None
    times = [-key if stamped and key % 3 == 0 else None for key in sorted(truth)]
    assert [table.stamp(key) for key in sorted(truth)] == times
    assert table.stamps().tolist() == [NO_STAMP if time is None else time for time in times]
    assert table.stamp(99) is None


# ---- drafting -----------------------------------------------------------------------------------------------------


NS = 1_403_636_579_763_555_584


@pytest.mark.parametrize("stamp", [0, -1, NS, np.int64(NS), np.uint64(NS), np.int32(5), NO_STAMP + 1, 2**63 - 1])
@pytest.mark.parametrize("kind", ["se2", "se3", "point2", "point3", "idp"])
def test_a_draft_keeps_every_digit_of_a_time_stamp(kind: str, stamp: int) -> None:
    draft = getattr(Draft(), kind)("x1", stamp=stamp)
    getattr(draft, kind)("x2")
    (group,) = draft.batch().variables
    assert group.stamps is not None
    assert (group.stamps.dtype, group.stamps.tolist()) == (np.int64, [int(stamp), NO_STAMP])


def test_a_draft_without_time_stamps_has_no_column_of_them() -> None:
    assert all(g.stamps is None for g in Draft().se2("x1").point2("l1", (0, 0), stamp=None).batch().variables)


@pytest.mark.parametrize(
    "stamp", [1.0, 1.5e9, math.nan, np.float64(NS), True, np.bool_(True), "12", b"1", 2**63, -(2**63), [1], NS * 1j]
)
def test_what_is_no_time_stamp_is_refused_with_a_word_on_nanoseconds(stamp: object) -> None:
    draft = Draft()
    with pytest.raises(BadStamp, match=r"se2 x3: stamp is .*; wanted whole nanoseconds") as refused:
        draft.se2("x3", (0, 0, 0), stamp=stamp)  # type: ignore[arg-type]
    assert refused.value.code == "bad_stamp"
    assert refused.value.detail["where"] == "se2 x3"
    assert draft.batch().variable_count == 0


def test_a_draft_becomes_columns() -> None:
    batch = (
        Draft()
        .se2("x0", (0, 0, 0), fixed=True)
        .se2("x1")
        .se2("x2")
        .point2("l5", (3, 4))
        .between_se2("x0", "x1", (1, 0, 0.1), sigmas=(0.1, 0.2, 0.5))
        .between_se2("x1", "x2", (2, 0, 0.2), information=np.diag([1, 2, 3]))
        .bearing_range_se2("x1", "l5", (0.5, 2), information=(4, 0.5, 9))
        .batch()
    )
    assert [(g.kind, g.keys.tolist(), g.values is None, g.fixed) for g in batch.variables] == [
        ("se2", [symbol("x", 0)], False, True),
        ("se2", [symbol("x", 1), symbol("x", 2)], True, False),
        ("point2", [symbol("l", 5)], False, False),
    ]
    between, bearing = batch.factors
    assert between.keys.shape == (2, 2)
    assert between.information.tolist() == [[1 / 0.1**2, 0, 0, 1 / 0.2**2, 0, 4], [1, 0, 0, 2, 0, 3]]
    assert bearing.information.tolist() == [[4, 0.5, 9]]
    assert (batch.variable_count, batch.factor_count) == (4, 3)


@pytest.mark.parametrize(
    ("draw", "problem", "text"),
    [
        (lambda d: d.se2("x", (0, 0, 0)), BadSymbol, "such as x12"),
        (lambda d: d.se2("x1", (0, 0)), BadShape, r"se2 x1: shape \(2,\); wanted \(3,\)"),
        (lambda d: d.between_se2("x0", "x1", (1, 0), sigmas=(1, 1, 1)), BadShape, "between_se2 x0 x1: measured"),
        (lambda d: d.between_se2("x0", "x1", (1, 0, 0)), BadInformation, "one of the two"),
        (lambda d: d.prior_se2("x0", (1, 0, 0), sigmas=(1, 0, 1)), BadInformation, "positive"),
        (lambda d: d.prior_se2("x0", (1, 0, 0), sigmas=(1, 1)), BadShape, "sigmas"),
        (lambda d: d.prior_point2("l0", (1, 0), information=[[1, 0.5], [0.4, 1]]), BadInformation, "symmetric"),
        (lambda d: d.prior_point2("l0", (1, 0), information=[1, 0]), BadShape, "upper triangle"),
        (lambda d: d.factor("between_se2", ("x0",), (1, 0, 0), sigmas=(1, 1, 1)), BadShape, "keys: 1; wanted 2"),
        (lambda d: d.variable("se4", "x0"), UnknownKind, "se4"),
        (lambda d: d.range_se2("x0", "l0", (1, 2), sigmas=0.1), BadShape, r"measured: shape \(2,\); wanted \(1,\)"),
        (lambda d: d.heading_se2("x0", (1, 2), sigmas=0.1), BadShape, r"measured: shape \(2,\); wanted \(1,\)"),
    ],
)
def test_a_draft_refuses_what_cannot_be_meant(draw: object, problem: type[Problem], text: str) -> None:
    with pytest.raises(problem, match=text):
        draw(Draft())


def test_a_refused_line_leaves_the_draft_as_it_was() -> None:
    draft = Draft().se2("x0", (0, 0, 0))
    with pytest.raises(BadShape):
        draft.se2("x1", (0, 0))
    with pytest.raises(BadInformation):
        draft.prior_se2("x0", (0, 0, 0))
    assert (draft.batch().variable_count, draft.batch().factor_count) == (1, 0)
