"""What is bent of what moved: the same whether it is looked for variable by variable or through all factors."""

import numpy as np
import pytest

from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels.tree_look import MUCH, look
from factorbus.solver.tree import Tree

# Nothing is relinearised, so a lot is bent.
NEVER = Options(bent_soon=1e9, bent_now=1e9, bent_most=1e9, patience=10**9, trust=1e9)


@pytest.mark.parametrize(("world", "poses"), [("manhattan", 300), ("city_trees", 120), ("sphere", 150)])
def test_both_ways_find_the_same(world: str, poses: int) -> None:
    solver = Solver(NEVER)
    for step in WORLDS[world](poses, 3):
        solver.stage(step.batch)
        solver.step()
    assert solver._tree is not None
    graph, tree = solver._graph, solver._tree.tree
    count = int(tree.state[tl.S_VARIABLES])
    free = np.flatnonzero(graph.var[:count, at.V_COLUMN] >= 0)
    for share, bent in ((0.3, 1e-3), (0.6, 1e-2), (1.0, 0.1)):
        moved = np.random.default_rng(4).permutation(free)[: int(share * free.size)]
        assert moved.size * MUCH > count
        one_by_one = found(solver, tree, moved, bent, variables=count * count)
        through = found(solver, tree, moved, bent, variables=count)
        assert one_by_one[0] == through[0] > bent
        np.testing.assert_allclose(through[1], one_by_one[1], rtol=1e-12)
        np.testing.assert_array_equal(through[2], one_by_one[2])
        assert one_by_one[2].size > 0
        np.testing.assert_array_equal(through[3], one_by_one[3])


def found(solver: Solver, tree: Tree, moved: np.ndarray, bent: float, variables: int) -> tuple:
    """The largest bend, Σ bend² by variable, who waits, ascending, and how each is marked."""
    graph, state, node = solver._graph, tree.state.copy(), tree.node.copy()
    turns, pending, listed = tree.turns.copy(), tree.pending.copy(), np.zeros_like(tree.moved)
    node[:, tl.N_FLAGS] = node[:, tl.N_LISTED] = 0
    node[moved, tl.N_LISTED], listed[: moved.size] = 1, moved
    state[[tl.S_MOVED, tl.S_PENDING, tl.S_VARIABLES]] = moved.size, 0, variables
    most = look(
        bent, graph.var, graph.fac, graph.payload, node, tree.link, tree.stiff, tree.lin[0], tree.scalars,
        graph.values, turns, pending, listed, state,
    )  # fmt: skip
    waiting = np.sort(pending[: state[tl.S_PENDING]])
    return most, turns[: node.shape[0], tl.U_STRAIN], waiting, node[:, tl.N_FLAGS]
