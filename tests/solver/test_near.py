"""What surrounds the robot is near the root, so that a step in a large map eliminates little, MATH §9.4."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from naive.solver_parts import graph_in
from naive.tree_records import Clique, assert_is_a_tree, tree_of

from factorbus.proto.messages import Batch
from factorbus.simulate import manhattan, sphere
from factorbus.solver import Options, Solver
from factorbus.solver.errors import BadOption
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.reroot import MOST_RINGS
from factorbus.solver.kernels.model import layout as at

NEAR = 60
ALWAYS = {
    "reroot_min_flops": 0.0,
    "reroot_period": 0.0,
    "reroot_size_linear": NEAR / 3,
    "reroot_size_area": 0.0,
    "reroot_max_extra": math.inf,
}  # of more than 27 flops
NEVER = {"reroot_min_flops": math.inf}
LINEAR = {
    "relinearize_next_step_share": 1e9,
    "relinearize_same_step_share": 1e9,
    "relinearize_max_error": math.inf,
    "converged_share": 1e9,
}  # little is relinearized
WORLDS = {"manhattan": manhattan, "sphere": sphere}


def drive(solver: Solver, steps: Iterator[Batch]) -> Iterator[Batch]:
    """The steps, each after it was made."""
    for batch in steps:
        solver.stage(batch)
        solver.step()
        yield batch


def neighbours(solver: Solver) -> dict[int, set[int]]:
    """The free variables that share a factor with each free one."""
    graph = graph_in(solver)
    free = graph.var[: solver.variable_count, at.V_COLUMN] >= 0
    found: dict[int, set[int]] = {v: set() for v in range(solver.variable_count) if free[v]}
    for i, j in graph.fac[: solver.factor_count, [at.F_I, at.F_J]].tolist():
        if j >= 0 and free[i] and free[j]:
            found[i].add(j)
            found[j].add(i)
    return found


def ends(solver: Solver, first: int) -> list[int]:
    """Of the factors from `first` on."""
    return graph_in(solver).fac[first : solver.factor_count, [at.F_I, at.F_J]].ravel().tolist()


def nearest(solver: Solver, first: int, count: int) -> set[int]:
    """All variables in whole shells around the ends of the factors from `first` on, as far as `count` reaches."""
    joined = neighbours(solver)
    shell, found = {v for v in ends(solver, first) if v in joined}, set()
    while shell and len(found) + len(shell) <= count:
        found |= shell
        shell = set().union(*(joined[v] for v in shell)) - found
    return found


def above(v: int, solver: Solver, cliques: dict[int, Clique]) -> set[int]:
    """The variables that are eliminated after v, of those on which that depends on."""
    c = int(tree_of(solver).node[v, tl.N_CLIQUE])
    found: set[int] = set()
    while (c := cliques[c].parent) >= 0:
        found.update(cliques[c].frontals)
    return found


def rings(solver: Solver) -> dict[int, int]:
    """The ring of each variable that the last elimination brought near the root."""
    tree, n = tree_of(solver), solver.variable_count
    near, ring = tree.node[:n, tl.N_NEAR] == tree.state[tl.S_STAMP], tree.node[:n, tl.N_RING]
    return {int(v): int(ring[v]) for v in np.flatnonzero(near & (ring >= 0))}


@pytest.mark.parametrize("world", ["manhattan", "sphere"])
def test_above_what_is_near_there_is_only_what_is_near_or_recent(world: str) -> None:
    options = Options.of(**ALWAYS, **LINEAR)
    solver, dim, first, looked, alone = Solver(options), 6 if world == "sphere" else 3, 0, 0, 0
    for n, _ in enumerate(drive(solver, (step.batch for step in WORLDS[world](250, 7)))):
        tree = tree_of(solver)
        if n >= 100 and solver.factor_count - first > 1 and tree.state[tl.S_RELINEARIZED] == 0:
            cliques = assert_is_a_tree(solver)
            close = nearest(solver, first, NEAR // dim)
            recent = {
                v
                for v in range(solver.variable_count)
                if tree.node[v, tl.N_SEEN] > n - options.tuning.constrain_recent_steps
            }
            brought = set(rings(solver))
            assert close <= brought
            # Small fronts are joined, so that a few others may come along.
            more = [len(above(v, solver, cliques) - brought - recent) for v in close]
            assert max(more) <= 6
            alone += more.count(0)
            looked += len(more)
        first = solver.factor_count
    assert looked > 100
    assert alone > 0.9 * looked


@pytest.mark.parametrize("world", ["manhattan", "sphere"])
def test_above_a_ring_there_are_only_rings_inside_it(world: str) -> None:
    options = Options.of(**{**ALWAYS, "reroot_size_linear": 25.0}, **LINEAR)
    solver, dim, first, looked, alone = Solver(options), 6 if world == "sphere" else 3, 0, 0, 0
    for n, _ in enumerate(drive(solver, (step.batch for step in WORLDS[world](400, 7)))):
        found = rings(solver)
        if n >= 200 and n % 5 == 0 and solver.factor_count - first > 1 and found and max(found.values()) > 0:
            # Each with all inside it has a quarter of the next.
            sizes = np.cumsum(np.bincount(list(found.values()))[::-1])[::-1]
            if sizes[0] < n:
                assert (
                    sizes[1:] * options.tuning.reroot_ring_ratio <= sizes[:-1] + options.tuning.reroot_ring_ratio
                ).all()
            assert sizes[-1] * dim >= 30 - dim
            # What is further inside is nearer.
            far, shell, hops = {}, {v for v in ends(solver, first) if v in found}, 0
            while shell:
                far |= dict.fromkeys(shell, hops)
                shell, hops = set().union(*(neighbours(solver)[v] for v in shell)) - far.keys(), hops + 1
            for ring in range(1, len(sizes)):
                inside, outside = ([far[v] for v in found if found[v] == r] for r in (ring, ring - 1))
                assert max(inside) <= min(outside)
            tree, cliques = tree_of(solver), assert_is_a_tree(solver)
            recent = {
                v
                for v in range(solver.variable_count)
                if tree.node[v, tl.N_SEEN] > n - options.tuning.constrain_recent_steps
            }
            more = [
                len([w for w in above(v, solver, cliques) - recent if found.get(w, -1) < ring])
                for v, ring in found.items()
            ]
            assert max(more) <= 8  # small fronts are joined
            alone += more.count(0)
            looked += len(more)
        first = solver.factor_count
    assert looked > 100
    assert alone > 0.9 * looked


@pytest.mark.parametrize("rings", [1.0, 0.0, math.nan])
def test_a_ring_is_larger_than_what_is_inside_it(rings: float) -> None:
    with pytest.raises(BadOption, match="reroot_ring_ratio"):
        Options.of(reroot_ring_ratio=rings)


def test_no_more_rings_than_there_are_groups_for() -> None:
    solver = Solver(Options.of(**{**ALWAYS, "reroot_size_linear": 60.0}, reroot_ring_ratio=1.001, **LINEAR))
    for _ in drive(solver, steps("manhattan", 200)):
        assert max(rings(solver).values(), default=0) <= MOST_RINGS
    assert_is_a_tree(solver)


@pytest.mark.parametrize("detour", [0.0, 0.5])
def test_what_is_out_of_the_way_stays_where_it_is(detour: float) -> None:
    solver = Solver(Options.of(**{**ALWAYS, "reroot_size_linear": 60.0, "reroot_max_extra": detour}, **LINEAR))
    first, stayed, came = 0, 0, 0
    node, clique = (array.copy() for array in (tree_of(solver).node, tree_of(solver).clique))
    for n, _ in enumerate(drive(solver, steps("manhattan", 500))):
        tree = tree_of(solver)
        old = {v for v in ends(solver, first) if v < n}
        needed = cliques_above(old, node, clique)
        brought = cliques_above({v for v in rings(solver) if v < n}, node, clique)
        if n > 100:
            assert flops_of(brought - needed, clique) <= detour * flops_of(needed, clique)
            came += len(brought - needed)
            near = tree.node[:n, tl.N_NEAR] == tree.state[tl.S_STAMP]
            stayed += int((near & (tree.node[:n, tl.N_RING] == -1)).sum())
        first, node, clique = solver.factor_count, tree.node.copy(), tree.clique.copy()
    assert stayed > 100
    assert came > 100 or detour == 0.0


def cliques_above(variables: set[int], node: np.ndarray, clique: np.ndarray) -> set[int]:
    """The cliques that have these as frontals, and those above."""
    found: set[int] = set()
    for v in variables:
        c = int(node[v, tl.N_CLIQUE])
        while c >= 0 and c not in found:
            found.add(c)
            c = int(clique[c, tl.C_PARENT])
    return found


def flops_of(cliques: set[int], clique: np.ndarray) -> float:
    """What it takes to eliminate these."""
    p, m = (clique[sorted(cliques)][:, column] for column in (tl.C_PIVOTS, tl.C_SEPARATOR_SCALARS))
    return float((p * (p + m + 1) ** 2).sum())


def test_the_more_an_elimination_takes_the_more_comes_with_it() -> None:
    near, around = 2.0, 0.05
    options = {
        "reroot_min_flops": 0.0,
        "reroot_period": 0.0,
        "reroot_size_linear": near,
        "reroot_size_area": around,
        "reroot_max_extra": math.inf,
    }
    solver, seen = Solver(Options.of(**options, **LINEAR)), set()
    node, clique, first = tree_of(solver).node.copy(), tree_of(solver).clique.copy(), 0
    for n, _ in enumerate(drive(solver, steps("manhattan", 900))):
        tree = tree_of(solver)
        F = flops_of(cliques_above({v for v in ends(solver, first) if v < n}, node, clique), clique)
        wanted = max(near * F ** (1 / 3), around * F ** (2 / 3))
        if n > 100 and wanted < n and tree.state[tl.S_RELINEARIZED] == 0:
            assert abs(3 * len(rings(solver)) - wanted) <= 3
            seen.add(near * F ** (1 / 3) > around * F ** (2 / 3))
        first, node, clique = solver.factor_count, tree.node.copy(), tree.clique.copy()
    assert seen == {True, False}


@pytest.mark.parametrize(("world", "poses", "most"), [("manhattan", 3000, 0.7), ("sphere", 900, 0.4)])
def test_it_saves_eliminations_where_they_are_heavy(world: str, poses: int, most: float) -> None:
    flops = {}
    for name, how in {"as it is": {}, "never": NEVER}.items():
        solver = Solver(Options.of(**how, **LINEAR))
        flops[name] = sum(tree_of(solver).state[tl.S_FLOPS] for _ in drive(solver, steps(world, poses)))
    assert flops["as it is"] < most * flops["never"]


def steps(world: str, poses: int) -> Iterator[Batch]:
    """Of a world, what is inserted."""
    return (step.batch for step in WORLDS[world](poses, 1))


def test_the_root_is_moved_less_often_the_more_must_be_spent_before() -> None:
    moves = {}
    for worth in (0.0, 0.5, 8.0):
        solver = Solver(Options.of(reroot_period=worth))
        states = (tree_of(solver).state for _ in drive(solver, steps("sphere", 700)))
        moves[worth] = sum(s[tl.S_FLOPS] > 0 and s[tl.S_SPENT] == 0 and s[tl.S_RELINEARIZED] == 0 for s in states)
    assert moves[0.0] > moves[0.5] > moves[8.0] > 0
