"""Inserts into a real solver: the good ones go in, the guilty are refused, a fault leaves the map as it was."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from naive.random_graphs import random_steps

from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Accepted, Batch, Delta, Factors, Insert, Variables
from factorbus.proto.problems import BadMessage, Problem
from factorbus.proto.symbols import parse_symbol
from factorbus.service.config import Limits
from factorbus.service.core.events import Applied, Arrived, Outcome, ParsedInsert, SingleInsertResult, Stepped, Verdict
from factorbus.service.questions.answers import Question
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import read_insert
from factorbus.solver import Options, Solver
from factorbus.solver.graph.columns import Columns

EPOCH = 9
INFORMATION = [100.0, 0, 0, 100, 0, 400]


def keys_of(*names: str) -> np.ndarray:
    return np.array([parse_symbol(name) for name in names], np.int64)


def edge(i: str, j: str, x: float = 1.0) -> Factors:
    return Factors("between_se2", keys_of(i, j)[None], np.array([[x, 0.0, 0.1]]), np.array([INFORMATION]))


def start() -> Batch:
    return Batch((Variables("se2", keys_of("x0"), np.zeros((1, 3)), fixed=True),))


def pose(name: str, after: str, x: float = 1.0) -> Batch:
    return Batch((Variables("se2", keys_of(name)),), (edge(after, name, x),))


def waiting(content: Batch | Problem, client: str = "a", sequence: int = 1, settle: bool = False) -> Arrived:
    insert = content if isinstance(content, Problem) else Insert(sequence, content, settle)
    return Arrived([], client, sequence, 0, 100, 0, insert, 0.0)


@dataclass(frozen=True)
class Result:
    """All that came of one apply."""

    outcomes: tuple[Outcome, ...]
    steps: tuple[Stepped, ...]
    variables: int
    factors: int


def apply(map_solver: MapSolver, *inserts: Arrived) -> Result:
    *events, end = map_solver.apply(inserts)
    assert isinstance(end, Applied)
    outcomes = tuple(o for e in events if isinstance(e, Verdict) for o in e.outcomes)
    assert sorted(map(id, inserts)) == sorted(id(o.insert) for o in outcomes), "everybody is answered once"
    return Result(outcomes, tuple(e for e in events if isinstance(e, Stepped)), end.variables, end.factors)


def codes(applied: Result) -> list[str]:
    return [getattr(o.answer, "code", "accepted") for o in applied.outcomes]


def accepted(applied: Result) -> list[Accepted]:
    return [codec.decode_accepted(o.answer) for o in applied.outcomes if isinstance(o.answer, bytes)]


def deltas(applied: Result) -> list[Delta]:
    return [codec.decode_delta(step.delta) for step in applied.steps]


def values(map_solver: MapSolver) -> dict[int, bytes]:
    taken = map_solver.snapshot([Question("estimate")])
    return {
        int(key): row.tobytes() for g in taken.variables if g.values is not None
        for key, row in zip(g.keys, g.values, strict=True)
    }  # fmt: skip


def make() -> Solver:
    return Solver(Options(clock=time.perf_counter))


@pytest.fixture
def map_solver() -> MapSolver:
    made = MapSolver(make, EPOCH, Limits())
    apply(made, waiting(start()))
    return made


def test_several_inserts_in_one_step(map_solver: MapSolver) -> None:
    applied = apply(
        map_solver, waiting(pose("x1", "x0")), waiting(pose("x2", "x0"), "b"), waiting(pose("x3", "x1"), "a", 2)
    )
    assert codes(applied) == ["accepted"] * 3
    assert [(a.revision, a.first_factor, a.applied, a.epoch) for a in accepted(applied)] == [
        (2, 0, 3, EPOCH),
        (2, 1, 3, EPOCH),
        (2, 2, 3, EPOCH),
    ]
    (delta,) = deltas(applied)
    assert (delta.revision, delta.previous, delta.epoch) == (2, 1, EPOCH)
    assert sorted(int(k) for g in delta.variables for k in g.keys) == sorted(keys_of("x1", "x2", "x3").tolist())
    assert (applied.variables, applied.factors) == (4, 3)
    assert delta.report["solver_ms"] > 0


def test_a_bad_insert_is_refused_and_the_others_go_on(map_solver: MapSolver) -> None:
    applied = apply(
        map_solver,
        waiting(pose("x1", "x0")),
        waiting(pose("x1", "x0"), "b"),
        waiting(pose("x2", "x9"), "c"),
        waiting(BadMessage("insert", "garbage", "sense"), "d"),
        waiting(pose("x2", "x1"), "e"),
    )
    by_client = dict(zip([o.insert.client for o in applied.outcomes], codes(applied), strict=True))
    assert by_client == {
        "a": "accepted",
        "b": "duplicate_variable",
        "c": "unknown_variable",
        "d": "bad_message",
        "e": "accepted",
    }
    assert len(applied.steps) == 1


def test_nothing_accepted_means_no_step_and_not_a_bit_changed(map_solver: MapSolver) -> None:
    apply(map_solver, waiting(pose("x1", "x0")))
    before = values(map_solver)
    applied = apply(map_solver, waiting(pose("x1", "x0")), waiting(pose("x2", "x7"), "b"))
    assert codes(applied) == ["duplicate_variable", "unknown_variable"]
    assert applied.steps == ()
    assert values(map_solver) == before
    assert map_solver.snapshot([Question("chi2")]).revision == 2


def test_when_the_step_fails_only_the_guilty_are_refused(map_solver: MapSolver) -> None:
    alone = Batch((Variables("se2", keys_of("x8"), np.zeros((1, 3))),))
    applied = apply(map_solver, waiting(pose("x1", "x0")), waiting(alone, "b"), waiting(pose("x2", "x1"), "c"))
    assert codes(applied) == ["accepted", "underconstrained", "accepted"]
    assert [step.revision for step in applied.steps] == [2, 3], "one step each"
    assert parse_symbol("x8") not in values(map_solver)
    assert [a.first_factor for a in accepted(applied)] == [0, 1]


def test_a_lonely_guilty_insert_is_tried_once(map_solver: MapSolver) -> None:
    alone = Batch((Variables("se2", keys_of("x8"), np.zeros((1, 3))),))
    applied = apply(map_solver, waiting(alone))
    assert (codes(applied), applied.steps, applied.variables) == (["underconstrained"], (), 1)


def test_a_map_has_a_size(map_solver: MapSolver) -> None:
    small = MapSolver(make, EPOCH, Limits(variables=2, factors=1))
    applied = apply(small, waiting(start()), waiting(pose("x1", "x0"), "b"), waiting(pose("x2", "x0"), "c"))
    assert codes(applied) == ["accepted", "accepted", "too_large"]
    assert [o.answer.detail["limit"] for o in applied.outcomes if isinstance(o.answer, Problem)] == [2]


def test_settle_iterates_until_converged(map_solver: MapSolver) -> None:
    apply(map_solver, waiting(pose("x1", "x0")), waiting(pose("x2", "x1"), "b"))
    apply(map_solver, waiting(Batch(factors=(edge("x0", "x2", 2.5),))))
    applied = apply(map_solver, waiting(Batch(), settle=True))
    assert deltas(applied)[0].report["converged"] is True


class Faulty(Solver):
    """A real solver with faults in it: the call that is next in `failing` raises, before or after it has done its work.

    A fault named like a variable is brought about by staging that variable, every time.
    """

    def __init__(self, failing: list[str]) -> None:
        super().__init__(Options())
        self._failing = failing

    def stage(self, batch: Any) -> int:
        staged = set[int]() if isinstance(batch, Columns) else {int(k) for group in batch.variables for k in group.keys}
        if staged & {parse_symbol(name) for name in self._failing if " " not in name}:
            raise IndexError("a fault of the solver")
        return self._run("stage", lambda: super(Faulty, self).stage(batch))

    def step(self, settle: bool = False, budget: float | None = None) -> Any:
        return self._run("step", lambda: super(Faulty, self).step(settle, budget))

    def changed(self) -> Any:
        return self._run("changed", super().changed)

    def pick_changed(self) -> Any:
        return self._run("pick_changed", super().pick_changed)

    def graph(self, *most: int | None) -> Any:
        return self._run("graph", lambda: super(Faulty, self).graph(*most))

    def _run(self, name: str, call: Callable[[], Any]) -> Any:
        if self._failing and self._failing[0] == f"before {name}":
            self._failing.pop(0)
            raise IndexError("a fault of the solver")
        result = call()
        if self._failing and self._failing[0] == f"after {name}":
            self._failing.pop(0)
            raise ZeroDivisionError("a fault of the solver")
        return result


def with_faults() -> tuple[MapSolver, list[str]]:
    failing: list[str] = []
    map_solver = MapSolver(lambda: Faulty(failing), EPOCH, Limits())
    for sequence, batch in enumerate((start(), pose("x1", "x0"), pose("x2", "x1")), 1):
        apply(map_solver, waiting(batch, sequence=sequence))
    return map_solver, failing


@pytest.mark.parametrize("fault", ["before stage", "after stage", "before step", "after step"])
def test_a_fault_of_the_solver_refuses_its_insert_and_keeps_what_was_accepted(fault: str) -> None:
    map_solver, failing = with_faults()
    held = set(values(map_solver))
    failing.append(fault)
    applied = apply(map_solver, waiting(pose("x3", "x2")))
    assert codes(applied) == ["internal"]
    assert set(values(map_solver)) == held
    (delta,) = deltas(applied)
    assert (delta.previous, delta.revision) == (3, 4), "readers are told of everything again"
    assert {int(k) for g in delta.variables for k in g.keys} == held
    assert codes(apply(map_solver, waiting(pose("x3", "x2"), sequence=2))) == ["accepted"]


def test_a_fault_after_the_answer_costs_only_a_delta() -> None:
    map_solver, failing = with_faults()
    failing.append("before pick_changed")
    applied = apply(map_solver, waiting(pose("x3", "x2")))
    assert codes(applied) == ["accepted"]
    (delta,) = deltas(applied)
    assert (accepted(applied)[0].revision, delta.previous, delta.revision) == (4, 4, 5), "a reader at 3 sees the gap"
    assert {int(k) for g in delta.variables for k in g.keys} == set(values(map_solver))


def test_a_fault_among_several_inserts_hits_only_the_one_that_brings_it() -> None:
    map_solver, failing = with_faults()
    failing.append("x13")
    applied = apply(
        map_solver, waiting(pose("x3", "x2")), waiting(pose("x13", "x2"), "b"), waiting(pose("x4", "x2"), "c")
    )
    assert codes(applied) == ["accepted", "internal", "accepted"]
    assert set(values(map_solver)) == set(keys_of("x0", "x1", "x2", "x3", "x4").tolist())
    assert [d.revision - d.previous for d in deltas(applied)] == [1] * len(applied.steps)


def test_what_cannot_be_brought_back_is_said_for_good() -> None:
    map_solver, failing = with_faults()
    failing += ["before step", "before graph"]
    assert codes(apply(map_solver, waiting(pose("x3", "x2")))) == ["internal"]
    applied = apply(map_solver, waiting(pose("x4", "x2")))
    assert codes(applied) == ["internal"]
    assert "drop it" in applied.outcomes[0].answer.message
    with pytest.raises(Problem, match="drop it"):
        map_solver.snapshot([Question("estimate")])


# ---- one insert, read where it lies -------------------------------------------------------------------------------


def located(batch: Batch, sequence: int = 1, settle: bool = False) -> Arrived:
    message = codec.encode_insert(Insert(sequence, batch, settle))
    arrived = read_insert(None, "a", message, REQUEST_LIMITS, 0.0)
    assert isinstance(arrived, Arrived)
    assert isinstance(arrived.content, ParsedInsert)
    return arrived._replace(askers=[])


def apply_single(map_solver: MapSolver, insert: Arrived) -> tuple[Result, bool]:
    """What came of it, and whether it was had in one piece."""
    events = map_solver.apply_batch((insert,), False)
    if isinstance(events, SingleInsertResult):
        applied = events.applied
        return Result((events.outcome,), (events.stepped,), applied.variables, applied.factors), True
    *rest, end = events
    assert isinstance(end, Applied)
    outcomes = tuple(o for e in rest if isinstance(e, Verdict) for o in e.outcomes)
    return Result(outcomes, tuple(e for e in rest if isinstance(e, Stepped)), end.variables, end.factors), False


def told(applied: Result) -> Any:
    """All of it but the times."""
    messages: list[Any] = [*accepted(applied), *deltas(applied)]
    reports = [{k: v for k, v in m.report.items() if not k.endswith("_ms")} for m in messages]
    plain = [
        (type(m).__name__, m.epoch, m.revision, getattr(m, "sequence", None), getattr(m, "first_factor", None))
        for m in messages
    ]
    columns = [
        (g.kind, g.keys.tobytes(), *(None if c is None else c.tobytes() for c in (g.values, g.stamps)), g.fixed)
        for d in deltas(applied)
        for g in d.variables
    ]
    steps = [(s.revision, s.strategy, s.chi2, s.rebuilt) for s in applied.steps]
    first = [o.first_factor for o in applied.outcomes]
    return plain, reports, columns, steps, first, codes(applied), applied.variables, applied.factors


@pytest.mark.parametrize("mode", ["inc-l", "bayes-tree"])
def test_one_insert_comes_to_the_same_either_way(mode: str) -> None:
    quick, usual = (MapSolver(lambda: Solver(Options(mode=mode)), EPOCH, Limits()) for _ in range(2))
    alone = 0
    for sequence, batch in enumerate(random_steps(3, steps=25), 1):
        settle = sequence % 10 == 0
        applied, in_one_piece = apply_single(quick, located(batch, sequence, settle))
        assert told(applied) == told(apply(usual, waiting(batch, sequence=sequence, settle=settle)))
        alone += in_one_piece
    assert alone == sequence
    assert values(quick) == values(usual)


def test_a_guilty_insert_is_refused_in_the_same_words_either_way(map_solver: MapSolver) -> None:
    for n in range(1, 20):
        apply_single(map_solver, located(pose(f"x{n}", f"x{n - 1}")))
    lonely = Batch((Variables("se2", keys_of("x80"), np.zeros((1, 3))),))
    before = values(map_solver)
    for bad in (pose("x1", "x0"), pose("x90", "x77"), lonely, Batch(factors=(edge("x1", "x1"),))):
        quick, in_one_piece = apply_single(map_solver, located(bad))
        assert not in_one_piece
        assert told(quick) == told(apply(map_solver, waiting(bad)))
        assert quick.outcomes[0].answer.message == apply(map_solver, waiting(bad)).outcomes[0].answer.message
    assert values(map_solver) == before
    assert apply_single(map_solver, located(Batch(factors=(edge("x3", "x5", 2.0),))))[1], "and the next one is taken"


def test_several_located_inserts_in_one_step(map_solver: MapSolver) -> None:
    applied = apply(map_solver, located(pose("x1", "x0")), located(pose("x2", "x0"), 2), located(pose("x2", "x0"), 3))
    assert codes(applied) == ["accepted", "accepted", "duplicate_variable"]


def test_the_size_of_a_map_is_kept_either_way() -> None:
    small = MapSolver(make, EPOCH, Limits(variables=2, factors=1))
    applied = [apply_single(small, located(batch))[0] for batch in (start(), pose("x1", "x0"), pose("x2", "x0"))]
    assert [code for result in applied for code in codes(result)] == ["accepted", "accepted", "too_large"]


def test_messages_that_are_larger_than_usual_are_written_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factorbus.service.solving.messages.ROOM", 100)
    map_solver = MapSolver(make, EPOCH, Limits())
    assert codes(apply(map_solver, located(start()))) == ["accepted"]
    for n in range(1, 6):
        applied, in_one_piece = apply_single(map_solver, located(pose(f"x{n}", f"x{n - 1}")))
        assert in_one_piece
        assert [(d.previous, d.revision) for d in deltas(applied)] == [(n, n + 1)]


@pytest.mark.parametrize("fault", ["before stage", "after stage", "before step", "after step"])
def test_a_fault_with_a_located_insert_refuses_it_and_keeps_what_was_accepted(fault: str) -> None:
    map_solver, failing = with_faults()
    held = set(values(map_solver))
    failing.append(fault)
    applied, in_one_piece = apply_single(map_solver, located(Batch(factors=(edge("x1", "x2", 2.0),))))
    assert (codes(applied), in_one_piece) == (["internal"], False)
    (delta,) = deltas(applied)
    assert (delta.previous, delta.revision, applied.steps[0].rebuilt) == (3, 4, True)
    assert {int(k) for g in delta.variables for k in g.keys} == held == set(values(map_solver))
    assert codes(apply_single(map_solver, located(pose("x3", "x2"), 2))[0]) == ["accepted"]


def test_a_fault_after_the_step_of_a_located_insert_costs_only_a_delta() -> None:
    map_solver, failing = with_faults()
    failing.append("before pick_changed")
    applied, in_one_piece = apply_single(map_solver, located(Batch(factors=(edge("x1", "x2", 2.0),))))
    assert (codes(applied), in_one_piece) == (["accepted"], False)
    (delta,) = deltas(applied)
    assert (accepted(applied)[0].revision, delta.previous, delta.revision) == (4, 4, 5)
    assert {int(k) for g in delta.variables for k in g.keys} == set(values(map_solver))
