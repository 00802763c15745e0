"""What a factor with a loss is told to be worth, against the map solved again without it.  MATH (10.8)"""

import numpy as np
import pytest

from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Solver
from factorbus.solver.changing import with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.why import FactorExplanation, why_factor

# ρ of an outlier ten standard deviations off, k = 1, and what the map falls by without it (the others hold 1e4 times as
# firmly): the case of a front end whose client was written from the page alone.
OUTLIER = {"huber": 19.0, "cauchy": 4.61, "geman-mcclure": 0.990, "tukey": 0.333, "dcs": 2.96}
UNIT = np.array([[1.0, 0.0, 1.0]])


def held_and_pulled(loss: str, apart: float, hold: float) -> Solver:
    """A point that four factors hold where it is and one, with the loss, pulls at."""
    key = np.array([[symbol("l", 1)]])
    solver = Solver()
    solver.stage(
        Batch(
            (Variables("point2", key[0], np.zeros((1, 2))),),
            (
                Factors("prior_point2", np.repeat(key, 4, axis=0), np.zeros((4, 2)), np.repeat(hold * UNIT, 4, axis=0)),
                Factors("prior_point2", key, np.array([[apart, 0.0]]), UNIT, loss, np.ones(1)),
            ),
        )
    )
    solver.step(settle=True)
    return solver


def fall(solver: Solver, factor: int) -> float:
    """By how much χ² falls where the map is solved again without the factor."""
    without, *_ = with_changes(solver, [Change("remove_factors", np.array([factor]))], Batch(), True)
    return solver.chi2() - without.chi2()


def why(solver: Solver, factor: int) -> FactorExplanation:
    return why_factor(CovarianceBlocks(solver.covariances.factored()), factor)


@pytest.mark.parametrize("loss", OUTLIER)
def test_an_outlier_tells_its_residual_and_what_it_counts_apart(loss: str) -> None:
    solver = held_and_pulled(loss, 10.0, 2500.0)
    explained = why(solver, 4)
    s = float(explained.residual @ explained.residual)
    assert explained.residual == pytest.approx([-10.0, 0.0], abs=1e-2)
    assert explained.weighted == pytest.approx(explained.residual)
    assert explained.chi2 == pytest.approx(s) == pytest.approx(100.0, rel=1e-3)
    assert explained.rho == pytest.approx(OUTLIER[loss], rel=2e-3)
    assert explained.without == pytest.approx(fall(solver, 4), rel=1e-6)
    assert explained.without == pytest.approx(OUTLIER[loss], rel=2e-3)
    assert 0.0 <= explained.weight < 0.11


# Of two of σ = 0.4 m that are 4 m apart, where one has the loss: what was told of it, and what the map falls by.
FRONT_END = {"huber": (10.0, 18.0), "cauchy": (1.0, 4.6), "tukey": (0.0, 0.33), "dcs": (0.04, 2.96)}


@pytest.mark.parametrize("loss", FRONT_END)
def test_one_that_is_held_no_firmer_than_it_pulls_is_not_told_as_the_linear_model_has_it(loss: str) -> None:
    key, weight = np.array([[symbol("l", 1)]]), UNIT / 0.4**2
    near = Factors("prior_point2", key, np.zeros((1, 2)), weight)
    far = near._replace(measured=np.array([[4.0, 0.0]]), loss=loss, scale=np.ones(1))
    solver = Solver()
    solver.stage(Batch((Variables("point2", key[0], np.zeros((1, 2))),), (near, far)))
    solver.step(settle=True)
    explained, (linear, true) = why(solver, 1), FRONT_END[loss]
    assert explained.without == pytest.approx(fall(solver, 1), rel=1e-7)
    assert explained.without == pytest.approx(true, rel=0.015)
    weighted = explained.weight * explained.chi2
    leverage = explained.weight / (1.0 + explained.weight)
    assert weighted / (1.0 - leverage) == pytest.approx(linear, rel=0.02, abs=1e-9)
    # Nothing is weighted of what it measures: 4 m less what it has moved the point.
    assert explained.residual[0] * 2.5 == pytest.approx(-np.sqrt(explained.chi2), rel=1e-9)
    assert explained.chi2 >= 81.0 - 1e-6


@pytest.mark.parametrize("loss", ["", *OUTLIER])
@pytest.mark.parametrize("apart", [0.3, 2.0, 4.0])
def test_without_is_what_solving_again_gains(loss: str, apart: float) -> None:
    """Also where the others give way: they hold about as firmly as it pulls."""
    solver = held_and_pulled(loss, apart, 0.5) if loss else held_and_pulled("huber", apart, 0.5)
    if not loss:
        solver, *_ = with_changes(solver, [Change("loss", np.array([4]))], Batch(), True)
    explained = why(solver, 4)
    assert explained.loss == loss
    assert explained.without == pytest.approx(fall(solver, 4), rel=1e-7, abs=1e-12)
    if not loss:
        assert (explained.weight, explained.rho) == (1.0, explained.chi2)


@pytest.mark.parametrize("loss", OUTLIER)
def test_a_false_loop_of_a_drive(loss: str) -> None:
    """Poses round a square, and a loop closure 1 m off: nonlinear, so to first order."""
    keys, T = np.array([symbol("x", i) for i in range(9)]), np.array([1.0, 0.0, np.pi / 4])
    edges = Factors("between_se2", np.column_stack([keys[:-1], keys[1:]]), np.tile(T, (8, 1)), _information(8, 1e4))
    loop = Factors("between_se2", keys[None, [8, 0]], np.array([[1.0, 0.0, 0.0]]), _information(1, 25.0))
    start = Variables("se2", keys[:1], np.zeros((1, 3)), fixed=True)
    solver = Solver()
    solver.stage(Batch((start, Variables("se2", keys[1:])), (edges, loop._replace(loss=loss, scale=np.ones(1)))))
    solver.step(settle=True)
    explained = why(solver, 8)
    assert explained.chi2 > 20.0
    assert explained.without == pytest.approx(fall(solver, 8), rel=0.01, abs=1e-3)
    assert solver.chi2() == pytest.approx(explained.rho + sum(why(solver, f).rho for f in range(8)))


def _information(rows: int, weight: float) -> np.ndarray:
    return np.tile(weight * np.eye(3)[np.triu_indices(3)], (rows, 1))
