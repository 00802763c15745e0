"""Newton's step of a graph against a dense Hessian of χ², and maps whose large residuals need it."""

import numpy as np
import pytest
from bench.every.drives import WORLDS
from bench.every.judge import FINE, Judge

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.inc_l.incremental import Incremental
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.kernels.model.retract import move
from factorbus.solver.optimize.system import System
from factorbus.solver.report import Stopwatch
from factorbus.solver.sparse.elimination import Elimination

# Ranges that find a drive on the wrong side of their anchors: residuals of 22 σ in the mean.
MIRRORED, ITS_OPTIMUM = 848544328, 765008.8536


def squeezed(points: int) -> Batch:
    """Points in a row, each as far from the next as odometry says, that two anchors draw five times nearer than it can
    be.  The prior is half a metre from the line between the anchors."""
    chance = np.random.default_rng(points)
    anchors = Variables("se3", np.array([0, 1]), np.array([[0, 0, 0, 0, 0, 0, 1.0], [10, 0, 0, 0, 0, 0, 1.0]]), True)
    places = np.array([5.0, 0.3, -0.2]) + 0.05 * chance.normal(size=(points, 3))
    free = Variables("point3", 2 + np.arange(points), places)
    keys = np.array([[anchor, 2 + n] for n in range(points) for anchor in (0, 1)])
    ranges = Factors("range_se3", keys, np.ones((len(keys), 1)), np.ones((len(keys), 1)))
    weights = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], (points, 1))
    return Batch((anchors, free), (ranges, Factors("prior_point3", 2 + np.arange(points)[:, None], places, weights)))


def system_of(batch: Batch) -> System:
    options = Options()
    graph = FactorGraph()
    admit(graph, batch)
    system = System(graph, Incremental(Elimination(options), options))
    system.blocks.extend(graph, (0,) * at.COUNTS)
    system.factor.moved()
    system.begin(np.empty(0, np.int64), Stopwatch(None))
    return system


def dense_newton(graph: FactorGraph) -> np.ndarray:
    """H⁻¹ η, both by second differences of χ² / 2."""
    count, h = int(graph.counts[at.SCALARS]), 1e-4
    trial = np.empty_like(graph.values)

    def half(delta: np.ndarray) -> float:
        move(int(graph.counts[at.VARIABLES]), graph.var, graph.values, delta, trial)
        return 0.5 * float(sum_chi2(0, int(graph.counts[at.FACTORS]), graph.var, graph.fac, trial, graph.payload))

    e = h * np.eye(count)
    eta = np.array([half(-each) - half(each) for each in e]) / (2 * h)
    H = np.array([[half(a + b) - half(a - b) - half(b - a) + half(-a - b) for b in e] for a in e]) / (4 * h * h)
    return np.linalg.solve(H, eta)


def test_it_is_that_of_a_dense_hessian() -> None:
    system = system_of(squeezed(4))
    assert system.factorize(0.0) < 0
    expected = dense_newton(system.graph)
    # What is left of the linear system is 1e-4 of the decrease, so that δ is right to a hundredth.
    np.testing.assert_allclose(system.newton_step(), expected, atol=0.02 * np.abs(expected).max())
    system.decrease()
    assert np.abs(system.step() - expected).max() > 0.2 * np.abs(expected).max()


def test_it_leaves_the_point_and_its_gradient() -> None:
    system = system_of(squeezed(3))
    system.factorize(0.0)
    before, values = system.decrease(), system.graph.values.copy()
    system.newton_step()
    assert system.decrease() == before
    np.testing.assert_array_equal(system.graph.values, values)


def test_beyond_bounds_there_is_a_step_without_it() -> None:
    """What would leave its bounds has an infinite χ², and no gradient."""
    system = system_of(squeezed(2))
    system.factorize(0.0)
    system.decrease()
    expected = system.step()
    system.linearize_at = lambda _step: float("inf")
    np.testing.assert_allclose(system.newton_step(), expected, rtol=1e-12)


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
def test_one_step_settles_where_damped_ones_took_many(mode: str) -> None:
    solver = Solver(Options(mode=mode))
    solver.stage(squeezed(5))
    report = solver.step(settle=True)
    assert report.converged
    assert report.iterations <= 5
    again = solver.step(settle=True)
    assert again.chi2 == pytest.approx(report.chi2, rel=1e-12)


def test_a_mirrored_map_left_alone_ends_at_its_optimum() -> None:
    """With damped steps it rested at 1.3e-6 above it, after 21."""
    solver, judge = Solver(Options()), Judge()
    for batch in WORLDS["ranges_3d"].make(300, MIRRORED):
        solver.stage(batch)
        report = solver.step()
        judge.take_in(batch)
    steps = 0
    while (solver.unfinished or not report.converged) and steps < 20:
        report, steps = solver.step(), steps + 1
    assert report.converged
    assert report.chi2 == pytest.approx(ITS_OPTIMUM, rel=1e-8)
    assert judge.look(solver.estimate(), coarse=FINE).ratio <= 1 + 1e-8
