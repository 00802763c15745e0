"""Values exactly 180° from what is measured, where the residual's derivative along the axis is 0: they are not free."""

from collections.abc import Callable

import numpy as np
import pytest

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver

INFO6 = np.diag([1.0, 1, 1, 4, 4, 4])[np.triu_indices(6)][None]
HERE = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
AXES = {"x": [1, 0, 0, 0], "y": [0, 1, 0, 0], "z": [0, 0, 1, 0], "oblique": [0.6, 0, 0.8, 0]}
X = [symbol("x", k) for k in range(4)]


def pose(key: int, fixed: bool = False) -> Variables:
    return Variables("se3", np.array([key]), HERE, fixed)


def edge(i: int, j: int, quat: list[float]) -> Factors:
    return Factors("between_se3", np.array([[X[i], X[j]]]), np.array([[1, 0, 0, *map(float, quat)]]), INFO6)


def left_alone(batches: list[Batch], mode: str) -> Solver:
    solver = Solver(Options(mode=mode))
    for batch in batches:
        solver.stage(batch)
        solver.step()
    for _ in range(3):
        solver.step()
    assert not solver.unfinished
    return solver


def settled(batches: list[Batch], mode: str) -> Solver:
    solver = Solver(Options(mode=mode))
    for batch in batches:
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    return solver


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
@pytest.mark.parametrize("axis", AXES)
def test_one_factor_holds_a_pose_half_a_turn_off(mode: str, axis: str) -> None:
    first = Batch((pose(X[0], True),), ())
    between = settled([first, Batch((pose(X[1]),), (edge(0, 1, AXES[axis]),))], mode)
    assert between.chi2() < 1e-12
    measured = np.array([[3, 2, 1, *map(float, AXES[axis])]])
    prior = Factors("prior_se3", np.array([[X[0]]]), measured, INFO6)
    assert settled([Batch((pose(X[0]),), (prior,))], mode).chi2() < 1e-12
    linear = np.concatenate([measured[0], np.eye(6).ravel(), np.zeros(6)])[None]
    factor = Factors("linear_6_se3", np.array([[X[0]]]), linear, INFO6)
    assert settled([Batch((pose(X[0]),), (factor,))], mode).chi2() < 1e-12


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
@pytest.mark.parametrize("finished", [settled, left_alone], ids=["settled", "left alone"])
@pytest.mark.parametrize("axis", ["y", "z"])
def test_a_loop_with_values_half_a_turn_off(
    axis: str, finished: Callable[[list[Batch], str], Solver], mode: str
) -> None:
    """All four poses at one place; by two of the edges the third and the fourth are turned by half a turn."""
    half, none = AXES[axis], [0, 0, 0, 1]
    batches = [
        Batch((pose(X[0], True),), ()),
        Batch((pose(X[1]),), (edge(0, 1, none),)),
        Batch((pose(X[2]),), (edge(1, 2, half),)),
        Batch((pose(X[3]),), (edge(2, 3, none), edge(0, 3, half))),
    ]
    assert finished(batches, mode).chi2() < 1e-10, "of 0 at the optimum"
