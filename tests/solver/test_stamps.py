"""A time stamp goes in with its variable, stays with it whatever becomes of the map, and goes when that goes."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.random_graphs import camera_steps, random_steps
from naive.solver_parts import graph_in

from examples import examples
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changing import with_changes, with_converted
from factorbus.solver.kernels.model import layout as at

MODES = ["bayes-tree", "inc-l", "all-batch"]
seeds = st.integers(0, 9999)
T0 = 1_403_636_579_763_555_584


def stamps(groups: Iterable[Any]) -> dict[int, int]:
    """By key; a group that has a column has a stamp in it."""
    found: dict[int, int] = {}
    for group in groups:
        if group.stamps is not None:
            assert group.stamps.shape == group.keys.shape
            own = {k: t for k, t in zip(group.keys.tolist(), group.stamps.tolist(), strict=True) if t != NO_STAMP}
            assert own
            found |= own
    return found


def kept(solver: Solver) -> dict[int, int]:
    """As every way to look at a map gives them, which is the same."""
    found = stamps(solver.estimate())
    assert found == stamps(solver.graph()[0]) == stamps(solver.content().variables())
    assert graph_in(solver).counts[at.STAMPED] == len(found)
    return found


def pose(n: int, stamp: int | None = None) -> Variables:
    value = np.array([[float(n), 0.0, 0.0]])
    return Variables("se2", np.array([symbol("x", n)]), value, n == 0, None if stamp is None else np.array([stamp]))


def edge(i: int, j: int) -> Factors:
    keys = np.array([[symbol("x", i), symbol("x", j)]])
    return Factors("between_se2", keys, np.array([[float(j - i), 0.0, 0.0]]), np.array([[100.0, 0, 0, 100, 0, 400]]))


def line(count: int = 6) -> Iterator[Batch]:
    yield Batch((pose(0, T0),))
    for n in range(1, count):
        yield Batch((pose(n, T0 + n),), (edge(n - 1, n),))


def fed(batches: Iterable[Batch], mode: str = "bayes-tree") -> Solver:
    solver = Solver(Options(mode=mode))
    for batch in batches:
        solver.stage(batch)
        solver.step()
    return solver


def test_the_wire_and_the_solver_agree_on_what_none_is() -> None:
    assert at.NO_STAMP == NO_STAMP == np.datetime64("NaT").astype(np.int64)


@pytest.mark.parametrize("mode", MODES)
@examples(8)
@given(seed=seeds)
def test_every_answer_has_the_stamps_that_came_in(mode: str, seed: int) -> None:
    solver, wanted = Solver(Options(mode=mode)), {}
    for batch in random_steps(seed):
        wanted |= stamps(batch.variables)
        solver.stage(batch)
        solver.step()
        changed = {key for group in solver.changed() for key in group.keys.tolist()}
        assert stamps(solver.changed()) == {key: stamp for key, stamp in wanted.items() if key in changed}
        assert kept(solver) == wanted


@pytest.mark.parametrize("stamp", [NO_STAMP + 1, -1, 0, 1, T0, 2**63 - 1])
@pytest.mark.parametrize("kind", ["se2", "se3", "point2", "point3", "idp"])
def test_any_kind_may_have_any_stamp(kind: str, stamp: int) -> None:
    value = {"se2": 3, "se3": 7, "point2": 2, "point3": 3, "idp": 6}
    row = np.zeros((1, value[kind]))
    row[0, -1] = 1.0
    solver = fed([Batch((Variables(kind, np.array([5]), row, True, np.array([stamp])),))])
    assert kept(solver) == {5: stamp}


def test_a_map_without_stamps_has_no_columns_of_them() -> None:
    solver = fed(batch._replace(variables=tuple(g._replace(stamps=None) for g in batch.variables)) for batch in line())
    assert all(group.stamps is None for group in (*solver.estimate(), *solver.changed(), *solver.graph()[0]))


def test_where_no_variable_of_a_group_has_one_there_is_no_column() -> None:
    none = np.array([NO_STAMP])
    points = Variables("point2", np.array([7]), np.zeros((1, 2)), True, none)
    solver = fed([Batch((pose(0, T0), points))])
    assert kept(solver) == {symbol("x", 0): T0}
    assert {group.kind: group.stamps is None for group in solver.estimate()} == {"se2": False, "point2": True}


@pytest.mark.parametrize("wrong", [np.array([1, 2]), np.array([1.0]), np.array([[1]]), [1], np.array([1], np.int32)])
def test_stamps_of_another_shape_or_type_are_refused(wrong: Any) -> None:
    solver = fed(line())
    before = kept(solver)
    with pytest.raises(errors.BadShape, match="stamps"):
        solver.stage(Batch((pose(6)._replace(stamps=wrong),), (edge(5, 6),)))
    assert kept(solver) == before


@pytest.mark.parametrize("mode", MODES)
def test_what_a_step_refuses_leaves_no_stamp_and_touches_none_that_was_given(mode: str) -> None:
    solver = fed(line(), mode)
    before = solver.estimate()
    solver.stage(Batch((pose(6, -5),), (edge(5, 6),)))
    held = solver.estimate()  # with what is staged
    solver.stage(Batch((Variables("se2", np.array([-1]), np.zeros((1, 3)), stamps=np.array([9])),)))
    with pytest.raises(errors.Underconstrained):
        solver.step()
    assert kept(solver) == stamps(before)
    solver.stage(Batch((pose(6, 77),), (edge(5, 6),)))
    solver.step()
    assert kept(solver)[symbol("x", 6)] == 77
    assert stamps(held)[symbol("x", 6)] == -5


def test_after_the_only_stamps_of_a_kind_are_taken_back_there_is_no_column() -> None:
    seen = Variables("point2", np.array([7]), np.zeros((1, 2)), True, np.array([1]))
    solver = fed([Batch((pose(0), seen)), Batch((pose(1),), (edge(0, 1),))])
    solver.stage(Batch((pose(2, 5),), (edge(1, 2),)))
    assert stamps(solver.estimate()) == {7: 1, symbol("x", 2): 5}
    solver.stage(Batch((Variables("se2", np.array([-1]), np.zeros((1, 3))),)))
    with pytest.raises(errors.Underconstrained):
        solver.step()
    assert kept(solver) == {7: 1}


def test_estimates_cannot_be_written_to_the_map() -> None:
    solver = fed(line())
    for group in solver.estimate():
        assert group.stamps is not None
        with pytest.raises(ValueError, match="read-only"):
            group.stamps[0] = 1


@pytest.mark.parametrize("stamp", [None, 4])
def test_removed_and_back_with_another_or_none(stamp: int | None) -> None:
    solver, last = fed(line()), symbol("x", 5)
    wanted = {key: each for key, each in kept(solver).items() if key != last}
    removed = [Change("remove_variables", keys=np.array([last]))]
    changed, *_ = with_changes(solver, removed, Batch((pose(5, stamp),), (edge(4, 5),)))
    assert kept(changed) == wanted | ({} if stamp is None else {last: stamp})


@pytest.mark.parametrize("change", ["remove_variables", "marginalize"])
def test_what_goes_takes_its_stamp(change: str) -> None:
    solver = fed(line())
    gone = np.array([symbol("x", 2), symbol("x", 3)])
    held = [Change("fix", keys=np.array([symbol("x", 4)]))] if change == "remove_variables" else []
    changed, *_ = with_changes(solver, [Change(change, keys=gone), *held])
    left = {symbol("x", n): T0 + n for n in (0, 1, 4, 5)}
    assert kept(changed) == left
    changed.stage(Batch((pose(2, -2),), (edge(1, 2),)))
    changed.step()
    assert kept(changed) == left | {symbol("x", 2): -2}


@pytest.mark.parametrize(
    "change",
    [
        Change("fix", keys=np.array([symbol("x", 2)])),
        Change("place", keys=np.array([symbol("x", 2)]), kind="se2", values=np.ones((1, 3)), carry=True),
        Change("remove_factors", np.array([0])),
    ],
    ids=lambda change: change.change,
)
def test_what_is_changed_keeps_its_stamp(change: Change) -> None:
    solver = fed([*line(), Batch((), (edge(0, 5), edge(0, 2)))])
    changed, *_ = with_changes(solver, [change])
    assert kept(changed) == kept(solver)


def test_a_feature_that_becomes_a_point_keeps_it() -> None:
    solver = Solver()
    for n, batch in enumerate(camera_steps(3)):
        own = tuple(g._replace(stamps=np.arange(g.keys.size) + 100 * n) for g in batch.variables)
        solver.stage(batch._replace(variables=own))
        solver.step()
    features = np.concatenate([group.keys for group in solver.estimate() if group.kind == "idp"])
    points, _ = with_converted(solver, features)
    assert kept(points) == kept(solver)


@pytest.mark.parametrize("mode", MODES)
def test_copies_have_them(mode: str) -> None:
    solver = fed(random_steps(7), mode)
    wanted = kept(solver)
    other, renewed, anew = (Solver(Options(mode=mode)) for _ in range(3))
    other.load(solver.dump())
    renewed.renew(solver, solver.variable_count, solver.factor_count)
    anew.load(solver.dump() | {"lanes": 0})
    for made in (other, renewed, anew):
        assert kept(made) == wanted


def test_memory_counts_them() -> None:
    bare = fed(batch._replace(variables=tuple(g._replace(stamps=None) for g in batch.variables)) for batch in line())
    assert fed(line()).factor_graph.columns_bytes()[0] - bare.factor_graph.columns_bytes()[0] == 8 * 6
