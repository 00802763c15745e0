"""What surrounds the robot is near the root, so that a step in a large map eliminates little, MATH §9.4."""

import math
from collections.abc import Iterator

import pytest
from naive.tree_records import Clique, assert_is_a_tree, tree_of

from factorbus.proto.messages import Batch
from factorbus.simulate import manhattan, sphere
from factorbus.solver import Options, Solver
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl

NEAR = 60
ALWAYS = {"heavy": 0.0, "worth": 0.0, "near": NEAR / 3}  # of more than 27 flops
NEVER = {"heavy": math.inf}
LINEAR = {"bent_soon": math.inf, "bent_now": math.inf, "bent_most": math.inf}  # little is relinearised
WORLDS = {"manhattan": manhattan, "sphere": sphere}


def drive(solver: Solver, steps: Iterator[Batch]) -> Iterator[Batch]:
    """The steps, each after it was made."""
    for batch in steps:
        solver.stage(batch)
        solver.step()
        yield batch


def neighbours(solver: Solver) -> dict[int, set[int]]:
    """The free variables that share a factor with each free one."""
    graph = solver._graph
    free = graph.var[: solver.variable_count, at.V_COLUMN] >= 0
    found: dict[int, set[int]] = {v: set() for v in range(solver.variable_count) if free[v]}
    for i, j in graph.fac[: solver.factor_count, [at.F_I, at.F_J]].tolist():
        if j >= 0 and free[i] and free[j]:
            found[i].add(j)
            found[j].add(i)
    return found


def nearest(solver: Solver, first: int, count: int) -> set[int]:
    """All variables in whole shells around the ends of the factors from `first` on, as far as `count` reaches."""
    graph, joined = solver._graph, neighbours(solver)
    ends = graph.fac[first : solver.factor_count, [at.F_I, at.F_J]].ravel().tolist()
    shell, found = {v for v in ends if v in joined}, set()
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


@pytest.mark.parametrize("world", ["manhattan", "sphere"])
def test_above_what_is_near_there_is_only_what_is_near_or_recent(world: str) -> None:
    options = Options(**ALWAYS, **LINEAR)
    solver, dim, first, looked, alone = Solver(options), 6 if world == "sphere" else 3, 0, 0, 0
    for n, _ in enumerate(drive(solver, (step.batch for step in WORLDS[world](250, 7)))):
        tree = tree_of(solver)
        if n >= 100 and solver.factor_count - first > 1 and tree.state[tl.S_RELINEARISED] == 0:
            cliques = assert_is_a_tree(solver)
            close = nearest(solver, first, NEAR // dim)
            recent = {v for v in range(solver.variable_count) if tree.node[v, tl.N_SEEN] > n - options.recent_steps}
            brought = {v for v in range(solver.variable_count) if tree.node[v, tl.N_NEAR] == tree.state[tl.S_STAMP]}
            assert close <= brought
            # Small fronts are joined, so that a few others may come along.
            more = [len(above(v, solver, cliques) - brought - recent) for v in close]
            assert max(more) <= 6
            alone += more.count(0)
            looked += len(more)
        first = solver.factor_count
    assert looked > 100
    assert alone > 0.9 * looked


@pytest.mark.parametrize(("world", "poses", "most"), [("manhattan", 3000, 0.7), ("sphere", 900, 0.4)])
def test_it_saves_eliminations_where_they_are_heavy(world: str, poses: int, most: float) -> None:
    flops = {}
    for name, how in {"as it is": {}, "never": NEVER}.items():
        solver = Solver(Options(**how, **LINEAR))
        flops[name] = sum(tree_of(solver).state[tl.S_FLOPS] for _ in drive(solver, steps(world, poses)))
    assert flops["as it is"] < most * flops["never"]


def steps(world: str, poses: int) -> Iterator[Batch]:
    """Of a world, what is inserted."""
    return (step.batch for step in WORLDS[world](poses, 1))


def test_the_root_is_moved_less_often_the_more_must_be_spent_before() -> None:
    moves = {}
    for worth in (0.0, 0.5, 8.0):
        solver = Solver(Options(worth=worth))
        states = (tree_of(solver).state for _ in drive(solver, steps("sphere", 700)))
        moves[worth] = sum(s[tl.S_FLOPS] > 0 and s[tl.S_SPENT] == 0 and s[tl.S_RELINEARISED] == 0 for s in states)
    assert moves[0.0] > moves[0.5] > moves[8.0] > 0
