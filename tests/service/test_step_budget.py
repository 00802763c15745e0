"""Milliseconds as units of work, by what steps took: bounded, robust, and at rest where the machine is."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.proto.codec import decode_map
from factorbus.service.core.budget import (
    CLIPPED,
    FAR,
    LARGE,
    LEAST_SHARE,
    MOST_DOUBLED,
    SLOWER,
    SMALL,
    USUAL_UNITS_PER_MS,
    StepBudget,
)
from factorbus.service.core.converging import CONVERGE_IDLE_S, POLISH_IDLE_S, Converging
from factorbus.service.core.events import BudgetUse, Publish, Stepped
from factorbus.service.maps.work_rate import measured_rate

rates = st.floats(1e5, 1e11)
budgets = st.floats(0.01, 60_000.0)
anything = st.floats(0.0, 1e18)


def step(work: float, step_ms: float, budget: float, **more: Any) -> Stepped:
    use = BudgetUse(work, budget, more.pop("deferred", 0), more.pop("unsolved", 0.0), more.pop("complete", True))
    return Stepped(
        1, b"", more.pop("strategy", "tree"), more.pop("chi2", 1.0), step_ms, step_ms=step_ms, use=use, **more
    )


@given(budgets, rates, st.lists(st.tuples(anything, anything), max_size=40))
def test_whatever_steps_say_units_are_whole_and_within_bounds(
    budget_ms: float, rate: float, steps: list[tuple[float, float]]
) -> None:
    budget = StepBudget(budget_ms, rate)
    for work, step_ms in steps:
        before = budget.units_per_ms
        budget.stepped(step(work, step_ms, budget.units()))
        assert rate / FAR <= budget.units_per_ms <= rate * FAR
        assert abs(math.log(budget.units_per_ms / before)) <= SLOWER * CLIPPED * (1 + 1e-9), "one step moves it little"
        units = budget.units()
        assert units == float(int(units))
        assert abs(units - budget_ms * budget.units_per_ms) <= 0.5 * (1 + 1e-9) + 1e-9 * units


@given(rates, st.floats(1.0 / FAR, FAR), budgets)
def test_it_comes_to_rest_at_what_the_machine_does(rate: float, times: float, budget_ms: float) -> None:
    budget, true = StepBudget(budget_ms, rate), rate * times
    for _ in range(1000):
        units = budget.units()
        budget.stepped(step(units, units / true, units))
    assert budget.units_per_ms == pytest.approx(true, rel=0.01)
    assert budget.units() / true == pytest.approx(budget_ms, rel=0.02, abs=1.0 / true)


@given(st.integers(0, 2**32 - 1))
def test_of_steps_that_vary_most_take_less_than_was_asked(seed: int) -> None:
    import numpy as np

    rng, budget = np.random.default_rng(seed), StepBudget(10.0, 1e8)
    taken = []
    for n in range(3000):
        units = budget.units()
        step_ms = units / 7e7 * math.exp(rng.normal(0.0, 0.3))
        step_ms *= 50.0 if n % 100 == 99 else 1.0  # the machine was busy with something else
        budget.stepped(step(units, step_ms, units))
        taken.append(step_ms)
    assert 0.6 < np.mean(np.array(taken[1000:]) < 10.0) < 0.95
    assert 4.0 < np.median(taken[1000:]) < 10.0


def test_what_says_nothing_of_the_rate_is_passed_over() -> None:
    budget = StepBudget(10.0, 1e8)
    units = budget.units()
    for said in (
        step(0.5 * LEAST_SHARE * units, 100.0, units),  # short: mostly what is not counted
        step(units, 100.0, units, strategy="batch"),  # replaced by what is not counted
        step(units, 0.0, units),  # no clock
        Stepped(1, b"", "tree", 1.0, 5.0),  # had no budget
    ):
        budget.stepped(said)
        assert budget.units_per_ms == 1e8
    budget.stepped(step(units, 100.0, units))
    assert budget.units_per_ms < 1e8


def test_without_a_budget_nothing_is_said_and_steps_have_no_bound() -> None:
    budget = StepBudget()
    budget.stepped(step(1e9, 1e3, 1e9, complete=False))
    assert (budget.units(), budget.units(3), budget.row(), budget.stats()) == (0.0, 0.0, {}, {})
    assert budget.units_per_ms == USUAL_UNITS_PER_MS


def test_what_the_last_step_left_is_told() -> None:
    budget = StepBudget(5.0)
    budget.stepped(step(4e8, 4.0, 5e8, deferred=12, unsolved=0.25, complete=False))
    assert budget.row() == {"budget_ms": 5.0, "complete": False}
    told = budget.stats()["budget"]
    wanted = {"budget_ms": 5.0, "step_ms": 4.0, "deferred_relinearizations": 12, "unsolved": 0.25, "complete": False}
    assert {name: told[name] for name in wanted} == wanted
    budget.stepped(Stepped(2, b"", "tree", 1.0, 90.0))  # one that settles
    assert budget.row()["complete"]


def test_a_further_step_of_no_use_has_the_next_one_take_more() -> None:
    converging, budget = Converging(), StepBudget(1.0, 1e6)
    converging.moved_on(False, True, 100.0, BudgetUse(unsolved=50.0, complete=False))
    given_units = []
    for n in range(MOST_DOUBLED + 2):
        given_units.append(budget.units(converging.doubled))
        said = step(1e6, 1.0, 1e6, unsolved=50.0, complete=False, chi2=100.0 if n else 90.0, unfinished=True)
        converging.went_on(said)
        budget.stepped(said)
    assert given_units == [1e6, *(1e6 * 2.0**n for n in range(MOST_DOUBLED + 1))]
    assert budget.units(converging.doubled) == 0.0, "at last one has no bound"
    assert converging.converging, "that is no reason to give up"
    converging.went_on(Stepped(9, b"", "tree", 80.0, 1.0, unfinished=True))
    assert budget.units(converging.doubled) == 1e6


def test_what_is_left_tells_of_progress_where_chi2_does_not() -> None:
    """Between what has moved and what is behind χ² may rise."""
    converging = Converging()
    converging.moved_on(False, True, 100.0, BudgetUse(unsolved=50.0, complete=False))
    for n in range(60):
        said = step(1e6, 1.0, 1e6, unsolved=50.0 * 0.98**n, complete=False, chi2=100.0 + n, unfinished=True)
        converging.went_on(said)
        assert converging.doubled == (0 if n else 1)


def test_polishing_keeps_to_the_budget_until_next_to_nothing_is_unsolved() -> None:
    """Only then has a step no bound: it substitutes back through the map, and relinearizes nothing."""
    converging, budget, doubled = Converging(), StepBudget(1.0, 1e6), []
    converging.moved_on(True, True, 100.0, BudgetUse(unsolved=0.01))
    for n in range(10):
        doubled.append(converging.doubled)
        said = step(1e6, 1.0, 1e6, unsolved=0.01, chi2=100.0 if n else 90.0, unfinished=True)
        converging.went_on(said)
        budget.stepped(said)
    assert doubled == [0] * 5 + [1] * 4 + [2], "of no use, and nothing left to defer: a quarter of a doubling each"
    assert budget.units(converging.doubled) == 4e6
    converging.went_on(step(1e6, 1.0, 1e6, unsolved=0.9e-6, chi2=90.0, unfinished=True, complete=False))
    assert budget.units(converging.doubled) == 1e6, "something is left"
    converging.went_on(step(1e6, 1.0, 1e6, unsolved=0.8e-6, chi2=90.0, unfinished=True))
    assert budget.units(converging.doubled) == 0.0
    converging.went_on(Stepped(9, b"", "tree", 80.0, 1.0, unfinished=True))
    assert budget.units(converging.doubled) == 1e6, "what that has moved is polished within the budget again"
    converging.moved_on(True, True, 100.0, BudgetUse(unsolved=0.9e-6))
    assert budget.units(converging.doubled) == 0.0


@pytest.mark.parametrize(("complete", "idle_s"), [(False, CONVERGE_IDLE_S), (True, POLISH_IDLE_S)])
def test_what_is_left_is_begun_with_before_a_map_is_polished(complete: bool, idle_s: float) -> None:
    converging = Converging()
    converging.moved_on(True, True, 1.0, BudgetUse(complete=complete))
    converging.began(False)
    converging.ended(0.0, 10.0)
    converging.look(10.0 + 0.9 * idle_s)
    assert not converging.is_due(10.0 + 0.9 * idle_s)
    converging.look(10.0 + 1.01 * idle_s)
    assert converging.is_due(10.0 + 1.01 * idle_s)


def test_the_rate_of_this_machine_is_measured() -> None:
    assert 1e4 < measured_rate() < 1e13


@given(st.lists(st.tuples(st.one_of(st.floats(0.0, 20.0), st.just(math.inf)), st.booleans()), max_size=40))
def test_a_large_correction_is_said_to_come_and_then_to_have_arrived(steps: list[tuple[float, bool]]) -> None:
    budget, coming = StepBudget(5.0), False
    for revision, (unsolved, complete) in enumerate(steps, 1):
        budget.stepped(step(1e8, 1.0, 5e8, unsolved=unsolved, complete=complete))
        left = 0.0 if complete else unsolved
        expected = []
        if (left < SMALL) if coming else (left >= LARGE):
            coming = not coming
            state, bound = "coming" if coming else "arrived", left if left < math.inf else None
            expected = [{"event": "correction", "epoch": 7, "revision": revision, "state": state, "unsolved": bound}]
        told = budget.correction(7, revision)
        assert [decode_map(each.message) for each in told if isinstance(each, Publish)] == expected
        assert len(told) == len(expected)


def test_without_a_budget_no_correction_is_said_to_come() -> None:
    budget = StepBudget()
    budget.stepped(step(1e9, 1e3, 1e9, unsolved=100.0, complete=False))
    assert budget.correction(7, 1) == []
