"""Far starts and outliers: the estimate never gets worse, and gets where it should."""

import numpy as np
import pytest
from naive.dense_least_squares import DenseGraph

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import manhattan
from factorbus.solver import Options, Solver, solve_batch

INFO = np.array([[100.0, 0, 0, 100, 0, 400]])


def ring(n: int, turn: float) -> tuple[Variables, Factors]:
    """n + 1 poses on a ring, the last one on the first; every edge exact."""
    angle = 2 * np.pi / n
    z = np.tile([2 * np.sin(angle / 2), 0.0, angle], (n, 1))
    z[:, :2] = z[:, :1] * [np.cos(angle / 2), np.sin(angle / 2)]
    keys = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    values = np.zeros((n - 1, 3))
    values[:, 2] = turn * np.arange(1, n)
    return Variables("se2", np.arange(1, n), values), Factors("between_se2", keys, z, np.repeat(INFO, n, 0))


# All headings of the start wind around once, as the ring does: a ring wound twice, or not at all, is a local minimum.
@pytest.mark.parametrize("turn", [0.3, 0.45, 0.6])
def test_a_ring_crumpled_into_a_point_unfolds_without_a_rise(turn: float) -> None:
    free, edges = ring(12, turn)
    fixed = Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True)
    solver = Solver(Options(max_iterations=1))
    solver.stage(Batch((fixed, free), (edges,)))
    chi2 = [np.inf]
    for _ in range(200):
        report = solver.step()
        assert report.chi2 <= min(chi2[-1], report.chi2_before)
        chi2.append(report.chi2)
        if report.converged:
            break
    assert solver.chi2() < 1e-9
    # The same at once.
    assert solve_batch((fixed, free), (edges,)).chi2 < 1e-12


def test_a_false_loop_closure_does_not_blow_the_map_up() -> None:
    solver, twin = Solver(), DenseGraph()
    for step in manhattan(poses=120, seed=3):
        solver.stage(step.batch)
        solver.step()
        twin.add(step.batch)
    poses = np.concatenate([group.keys for group in solver.estimate()])
    lie = Factors("between_se2", np.array([[poses[0], poses[-1]]]), np.array([[300.0, -500.0, 3.0]]), 1e4 * INFO)
    twin.put(solver.estimate())
    before = twin.chi2()
    twin.add(Batch((), (lie,)))
    with_it = twin.chi2()
    solver.stage(Batch((), (lie,)))
    report = solver.step(settle=True)
    assert report.chi2_before == pytest.approx(with_it, rel=1e-6)
    twin.put(solver.estimate())
    assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-6)
    assert before < twin.chi2() < with_it
    _, eta = twin.system()
    assert np.abs(eta).max() < 1e-6 * twin.chi2(), "it is at an optimum, though of little use"


def test_a_noisy_start_far_from_the_truth_converges_to_the_optimum() -> None:
    solver = Solver()
    for step in manhattan(poses=200, seed=5):
        solver.stage(step.batch)
        solver.step()
    best = solver.step(settle=True).chi2
    variables, factors = solver.graph()
    rng = np.random.default_rng(1)
    moved = [
        Variables(g.kind, g.keys, g.values + (not g.fixed) * rng.normal(0, [0.7, 0.7, 0.25], g.values.shape), g.fixed)
        for g in variables
    ]
    result = solve_batch(moved, factors)
    assert result.converged
    assert result.chi2 == pytest.approx(best, rel=1e-9)
