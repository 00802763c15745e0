"""Arenas that have to grow at almost every step, in the midst of it too, lead to the same bits."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from naive.random_graphs import random_steps
from naive.solver_parts import graph_in, stepper_in
from naive.tree_records import tree_of

from factorbus.simulate import WORLDS, manhattan
from factorbus.solver import Group, Options, Solver, errors
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.graph.arenas import roomy
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.model import layout as at

GRAPH = {"keys": 1, "var": 1, "dims": 1, "stamps": 1, "values": 7, "fac": 1, "payload": 28}
TREE = {"node": 1, "link": 1, "clique": 1, "lists": 8, "hessian": 121, "factor_errors": 1, "turns": 1, "pending": 1}
TREE |= {"changed": 1, "moved": 1, "marked": 1, "motions": 8}


def cramped() -> Solver:
    """A solver that has room for one variable and one factor."""
    solver = Solver(Options())
    for thing, sizes in ((graph_in(solver), GRAPH), (tree_of(solver), TREE)):
        for name, size in sizes.items():
            setattr(thing, name, getattr(thing, name)[:size].copy())
    for name in ("lin", "scalars"):
        setattr(tree_of(solver), name, getattr(tree_of(solver), name)[:, :7].copy())
    graph_in(solver).table = np.zeros(2, np.int64)
    return solver


def bits(groups: list[Group]) -> list[Any]:
    return [
        (g.kind, g.keys.tobytes(), g.values.tobytes(), g.fixed, g.stamps is not None and g.stamps.tobytes())
        for g in groups
    ]


def reported(report: Any) -> dict[str, Any]:
    told = report.as_dict()
    return {name: told[name] for name in told.keys() - {"phases_ms", "step_ms", "compiled_ms"}}


@pytest.mark.parametrize("seed", range(12))
def test_room_makes_no_difference(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factorbus.solver.graph.factor_ids.roomy", lambda need, _size: need)
    monkeypatch.setattr("factorbus.solver.bayes_tree.tree.roomy", lambda need, _size: need)
    grown, make_room = list[int](), CliqueTree.make_room
    monkeypatch.setattr(CliqueTree, "make_room", lambda tree: (grown.append(1), make_room(tree))[1])
    tight, wide = cramped(), Solver(Options())
    for n, batch in enumerate(random_steps(seed, steps=60)):
        assert tight.stage(batch) == wide.stage(batch)
        assert reported(tight.step()) == reported(wide.step()), f"step {n}"
        assert bits(tight.estimate()) == bits(wide.estimate())
    assert len(grown) > 60


def test_what_is_small_grows_by_more() -> None:
    assert roomy(70, 64) == 256
    assert roomy(300, 64) == 300
    assert roomy(1 << 14, 1 << 13) == 1 << 14


def test_what_has_a_row_for_each_of_the_same_things_grows_alike() -> None:
    graph = FactorGraph()
    for _ in range(40):
        graph.reserve_variables(1000, 3000)
        graph.counts[at.VARIABLES] += 1000
        assert graph.keys.size == len(graph.var) == graph.dims.size >= graph.counts[at.VARIABLES]
        graph.keys[graph.counts[at.VARIABLES] - 1000 : graph.counts[at.VARIABLES]] = -1 - graph.counts[at.VARIABLES]


@pytest.mark.parametrize("again", [copy.deepcopy, lambda graph: pickle.loads(pickle.dumps(graph))])
def test_a_copy_of_a_graph_gives_its_own_values(again: Any) -> None:
    solver = Solver()
    for batch in random_steps(1, steps=5):
        solver.stage(batch)
        solver.step()
    solver.estimate()
    other: FactorGraph = again(graph_in(solver))
    other.values += 1.0
    told = np.concatenate([group.values.ravel() for group in other.variables()])
    assert sorted(told) == sorted(other.values[: other.counts[at.VALUES]])


def test_an_estimate_is_the_callers_own_and_follows_what_is_taken_back() -> None:
    first, second, *_ = random_steps(2, steps=3)
    solver = Solver()
    solver.stage(first)
    solver.step()
    held = solver.estimate()
    before = bits(held)
    for group in held:
        assert group.values.flags.writeable != group.fixed
        assert not group.keys.flags.writeable
        if not group.fixed:
            group.values[...] = np.nan
    assert bits(solver.estimate()) == before
    solver.stage(second)
    assert bits(solver.estimate()) != before
    graph_in(solver).forget(stepper_in(solver).mark)
    assert bits(solver.estimate()) == before
    with pytest.raises(errors.DuplicateVariable):
        solver.stage(first)


def test_a_step_that_finds_no_room_is_admitted_like_any_other() -> None:
    solver, rooms = Solver(), set()
    for step in manhattan(700, 3):
        solver.stage(step.batch)
        graph = graph_in(solver)
        rooms.add((graph.keys.size, graph.table.size, graph.values.size, len(graph.fac), graph.payload.size))
    assert solver.variable_count == 700
    assert len(rooms) > 3
    for v in range(700):
        assert graph.find(int(graph.keys[v])) == v


@pytest.mark.parametrize(("world", "seed"), [("manhattan", 1), ("manhattan", 2), ("city_trees", 1), ("sphere", 1)])
def test_a_step_that_finds_no_room_in_a_later_round_is_the_step_that_finds_it(world: str, seed: int) -> None:
    """One that was loaded has no more room than is in use.  A round that relinearizes is not counted as the last one
    when the step goes on: what waited was not due any more, and a journal was run again to other bits."""
    roomy_one, tight = Solver(), Solver()
    for step in WORLDS[world](120, seed):
        state, tight = tight.dump(), Solver()
        tight.load(state)
        for solver in (roomy_one, tight):
            solver.stage(step.batch)
        assert roomy_one.step().as_dict() == tight.step().as_dict()
        for here, there in zip(roomy_one.estimate(), tight.estimate(), strict=True):
            assert here.values.tobytes() == there.values.tobytes()
