"""When bent variables are relinearised: all that wait together, when it tells in χ², MATH (9.16) and (9.19)."""

from collections.abc import Iterator

import numpy as np
import pytest
from naive.tree_records import tree_of

from factorbus.proto.messages import Batch
from factorbus.simulate import city_trees, manhattan
from factorbus.solver import Options, Solver
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.tree import Tree

NEVER = {"bent_soon": np.inf, "bent_now": np.inf, "bent_most": np.inf, "patience": 10**9}


def waiting(tree: Tree) -> np.ndarray:
    """The variables that wait."""
    return tree.pending[: tree.state[tl.S_PENDING]].copy()


def drive(solver: Solver, steps: Iterator[Batch]) -> Iterator[tuple[Tree, np.ndarray, bool]]:
    """The tree after every step; what waited before it; whether that was due."""
    for batch in steps:
        tree = tree_of(solver)
        before, due = waiting(tree), bool(tree.state[tl.S_DUE])
        solver.stage(batch)
        solver.step()
        yield tree, before, due


@pytest.mark.parametrize("world", [manhattan, city_trees])
def test_what_waits_adds_no_more_than_a_share_to_chi2(world) -> None:
    options = Options()
    solver, waited, relinearised, largest = Solver(options), 0, 0, 0.0
    for tree, before, due in drive(solver, (step.batch for step in world(700, 11))):
        if due:
            assert (tree.node[before, tl.N_LINEARISED] == tree.state[tl.S_STEP]).all()
            relinearised += 1
        share = tree.turns[waiting(tree), tl.U_STRAIN].sum() / (tree.account[tl.A_CHI2] + 1e-3)
        rested = options.rest / max(tree.state[tl.S_STEP] - tree.state[tl.S_RELINEARISED_AT], 1)
        most = options.bent_soon * min(max(rested**2, 1.0), options.reluctance)
        assert share <= 1.5 * most or tree.state[tl.S_DUE]
        if not tree.state[tl.S_DUE]:
            waited += waiting(tree).size > 0
            largest = max(largest, share)
    assert relinearised > 3
    assert waited > 100
    assert largest > 0.1 * options.bent_soon


def test_nothing_waits_longer_than_patience() -> None:
    patience, every = 30, 4
    solver = Solver(Options(**{**NEVER, "patience": patience}, look_every=every))
    since: dict[int, int] = {}
    longest = 0
    for n, (tree, _, _) in enumerate(drive(solver, (step.batch for step in manhattan(400, 11)))):
        fresh = tree.node[:, tl.N_LINEARISED] == tree.state[tl.S_STEP]
        since = {v: n if fresh[v] else since.get(v, n) for v in waiting(tree).tolist()}
        longest = max([longest, *(n - first for first in since.values())])
    assert patience // 2 < longest <= patience + 2 * every


def test_what_is_bent_far_does_not_wait() -> None:
    """By itself it is nothing in the χ² of a large map, and much where it is."""
    limit = 0.2
    solver, found = Solver(Options(**{**NEVER, "bent_most": limit}, look_every=1)), 0
    for tree, before, due in drive(solver, (step.batch for step in manhattan(400, 11))):
        if due:
            assert (tree.node[before, tl.N_LINEARISED] == tree.state[tl.S_STEP]).all()
        assert tree.account[tl.A_BEND] <= limit or tree.state[tl.S_DUE]
        found += bool(tree.state[tl.S_DUE])
    assert found > 3


def test_what_waits_in_vain_is_taken_along_by_a_settle() -> None:
    solver = Solver(Options(**NEVER))
    for _ in drive(solver, (step.batch for step in manhattan(300, 11))):
        pass
    assert waiting(tree_of(solver)).size > 10
    solver.step(settle=True)
    assert waiting(tree_of(solver)).size == 0
