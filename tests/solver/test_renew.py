"""Cliques below those that new factors change are eliminated again as they are, MATH §9.5."""

from collections.abc import Iterator

import numpy as np
import pytest
from naive.tree_records import Clique, cliques, tree_of
from naive.tree_solution import assert_solves

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import city_trees, manhattan, sphere
from factorbus.solver import Options, Solver, errors
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.kernels.bayes_tree import layout as tl

OFTEN = {
    "relinearize_next_step_share": 1e-9,
    "relinearize_same_step_share": 1e9,
    "relinearize_threshold": 1e-6,
    "relinearize_cooldown_factor": 1.0,
    "converged_share": 1e9,
}
WORLDS = {"manhattan": manhattan, "city_trees": city_trees, "sphere": sphere}


def steps(world: str, poses: int) -> Iterator[Batch]:
    """Of a world, what is inserted."""
    return (step.batch for step in WORLDS[world](poses, 5))


def kept(before: dict[int, Clique], solver: Solver) -> list[int]:
    """Cliques that have a variable relinearized in this step, and the frontals and the separator of before."""
    tree = tree_of(solver)
    fresh = tree.node[:, tl.N_LINEARIZED] == tree.state[tl.S_STEP]
    same = [
        c
        for c, clique in cliques(solver).items()
        if c in before and (clique.frontals, clique.separator) == (before[c].frontals, before[c].separator)
    ]
    return [c for c in same if fresh[before[c].frontals].any()]


@pytest.mark.parametrize("world", sorted(WORLDS))
@pytest.mark.parametrize("rounds", [{}, {"relinearize_same_step_share": 1e-9}])
def test_renewed_cliques_have_the_numbers_of_the_new_points(world: str, rounds: dict[str, float]) -> None:
    solver, renewed = Solver(Options.of(**{**OFTEN, **rounds}, wildfire_threshold=0.0, clique_split_min_pivots=6)), 0
    for batch in steps(world, 130):
        before = cliques(solver)
        solver.stage(batch)
        solver.step()
        here = kept(before, solver)
        renewed += len(here)
        if here:
            assert_solves(solver)
    assert renewed > 40


@pytest.mark.parametrize("world", ["manhattan", "city_trees"])
def test_most_of_what_is_relinearized_is_not_ordered_again(world: str) -> None:
    solver, renewed, relinearized = Solver(Options.of(**OFTEN)), 0, 0
    for batch in steps(world, 400):
        before = cliques(solver)
        solver.stage(batch)
        solver.step()
        tree = tree_of(solver)
        fresh = tree.node[: solver.variable_count, tl.N_LINEARIZED] == tree.state[tl.S_STEP]
        relinearized += int(fresh.sum()) if tree.state[tl.S_RELINEARIZED] else 0
        renewed += sum(int(fresh[before[c].frontals].sum()) for c in kept(before, solver))
    assert renewed > 0.6 * relinearized > 100


def test_a_step_refused_while_cliques_are_renewed_leaves_no_trace() -> None:
    tried, spared, due = Solver(Options.of(**OFTEN)), Solver(Options.of(**OFTEN)), 0
    for n, batch in enumerate(steps("city_trees", 200)):
        for solver in (tried, spared):
            solver.stage(batch)
            solver.step()
        if tree_of(tried).state[tl.S_DUE]:
            due += 1
            used = used_numbers(tree_of(tried))
            tried.stage(unheld(n))
            with pytest.raises(errors.Underconstrained):
                tried.step()
            assert used_numbers(tree_of(tried)) == used
        assert numbers_of(tried) == numbers_of(spared)
    assert due > 50


def unheld(n: int) -> Batch:
    """A pose in the plane that two points hold in two of its three directions."""
    new = 10**9 + 3 * n
    return Batch(
        (
            Variables("se2", np.array([new]), np.full((1, 3), 0.1)),
            Variables("point2", np.array([new + 1, new + 2]), np.array([[2.0, 1.0], [-1.0, 2.0]])),
        ),
        (
            Factors(
                "landmark_se2",
                np.array([[new, new + 1], [new, new + 2]]),
                np.array([[2.0, 1.0], [-1.0, 2.0]]),
                np.tile([2.0, 0.5, 1.0], (2, 1)),
            ),
        ),
    )


def used_numbers(tree: CliqueTree) -> int:
    """Doubles of blocks in use."""
    return int(tree.state[tl.S_NUMBERS] - tree.state[tl.S_IDLE])


def numbers_of(solver: Solver) -> list[tuple[list[int], bytes]]:
    """The variables of each clique and the bits of its rows of R, and of the estimate."""
    tree, found = tree_of(solver), []
    for c, clique in cliques(solver).items():
        row = tree.clique[c]
        p, width = int(row[tl.C_PIVOTS]), int(row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS] + 1)
        rows = [tree.numbers[i : i + width] for i in row[tl.C_ROWS] + np.arange(p) * row[tl.C_LD]]
        upper = b"".join(line[i:].tobytes() for i, line in enumerate(rows))
        found.append((clique.frontals + clique.separator, upper))
    return sorted(found) + [([], group.values.tobytes()) for group in solver.estimate()]


def test_little_room_makes_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = Solver(Options.of(**OFTEN))
    for where in ("graph.factor_ids", "bayes_tree.tree"):
        monkeypatch.setattr(f"factorbus.solver.{where}.roomy", lambda need, _size: need)
    grown, make_room = list[int](), CliqueTree.make_room
    tight = Solver(Options.of(**OFTEN))
    tree = tree_of(tight)
    tree.numbers = tree.numbers[: int(tree.state[tl.S_NUMBERS])].copy()
    tree.link, tree.factor_errors = tree.link[:1].copy(), tree.factor_errors[:1].copy()
    tree.hessian = tree.hessian[:121].copy()

    def watched(tree: CliqueTree) -> None:
        if tree.state[tl.S_RELINEARIZED] > 0:
            grown.append(1)
        make_room(tree)

    monkeypatch.setattr(CliqueTree, "make_room", watched)
    for batch in steps("manhattan", 200):
        for solver in (wide, tight):
            solver.stage(batch)
            solver.step()
        assert numbers_of(wide) == numbers_of(tight)
    assert len(grown) > 5
