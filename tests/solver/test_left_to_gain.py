"""Where Σ error² does not say what is left to gain: what is not solved, saddle points, valleys.  MATH §9.6"""

import math

import numpy as np
import pytest
from naive.random_graphs import camera_steps
from naive.solver_parts import tree_of
from solver.test_converged import put

from factorbus.client import Changes, Draft
from factorbus.solver import Options, Solver
from factorbus.solver.bayes_tree import steps
from factorbus.solver.bayes_tree.left_to_gain import judge_batch
from factorbus.solver.changing import with_changes
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.optimize.gauss_newton import Minimization

SHARE = Options().converged_share
AS_GIVEN = Options(initialize_locally=False)


def test_what_is_back_at_its_linearization_points_has_not_converged_when_another_robot_goes_on() -> None:
    """So it is where Levenberg-Marquardt ended before it had: a step elsewhere solves nothing of it, and said that all
    had converged at 1.02 times the optimum."""
    solver, sigmas = Solver(), (0.1, 0.1, 0.1)
    draft = Draft().se2("x0", (0, 0, 0), fixed=True).se2("y0", (0, 0, 0), fixed=True)
    for n in range(1, 6):
        draft.se2(f"x{n}", (n, 0, 0)).between_se2(f"x{n - 1}", f"x{n}", (1, 0, 0), sigmas=sigmas)
    put(solver, draft)
    best = put(solver, Draft().between_se2("x0", "x5", (5.02, 0, 0), sigmas=sigmas))
    assert best.converged
    tree_of(solver).reset_to_linearization()
    for n in range(1, 4):
        report = put(solver, Draft().se2(f"y{n}").between_se2(f"y{n - 1}", f"y{n}", (1, 0, 0), sigmas=sigmas))
        assert report.chi2 == pytest.approx(0.04)
        assert not report.converged
        assert solver.unfinished
    report = solver.step()
    assert report.chi2 == pytest.approx(best.chi2)
    assert report.converged
    assert not solver.unfinished


def between_two(along: float) -> Draft:
    """A point half way between two poses that both measured 2 m where 1 m is right, `along` off the line through them:
    both push it off that line, which a weak prior alone holds against.  A Gauss-Newton step goes 2000 times as far."""
    c = math.sqrt(0.5)
    draft = Draft().se2("o0", (c, c, 0), fixed=True).se2("o1", (-c, -c, 0), fixed=True)
    draft.point2("l0", (c * along, -c * along)).prior_point2("l0", (0, 0), sigmas=(3.16, 3.16))
    for pose in ("o0", "o1"):
        draft.range_se2(pose, "l0", 2.0, sigmas=0.1)
    return draft


NEAR, BEST = 5e-7, 0.299


def test_after_a_change_beside_a_saddle_point_the_map_goes_on() -> None:
    """The step gains nothing, and leads to where 0.2 are left of a χ² of 200, which is 0.3 at the optimum."""
    solver = Solver()
    put(solver, between_two(1.7))
    there = between_two(NEAR).batch().variables
    changes = Changes().place([group for group in there if group.kind == "point2"])
    made, _, report, _ = with_changes(solver, changes.listed())
    assert report.because.startswith("another step would gain")
    assert report.chi2 == pytest.approx(BEST, rel=1e-2)
    assert report.converged
    made.step()
    assert not made.unfinished


def test_a_batch_whose_last_step_leads_to_where_much_is_left_has_not_converged() -> None:
    solver = Solver(AS_GIVEN)
    report = put(solver, between_two(NEAR))
    assert report.chi2 == pytest.approx(200.0, rel=1e-2)
    tree = tree_of(solver)
    result = Minimization(report.chi2 * (1.0 + 1e-9), 0.0, converged=True)
    judge_batch(tree, result, SHARE, math.inf)
    assert not result.converged
    assert solver.unfinished
    report = solver.step()  # which looks again at what was found to be left
    assert report.chi2 == pytest.approx(BEST, rel=1e-2)
    solver.step()
    assert not solver.unfinished


@pytest.mark.parametrize(("last", "rests"), [(0.0, True), (math.inf, False)])
def test_a_map_rests_where_damped_steps_hardly_gain_and_a_whole_one_would_not(last: float, rests: bool) -> None:
    """last: what a step with nothing new has gained.  Such maps had gone on for ever, some with the same bits."""
    solver = Solver()
    put(solver, between_two(1.7))
    tree = tree_of(solver)
    result = Minimization(float(tree.totals[tl.T_CHI2]), 1e-3)
    judge_batch(tree, result, SHARE, last)
    assert result.converged == rests
    assert (tree.totals[tl.T_LEAST] == tree.totals[tl.T_CHI2]) == rests


def test_it_does_not_rest_where_a_whole_step_would_gain_much() -> None:
    solver = Solver(AS_GIVEN)
    tree, result = tree_of(solver), Minimization(put(solver, between_two(NEAR)).chi2, 1e-3)
    judge_batch(tree, result, SHARE, 0.0)
    assert not result.converged
    assert tree.totals[tl.T_LEAST] == 0.0


def test_where_damped_steps_hardly_gain_the_next_ones_begin_without_damping(monkeypatch: pytest.MonkeyPatch) -> None:
    """A map of ranges stayed at χ² 352 for hundreds of steps, in which damping went from 40 to 800 and back; without it
    67 was reached."""
    tried = list[float]()

    def hardly(_: object, chi2: float, damping: float, *__: object) -> Minimization:
        tried.append(damping)
        return Minimization(chi2, 100.0)

    solver = Solver()
    put(solver, between_two(1.7))
    monkeypatch.setattr(steps, "minimize", hardly)
    monkeypatch.setattr(steps.TreeSteps, "_stalls", True)
    for _ in range(5):
        solver.step()
    assert tried == [0.0, 100.0, 0.0, 100.0, 0.0]


def test_a_step_with_nothing_new_does_not_rest_beside_a_saddle_point() -> None:
    """Σ error² is 10⁻⁹ of χ² there, and 4 · 10⁻⁷ is what a step takes off."""
    solver = Solver(AS_GIVEN)
    assert put(solver, between_two(1e-8)).chi2 == pytest.approx(200.0)
    report = solver.step()
    assert report.chi2 == pytest.approx(BEST, rel=1e-2)
    assert report.converged
    assert not solver.unfinished


def test_a_step_that_came_to_its_limit_by_steps_that_gain_does_not_rest() -> None:
    """A drive of cameras that ran off to a χ² of 10²⁰ comes back ten steps at a time: each time R of the tree, whose
    pivots were raised, said that nothing was left, and the map rested at 9 times its optimum."""
    chance = np.random.default_rng([494, 5])
    noise, steps = 10.0 ** chance.uniform(-2, 0.3), int(chance.integers(3, 16))
    solver, optimum = Solver(), 2.759602
    for batch in camera_steps(494, steps, noise, "huber"):
        solver.stage(batch)
        report = solver.step()
    rests = 0
    for _ in range(40):
        report = solver.step()
        assert not report.converged or report.chi2 <= 1.001 * optimum
        rests = rests + 1 if report.converged and not solver.unfinished else 0
        if rests == 3:
            break
    assert rests == 3
    assert report.chi2 == pytest.approx(optimum, rel=1e-6)
