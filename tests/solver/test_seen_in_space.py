"""χ² of relative poses in space, whatever their information is like: where it is the same for a translation in all
directions a shorter sum is computed."""

import numpy as np
import pytest
from naive.solver_parts import graph_in
from naive.tree_records import tree_of

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import WORLDS
from factorbus.solver import Solver
from factorbus.solver.kernels.bayes_tree import layout as tl

TRIANGLE = np.triu_indices(6)


def isotropic(rng: np.random.Generator) -> np.ndarray:
    """The same for a translation in all directions; of the rotation anything."""
    turn = rng.standard_normal((3, 3))
    made = np.zeros((6, 6))
    made[:3, :3], made[3:, 3:] = rng.uniform(1.0, 50.0) * np.eye(3), turn @ turn.T + 20.0 * np.eye(3)
    return made


def uneven(rng: np.random.Generator) -> np.ndarray:
    return isotropic(rng) + np.diag([0.0, 5.0, 0.0, 0.0, 0.0, 0.0])


def oblique(rng: np.random.Generator) -> np.ndarray:
    made = isotropic(rng)
    made[0, 1] = made[1, 0] = 0.5
    return made


def coupled(rng: np.random.Generator) -> np.ndarray:
    made = isotropic(rng)
    made[2, 5] = made[5, 2] = 1.5
    return made


@pytest.mark.parametrize("make", [isotropic, uneven, oblique, coupled])
def test_chi2_of_every_step_is_the_sum_over_all_factors(make) -> None:
    rng, solver = np.random.default_rng(7), Solver()
    for step in WORLDS["sphere"](60, 5):
        factors = tuple(
            Factors(
                group.kind,
                group.keys,
                group.measured,
                np.array([make(rng)[TRIANGLE] for _ in group.keys])
                if group.kind == "between_se3"
                else group.information,
            )
            for group in step.batch.factors
        )
        variables = tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in step.batch.variables)
        solver.stage(Batch(variables, tuple(factors)))
        report = solver.step()
        assert report.chi2 == pytest.approx(solver.chi2(), rel=1e-9, abs=1e-9)
        assert report.converged
    graph, form = graph_in(solver), tree_of(solver).factor_errors[:, tl.E_FORM]
    assert report.chi2 > 1.0
    assert set(form[1 : solver.factor_count].tolist()) == ({tl.ISOTROPIC} if make is isotropic else {0.0})
    assert len(graph.fac) >= solver.factor_count > 60
