"""Moving linearization points: whatever moves, its factors are linearized again, each once, and no others."""

import copy

import numpy as np
import pytest
from naive.solver_parts import graph_in
from naive.tree_records import tree_of

from factorbus.simulate import manhattan
from factorbus.solver import Options, Solver
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.bayes_tree.relinearize import SPARSE, linearize_around
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at


@pytest.fixture(scope="module")
def driven() -> Solver:
    """Without chord steps, after which a Hessian has another gradient than that of its linearization."""
    solver = Solver(Options.of(converged_share=1e9, relinearize_same_step_share=1e9))
    for step in manhattan(400, 1):
        solver.stage(step.batch)
        solver.step()
    return solver


@pytest.mark.parametrize("picked", [[3], [5, 390], list(range(40, 60)), list(range(1, 400))])
def test_the_factors_of_some_variables_are_linearized(driven: Solver, picked: list[int]) -> None:
    tree, graph = tree_of(driven), graph_in(driven)
    count = int(tree.state[tl.S_FACTORS])
    ends = graph.fac[:count, [at.F_I, at.F_J]]
    around = np.flatnonzero(np.isin(ends, picked).any(axis=1))
    if len(picked) == 2:
        assert np.ptp(around) >= SPARSE * around.size, "far apart: found by walking"
    right, wrong, copied = tree.hessian.copy(), np.full(tree.hessian.size, np.nan), copy.copy(tree)
    copied.hessian = wrong
    linearize_around(graph_at(graph.array_table), tree_at(copied.array_table), np.array(picked))
    starts = np.append(tree.link[:count, tl.L_AT], tree.state[tl.S_HESSIAN])
    done = [
        f for f in range(count) if np.array_equal(wrong[starts[f] : starts[f + 1]], right[starts[f] : starts[f + 1]])
    ]
    assert done == around.tolist()
    assert np.isnan(wrong).sum() == wrong.size - sum(int(starts[f + 1] - starts[f]) for f in done)
