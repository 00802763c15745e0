"""What is read from, and written to, a ledger in place, and what is left out where nothing can come of it."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from false_closures import drive_with_false
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver
from factorbus.solver.closures.evidence import weights_without
from factorbus.solver.closures.gated import GatedSolver
from factorbus.solver.closures.ledger import Closure, ClosureLedger
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.closures.numbers import _known, closure_numbers, residuals_weighed
from factorbus.solver.kernels.closures.back import bound_without, list_free_ends, list_worst
from factorbus.solver.kernels.model import layout as at

_PLANE = "between_se2"


def driven(poses: int, share: float = 0.0, seed: int = 5) -> GatedSolver:
    made = GatedSolver(Options())
    for batch in drive_with_false(poses, seed, share, "local").batches:
        made.insert(batch)
    return made


@pytest.fixture(scope="module")
def clean() -> GatedSolver:
    """A drive without false closures, which are all in."""
    made = driven(400)
    assert len(made.closures) > 50
    assert all(c.is_in for c in made.closures)
    return made


@examples(60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_the_worst_are_those_that_sorting_all_of_them_gives(clean: GatedSolver, seed: int, room: int) -> None:
    rng, ledger = np.random.default_rng(seed), clean.ledger.of_kind[_PLANE]
    kept = ledger.bound.copy()
    try:
        rows = np.sort(rng.choice(len(ledger.closures), 40, replace=False))
        ledger.bound[rows] *= rng.choice([1e-6, 1.0, 1e3, np.nan], 40)[:, None, None]
        table, found, distance = clean.solver._graph.array_table, np.empty(room, np.int64), np.empty(room)
        weighed = np.nan_to_num(residuals_weighed(clean.solver, ledger, rows), nan=np.inf)
        most = float(rng.choice(weighed))
        count = list_worst(rows, ledger.ends, ledger.z, ledger.bound, table, most, found, distance)
    finally:
        ledger.bound[:] = kept
    beyond = np.flatnonzero(weighed > most) if np.isfinite(most) else np.flatnonzero(np.isinf(weighed))
    wanted = beyond[np.argsort(-weighed[beyond], kind="stable")][:room]
    assert found[:count].tolist() == rows[wanted].tolist()
    np.testing.assert_array_equal(distance[:count], weighed[wanted])
    assert all(one >= other for one, other in pairwise(distance[:count].tolist()))


def test_bounds_made_in_place_are_those_of_the_numbers_also_where_an_end_is_fixed() -> None:
    made = driven(300)
    first = int(made.solver._graph.keys[0])
    last = first + 299
    estimate = {int(k): v for g in made.solver.estimate() for k, v in zip(g.keys, g.values, strict=True)}
    (dx, dy), turn = estimate[last][:2] - estimate[first][:2], estimate[first][2]
    z = [np.cos(turn) * dx + np.sin(turn) * dy, np.cos(turn) * dy - np.sin(turn) * dx, estimate[last][2] - turn]
    weight = np.array([[400.0, 0.0, 0.0, 400.0, 0.0, 900.0]])
    made.insert(Batch((), (Factors(_PLANE, np.array([[first, last]]), np.array([z]), weight),)))
    made.accept(made.closures[-1].factor_id)
    ledger, graph = made.ledger.of_kind[_PLANE], made.solver._graph
    rows = np.array([len(ledger.closures) - 1, 0, 3, 4])
    free, places = np.empty(8, np.int64), np.empty((4, 2), np.int64)
    count = list_free_ends(rows, ledger.ends, graph.array_table, free, places)
    assert places[0, 0] == -1 < places[0, 1]
    known, bound = made.solver.covariances.try_joint(free[:count], 3 * count), ledger.bound.copy()
    assert known is not None
    bound_without(rows, ledger.ends, ledger.noise, places, known, graph.array_table, bound)
    wanted = weights_without(closure_numbers(made.solver, ledger, rows))
    np.testing.assert_allclose(bound[rows], wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())
    untouched = np.setdiff1d(np.arange(len(ledger.closures)), rows)
    np.testing.assert_array_equal(bound[untouched], ledger.bound[untouched])


def test_columns_that_were_foreseen_are_those_that_closures_are_measured_by(clean: GatedSolver) -> None:
    ledger, graph = clean.ledger.of_kind[_PLANE], clean.solver._graph
    other = ClosureLedger()
    for c in clean.closures:
        other.add(c.factor, c.factor_id, graph, c.came)
    wanted, count = other.of_kind[_PLANE], len(clean.closures)
    np.testing.assert_array_equal(ledger.ends[:count], wanted.ends[:count])
    np.testing.assert_allclose(ledger.z[:count], wanted.z[:count], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ledger.noise[:count], wanted.noise[:count], rtol=1e-9, atol=1e-15)
    assert [c.row for c in ledger.closures] == list(range(count))
    assert ledger.is_tested[:count].all()
    assert not (ledger.is_suspect | ledger.is_new | ledger.is_improbable | ledger.is_rival).any()
    assert ledger.accepted == count
    assert clean.ledger.counts()["accepted"] == count


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_where_no_look_is_due_looking_finds_nothing(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    made = GatedSolver(Options())
    due, left_out = made.judge.is_settled, 0

    def looked_all_the_same(solver: Solver, ledger: ClosureLedger, new: Sequence[Closure]) -> bool:
        nonlocal left_out
        left_out += (settled := due(solver, ledger, new))
        if settled:
            assert list(made.judge.looks(lambda: made.solver, ledger, new)) == []
            with monkeypatch.context() as all_are_due:
                all_are_due.setattr(made.judge, "_is_any_due", lambda *_: True)
                assert ledger.suspect_count == 1 or made.judge.look(solver, ledger, _PLANE) is None
        return settled

    monkeypatch.setattr(made.judge, "is_settled", looked_all_the_same)
    for batch in drive_with_false(400, 5, share, "random").batches:
        made.insert(batch)
    assert left_out > 10


@pytest.mark.parametrize("rows", [3, 40])
def test_closures_have_arrays_of_their_own(rows: int) -> None:
    """Of a group that is copied whole, and of one that is not."""
    rng, forest = np.random.default_rng(1), TrustedForest()
    chain = np.array([[k, k + 1] for k in range(rows - 1)])
    keys = np.concatenate([chain, [[0, rows - 1]]])
    group = Factors(
        _PLANE, keys, rng.normal(size=(rows, 3)), rng.normal(size=(rows, 6)), "huber", np.arange(1.0, rows + 1)
    )
    sent = group._replace(keys=keys.copy(), measured=group.measured.copy(), information=group.information.copy())
    (closing,) = forest.split(Batch((Variables("se2", np.arange(rows)),), (sent,))).closing
    for array in (sent.keys, sent.measured, sent.information):
        array[:] = -7
    assert (closing.kind, closing.loss) == (_PLANE, "huber")
    for found, whole in ((closing.keys, keys), (closing.measured, group.measured), (closing.scale, group.scale)):
        np.testing.assert_array_equal(found, whole[-1:])  # pyright: ignore[reportOptionalSubscript]
    np.testing.assert_array_equal(closing.information, group.information[-1:])


def test_a_look_is_due_at_every_eighth_and_while_any_is_a_suspect() -> None:
    judge, ledger = GatedSolver(Options()).judge, ClosureLedger()
    due = []
    for ledger.looks in range(1, 25):
        due += [ledger.looks] * (not judge.is_settled(Solver(Options()), ledger, ()))
    assert due == [8, 16, 24]
    made = driven(300, 0.5)
    assert made.suspects()
    for made.ledger.looks in range(1000, 1016):  # some that no batch of expected ones is followed by
        assert not made.judge.is_settled(made.solver, made.ledger, made.closures)


def test_one_suspect_outside_the_gate_is_not_looked_at_again_while_it_is_alone() -> None:
    made = driven(300)
    first = int(made.solver._graph.keys[0])
    weight = np.array([[400.0, 0.0, 0.0, 400.0, 0.0, 900.0]])
    off = Factors(_PLANE, np.array([[first, first + 299]]), np.array([[900.0, 0.0, 0.0]]), weight)
    made.insert(Batch((), (off,)))
    (alone,) = made.suspects()
    assert alone.reason == "improbable"
    ledger, seen = made.ledger.of_kind[_PLANE], alone.distance
    ledger.looked[alone.row], made.ledger.looks = 0, made.ledger.moved_at  # as after a look at which others went in
    row, limits = np.array([alone.row]), made.judge.limits[3]
    between = 0.5 * (limits.gate + limits.out)  # what agrees with others may be there
    ledger.bound[row] *= between / residuals_weighed(made.solver, ledger, row).item()
    assert made.judge.look(made.solver, made.ledger, _PLANE) is None
    ledger.bound[row] *= 0.9 * limits.gate / between
    verdicts = made.judge.look(made.solver, made.ledger, _PLANE)
    assert verdicts is not None
    assert verdicts.factors.tolist() == [alone.factor_id]
    assert (verdicts.reasons, verdicts.distance[0]) == (("improbable",), pytest.approx(seen, rel=1e-3))


@pytest.mark.parametrize(("off_m", "counted"), [(4.0, True), (40.0, False)])
def test_improbable_ones_that_are_far_off_do_not_make_near_ones_likelier(off_m: float, counted: bool) -> None:
    made = driven(300)
    graph, ledger = made.solver._graph, made.ledger.of_kind[_PLANE]
    first, before = int(graph.keys[0]), made.judge._odds(made.solver, ledger)
    estimate = {int(k): v for g in made.solver.estimate() for k, v in zip(g.keys, g.values, strict=True)}
    (dx, dy), turn = estimate[first + 299][:2] - estimate[first][:2], estimate[first][2]
    there = [np.cos(turn) * dx + np.sin(turn) * dy, np.cos(turn) * dy - np.sin(turn) * dx]
    z = [there[0] + off_m, there[1], estimate[first + 299][2] - turn]
    weight = np.array([[400.0, 0.0, 0.0, 400.0, 0.0, 900.0]])
    made.insert(Batch((), (Factors(_PLANE, np.array([[first, first + 299]]), np.array([z]), weight),)))
    assert [c.reason for c in made.suspects()] == ["improbable"]
    odds = made.judge._odds(made.solver, ledger)
    assert odds.false == pytest.approx(before.false * (2.0 if counted else 1.0))
    made.suspects()[0].reason = "rival"
    ledger.mark(made.closures[-1])
    assert made.judge._odds(made.solver, ledger).false == pytest.approx(2.0 * before.false)


def test_numbers_read_in_one_pass_are_those_of_each_end() -> None:
    made = driven(300, 0.3)
    ledger, graph = made.ledger.of_kind[_PLANE], made.solver._graph
    rows = np.array([5, 3, 3, 0, ledger.count - 1])[::-1]  # not in one piece, and with one twice
    numbers, ends = closure_numbers(made.solver, ledger, rows), ledger.ends[rows].reshape(-1)
    np.testing.assert_array_equal(numbers.known, _known(made.solver, ends, 3))
    at_ends = np.stack([T[:, :2, 2] for T in (numbers.a, numbers.b)], axis=1).reshape(-1, 2)
    np.testing.assert_array_equal(at_ends, graph.values[graph.var[ends, at.V_AT, None] + np.arange(2)])
    starts = graph.var[: graph.counts[at.VARIABLES], at.V_AT]
    sides = np.ptp(graph.values[starts[:, None] + np.arange(2)], axis=0)
    assert made.judge._extent(made.solver, ledger) == sides.max() / 2.0


def test_closures_that_were_expected_are_the_same_objects_whoever_asks_first() -> None:
    made, came = GatedSolver(Options()), list[Closure]()
    for batch in drive_with_false(300, 5, 0.3, "random").batches:
        report = made.insert(batch)
        if len(came) % 3:
            assert len(report.accepted) == len(list(report.accepted))
        came += report.accepted
    assert len(came) > 15
    assert all(made.ledger.of_factor[c.factor_id] is c for c in came)
    listed = made.ledger.of_kind[_PLANE].closures
    assert [c.row for c in listed] == list(range(len(listed))) == [listed.index(c) for c in listed]
    assert {c.factor_id for c in listed} == set(made.ledger.of_factor) == {c.factor_id for c in made.closures}
