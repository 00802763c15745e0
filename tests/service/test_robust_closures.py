"""A map that weighs its closures: stages, states, what a user says, and the journal, whatever comes in which order."""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tested_maps import TestedMap, between, corridor, happenings, ids, right

from factorbus.proto.closures import CLOSURE_REASONS, ClosureEntry, decode_closure_entry, encode_closure_entry
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.own_clients import JUDGE
from factorbus.service.core.events import Stepped, Verdict
from factorbus.solver.closures import graduation
from factorbus.solver.closures.graduation import ClosureGraduation, own_chi2
from factorbus.solver.closures.ledger import OUTWEIGHED
from factorbus.solver.errors import NotFinite

LENGTH = 8
_FALSE = [3.0, 0.0, 3.14]


def driven(length: int = LENGTH) -> TestedMap:
    made = TestedMap("robust")
    for batch in corridor(length):
        made.insert(batch)
    return made


def distorted(length: int = LENGTH) -> TestedMap:
    """The same with a heading that drifts, so that the first closure does not fit and is graduated."""
    made = TestedMap("robust")
    for batch in corridor(length):
        factors = tuple(
            group._replace(measured=group.measured + np.array([0.0, 0.0, 0.015])) for group in batch.factors
        )
        made.insert(batch._replace(factors=factors))
    return made


def entries_of(made: TestedMap) -> list[ClosureEntry]:
    """Of the last record."""
    return [decode_closure_entry(entry.message) for entry in made.records[-1].entries if entry.client == JUDGE]


def losses(made: TestedMap) -> dict[int, str]:
    return {i: g.loss for g in made.solver.solver.graph()[1] for i in g.ids.tolist() if g.loss}


def outweighed(made: TestedMap) -> set[int]:
    found = made.suspects()
    return {k for k, reason in zip(found.factors.tolist(), found.reasons, strict=True) if reason == "outweighed"}


def test_words_of_reasons_are_those_of_the_wire() -> None:
    own = {graduation.FITS, graduation.GRADUATING, graduation.GRADUATED, graduation.LIGHT, OUTWEIGHED}
    assert own < set(CLOSURE_REASONS)


def test_closures_have_a_loss_and_what_does_not_fit_is_a_suspect_with_its_weight_and_out() -> None:
    made = driven()
    factors = (right(1, LENGTH), between(2, 15, _FALSE), between(16, 17, [1.0, 0.0, 0.0]), right(3, LENGTH))
    (accepted,) = made.insert(Batch((Variables("se2", ids(17)),), factors))
    assert (accepted.first_factor, accepted.report["closures"], accepted.report["suspects"]) == (16, 3, 1)
    assert made.states() == {16: "accepted", 17: "suspect", 19: "accepted"}
    assert made.in_graph() == {k: row for k, row in made.ids.items() if k != 17}
    assert losses(made) == dict.fromkeys((16, 19), "geman-mcclure")
    found = made.suspects()
    assert found.policy == "robust"
    assert found.weight is not None
    np.testing.assert_allclose(found.weight, [1.0, 0.0, 1.0], atol=1e-3)
    np.testing.assert_array_equal(found.chance, 1.0 - found.weight)
    assert (found.reasons, found.distance[1] > 16.0) == (("fits", "outweighed", "fits"), True)
    made.check_counts()
    made.kill()


def test_stages_are_entries_and_steps_and_none_has_converged_before_the_last() -> None:
    made = distorted()
    came = made.arrived(Batch((), (right(1, LENGTH),)))
    events, _ = made.solver.apply_whole([came])
    entries = [
        o.insert.content for e in events if isinstance(e, Verdict) for o in e.outcomes if o.insert.client == JUDGE
    ]
    scales = [entry.scale for entry in entries]
    assert len(scales) >= 3
    assert [scale is None for scale in scales] == [False] * (len(scales) - 1) + [True]
    own = [float(scale[0]) for scale in scales[:-1]]
    assert own == sorted(own, reverse=True), "the kernel narrows"
    assert own[-1] == pytest.approx(ClosureGraduation().final_scales["between_se2"])
    assert [entry.reasons for entry in entries[:-2]] == [("graduating",)] * (len(entries) - 2)
    assert [entry.states for entry in entries] == [("suspect",)] * (len(entries) - 1) + [("accepted",)]
    steps = [event for event in events if isinstance(event, Stepped)]
    assert len(steps) == len(entries)
    assert made.states() == {16: "accepted"}
    assert made.suspects().reasons == ("graduated",)
    assert made.solver.converged


def test_on_the_way_reports_say_that_the_map_has_not_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    made, told = distorted(), list[tuple[bool, str]]()
    report_of = type(made.solver)._report_of

    def noted(self: Any, *arguments: Any) -> dict[str, Any]:
        reported = report_of(self, *arguments)
        told.append((reported["converged"], reported["because"]))
        return reported

    monkeypatch.setattr(type(made.solver), "_report_of", noted)
    (accepted,) = made.insert(Batch((), (right(1, LENGTH),)))
    assert [converged for converged, because in told if "1 closure graduated" in because][:-1] == [False] * (
        len(told) - 2
    )
    assert told[-1][0]
    assert accepted.report["converged"]
    assert accepted.report["chi2"] == pytest.approx(made.solver.chi2())


def test_a_journal_is_run_again_by_its_entries_and_not_by_weighing(monkeypatch: pytest.MonkeyPatch) -> None:
    made = distorted()
    made.insert(Batch((), (right(1, LENGTH), between(2, 15, [9.0, 0.0, 1.0]))))
    before = made.states()
    assert before == {16: "accepted", 17: "suspect"}

    def weigh(*_: object) -> None:
        raise AssertionError("a later version may weigh otherwise: nobody asks it")

    monkeypatch.setattr(ClosureGraduation, "looks", weigh)
    made.kill()
    assert made.states() == before


def test_what_was_outweighed_comes_back_when_others_agree_with_it() -> None:
    made = driven(20)
    # A false closure that the map has, in place of what odometry says, and right ones against it.
    made.insert(Batch((), (between(2, 38, [0.25, 0.25, 3.2]),)))
    for k in range(3, 12):
        made.insert(Batch((), (right(k, 20),)))
    states = made.states()
    assert [states[factor] for factor in sorted(states)[1:]] == ["accepted"] * 9
    assert states[min(states)] == "suspect"
    made.kill()


def test_what_a_user_says_stays_and_frees_of_the_loss() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH), between(2, 15, _FALSE))))
    accepted = made.change(Change("accept", ids(17)), Change("reject", ids(16)))
    assert accepted.first_factor == 18
    assert set(made.in_graph()) == {*range(16), 17}
    assert losses(made) == {}
    for k in range(3, 7):
        made.insert(Batch((), (right(k, LENGTH),)))
    assert made.states() | {16: "rejected", 17: "restored"} == made.states()
    found = made.suspects()
    assert found.weight is not None
    assert dict(zip(found.factors.tolist(), found.weight.tolist(), strict=True))[16] == 0.0
    made.change(Change("accept", ids(16)))
    made.change(Change("reject", ids(17)))
    assert (made.states()[16], made.states()[17], 16 in losses(made)) == ("restored", "rejected", False)
    made.kill()
    made.kill(made.solver.dump(), len(made.records))


def test_losses_and_weights_that_a_user_gives() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH), right(2, LENGTH), between(3, 14, _FALSE))))
    made.change(Change("loss", ids(16), loss="dcs", scale=np.ones(1)), Change("weigh", ids(17), weight=np.full(1, 0.5)))
    assert losses(made) == {16: "dcs", 17: "geman-mcclure"}
    assert made.states() == {16: "restored", 17: "accepted", 18: "suspect"}, "its user weighs the first from now on"
    made.change(Change("reject", ids(17)))
    made.change(Change("accept", ids(17)))
    assert 17 not in losses(made)
    (found,) = (g for g in made.solver.solver.graph()[1] if not g.loss)
    np.testing.assert_allclose(found.information[found.ids == 17][0, 0], 0.5 / 0.02**2)
    refused = made.change(Change("reject", ids(18)), Change("accept", ids(18)))
    assert refused.code == "named_twice"
    assert made.change(Change("weigh", ids(18), weight=np.ones(1))).code == "switched_off"
    made.change(Change("reject", ids(18)))
    made.kill()


def test_closures_with_a_loss_of_their_sender_are_not_weighed() -> None:
    made = driven()
    own = between(2, 15, _FALSE)._replace(loss="cauchy", scale=np.ones(1))
    made.insert(Batch((), (own, right(1, LENGTH))))
    assert (made.states(), losses(made)) == ({17: "accepted"}, {16: "cauchy", 17: "geman-mcclure"})


def test_closures_that_came_without_entries_are_weighed_with_the_next_insert() -> None:
    made = distorted()
    made.insert(Batch((), (right(1, LENGTH), right(4, LENGTH), between(2, 15, [9.0, 0.0, 1.0]))))
    before = made.states()
    made.go_back()
    assert set(made.suspects().reasons) == {"new"}
    made.kill()
    made.insert(Batch())
    assert made.states() == before
    made.kill()


def test_a_stage_whose_step_fails_leaves_final_losses_and_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    made = distorted()
    with monkeypatch.context() as patched:
        patched.setattr("factorbus.service.solving.apply.try_change", refuse)
        (accepted,) = made.insert(Batch((), (right(1, LENGTH),)))
        assert accepted.report["suspects"] == 1
        assert (made.states(), made.suspects().reasons) == ({16: "suspect"}, ("failed",))
        made.kill()
    made.insert(Batch((), (right(3, LENGTH),)))
    assert made.states() == {16: "accepted", 17: "accepted"}


@pytest.mark.parametrize("fails", range(1, 12))
def test_where_weighing_fails_between_stages_losses_are_final_and_it_is_tried_again(
    monkeypatch: pytest.MonkeyPatch, fails: int
) -> None:
    made, calls = distorted(), itertools.count(1)

    def measured(*arguments: Any) -> np.ndarray:
        if next(calls) == fails:
            raise ArithmeticError("by chance")
        return own_chi2(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(graduation, "own_chi2", measured)
        made.insert(Batch((), (right(1, LENGTH),)))
        assert next(calls) > fails
    assert scales(made) == pytest.approx([ClosureGraduation().final_scales["between_se2"]])
    assert made.states() == {16: "suspect"}
    assert made.solver.converged
    made.kill()
    made.insert(Batch((), (right(3, LENGTH),)))
    assert made.states() == {16: "accepted", 17: "accepted"}
    made.kill()


def scales(made: TestedMap) -> list[float]:
    return [float(scale) for group in made.solver.solver.graph()[1] if group.scale is not None for scale in group.scale]


def refuse(*_: object) -> None:
    raise NotFinite("a value")


def broken(*_: object) -> Iterator[None]:
    yield from (1 / 0 for _ in (1,))  # type: ignore[misc]


def test_weighing_that_fails_keeps_the_insert_and_is_done_with_the_next_closure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = driven()
    with monkeypatch.context() as patched:
        patched.setattr(ClosureGraduation, "looks", broken)
        (accepted,) = made.insert(Batch((), (right(1, LENGTH),)))
    assert (accepted.report["suspects"], made.suspects().reasons) == (1, ("new",))
    made.insert(Batch((), (right(3, LENGTH),)))
    assert made.states() == {16: "accepted", 17: "accepted"}
    made.kill()


def test_in_space_the_same() -> None:
    made, triangle = TestedMap("robust"), np.diag([2500.0] * 3 + [10_000.0] * 3)[np.triu_indices(6)][None]

    def pose_between(i: int, j: int, x: float) -> Factors:
        return Factors("between_se3", ids(i, j)[None], np.array([[x, 0.0, 0, 0, 0, 0, 1]]), triangle)

    made.insert(Batch((Variables("se3", ids(0), np.array([[0.0] * 6 + [1.0]]), True),)))
    for k in range(1, 9):
        made.insert(Batch((Variables("se3", ids(k)),), (pose_between(k - 1, k, 1.0),)))
    (accepted,) = made.insert(Batch((), (pose_between(2, 5, 3.0), pose_between(1, 7, 2.0))))
    assert (accepted.report["closures"], accepted.report["suspects"]) == (2, 1)
    assert made.states() == {8: "accepted", 9: "suspect"}
    state = made.solver.dump()
    made.change(Change("accept", ids(9)))
    made.kill(state, len(made.records) - 1)


def test_an_entry_with_scales_is_what_it_was() -> None:
    made = distorted()
    made.insert(Batch((), (right(1, LENGTH),)))
    for entry in entries_of(made):
        again = decode_closure_entry(encode_closure_entry(entry))
        assert (again.scale is None) == (entry.scale is None)
        if again.scale is not None:
            np.testing.assert_array_equal(again.scale, entry.scale)


@settings(max_examples=25, deadline=None)
@given(happened=happenings(), drift=st.booleans())
def test_whatever_happens_ids_stay_and_the_journal_gives_the_same_bits(
    happened: list[tuple[str, int, float]], drift: bool
) -> None:
    made, gone, state, since = (distorted() if drift else driven()), set[int](), None, 0
    for what, n, off in happened:
        closures = sorted(made.states())
        poses = {int(key) for group in made.solver.solver.estimate() for key in group.keys}
        if what in ("right", "false"):
            k = 1 + n % (LENGTH - 1)
            if {k, 2 * LENGTH + 1 - k} <= poses:
                z = [0.01 * off, 0.0, 3.14159] if what == "right" else [2.0 + off, off, 3.0]
                other = Batch((), (between(k, 2 * LENGTH + 1 - k, z),))
                made.insert(other, *([other] if n % 3 == 0 else []))
        elif what in ("accept", "reject", "remove") and closures:
            chosen = closures[n % len(closures)]
            came = made.change(Change("remove_factors" if what == "remove" else what, ids(chosen)))
            gone |= {chosen} if what == "remove" and not hasattr(came, "code") else set()
        elif what == "drop" and max(poses) > LENGTH + 2:
            last = max(poses)
            made.change(Change("remove_variables", keys=ids(last)))
            gone |= {factor for factor, keys in made.ids.items() if last in keys}
        elif what == "keep":
            state, since = made.solver.dump(), len(made.records)
        elif what == "kill":
            made.kill(state, since) if n % 2 else made.kill()
        states = made.states()
        out = {factor for factor, state_ in states.items() if state_ == "rejected"} | outweighed(made)
        assert not states.keys() & gone
        made.check_counts()
        assert made.in_graph() == {factor: keys for factor, keys in made.ids.items() if factor not in gone | out}
    made.kill()
