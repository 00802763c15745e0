"""Where pivots were raised R is not quite that of Λ: what a step says then."""

from typing import Any

import numpy as np
import pytest

from factorbus.client import Draft
from factorbus.proto.symbols import symbol
from factorbus.simulate import WORLDS
from factorbus.solver import Solver
from factorbus.solver.bayes_tree import steps
from factorbus.solver.divergence import copied
from factorbus.solver.optimize.gauss_newton import minimize


def test_a_tree_that_is_not_where_damped_steps_ended_has_not_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """It could not be eliminated there: a map with links of 1e-7 m said converged at 10¹⁷ times its optimum."""
    solver = Solver()
    for step in WORLDS["manhattan"](400, 5):
        solver.stage(step.batch)
    draft = Draft().se2("r0").se2("r1").between_se2("x10", "r0", (1, 0, 0.5), sigmas=(1, 1, 1))
    solver.stage(draft.between_se2("r0", "r1", (1, 0, 0.5), sigmas=(1e-8, 1e-8, 1e-8)).batch())
    solver.step()

    def elsewhere(*given: Any) -> Any:
        result = minimize(*given)
        result.chi2 *= 0.5
        return result

    pulls = Draft().prior_se2("x300", value_of(solver, "x300") + 0.3, sigmas=(0.1, 0.1, 0.1)).batch()
    said = copied(solver)
    said.stage(pulls)
    solver.stage(pulls)
    assert any(said.step().converged for _ in range(8))
    monkeypatch.setattr(steps, "minimize", elsewhere)
    assert not any(solver.step().converged for _ in range(8))


def value_of(solver: Solver, name: str) -> np.ndarray:
    """The estimate of a variable."""
    key = symbol(name[0], int(name[1:]))
    (found,) = (group.values[group.keys == key][0] for group in solver.estimate() if key in group.keys)
    return found
