"""Inserts that change what a map has, among others: steps of their own, refused whole, the same when applied again."""

import numpy as np
import pytest

from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Change, Factors, Insert, Variables
from factorbus.proto.symbols import symbol
from factorbus.service.config import Limits
from factorbus.service.core.events import Arrived, Outcome, Stepped, Verdict
from factorbus.service.questions.answers import Question
from factorbus.service.solving import apply
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import read_again, read_insert
from factorbus.solver import Options, Solver

EPOCH = 9


def pose(n: int, x: float = 1.0) -> Batch:
    keys = np.array([symbol("x", n)])
    if n == 0:
        return Batch((Variables("se2", keys, np.zeros((1, 3)), fixed=True),))
    z, information = np.array([[x, 0.0, 0.1]]), np.array([[100.0, 0, 0, 100, 0, 400]])
    return Batch(
        (Variables("se2", keys),), (Factors("between_se2", np.array([[keys[0] - 1, keys[0]]]), z, information),)
    )


def waiting(content: Batch | tuple[Change, ...], sequence: int, client: str = "a") -> Arrived:
    batch, changes = (content, ()) if isinstance(content, Batch) else (Batch(), content)
    message = codec.encode_insert(Insert(sequence, batch, changes=changes))
    arrived = read_insert(None, client, message, REQUEST_LIMITS, 0.0)
    assert isinstance(arrived, Arrived)
    return arrived._replace(askers=[])


def gone(*names: int) -> tuple[Change, ...]:
    return (Change("remove_variables", keys=np.array([symbol("x", n) for n in names])),)


def broken(*_arguments: object, **_more: object) -> object:
    """A change that fails in a way that nobody thought of."""
    raise ZeroDivisionError("a fault of the solver")


def weighed(factor: int, weight: float) -> Change:
    return Change("weigh", np.array([factor]), weight=np.array([weight]))


def loop(i: int, j: int, x: float) -> Batch:
    keys, information = np.array([[symbol("x", i), symbol("x", j)]]), np.array([[100.0, 0, 0, 100, 0, 400]])
    return Batch(factors=(Factors("between_se2", keys, np.array([[x, 0.0, 0.3]]), information),))


def make(map_solver: MapSolver | None = None) -> MapSolver:
    map_solver = map_solver or MapSolver(lambda: Solver(Options()), EPOCH, Limits())
    for n in range(5):
        list(map_solver.apply([waiting(pose(n), n + 1)]))
    return map_solver


def came(map_solver: MapSolver, *inserts: Arrived) -> tuple[list[Verdict], list[Stepped]]:
    events, _ = map_solver.apply_whole(inserts)
    return [e for e in events if isinstance(e, Verdict)], [e for e in events if isinstance(e, Stepped)]


def outcomes(judged: list[Verdict]) -> list[Outcome]:
    return [outcome for each in judged for outcome in each.outcomes]


def keys_in(map_solver: MapSolver) -> list[int]:
    taken = map_solver.snapshot([Question("estimate")])
    return sorted(int(key) - symbol("x", 0) for group in taken.variables for key in group.keys)


def test_a_change_is_a_step_of_its_own_whose_delta_has_everything() -> None:
    map_solver = make()
    inserts = [waiting(pose(5), 6), waiting(gone(3, 4, 5), 7), waiting(pose(3), 8), waiting(pose(4), 9)]
    judged, steps = came(map_solver, *inserts)
    answers = [codec.decode_accepted(outcome.answer) for outcome in outcomes(judged)]
    assert [(a.sequence, a.revision, a.first_factor, a.applied) for a in answers] == [
        (6, 6, 4, 1),
        (7, 7, 5, 1),
        (8, 8, 5, 2),
        (9, 8, 6, 2),
    ]
    deltas = [codec.decode_delta(step.delta) for step in steps]
    assert [(delta.previous, delta.revision) for delta in deltas] == [(5, 6), (0, 7), (7, 8)]
    assert sorted(int(k) - symbol("x", 0) for g in deltas[1].variables for k in g.keys) == [0, 1, 2]
    assert answers[1].report["removed_variables"] == 3
    assert answers[1].report["removed_factors"] == 3
    assert keys_in(map_solver) == [0, 1, 2, 3, 4]
    assert map_solver.size == (5, 4)


def test_what_cannot_be_changed_is_refused_and_its_neighbours_go_on() -> None:
    map_solver = make()
    unknown = (Change("remove_factors", np.array([77])),)
    alone = (gone(4)[0]._replace(alone=True),)
    judged, _ = came(map_solver, waiting(unknown, 6), waiting(pose(5), 7), waiting(gone(2), 8), waiting(alone, 9))
    codes = [getattr(o.answer, "code", "accepted") for o in outcomes(judged)]
    assert codes == ["unknown_factor", "accepted", "underconstrained", "in_use"]
    assert keys_in(map_solver) == [0, 1, 2, 3, 4, 5]


def test_a_fault_in_a_change_leaves_the_map_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apply, "with_changes_within", broken)
    map_solver = make()
    judged, steps = came(map_solver, waiting(gone(4), 6))
    assert [o.answer.code for o in outcomes(judged)] == ["internal"]
    assert steps == []
    assert keys_in(map_solver) == [0, 1, 2, 3, 4]
    judged, _ = came(map_solver, waiting(pose(5), 7))
    assert codec.decode_accepted(outcomes(judged)[0].answer).revision == 6


def test_the_same_folds_give_the_same_bits_again() -> None:
    """As a restart applies them: from the bytes of the messages."""
    records = [[waiting(pose(n), n + 1)] for n in range(5)]
    records += [[waiting(pose(5), 6), waiting(gone(5), 7), waiting(pose(5, 1.2), 8)]]
    records += [
        [waiting((Change("weigh", np.array([2]), weight=np.array([0.5])), Change("fix", keys=gone(1)[0].keys)), 9)]
    ]
    records += [[waiting(pose(6), 10)]]
    first, second = (MapSolver(lambda: Solver(Options()), EPOCH, Limits()) for _ in range(2))
    for inserts in records:
        _, steps = came(first, *inserts)
        again = []
        for insert in inserts:
            digest, content = read_again(insert.message)
            again.append(insert._replace(digest=digest, content=content))
        events = list(second.apply_again(again, rebuilt=False))
        deltas = [codec.decode_delta(e.delta) for e in events if isinstance(e, Stepped)]
        for one, other in zip([codec.decode_delta(step.delta) for step in steps], deltas, strict=True):
            assert (one.previous, one.revision, one.report["chi2"]) == (
                other.previous,
                other.revision,
                other.report["chi2"],
            )
            assert [g.values.tobytes() for g in one.variables] == [g.values.tobytes() for g in other.variables]
    assert first.revision == second.revision


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l"])
def test_a_checkpoint_after_a_change_is_where_the_map_goes_on_from(mode: str) -> None:
    map_solver = make(MapSolver(lambda: Solver(Options(mode=mode)), EPOCH, Limits()))
    came(map_solver, waiting(gone(4), 6))
    again = MapSolver(lambda: Solver(Options(mode=mode)), EPOCH, Limits())
    again.load(map_solver.dump())
    for each in (map_solver, again):
        judged, _ = came(each, waiting(pose(4), 7))
        assert codec.decode_accepted(outcomes(judged)[0].answer).first_factor == 4
    one, other = (each.snapshot([Question("estimate")]).variables for each in (map_solver, again))
    assert [g.values.tobytes() for g in one] == [g.values.tobytes() for g in other]


def test_a_change_of_factors_is_a_step_whose_delta_has_what_moved() -> None:
    map_solver = make()
    judged, steps = came(map_solver, waiting(loop(1, 3, 2.5), 6), waiting((weighed(4, 0.5),), 7), waiting(pose(5), 8))
    answers = [codec.decode_accepted(outcome.answer) for outcome in outcomes(judged)]
    assert [(a.sequence, a.revision, a.applied) for a in answers] == [(6, 6, 1), (7, 7, 1), (8, 8, 1)]
    deltas = [codec.decode_delta(step.delta) for step in steps]
    assert [(delta.previous, delta.revision) for delta in deltas] == [(5, 6), (6, 7), (7, 8)]
    report = answers[1].report
    assert (report["edited_factors"], report["removed_factors"], report["new_factors"]) == (1, 0, 0)
    assert "another weight or loss" in str(report["because"])
    told = {
        int(k): row.tobytes()
        for delta in deltas
        for g in delta.variables
        for k, row in zip(g.keys, g.values, strict=True)
    }
    held = {
        int(k): row.tobytes()
        for g in map_solver.snapshot([Question("estimate")]).variables
        for k, row in zip(g.keys, g.values, strict=True)
    }
    assert {key: held[key] for key in told} == told
    _, steps = came(map_solver, waiting((Change("remove_factors", np.array([4])),), 9))
    assert codec.decode_delta(steps[0].delta).previous == 8
    assert map_solver.size == (6, 5)


def test_a_fault_in_a_change_of_factors_has_the_solver_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apply, "try_change", broken)
    map_solver = make()
    judged, steps = came(map_solver, waiting((weighed(1, 0.5),), 6))
    assert [o.answer.code for o in outcomes(judged)] == ["internal"]
    assert [step.rebuilt for step in steps] == [True]
    assert map_solver.size == (5, 4)


def test_changes_of_factors_have_the_same_bits_when_folded_again_and_after_a_checkpoint() -> None:
    """Those that are refused among them: they leave no trace either."""
    records = [[waiting(pose(n), n + 1)] for n in range(5)]
    records += [[waiting(loop(0, 4, 3.5), 6)], [waiting(loop(1, 4, 2.5), 7)]]
    records += [
        [waiting((weighed(4, 0.5), weighed(2, 3.0)), 8)],
        [waiting((Change("remove_factors", np.array([1])),), 9)],
    ]
    records += [[waiting((Change("remove_factors", np.array([0, 2, 3])),), 10), waiting(pose(5), 11)]]
    records += [[waiting((Change("loss", np.array([5]), loss="huber", scale=np.ones(1)),), 12)], [waiting(pose(6), 13)]]
    first, second = (MapSolver(lambda: Solver(Options()), EPOCH, Limits()) for _ in range(2))
    third = MapSolver(lambda: Solver(Options()), EPOCH, Limits())
    codes = []
    for n, inserts in enumerate(records):
        judged, steps = came(first, *inserts)
        codes += [getattr(o.answer, "code", "") for o in outcomes(judged)]
        again = [i._replace(content=read_again(i.message)[1]) for i in inserts]
        others = [list(second.apply_again(again))]
        if n == 8:
            third.load(first.dump())
        if n > 8:
            others.append(list(third.apply_again(again)))
        for events in others:
            for one, other in zip(steps, [e for e in events if isinstance(e, Stepped)], strict=True):
                a, b = codec.decode_delta(one.delta), codec.decode_delta(other.delta)
                assert (a.previous, a.revision, a.report["chi2"]) == (b.previous, b.revision, b.report["chi2"])
                assert [g.values.tobytes() for g in a.variables] == [g.values.tobytes() for g in b.variables]
    assert codes.count("underconstrained") == 1
    assert first.revision == second.revision == third.revision


def test_what_an_insert_brings_of_new_kinds_is_bounded_with_changes_and_without() -> None:
    map_solver, steps = make(), "".join(f"_{k}=multiply(_{k - 1},z);" for k in range(2, 20))
    kind = "large{}(a:se2,z:50)=_1=multiply(z,dot(position(a),[1,2]));" + steps + "add(_19,_1)"
    keys, upper = np.array([[symbol("x", 1)]]), np.eye(50)[np.triu_indices(50)][None]
    group = [Factors(kind.format(n), keys, np.full((1, 50), 0.5), upper) for n in range(3)]
    three, one = Batch(factors=tuple(group)), Batch(factors=(group[0],))
    message = codec.encode_insert(Insert(7, three, changes=(weighed(0, 2.0),)))
    with_change = read_insert(None, "a", message, REQUEST_LIMITS, 0.0)
    assert isinstance(with_change, Arrived)
    answers = []
    for insert in (waiting(three, 6), with_change._replace(askers=[]), waiting(one, 8)):
        answers += [each.answer for each in outcomes(came(map_solver, insert)[0])]
    assert [getattr(answer, "code", "accepted") for answer in answers] == ["too_large", "too_large", "accepted"]
