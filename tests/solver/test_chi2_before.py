"""χ² before a step that another solver makes of a map: at the values that the map had, however few they are."""

import numpy as np
import pytest
from naive.dense_least_squares import DenseGraph

from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.solver import Options, Solver
from factorbus.solver.changing import with_changes
from factorbus.solver.report import StepReport

MODES = ("bayes-tree", "inc-l", "all-batch")
ODOMETRY, LOOP = np.array([[1.0, 0, 0.1]]), np.array([[2.4, 0.1, 0.3]])
INFORMATION = np.array([[100.0, 0, 0, 100, 0, 400]])
KEYS = np.arange(4)


def between(i: int, j: int, measured: np.ndarray) -> Factors:
    return Factors("between_se2", np.array([[i, j]]), measured, INFORMATION)


def driven(mode: str) -> Solver:
    """Four poses, of which a loop that does not fit asks for a compromise."""
    solver = Solver(Options(mode=mode))
    solver.stage(Batch((Variables("se2", KEYS[:1], np.zeros((1, 3)), fixed=True),)))
    for i in range(3):
        solver.stage(Batch((Variables("se2", KEYS[i + 1 : i + 2]),), (between(i, i + 1, ODOMETRY),)))
    solver.stage(Batch(factors=(between(0, 3, LOOP),)))
    solver.step()
    return solver


def dense(solver: Solver, values: Solver | None = None) -> DenseGraph:
    twin = DenseGraph()
    twin.add(Batch(*map(tuple, solver.graph())))
    twin.put((values or solver).estimate())
    return twin


CHANGES: dict[str, tuple[Change, ...]] = {
    "weigh": (Change("weigh", np.array([3]), weight=np.array([40.0])),),
    "loss": (Change("loss", np.array([3]), loss="cauchy", scale=np.array([0.1])),),
    "remove": (Change("remove_factors", np.array([1])),),
    "fix": (Change("weigh", np.array([3]), weight=np.array([40.0])), Change("fix", keys=KEYS[2:3])),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("change", sorted(CHANGES))
def test_of_changes_it_is_that_of_the_estimate(mode: str, change: str) -> None:
    solver = driven(mode)
    made, _, report, _ = with_changes(solver, CHANGES[change])
    assert_is_before(report, dense(made, solver))


@pytest.mark.parametrize("mode", MODES)
def test_of_placed_variables_it_is_that_of_their_places(mode: str) -> None:
    solver, placed = driven(mode), np.array([[2.0, 0.7, 0.4]])
    made, _, report, _ = with_changes(solver, [Change("place", kind="se2", keys=KEYS[2:3], values=placed)])
    before = dense(made, solver)
    before.values[2] = placed[0]
    assert_is_before(report, before)


@pytest.mark.parametrize("mode", MODES)
def test_of_a_map_that_goes_on_in_another_solver_it_is_that_of_the_estimate(mode: str) -> None:
    solver = driven(mode)
    with_changes(solver, CHANGES["weigh"])
    renewed, eliminated = Solver(Options(mode=mode)), Solver(Options(mode=mode))
    reports = (
        renewed.renew(solver, solver.variable_count, solver.factor_count),
        eliminated.load(solver.dump() | {"lanes": 0}),
    )
    for report in reports:
        assert report is not None
        assert_is_before(report, dense(solver))


@pytest.mark.parametrize("mode", MODES[:2])
def test_what_comes_afterwards_is_placed_as_ever(mode: str) -> None:
    """A pose that odometry and a loop hold begins between what the two want."""
    made = with_changes(driven(mode), CHANGES["weigh"])[0]
    made.stage(Batch((Variables("se2", np.array([4])),), (between(3, 4, ODOMETRY), between(2, 4, LOOP))))
    first = dense(made)
    assert made.step().chi2_before < 0.9 * first.chi2()


def assert_is_before(report: StepReport, before: DenseGraph) -> None:
    assert report.chi2_before == pytest.approx(before.chi2(), rel=1e-9)
    assert report.chi2 <= report.chi2_before
