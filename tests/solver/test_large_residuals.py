"""Where residuals are large, an undamped Gauss-Newton step may lead away from the very optimum."""

import numpy as np
import pytest
from scipy.optimize import minimize

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver

_ENDS = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
_HERE, _Z, _WEIGHT = np.array([5.0, 0.3]), 1.0, 0.5


def _squeezed() -> Batch:
    """A point that two ranges, each a fifth of what it can be, draw to the line between two fixed poses: across that
    line only a weak prior is in Λ, a quarter of the curvature that χ² has there."""
    poses = Variables("se2", np.array([0, 1]), _ENDS, fixed=True)
    point = Variables("point2", np.array([2]), np.array([[5.0, 2.0]]))
    ranges = Factors("range_se2", np.array([[0, 2], [1, 2]]), np.full((2, 1), _Z), np.ones((2, 1)))
    prior = Factors("prior_point2", np.array([[2]]), _HERE[None], np.array([[_WEIGHT, 0.0, _WEIGHT]]))
    return Batch((poses, point), (ranges, prior))


def _chi2(point: np.ndarray) -> float:
    distances = np.linalg.norm(point - _ENDS[:, :2], axis=1)
    return float(((distances - _Z) ** 2).sum() + _WEIGHT * ((point - _HERE) ** 2).sum())


_OPTIMUM = float(minimize(_chi2, np.array([5.0, 0.1]), method="BFGS", options={"gtol": 1e-10}).fun)


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
def test_a_map_left_alone_ends_at_the_optimum_that_undamped_steps_lead_away_from(mode: str) -> None:
    solver = Solver(Options(mode=mode))
    solver.stage(_squeezed())
    report = solver.step()
    for _ in range(20):
        before = report.chi2
        if report.converged and not solver.unfinished:
            break
        report = solver.step()
        assert report.chi2 <= before * (1 + 1e-8)
    assert report.converged
    assert not solver.unfinished
    assert report.chi2 == pytest.approx(_OPTIMUM, rel=1e-6)


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
def test_a_map_that_settles_there_says_that_it_has_converged(mode: str) -> None:
    solver = Solver(Options(mode=mode))
    solver.stage(_squeezed())
    report = solver.step(settle=True)
    assert report.converged
    assert report.chi2 == pytest.approx(_OPTIMUM, rel=1e-9)
