"""Steps with a budget: what does not fit is left for later ones, and the map still comes to its optimum.  MATH §9.10"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from bench.every import hard
from bench.every.motion import PLANE, SPACE
from naive.random_graphs import random_steps
from naive.solver_parts import graph_in, has_nothing_new
from naive.tree_records import assert_is_a_tree, cliques, tree_of

from factorbus.proto.messages import Batch, Change
from factorbus.simulate import Spiral, city_trees, manhattan, sphere
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changing import try_change
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.report import StepReport

WORLDS: dict[str, Callable[[int], Iterator[Batch]]] = {
    "streets": lambda seed: (step.batch for step in manhattan(700, seed)),
    "trees": lambda seed: (step.batch for step in city_trees(300, seed=seed)),
    "sphere": lambda seed: (step.batch for step in sphere(300, seed, spiral=Spiral(20, 20))),
    "robots": lambda seed: random_steps(seed, steps=40),
}
SETTLING = 60  # further steps, in which every map here comes to its optimum


def budgets(seed: int) -> Iterator[float]:
    """From what is less than any clique takes to what no step here needs, in any order."""
    rng = np.random.default_rng(seed)
    while True:
        yield 10.0 ** rng.uniform(3.0, 8.0)


def driven(batches: Sequence[Batch], seed: int) -> tuple[Solver, list[StepReport]]:
    """A solver that has had them, each with another budget, and its reports."""
    solver, reports = Solver(), []
    for batch, budget in zip(batches, budgets(seed), strict=False):
        solver.stage(batch)
        reports.append(solver.step(budget=budget))
    return solver, reports


def left_alone(solver: Solver) -> StepReport:
    """The report of the last of the further steps that it takes."""
    report = solver.step()
    for _ in range(SETTLING):
        if not solver.unfinished:
            return report
        report = solver.step()
    raise AssertionError(f"not at its optimum after {SETTLING} further steps: {report}")


def batch_chi2(batches: Sequence[Batch]) -> float:
    """χ² where the graph's optimum is, found without a tree."""
    solver = Solver(Options(mode="all-batch"))
    for batch in batches:
        solver.stage(batch)
    return solver.step(settle=True).chi2


def bits(solver: Solver) -> bytes:
    """Of the whole estimate."""
    return graph_in(solver).values[: graph_in(solver).counts[at.VALUES]].tobytes()


def nothing_timed(report: StepReport) -> StepReport:
    return report._replace(phases_ms={}, step_ms=0.0, compiled_ms=None)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("world", WORLDS)
def test_with_any_budgets_a_map_that_is_left_alone_comes_to_its_optimum(world: str, seed: int) -> None:
    batches = list(WORLDS[world](seed))
    solver, reports = driven(batches, seed)
    assert_is_a_tree(solver)
    report = left_alone(solver)
    assert report.converged
    assert report.deferred_relinearizations == 0
    assert not tree_of(solver).behind
    free = Solver()
    for batch in batches:
        free.stage(batch)
        free.step()
    free.step(settle=True)
    assert report.chi2 <= free.chi2() * (1.0 + 1e-6) + 1e-9
    if world == "streets":
        assert report.chi2 <= batch_chi2(batches) * (1.0 + 1e-6)
        assert any(each.deferred_relinearizations for each in reports)
        assert any(not each.converged for each in reports)


def test_the_far_part_stays_behind_and_follows() -> None:
    """A budget that is used by a loop itself leaves cliques that moved, and every one is solved in the end."""
    batches, left = list(WORLDS["streets"](3)), 0
    solver = Solver()
    for n, batch in enumerate(batches):
        solver.stage(batch)
        report = solver.step(budget=1e5 if n % 50 else 0.0)
        tree = tree_of(solver)
        if not tree.behind:
            continue
        left += 1
        assert not report.converged
        assert solver.unfinished
        assert report.unsolved > 0.0
        flagged = {c for c in cliques(solver) if tree.clique[c, tl.C_MOVES] & tl.BEHIND}
        assert flagged
        for c in flagged:  # a walk down from the root finds it
            above = int(tree.clique[c, tl.C_PARENT])
            assert above < 0 or above in flagged
    assert left > 20
    left_alone(solver)
    assert not any(tree_of(solver).clique[c, tl.C_MOVES] & tl.BEHIND for c in cliques(solver))
    assert_is_solved(solver)


def assert_is_solved(solver: Solver) -> None:
    """δ of every clique is R_F⁻¹ (d − R_S δ_S), to rounding, for the linear problem of the tree."""
    tree, graph = tree_of(solver), graph_in(solver)
    delta = tree.scalars[0]
    for c in cliques(solver):
        row = tree.clique[c]
        p, m = int(row[tl.C_PIVOTS]), int(row[tl.C_SEPARATOR_SCALARS])
        listed = tree.lists[row[tl.C_LIST] :][: row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]]
        dims = graph.dims[graph.var[listed, at.V_COLUMN]]
        at_scalars = np.concatenate(
            [first + np.arange(dim) for first, dim in zip(graph.var[listed, at.V_SCALAR], dims, strict=True)]
        )
        for k in range(p):
            line = tree.numbers[row[tl.C_ROWS] + k * row[tl.C_LD] :][: p + m + 1]
            left = line[k : p + m] @ delta[at_scalars[k:]] - line[p + m]
            assert abs(left) < 1e-3


@pytest.mark.parametrize("world", ["streets", "robots"])
def test_the_same_budgets_make_the_same_bits_also_from_a_state_in_between(world: str) -> None:
    batches = list(WORLDS[world](4))
    kept, gone_on = Solver(), Solver()
    for n, (batch, budget) in enumerate(zip(batches, budgets(4), strict=False)):
        for solver in (kept, gone_on):
            solver.stage(batch)
        assert nothing_timed(kept.step(budget=budget)) == nothing_timed(gone_on.step(budget=budget))
        assert bits(kept) == bits(gone_on)
        if n % 9 == 0:
            state = gone_on.dump()
            gone_on = Solver()
            gone_on.load(state)
    assert nothing_timed(kept.step()) == nothing_timed(gone_on.step())
    assert bits(kept) == bits(gone_on)


def test_a_budget_that_is_not_reached_changes_no_more_than_rounding() -> None:
    free, wide = Solver(), Solver(Options(step_budget=1e13))
    for batch in WORLDS["streets"](5):
        for solver in (free, wide):
            solver.stage(batch)
        ours, theirs = wide.step(), free.step()
        assert (ours.relinearized, ours.eliminated, ours.flops) == (
            theirs.relinearized,
            theirs.eliminated,
            theirs.flops,
        )
        assert ours.chi2 == pytest.approx(theirs.chi2, rel=1e-9, abs=1e-9)
        assert (ours.converged, ours.deferred_relinearizations) == (theirs.converged, 0)


def test_every_insert_is_accepted_with_a_budget_below_anything() -> None:
    solver, free = Solver(Options(step_budget=1.0)), Solver()
    heavy = 0
    for batch in WORLDS["streets"](6):
        for each in (solver, free):
            each.stage(batch)
        report, theirs = solver.step(), free.step()
        assert (report.new_variables, report.new_factors) == (theirs.new_variables, theirs.new_factors)
        assert report.relinearized <= report.eliminated  # what is eliminated anyway
        assert report.iterations <= 1 or report.strategy == "batch"
        heavy += theirs.iterations > 1
    assert heavy > 5
    assert left_alone(solver).chi2 == pytest.approx(left_alone(free).chi2, rel=1e-6)


def test_a_step_takes_no_more_than_its_budget_where_nothing_far_is_joined() -> None:
    """All but the loops themselves, which are eliminated whole, and steps that Levenberg-Marquardt replaces."""
    budget, deferred = 5e7, 0
    solver = Solver(Options(step_budget=budget))
    for batch in WORLDS["streets"](7):
        solver.stage(batch)
        report = solver.step()
        if report.new_factors <= report.new_variables and report.strategy != "batch":
            assert report.work <= 1.02 * budget
        deferred += report.deferred_relinearizations > 0
    assert deferred > 5


def test_a_chord_step_that_does_not_fit_is_not_begun() -> None:
    """It solves all cliques from the factors that it corrects up to the root, whatever is left of the budget.

    Behind it comes what back-substitution has in any case, an eighth of the nine tenths that are planned with, and
    what it takes to look at those that wait.
    """
    budget, shares = 1e7, []
    for seed in (7, 8):
        solver = Solver(Options(step_budget=budget))
        for batch in WORLDS["trees"](seed):
            solver.stage(batch)
            report = solver.step()
            if "chord step" in report.because:
                shares.append(report.work / budget)
    assert 0.5 < max(shares) <= 1.1


def test_what_is_left_is_a_bound_of_what_there_is_to_gain() -> None:
    batches, solver, reports = list(WORLDS["streets"](8))[:420], Solver(), []
    for n, batch in enumerate(batches):
        solver.stage(batch)
        report = solver.step(budget=2e6)
        if n > 250 and not report.converged and n % 10 == 0:
            reports.append((report, batch_chi2(batches[: n + 1])))
    assert len(reports) > 3
    for report, optimum in reports:
        assert report.unsolved >= 0.9 * (report.chi2 - optimum)


def test_by_how_much_a_torn_estimate_is_above_its_optimum() -> None:
    solver, whole, torn = Solver(Options(step_budget=2.3e7)), Solver(), 0
    for step in manhattan(1160, seed=3):
        for each in (solver, whole):
            each.stage(step.batch)
        report, optimum = solver.step(), whole.step().chi2
        if report.chi2 > optimum + 1.0:
            torn += 1
            assert report.unsolved >= 0.9 * (report.chi2 - optimum)
    assert torn > 20


def test_a_step_that_settles_has_no_budget() -> None:
    batches = list(WORLDS["streets"](9))
    solver = Solver(Options(step_budget=1.0))
    for batch in batches:
        solver.stage(batch)
        solver.step()
    report = solver.step(settle=True)
    assert report.converged
    assert report.chi2 == pytest.approx(batch_chi2(batches), rel=1e-6)


@pytest.mark.parametrize("budget", [1e7, 1e8])
@pytest.mark.parametrize("world", WORLDS)
def test_further_steps_with_a_budget_finish_what_was_left(world: str, budget: float) -> None:
    """As a service gives them: one of no use is followed by one that may take twice as much, or that has no bound."""
    batches, solver, doubled = list(WORLDS[world](1)), Solver(), 0
    for batch in batches:
        solver.stage(batch)
        last = solver.step(budget=budget)
    within, complete_at, least, left = [], None, last.chi2, last.unsolved or math.inf
    for n in range(200):
        if not solver.unfinished:
            break
        report = solver.step(budget=budget * 2.0**doubled if doubled < 7 else 0.0)
        if report.budget and not tree_of(solver).raised:
            within.append(report.work / report.budget)
        if complete_at is None and report.complete:
            complete_at = n
        useful = report.chi2 < least * (1.0 - 1e-7) or (report.budget > 0.0 and report.unsolved < 0.99 * left)
        least, left = min(least, report.chi2), min(left, report.unsolved or math.inf)
        doubled = 0 if useful else doubled + 1
    assert not solver.unfinished
    assert solver.complete
    assert complete_at is not None
    assert max(within) < 2.0
    if world != "robots" and budget < 1e8:
        assert sum(share > 0.5 for share in within) > 1, "more than one step was needed"
    free = Solver()
    for batch in batches:
        free.stage(batch)
        free.step()
    assert solver.chi2() <= free.step(settle=True).chi2 * (1.0 + 1e-6) + 1e-9


def test_a_budget_of_the_options_is_none_of_a_step_with_nothing_new() -> None:
    solver = Solver(Options(step_budget=1e6))
    for batch in list(WORLDS["streets"](12))[:300]:
        solver.stage(batch)
        solver.step()
    assert solver.step().budget == 0.0
    assert solver.step(budget=1e6).budget == 1e6


def test_changes_in_the_middle() -> None:
    """Factors go while parts of the map are behind: the map ends where one ends that never had them."""
    batches, rng = list(WORLDS["streets"](10)), np.random.default_rng(10)
    solver, made = Solver(), 0
    for n, (batch, budget) in enumerate(zip(batches, budgets(10), strict=False)):
        first = solver.stage(batch)
        solver.step(budget=budget)
        loops = [first + k for k in range(batch.variable_count, batch.factor_count)]
        if loops and n > 200 and rng.uniform() < 0.3:
            came = try_change(solver, [Change("remove_factors", np.array(loops[:1]))], Batch((), ()), False)
            assert came is not None
            made += 1
    assert made > 10
    assert_is_a_tree(solver)
    report = left_alone(solver)
    anew = Solver()
    anew.renew(solver, solver.variable_count, solver.factor_count)
    assert report.chi2 == pytest.approx(anew.step(settle=True).chi2, rel=1e-6)


def test_a_refused_step_leaves_what_waits_as_it_was() -> None:
    batches = list(WORLDS["streets"](11))
    one, other = Solver(), Solver()
    loose = next(iter(random_steps(3, steps=1)))
    refused = 0
    for n, (batch, budget) in enumerate(zip(batches, budgets(11), strict=False)):
        if n % 40 == 39:
            try:
                one.stage(unheld(loose, n))
                one.step(budget=budget)
            except errors.SolverError:
                refused += 1
            assert has_nothing_new(one)
        for solver in (one, other):
            solver.stage(batch)
        assert nothing_timed(one.step(budget=budget)) == nothing_timed(other.step(budget=budget))
    assert refused > 5
    assert bits(one) == bits(other)


def unheld(loose: Batch, n: int) -> Batch:
    """A pose of its own that nothing holds."""
    group = loose.variables[0]
    assert group.values is not None
    return Batch((group._replace(keys=np.array([-1000 - n]), values=group.values[:1], fixed=False),), ())


@pytest.mark.parametrize("budget", [-1.0, float("nan"), float("inf"), True, "10"])
def test_a_budget_is_a_finite_number(budget: object) -> None:
    with pytest.raises(errors.BadOption, match="step_budget"):
        Options(step_budget=budget)  # type: ignore[arg-type]


@pytest.mark.parametrize("budget", [-1.0, math.nan, math.inf, True, "10", 10**400])
def test_the_budget_of_one_step_is_in_the_same_range(budget: Any) -> None:
    solver = Solver()
    with pytest.raises(errors.BadOption, match="step_budget"):
        solver.step(budget=budget)
    assert solver.step(budget=0).budget == 0.0


@pytest.mark.parametrize("budget", [1e5, 3e6])
@pytest.mark.parametrize(("world", "seed"), [("meetings", 2), ("meetings", 3), ("late", 2), ("drift", 2)])
def test_where_much_turns_a_map_with_a_budget_does_not_run_away(world: str, seed: int, budget: float) -> None:
    """A Gauss-Newton step leads far away there, and Levenberg-Marquardt has to follow before the next poses come."""
    batches = list(hard_steps(world, seed))
    solver, free = Solver(Options(step_budget=budget)), Solver()
    for batch in batches:
        for each in (solver, free):
            each.stage(batch)
            each.step()
        assert np.abs(graph_in(solver).values).max() < 1e4
    assert left_alone(solver).chi2 == pytest.approx(left_alone(free).chi2, rel=1e-6)


def hard_steps(world: str, seed: int) -> Iterator[Batch]:
    if world == "drift":
        return hard.drift(150, seed)
    if world == "late":
        return hard.late_positions(PLANE, 150, seed)
    return hard.meetings(SPACE, 150, seed)
