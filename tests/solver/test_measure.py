"""What moved is measured: the same variable by variable and through all factors."""

import copy

import numpy as np
import pytest
from naive.solver_parts import NEVER_RELINEARIZES, graph_in
from naive.tree_records import tree_of

from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.linearization_error import MUCH, evaluate_moved
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at

NEVER = Options.of(**NEVER_RELINEARIZES)


@pytest.mark.parametrize(("world", "poses"), [("manhattan", 300), ("city_trees", 120), ("sphere", 150)])
def test_both_ways_find_the_same(world: str, poses: int) -> None:
    solver = Solver(NEVER)
    for step in WORLDS[world](poses, 3):
        solver.stage(step.batch)
        solver.step()
    graph, tree = graph_in(solver), tree_of(solver)
    count = int(tree.state[tl.S_VARIABLES])
    free = np.flatnonzero(graph.var[:count, at.V_COLUMN] >= 0)
    for share, threshold in ((0.3, 1e-3), (0.6, 1e-2), (1.0, 0.1)):
        moved = np.random.default_rng(4).permutation(free)[: int(share * free.size)]
        assert moved.size * MUCH > count
        one_by_one = found(solver, tree, moved, threshold, variables=count * count)
        through = found(solver, tree, moved, threshold, variables=count)
        assert one_by_one[0] == through[0] > threshold
        np.testing.assert_allclose(through[1], one_by_one[1], rtol=1e-12)
        np.testing.assert_array_equal(through[2], one_by_one[2])
        assert one_by_one[2].size > 0
        np.testing.assert_array_equal(through[3], one_by_one[3])
        np.testing.assert_array_equal(through[4], one_by_one[4])


def found(solver: Solver, tree: CliqueTree, moved: np.ndarray, threshold: float, variables: int) -> tuple:
    """The largest error, Σ error² by factor, who waits, ascending, how each is marked, and χ² by factor."""
    graph, state, node, totals = graph_in(solver), tree.state.copy(), tree.node.copy(), tree.totals.copy()
    pending, listed, factor_errors = tree.pending.copy(), np.zeros_like(tree.moved), tree.factor_errors.copy()
    node[:, tl.N_FLAGS] = node[:, tl.N_LISTED] = 0
    node[moved, tl.N_LISTED], listed[: moved.size] = MODEL, moved
    factor_errors[:, [tl.E_CHI2, tl.E_ERROR, tl.E_COUNTED]] = 0.0
    state[[tl.S_MOVED, tl.S_PENDING]] = moved.size, 0
    totals[[tl.T_CHI2, tl.T_ERROR, tl.T_COUNTED]] = 0.0
    state[tl.S_VARIABLES] = variables
    copied = copy.copy(tree)
    copied.node, copied.factor_errors, copied.pending, copied.moved = node, factor_errors, pending, listed
    copied.state, copied.totals = state, totals
    most = evaluate_moved(graph_at(graph.array_table), tree_at(copied.array_table), threshold)
    assert totals[tl.T_CHI2] == pytest.approx(factor_errors[:, tl.E_CHI2].sum())
    assert totals[tl.T_ERROR] == pytest.approx(factor_errors[:, tl.E_ERROR].sum())
    waiting = np.sort(pending[: state[tl.S_PENDING]])
    return most, factor_errors[:, tl.E_COUNTED], waiting, node[:, tl.N_FLAGS], factor_errors[:, tl.E_CHI2]
