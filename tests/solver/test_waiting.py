"""When waiting variables are relinearized: all together, when it tells in χ², MATH (9.16), (9.19), (9.22)."""

from collections.abc import Iterator

import numpy as np
import pytest
from naive.solver_parts import graph_in
from naive.tree_records import tree_of

from factorbus.proto.messages import Batch
from factorbus.simulate import city_trees, manhattan
from factorbus.solver import Options, Solver
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.linearization_error import relinearize_cost, required_share
from factorbus.solver.kernels.model import layout as at

NEVER = {
    "relinearize_next_step_share": 1e9,
    "relinearize_same_step_share": 1e9,
    "relinearize_max_error": np.inf,
    "relinearize_max_wait": 10**9,
    "converged_share": 1e9,
}


def waiting(tree: CliqueTree) -> np.ndarray:
    """The variables that wait."""
    return tree.pending[: tree.state[tl.S_PENDING]].copy()


def drive(solver: Solver, steps: Iterator[Batch]) -> Iterator[tuple[CliqueTree, np.ndarray, bool]]:
    """The tree after every step; what waited before it; whether that was due."""
    for batch in steps:
        tree = tree_of(solver)
        before, due = waiting(tree), bool(tree.state[tl.S_DUE])
        solver.stage(batch)
        solver.step()
        yield tree, before, due


@pytest.mark.parametrize("world", [manhattan, city_trees])
def test_what_waits_adds_no_more_than_a_share_to_chi2(world) -> None:
    options = Options.of(relinearize_same_step_share=1e9, converged_share=1e9)
    solver, waited, relinearized, largest = Solver(options), 0, 0, 0.0
    for tree, before, due in drive(solver, (step.batch for step in world(700, 11))):
        if due:
            assert (tree.node[before, tl.N_LINEARIZED] == tree.state[tl.S_STEP]).all()
            relinearized += 1
        waited += waiting(tree).size > 0 and not tree.state[tl.S_DUE]
        share = tree.totals[tl.T_COUNTED] / (tree.totals[tl.T_MODEL] + 1e-2)
        rested = options.tuning.relinearize_cooldown_steps / max(
            tree.state[tl.S_STEP] - tree.state[tl.S_RELINEARIZED_AT], 1
        )
        most = options.tuning.relinearize_next_step_share * min(
            max(rested**2, 1.0), options.tuning.relinearize_cooldown_factor
        )
        scalars = graph_in(solver).dims[graph_in(solver).var[waiting(tree), at.V_COLUMN]].sum()
        most *= min(max((scalars / options.tuning.relinearize_full_batch) ** 3, 0.02), 1.0)
        most *= 24.0 if (graph_in(solver).var[waiting(tree), at.V_KIND] == at.POINT2).any() else 1.0
        assert share <= 1.5 * most or tree.state[tl.S_DUE]
        if not tree.state[tl.S_DUE]:
            largest = max(largest, share / most)
    assert relinearized > 3
    assert waited > 10
    assert largest > 0.1


def test_the_more_wait_the_more_it_has_to_be_worth() -> None:
    """(9.22): with many variables that wait a large share is due, with few of them a small one."""
    shares: dict[bool, list[float]] = {True: [], False: []}
    for many in (10, 10**6):
        solver = Solver(
            Options.of(
                relinearize_full_batch=many,
                relinearize_same_step_share=1e9,
                relinearize_max_error=np.inf,
                converged_share=1e5,
            )
        )
        for tree, _, _ in drive(solver, (step.batch for step in manhattan(400, 11))):
            share = tree.totals[tl.T_COUNTED] / (tree.totals[tl.T_MODEL] + 1e-2)
            if tree.state[tl.S_DUE] and share > 0.0:  # 0: nothing that waits counts
                shares[many == 10].append(share)
    assert len(shares[True]) > 3
    assert len(shares[False]) > len(shares[True])
    assert min(shares[True]) > 3.0 * min(shares[False])


def test_poses_in_space_and_landmarks_have_to_be_worth_more() -> None:
    """(9.22): one of them among all that wait is enough."""
    assert [relinearize_cost(kind) for kind in (at.SE2, at.SE3, at.POINT2, at.POINT3)] == [1.0, 8.0, 24.0, 24.0]
    settings = np.zeros(tl.P_SIZE)
    settings[tl.P_FULL_BATCH] = 1000
    assert [required_share(count, settings) for count in (3, 500, 1000, 10**5)] == [0.02, 0.125, 1.0, 1.0]


def test_nothing_waits_longer_than_patience() -> None:
    patience = 30
    solver = Solver(Options.of(**{**NEVER, "relinearize_max_wait": patience}))
    since: dict[int, int] = {}
    longest = 0
    for n, (tree, _, _) in enumerate(drive(solver, (step.batch for step in manhattan(400, 11)))):
        fresh = tree.node[:, tl.N_LINEARIZED] == tree.state[tl.S_STEP]
        since = {v: n if fresh[v] else since.get(v, n) for v in waiting(tree).tolist()}
        longest = max([longest, *(n - first for first in since.values())])
    assert patience // 2 < longest <= patience + 1


def test_what_has_a_large_error_does_not_wait() -> None:
    """By itself it is nothing in the χ² of a large map, and much where it is."""
    limit = 0.2
    solver, found = Solver(Options.of(**{**NEVER, "relinearize_max_error": limit})), 0
    for tree, before, due in drive(solver, (step.batch for step in manhattan(400, 11))):
        if due:
            assert (tree.node[before, tl.N_LINEARIZED] == tree.state[tl.S_STEP]).all()
        counted = tree.factor_errors[: tree.state[tl.S_FACTORS], tl.E_COUNTED]
        worst = np.sqrt(counted.max(initial=0.0)) / tree.totals[tl.T_UNIT]
        assert worst <= limit or tree.state[tl.S_DUE]
        found += bool(tree.state[tl.S_DUE])
    assert found > 3


def test_what_waits_in_vain_is_taken_along_by_a_settle() -> None:
    solver = Solver(Options.of(**NEVER))
    for _ in drive(solver, (step.batch for step in manhattan(300, 11))):
        pass
    assert waiting(tree_of(solver)).size > 10
    solver.step(settle=True)
    assert waiting(tree_of(solver)).size == 0
