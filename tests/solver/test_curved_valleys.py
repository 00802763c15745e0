"""Along a curved valley Gauss-Newton steps gain hardly less than the ones before, and forces that are small by
themselves add up: a step that says that it has converged has.  MATH (9.39), (9.41)"""

import numpy as np
import pytest
from bench.every.drives import WORLDS
from naive.solver_parts import NEVER_RELINEARIZES, graph_in
from naive.tree_records import tree_of

from factorbus.solver import Options, Solver
from factorbus.solver.divergence import copied
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.decrement import AMPLE, HARDLY_LESS, decrement
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.retract import move

from .test_decrement import normal_equations

# A world and its seed, and the first and last of the steps that said so, at how many times the optimum's χ².
VALLEYS = {
    "landmarks far away": ("far_2d", 20461, 104, 116),  # 1.011
    "the same in own kinds": ("own_far_2d", 20231, 35, 40),  # 1.003
    "nine rounds, none of which was the last": ("own_far_2d", 20512, 148, 153),  # 1.028
    "of positions, most of which miss next to nothing": ("late_3d", 7030, 103, 109),  # 1.002
    "against a prior that is exactly linear": ("late_2d", 9152, 92, 98),  # 1.0011
}


@pytest.mark.parametrize("name", VALLEYS)
def test_a_step_that_says_that_it_has_converged_has(name: str) -> None:
    (world, seed, first, last), solver = VALLEYS[name], Solver()
    for k, batch in enumerate(WORLDS[world].make(WORLDS[world].poses, seed)):
        if k > last:
            break
        solver.stage(batch)
        report = solver.step()
        if k >= first and report.converged:
            settled = copied(solver)
            assert report.chi2 <= 1.001 * min(settled.step(settle=True).chi2 for _ in range(4))
    for _ in range(20):
        report = solver.step()
    assert report.converged
    assert not solver.unfinished


@pytest.mark.parametrize(("world", "seed"), [("late_2d", 3), ("late_3d", 3), ("frames_2d", 5), ("far_2d", 20461)])
def test_what_steps_take_off_follows_from_what_the_first_one_does(world: str, seed: int) -> None:
    """Nothing is relinearized, so all factors miss something.  (9.41)"""
    solver = Solver(Options.of(**NEVER_RELINEARIZES, wildfire_threshold=0.0))
    for k, batch in enumerate(WORLDS[world].make(60, seed)):
        solver.stage(batch)
        if k > 1:
            solver.step()
    graph, tree = graph_in(solver), tree_of(solver)
    was, _ = normal_equations(solver, tree.lin[0])
    _, gradient = normal_equations(solver, graph.values)
    step = np.linalg.solve(was, gradient)
    expected, there = float(gradient @ step), graph.values.copy()
    arrays = graph_at(graph.array_table), tree_at(tree.array_table)
    assert decrement(-1.0, True, 100.0 * expected, *arrays) == pytest.approx(expected, rel=1e-6), "little: not tried"
    move(int(graph.counts[at.VARIABLES]), graph.var, graph.values, -step, there)
    factors = int(graph.counts[at.FACTORS])
    chi2 = float(tree.totals[tl.T_CHI2])
    rate = (chi2 - sum_chi2(0, factors, graph.var, graph.fac, there, graph.payload)) / expected - 1.0
    within = -HARDLY_LESS < rate < HARDLY_LESS
    wanted = expected * (AMPLE / (1.0 - rate) if rate > 0.0 else 1.0) if within else chi2
    assert decrement(-1.0, True, 1.5 * expected, *arrays) == pytest.approx(min(wanted, chi2), rel=1e-6)
