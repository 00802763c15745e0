"""Another budget for a map that is there: its journal has it, the next step keeps to it, and what was left goes on."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.journal.problems import JournalDamaged, JournalFailed
from factorbus.journal.settings import note_option
from factorbus.journal.store import Store, create, open_store
from factorbus.proto import codec
from factorbus.proto.messages import Batch, Insert
from factorbus.proto.problems import BadMessage, BadOption, Problem
from factorbus.service.config import Limits
from factorbus.service.core.budget import FAR, SMALL, StepBudget
from factorbus.service.core.events import Arrived, BudgetUse, InsertBatch, Publish, Stepped
from factorbus.service.core.map_state import MapCore, Restored
from factorbus.service.journal.library import made_as_of, make_map_solver
from factorbus.service.journal.recovery import verify
from factorbus.service.journal.writing import written
from factorbus.service.questions.admin import BudgetChange, NoBudget, check_budget, read_budget
from factorbus.service.questions.answers import Question
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import message_digest
from factorbus.simulate import manhattan

UNITS = 1e8
budgets = st.one_of(st.just(0.0), st.floats(0.01, 60_000.0))


def of(left: float, complete: bool) -> Stepped:
    use = BudgetUse(1e8, 1e8, 3, left, complete)
    return Stepped(1, b"", "tree", 1.0, 1.0, step_ms=1.0, use=use, unfinished=True)


@given(st.lists(st.tuples(budgets, st.floats(0.1, 100.0)), min_size=1, max_size=12))
def test_units_follow_the_last_change_and_the_rate_stays(changes: list[tuple[float, float]]) -> None:
    budget = StepBudget()
    for budget_ms, step_ms in changes:
        had, rate = budget.budget_ms, budget.units_per_ms
        budget.change(budget_ms, UNITS)
        assert budget.units_per_ms == (rate if had else UNITS)
        assert budget.units() == float(round(budget_ms * budget.units_per_ms))
        assert bool(budget.stats()) == bool(budget_ms)
        units = budget.units()
        budget.stepped(Stepped(1, b"", "tree", 1.0, step_ms, step_ms=step_ms, use=BudgetUse(units, units)))
        assert UNITS / FAR <= budget.units_per_ms <= UNITS * FAR


def test_what_was_left_is_told_until_it_is_done() -> None:
    budget = StepBudget(1.0, UNITS)
    budget.stepped(of(50.0, False))
    (coming,) = budget.correction(7, 1)
    budget.change(0.0, 1.0)
    assert budget.units() == budget.units(3) == 0.0
    assert budget.row() == {"budget_ms": 0.0, "complete": False}
    assert budget.stats() == {}
    assert budget.correction(7, 1) == []
    budget.stepped(Stepped(2, b"", "tree", 1.0, 9.0))  # a step without a bound
    (arrived,) = budget.correction(7, 2)
    assert isinstance(coming, Publish)
    assert isinstance(arrived, Publish)
    assert [codec.decode_map(each.message)["state"] for each in (coming, arrived)] == ["coming", "arrived"]
    assert budget.row() == {}
    assert SMALL > 0.0


def test_a_map_that_gave_up_tries_again() -> None:
    core = MapCore("m", "bayes-tree", 7, Limits(), 0.0, budget=StepBudget(1.0, UNITS))
    core.restore((), Restored(5, 10, 12, 3.0, False, True, None, None, False))
    (run,) = core.tick(10.0)
    assert isinstance(run, InsertBatch)
    assert (run.further, run.budget, run.budget_ms) == (True, UNITS, 1.0)
    core._converging._in_vain, core._converging.gave_up = 5.0, "of no use"
    core._converging._untold, core._running = False, None
    assert core.tick(20.0) == []
    core.change_budget(4.0, 3.0)
    (run,) = core.tick(30.0)
    assert isinstance(run, InsertBatch)
    assert (run.further, run.budget, run.budget_ms) == (True, 4.0 * UNITS, 4.0)


def test_what_is_asked_is_read_whole() -> None:
    def asked(**content: object) -> bytes:
        return codec.encode_map(content)

    assert read_budget(asked(map="m", budget_ms=2.5)) == BudgetChange("m", 2.5)
    assert read_budget(asked(map="m", budget_ms=0)) == BudgetChange("m", 0.0)
    for wrong in (-1.0, -5e-324, 60_000.1, math.nan, math.inf):
        with pytest.raises(BadOption) as refused:
            read_budget(asked(map="m", budget_ms=wrong))
        assert refused.value.detail["where"] == "budget.budget_ms"
    for content in ({"map": "m"}, {"map": "m", "budget_ms": "10"}, {"map": "m", "budget_ms": True}, {"budget_ms": 1.0}):
        with pytest.raises(BadMessage):
            read_budget(asked(**content))
    with pytest.raises(Problem) as bad:
        read_budget(asked(map="a/b", budget_ms=1.0))
    assert bad.value.code == "bad_name"


def test_only_the_tree_has_budgets() -> None:
    check_budget("inc-l", 0.0)
    check_budget("bayes-tree", 1.0)
    with pytest.raises(NoBudget, match="inc-l"):
        check_budget("inc-l", 1.0)


def made(folder: Path) -> tuple[MapSolver, Store]:
    map_solver = make_map_solver("bayes-tree", {}, 7, Limits())
    return map_solver, create(folder, "m", "bayes-tree", map_solver.options(), 7, "none")


def apply(map_solver: MapSolver, store: Store, number: int, batch: Batch, units: float, ms: float) -> Mapping[str, Any]:
    content = Insert(number, batch)
    message = codec.encode_insert(content)
    taken = [Arrived([], "a", number, 0, len(message), message_digest(message), content, 0.0, message)]
    map_solver.allow(units, ms)
    events, _ = map_solver.apply_whole(taken, False)
    last = store.last()
    store.append([written(last.record + 1, taken, events, last, False, units)])
    (stepped,) = [event for event in events if isinstance(event, Stepped)]
    return codec.decode_delta(stepped.delta).report


def test_changed_again_and_again_the_journal_has_the_last_and_the_same_bits(tmp_path: Path) -> None:
    map_solver, store = made(tmp_path / "m")
    for n, batch in enumerate(step.batch for step in manhattan(200, 3)):
        if n % 40 == 20:
            budget_ms = (0.02, 0.1, 0.0, 0.03, 0.05)[n // 40]
            note_option(store, "budget_ms", budget_ms or None)
            map_solver.change_budget(budget_ms)
        now = float(map_solver.options().get("budget_ms", 0.0))
        report = apply(map_solver, store, n + 1, batch, now * UNITS, now)
        assert report.get("budget_ms", 0.0) == now
        assert report.get("budget", 0.0) == now * UNITS
        header = store.header()
        assert header.options == map_solver.options()
        assert made_as_of(header.mode, header.options).budget_ms == now
    assert {record.budget for record in store.records()} == {0.0, 0.02e8, 0.1e8, 0.03e8, 0.05e8}
    again = make_map_solver("bayes-tree", store.header().options, 7, Limits())
    assert all(same for _, same in verify(store, again))
    taken = [each.snapshot([Question("estimate")]).variables for each in (map_solver, again)]
    rows = [[group.values.tobytes() for group in groups if group.values is not None] for groups in taken]
    assert rows[0] == rows[1]
    assert list(store.check()) == []
    store.close()


def test_a_step_that_began_before_says_what_it_had(tmp_path: Path) -> None:
    map_solver, store = made(tmp_path / "m")
    batch = next(iter(manhattan(3, 3))).batch
    map_solver.allow(5e8, 5.0)
    map_solver.change_budget(2.0)
    content = Insert(1, batch)
    message = codec.encode_insert(content)
    events, _ = map_solver.apply_whole(
        [Arrived([], "a", 1, 0, len(message), message_digest(message), content, 0.0, message)], False
    )
    (stepped,) = [event for event in events if isinstance(event, Stepped)]
    assert codec.decode_delta(stepped.delta).report["budget_ms"] == 5.0
    store.close()


def test_where_it_cannot_be_written_nothing_has_changed(tmp_path: Path) -> None:
    _, store = made(tmp_path / "m")
    note_option(store, "budget_ms", 3.0)
    reader = open_store(tmp_path / "m", read_only=True)
    with pytest.raises(JournalFailed):
        note_option(reader, "budget_ms", 4.0)
    assert reader.header().options["budget_ms"] == 3.0
    store._set({"mode": "inc-l"})  # the seal does not hold: it is not sealed again over that
    with pytest.raises(JournalDamaged):
        note_option(store, "budget_ms", 4.0)
    reader.close()
    store.close()
