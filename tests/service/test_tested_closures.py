"""A map that tests its closures: ids, verdicts, what a user says, and the journal, whatever comes in which order."""

from itertools import islice
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from naive.random_plane import contradicting_steps
from tested_maps import TestedMap, between, corridor, happenings, ids, right

from factorbus.journal.records import ACCEPTED, REFUSED
from factorbus.proto.closures import CLOSURE_REASONS, CLOSURE_STATES, ClosureEntry, decode_closure_entry
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.own_clients import JUDGE
from factorbus.solver import Solver
from factorbus.solver.closures import ahead, ledger
from factorbus.solver.closures.judging import ClosureJudge
from factorbus.solver.closures.numbers import residuals_weighed
from factorbus.solver.divergence import unstage
from factorbus.solver.errors import NotFinite
from factorbus.solver.report import StepReport

LENGTH = 8


def driven(length: int = LENGTH) -> TestedMap:
    made = TestedMap()
    for batch in corridor(length):
        made.insert(batch)
    return made


def test_words_of_states_and_reasons_are_those_of_the_wire() -> None:
    assert ledger.CLOSURE_STATES == CLOSURE_STATES
    assert {ledger.NEW, ledger.BY_USER, ledger.FAILED} < set(CLOSURE_REASONS)


def test_a_report_says_what_became_of_closures_and_ids_are_as_if_all_were_in() -> None:
    made = driven()
    new = Variables("se2", ids(17))
    # Of three closures the second is false; odometry comes between them.
    factors = (right(1, LENGTH), between(2, 15, [3.0, 0.0, 3.14]), between(16, 17, [1.0, 0.0, 0.0]), right(3, LENGTH))
    (accepted,) = made.insert(Batch((new,), factors))
    assert (accepted.first_factor, accepted.report["closures"], accepted.report["suspects"]) == (16, 3, 1)
    assert made.states() == {16: "accepted", 17: "suspect", 19: "accepted"}
    assert made.in_graph() == {k: row for k, row in made.ids.items() if k != 17}
    assert accepted.revision == made.solver.revision, "the answer names the revision that has the verdicts"
    (plain,) = made.insert(Batch((Variables("se2", ids(18)),), (between(17, 18, [1.0, 0.0, 0.0]),)))
    assert (plain.first_factor, "suspects" in plain.report) == (20, False)


def test_verdicts_are_entries_behind_their_insert() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH),)), Batch((), (between(2, 15, [3.0, 0.0, 3.14]),)))
    entries = made.records[-1].entries
    assert [entry.client for entry in entries] == ["robot", JUDGE, "robot", JUDGE]
    verdicts = [decode_closure_entry(entry.message) for entry in entries if entry.client == JUDGE]
    assert [(v.sequence, v.factors.tolist(), v.states) for v in verdicts] == [
        (1, [16], ("accepted",)),
        (2, [17], ("suspect",)),
    ]


def test_suspects_are_looked_at_again_when_the_map_has_got_or_lost_closures() -> None:
    made = driven(40)
    for n in range(30):  # more than one look is at
        made.insert(Batch((), (between(20 + n, 2, [9.0, 9.0, 1.0 + 0.01 * n]),)))
    assert set(made.states().values()) == {"suspect"}
    ledger_of = made.solver._ledger.of_kind["between_se2"]  # type: ignore[attr-defined]
    before = ledger_of.looked[:30].copy()
    assert before.max() == 30
    for k in range(1, 20, 3):
        made.insert(Batch((), (right(k, 40),)))
    assert "accepted" in made.states().values()
    left = ledger_of.looked[:30] <= before
    most_likely = residuals_weighed(made.solver._solver, ledger_of, np.arange(30))  # type: ignore[attr-defined]
    assert (most_likely[left] > ClosureJudge().limits[3].out).all(), "but for those that cannot be believed"
    assert made.change(Change("reject", ids(next(k for k, state in made.states().items() if state == "accepted"))))
    for k in (2, 5, 8, 11, 14):
        made.insert(Batch((), (right(k, 40),)))
    assert (ledger_of.looked[:30] > before).all(), "each of them, a few at a time"


def test_a_journal_is_run_again_by_its_verdicts_and_not_by_judging(monkeypatch: pytest.MonkeyPatch) -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH), between(2, 15, [3.0, 0.0, 3.14]))))

    def judge(*_: object) -> None:
        raise AssertionError("a later version may judge otherwise: nobody asks it")

    monkeypatch.setattr(ClosureJudge, "look", judge)
    monkeypatch.setattr(ClosureJudge, "look_back", judge)
    monkeypatch.setattr(ahead, "_foresee", judge)
    made.kill()
    assert made.states() == {16: "accepted", 17: "suspect"}


def test_closures_that_came_without_verdicts_are_judged_with_the_next_insert_whatever_it_is() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH), right(4, LENGTH), between(2, 15, [3.0, 0.0, 3.14]))))
    before = made.states()
    assert before == {16: "accepted", 17: "accepted", 18: "suspect"}
    made.go_back()
    assert set(made.suspects().reasons) == {"new"}
    made.kill()
    made.insert(Batch((Variables("se2", np.array([900])),), (between(15, 900, [1.0, 0.0, 0.0], trusted=True),)))
    assert made.states() == before
    assert "new" not in made.suspects().reasons
    judged = made.judged()
    made.insert(Batch())
    assert made.judged() == judged, "once"
    made.kill()
    made.go_back()
    for further in (False, True):  # nothing but a graft, or a step with nothing new
        made.solver.apply_whole([], further)
        assert set(made.suspects().reasons) == {"new"}, "without an insert the journal has no place for verdicts"


def test_what_a_user_says_stays_whatever_comes() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH), between(2, 15, [3.0, 0.0, 3.14]))))
    accepted = made.change(Change("accept", ids(17)), Change("reject", ids(16)))
    assert accepted.first_factor == 18
    assert set(made.in_graph()) == {*range(16), 17}
    for k in range(3, 7):
        made.insert(Batch((), (right(k, LENGTH),)))
    assert made.states() | {16: "rejected", 17: "restored"} == made.states()
    made.change(Change("accept", ids(16)))
    made.change(Change("reject", ids(17)))
    assert {16: made.states()[16], 17: made.states()[17]} == {16: "restored", 17: "rejected"}
    made.kill()


def test_changes_of_closures_that_are_out() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH), between(2, 15, [3.0, 0.0, 3.14]), between(2, 14, [9.0, 0.0, 3.14]))))
    assert made.states() == {16: "accepted", 17: "suspect", 18: "suspect"}
    for change in (Change("weigh", ids(17), weight=np.ones(1)), Change("loss", ids(17), loss="dcs", scale=np.ones(1))):
        refused = made.change(change)
        assert (refused.code, refused.detail["factor"], refused.detail["state"]) == ("switched_off", 17, "suspect")
    refused = made.change(Change("accept", ids(3)))
    assert (refused.code, refused.detail) == ("not_a_closure", {"factor": 3})
    assert made.change(Change("accept", ids(17)), Change("reject", ids(17))).code == "named_twice"
    assert made.change(Change("accept", ids(17)), Change("remove_factors", ids(17))).code == "named_twice"
    removed = made.change(Change("remove_factors", ids(17, 16)))
    assert removed.report["removed_factors"] == 1
    assert made.states() == {18: "suspect"}
    made.change(Change("remove_variables", keys=ids(16, 15, 14)))
    assert made.states() == {}
    made.kill()


def test_a_closure_in_the_estimate_that_one_insert_asks_two_things_of_is_named_twice() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH),)))
    before = made.states()
    assert before == {16: "accepted"}
    weigh, loss = (
        Change("weigh", ids(16), weight=np.full(1, 0.5)),
        Change("loss", ids(16), loss="dcs", scale=np.ones(1)),
    )
    for changes in (
        (Change("remove_factors", ids(3, 16)), Change("accept", ids(16))),
        (Change("remove_factors", ids(16)), Change("reject", ids(16))),
        (weigh, Change("reject", ids(16))),
        (Change("reject", ids(16)), loss),
    ):
        refused = made.change(*changes)
        assert (refused.code, refused.detail["factor"]) == ("named_twice", 16), changes
    assert (made.states(), 16 in made.in_graph()) == (before, True)
    made.change(weigh, Change("accept", ids(16)))
    assert made.states() == {16: "restored"}
    made.kill()


def test_a_loss_of_a_closure_goes_out_and_comes_back_with_it() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH),)))
    made.change(Change("loss", ids(16), loss="dcs", scale=np.ones(1)), Change("weigh", ids(16), weight=np.full(1, 0.5)))
    made.change(Change("reject", ids(16)))
    made.change(Change("accept", ids(16)))
    (found,) = (group for group in made.solver.solver.graph()[1] if group.loss)
    assert (found.ids.tolist(), found.loss) == ([16], "dcs")
    np.testing.assert_allclose(found.information[0, 0], 0.5 / 0.02**2)
    made.kill()


def test_trusted_factors_and_those_of_changes_are_not_tested() -> None:
    made = driven()
    made.insert(Batch((), (between(2, 15, [0.3, 0.0, 3.14], trusted=True),)))
    made.insert(Batch((), (between(3, 14, [0.3, 0.0, 3.14]),)), changes=(Change("fix", keys=ids(1)),))
    assert (made.states(), set(made.in_graph())) == ({}, set(range(18)))


def test_poses_that_went_and_came_again_are_joined_anew() -> None:
    made = driven()
    made.change(Change("remove_variables", keys=ids(16)))
    (accepted,) = made.insert(Batch((Variables("se2", ids(16)),), (between(1, 16, [0.5, 0.0, 3.14]),)))
    assert accepted.first_factor == 16
    assert made.states() == {}, "nothing else joins it"
    made.kill()


def test_a_bad_closure_refuses_its_insert_whole() -> None:
    made = driven()
    new, odometry = Variables("se2", ids(17)), between(16, 17, [1.0, 0.0, 0.0])
    (refused,) = made.insert(Batch((new,), (odometry, between(1, 99, [0.0, 0.0, 0.0]))))
    assert refused.code == "unknown_variable"
    made.insert(Batch((new,), (odometry,)))
    assert made.solver.size == (18, 17)
    made.kill()


def test_what_the_map_expects_goes_in_with_the_step_of_its_insert() -> None:
    made = driven()
    new, odometry = Variables("se2", ids(17)), between(16, 17, [1.0, 0.0, 0.0])
    revision = made.solver.revision
    # The first of its factors is a closure that stays out, so that no factor's id is that of its row.
    (accepted,) = made.insert(Batch((new,), (between(2, 15, [3.0, 0.0, 3.14]), odometry, right(1, LENGTH))))
    assert (accepted.revision, made.solver.revision) == (revision + 1, revision + 1)
    assert (accepted.report["new_factors"], accepted.report["closures"], accepted.report["suspects"]) == (2, 2, 1)
    entries = [decode_closure_entry(entry.message) for entry in made.records[-1].entries if entry.client == JUDGE]
    assert [(entry.ahead, entry.factors.tolist(), entry.states) for entry in entries] == [
        (True, [18], ("accepted",)),
        (False, [16], ("suspect",)),
    ]
    assert made.in_graph() == {k: row for k, row in made.ids.items() if k != 16}
    made.kill()
    made.kill(made.solver.dump(), len(made.records))


def refuse_steps(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """No step succeeds that has more factors."""
    step = Solver.step

    def without(self: Solver, *arguments: Any) -> StepReport:
        if self.factor_count > most:
            unstage(self)
            raise NotFinite("a value")
        return step(self, *arguments)

    monkeypatch.setattr(Solver, "step", without)


def test_verdicts_whose_step_fails_leave_suspects(monkeypatch: pytest.MonkeyPatch) -> None:
    made = driven()
    with monkeypatch.context() as patched:
        refuse_steps(patched, 2 * LENGTH)
        (accepted,) = made.insert(Batch((), (right(1, LENGTH),)))
        assert accepted.report["suspects"] == 1
        assert (made.states(), made.suspects().reasons) == ({16: "suspect"}, ("failed",))
        entries = made.records[-1].entries
        assert [entry.client for entry in entries] == ["robot", JUDGE, JUDGE, JUDGE]
        assert [entry.outcome for entry in entries] == [ACCEPTED, REFUSED, REFUSED, ACCEPTED]
        assert [decode_closure_entry(entry.message).ahead for entry in entries[1:]] == [True, False, False]
        made.kill()
    made.insert(Batch((), (right(3, LENGTH),)))
    assert made.states() == {16: "accepted", 17: "accepted"}, "it is looked at again"


def test_an_insert_that_fails_without_its_closures_too_is_refused_and_so_is_what_was_believed_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = driven()
    revision, content = made.solver.revision, Batch((Variables("se2", ids(17)),), (between(16, 17, [1.0, 0.0, 0.0]),))
    with monkeypatch.context() as patched:
        refuse_steps(patched, 2 * LENGTH)
        (refused,) = made.insert(content._replace(factors=(right(1, LENGTH), *content.factors)))
        assert (refused.code, made.solver.revision) == ("not_finite", revision)
        entries = made.records[-1].entries
        assert [(entry.client, entry.outcome) for entry in entries] == [("robot", REFUSED), (JUDGE, REFUSED)]
        made.kill()
    assert (made.states(), made.in_graph()) == ({}, made.ids)
    made.insert(content)
    made.insert(Batch((), (right(1, LENGTH),)))
    assert made.states() == {17: "accepted"}


def test_a_judge_that_fails_keeps_the_insert_and_is_asked_again_with_the_next_closure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = driven()
    with monkeypatch.context() as patched:
        patched.setattr(ahead, "_foresee", lambda *_: 1 / 0)
        patched.setattr(ClosureJudge, "look", lambda *_: 1 / 0)
        (accepted,) = made.insert(Batch((), (right(1, LENGTH),)))
    assert (accepted.report["suspects"], made.suspects().reasons) == (1, ("new",))
    made.insert(Batch((), (right(3, LENGTH),)))
    assert made.states() == {16: "accepted", 17: "accepted"}
    made.kill()


@settings(max_examples=40, deadline=None)
@given(happened=happenings())
def test_whatever_happens_ids_stay_and_the_journal_gives_the_same_bits(happened: list[tuple[str, int, float]]) -> None:
    made, gone, state, since = driven(), set[int](), None, 0
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
        out = {factor for factor, state_ in states.items() if state_ in ("suspect", "rejected")}
        assert not states.keys() & gone
        made.check_counts()
        assert made.in_graph() == {factor: keys for factor, keys in made.ids.items() if factor not in gone | out}
    made.kill()


def test_an_entry_of_the_judge_is_what_it_was() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH),)))
    entry = made.records[-1].entries[1]
    again = decode_closure_entry(entry.message)
    assert isinstance(again, ClosureEntry)
    assert (again.states, again.reasons, again.tried.tolist()) == (("accepted",), ("passed",), [-1])
    assert made.judged() == 1


def test_many_closures_at_once_are_judged_in_several_looks() -> None:
    made = driven(40)
    factors = tuple(right(k, 40) for k in range(1, 40)) * 2
    (accepted,) = made.insert(Batch((), factors))
    assert (accepted.report["closures"], accepted.report["suspects"]) == (78, 0)
    assert made.judged() == 2, "64 and the rest"
    assert made.in_graph() == made.ids
    made.kill()
    made.kill(made.solver.dump(), len(made.records))


def test_in_space_the_same() -> None:
    made, triangle = TestedMap(), np.diag([2500.0] * 3 + [10_000.0] * 3)[np.triu_indices(6)][None]

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


def test_counts_are_there_whatever_came() -> None:
    made = driven()
    made.insert(Batch((), (right(1, LENGTH),)))
    counts = {"accepted": 1, "suspect": 0, "rejected": 0, "restored": 0}
    odometry = between(16, 17, [1.0, 0.0, 0.0])
    for content in (Batch((), (odometry,)), Batch((Variables("se2", ids(17)),), (odometry,)), Batch()):
        assert made.solver.apply_whole([made.arrived(content)])[1].closures == counts
    assert made.solver.apply_whole([], further=True)[1].closures == counts


@pytest.mark.parametrize("policy", ["test", "robust"])
@pytest.mark.parametrize("seed", [9, 19, 23])
def test_an_answer_tells_chi2_of_the_revision_that_it_names(seed: int, policy: str) -> None:
    """Steps that verdicts bring about come behind that of the insert, and its answer names the last one."""
    made = TestedMap(policy)
    for batch in islice(contradicting_steps(seed), 6):
        (answer,) = made.insert(batch)
        assert answer.revision == made.solver.revision
        assert answer.report["chi2"] == pytest.approx(made.solver.chi2(), rel=1e-9)
