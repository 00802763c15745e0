"""What is taken out was never there; ids stay; whatever cannot be leaves everything as it was."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from naive.dense_least_squares import DenseGraph, distance
from naive.estimates import apart, values
from naive.random_derived import calibration_steps
from naive.random_graphs import camera_steps, random_steps
from naive.random_imu import imu_steps
from naive.random_mounts import mount_steps
from naive.random_similar import similar_steps
from naive.solver_parts import graph_in

from factorbus.proto.kinds import CHANGES as WIRE_CHANGES
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changes.requested import CHANGES
from factorbus.solver.changing import with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.why import why_factor

MODES = ["bayes-tree", "inc-l", "all-batch", "inc-l-b10"]


def fed(batches: list[Batch], mode: str = "bayes-tree") -> tuple[Solver, list[int]]:
    """A solver with these, step by step, and the first factor of each."""
    solver, firsts = Solver(Options(mode=mode)), []
    for batch in batches:
        firsts.append(solver.stage(batch))
        solver.step()
    return solver, firsts


def undone(batch: Batch, first: int) -> list[Change]:
    keys = np.concatenate([group.keys for group in batch.variables])
    ids = np.arange(first, first + batch.factor_count)
    return [Change("remove_factors", ids), Change("remove_variables", keys=keys, alone=True)]


def factor_rows(solver: Solver) -> dict[int, tuple[Any, ...]]:
    """All there is to know of each factor, by its id."""
    rows: dict[int, tuple[Any, ...]] = {}
    for g in solver.graph()[1]:
        assert g.ids is not None
        for n, each in enumerate(g.ids.tolist()):
            scale = None if g.scale is None else float(g.scale[n])
            numbers = g.keys[n].tobytes(), g.measured[n].tobytes(), g.information[n].tobytes()
            rows[each] = (g.kind, *numbers, g.loss, scale)
    return rows


def pose(name: int, x: float = 0.0) -> Variables:
    return Variables("se2", np.array([symbol("x", name)]), np.array([[x, 0.0, 0.0]]), fixed=name == 0)


def edge(i: int, j: int, x: float = 1.0, loss: str = "") -> Factors:
    keys, z = np.array([[symbol("x", i), symbol("x", j)]]), np.array([[x, 0.0, 0.1]])
    return Factors("between_se2", keys, z, np.array([[100.0, 0, 0, 100, 0, 400]]), loss, np.ones(1) if loss else None)


def chain(count: int = 6) -> list[Batch]:
    """A line of poses, and a closure that does not quite fit."""
    steps = [Batch((pose(0),))]
    steps += [Batch((pose(i, float(i)),), (edge(i - 1, i),)) for i in range(1, count)]
    return [*steps, Batch(factors=(edge(0, count - 1, count - 0.5),))]


def test_the_wire_and_the_solver_know_the_same_changes() -> None:
    assert tuple(WIRE_CHANGES) == CHANGES


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "steps",
    [
        random_steps,
        lambda seed: camera_steps(seed, loss="huber"),
        mount_steps,
        calibration_steps,
        imu_steps,
        similar_steps,
    ],
    ids=["robots", "camera", "mounts", "calibration", "inertial", "similarities"],
)
@pytest.mark.parametrize("seed", range(3))
def test_an_insert_undone_leaves_the_estimate_that_would_have_been_without(
    seed: int, steps: Callable[[int], Any], mode: str
) -> None:
    *before, last = steps(seed)
    solver, firsts = fed([*before, last], mode)
    without, _ = fed(before, mode)
    after, _, report, counted = with_changes(solver, undone(last, firsts[-1]), settle=True)
    without.step(settle=True)
    assert apart(after, without) < 1e-9
    assert after.chi2() == pytest.approx(without.chi2(), rel=1e-11)
    assert report.chi2 == pytest.approx(after.chi2(), rel=1e-11)
    assert counted["removed_variables"] == last.variable_count
    assert counted["removed_factors"] == last.factor_count


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(3))
def test_factors_taken_out_in_the_middle_were_never_there(seed: int, mode: str) -> None:
    """Those that close loops, of which the map can do without."""
    batches = list(random_steps(seed, steps=9))
    solver, firsts = fed(batches, mode)
    gone, kept = [], []
    for batch, first in zip(batches, firsts, strict=True):
        stays = []
        for group in batch.factors:
            loop = group.kind.startswith("between") and abs(int(group.keys[0, 1] - group.keys[0, 0])) > 1
            (gone if loop else stays).append(first if loop else group)
            first += 1
        kept.append(Batch(batch.variables, tuple(stays)))
    assert gone, "a seed without loops shows nothing"
    after, *_ = with_changes(solver, [Change("remove_factors", np.array(gone))], settle=True)
    without, _ = fed(kept, mode)
    without.step(settle=True)
    assert apart(after, without) < 1e-9
    assert set(factor_rows(after)) == set(factor_rows(solver)) - set(gone)


@pytest.mark.parametrize("mode", MODES)
def test_without_settling_the_step_is_gauss_newton_at_the_estimate(mode: str) -> None:
    """The linear problem that is solved is that of what is left, linearized at the estimate: as a dense twin has it."""
    batches = list(random_steps(5, steps=8))
    solver, firsts = fed(batches, mode)
    twin = DenseGraph()
    for batch in batches[:-1]:
        twin.add(batch)
    twin.put(solver.estimate())
    kept = twin.chi2()
    after, *_ = with_changes(solver, undone(batches[-1], firsts[-1]))
    assert after.chi2() <= kept
    twin.gauss_newton(iterations=1)
    assert after.chi2() == pytest.approx(twin.chi2(), rel=1e-3)


@pytest.mark.parametrize("mode", MODES)
def test_a_map_goes_on_after_a_change_as_one_that_never_had_it(mode: str) -> None:
    batches = list(random_steps(7, steps=12))
    solver, firsts = fed(batches[:6], mode)
    solver, *_ = with_changes(solver, undone(batches[5], firsts[5]))
    without, _ = fed(batches[:5], mode)
    for batch in [batches[5], *batches[6:]]:
        first = solver.stage(batch)
        assert first == graph_in(solver).next_id - batch.factor_count
        solver.step()
        without.stage(batch)
        without.step()
    for each in (solver, without):
        each.step(settle=True)
    assert apart(solver, without) < 1e-9


def test_ids_stay_with_their_factors_and_are_not_used_again() -> None:
    solver, _ = fed(chain())
    before = factor_rows(solver)
    solver, *_ = with_changes(solver, [Change("remove_factors", np.array([5]))])
    assert solver.stage(Batch(factors=(edge(0, 3, 3.0),))) == 6
    solver.step()
    solver, *_ = with_changes(solver, [Change("remove_variables", keys=np.array([symbol("x", 5)]))])
    assert solver.stage(Batch(factors=(edge(1, 4, 3.0),))) == 7
    solver.step()
    rows = factor_rows(solver)
    assert sorted(rows) == [0, 1, 2, 3, 6, 7]
    assert all(rows[each] == before[each] for each in range(4))
    graph = graph_in(solver)
    assert graph.ids_of(np.arange(6)).tolist() == [0, 1, 2, 3, 6, 7]
    assert graph.rows_of(np.arange(-1, 9)).tolist() == [-1, 0, 1, 2, 3, -1, -1, 4, 5, -1]
    assert why_factor(CovarianceBlocks(solver.covariances.factored()), 6).keys == (symbol("x", 0), symbol("x", 3))
    with pytest.raises(errors.UnknownFactor, match="has been removed"):
        why_factor(CovarianceBlocks(solver.covariances.factored()), 5)


def test_a_solver_with_changes_is_dumped_and_loaded_with_its_ids() -> None:
    solver, _ = fed(chain())
    solver, *_ = with_changes(solver, [Change("remove_factors", np.array([5]))])
    again = Solver(Options())
    again.load(solver.dump())
    for each in (solver, again):
        assert each.stage(Batch(factors=(edge(0, 3, 3.0),))) == 6
        each.step()
    assert factor_rows(again) == factor_rows(solver)
    assert values(again).keys() == values(solver).keys()
    assert all((row == values(again)[key][1]).all() for key, (_, row) in values(solver).items())


@pytest.mark.parametrize("mode", MODES)
def test_a_loss_given_later_is_a_loss_given_at_once(mode: str) -> None:
    batches = [*chain(), Batch(factors=(edge(1, 4, 9.0),))]
    at_once = [*chain(), Batch(factors=(edge(1, 4, 9.0, loss="cauchy"),))]
    solver, _ = fed(batches, mode)
    given, _ = fed(at_once, mode)
    given.step(settle=True)
    later, _, _, counted = with_changes(
        solver, [Change("loss", np.array([6]), loss="cauchy", scale=np.ones(1))], settle=True
    )
    assert counted["edited_factors"] == 1
    assert apart(later, given) < 1e-9
    assert factor_rows(later) == factor_rows(given)
    plain, *_ = with_changes(later, [Change("loss", np.array([6]))], settle=True)
    solver.step(settle=True)
    assert apart(plain, solver) < 1e-9
    assert factor_rows(plain) == factor_rows(solver)


def test_a_weight_multiplies_the_information() -> None:
    solver, _ = fed(chain())
    halved, *_ = with_changes(solver, [Change("weigh", np.array([5, 2]), weight=np.array([0.5, 0.25]))], settle=True)
    heavy = {5: 0.5, 2: 0.25}
    batches = chain()
    by_hand = [
        Batch(b.variables, tuple(g._replace(information=heavy.get(n - 1, 1.0) * g.information) for g in b.factors))
        for n, b in enumerate(batches)
    ]
    twin, _ = fed(by_hand)
    twin.step(settle=True)
    assert apart(halved, twin) < 1e-9
    assert factor_rows(halved) == factor_rows(twin)


@pytest.mark.parametrize("mode", MODES)
def test_what_is_fixed_stays_and_what_is_freed_moves_again(mode: str) -> None:
    solver, _ = fed(chain(), mode)
    solver.step(settle=True)
    key = symbol("x", 3)
    held = values(solver)[key][1]
    fixed, _, _, counted = with_changes(solver, [Change("fix", keys=np.array([key]))])
    assert counted["fixed_variables"] == 1
    fixed.stage(Batch(factors=(edge(0, 3, 9.0),)))
    fixed.step(settle=True)
    assert (values(fixed)[key][1] == held).all()
    freed, _, _, counted = with_changes(fixed, [Change("free", keys=np.array([key]))], settle=True)
    assert counted["freed_variables"] == 1
    assert distance("se2", values(freed)[key][1], held) > 0.5
    solver.stage(Batch(factors=(edge(0, 3, 9.0),)))
    solver.step(settle=True)
    assert apart(freed, solver) < 1e-9


def test_changes_and_additions_are_one_step() -> None:
    """A pose is taken out of a chain, and its neighbours are joined instead: neither goes without the other."""
    solver, _ = fed(chain()[:-1])
    bridge = Batch(factors=(edge(2, 4, 2.0),))
    gone = [Change("remove_variables", keys=np.array([symbol("x", 3)]))]
    with pytest.raises(errors.Underconstrained):
        with_changes(solver, gone)
    after, first, report, _ = with_changes(solver, gone, bridge)
    assert (first, report.new_factors, report.new_variables) == (5, 1, 0)
    assert sorted(factor_rows(after)) == [0, 1, 4, 5]


def test_a_variable_that_is_placed_is_where_the_estimate_goes_on_from() -> None:
    solver, _ = fed(chain())
    keys = np.array([symbol("x", 0), symbol("x", 3)])
    placed, *_ = with_changes(
        solver,
        [Change("place", keys=keys, kind="se2", values=np.array([[5.0, 1.0, 7.0], [8.0, 1.0, 0.0]]))],
        settle=True,
    )
    start = values(placed)[symbol("x", 0)][1]
    np.testing.assert_allclose(start, [5.0, 1.0, 7.0 - 2 * np.pi])
    solver.step(settle=True)
    assert placed.chi2() == pytest.approx(solver.chi2(), rel=1e-9), "the map has moved as a whole"


@pytest.mark.parametrize("mode", MODES)
def test_everything_can_go(mode: str) -> None:
    solver, _ = fed(chain(), mode)
    every = np.array([symbol("x", i) for i in range(6)])
    empty, _, _, counted = with_changes(solver, [Change("remove_variables", keys=every)])
    assert (empty.variable_count, empty.factor_count) == (0, 0)
    assert counted["removed_factors"] == 6
    assert empty.stage(chain()[0]) == 6
    empty.step()
    assert list(values(empty)) == [symbol("x", 0)]


BAD: dict[str, tuple[type[errors.SolverError], list[Change]]] = {
    "no such factor": (errors.UnknownFactor, [Change("remove_factors", np.array([99]))]),
    "a negative factor": (errors.UnknownFactor, [Change("remove_factors", np.array([-1]))]),
    "gone already": (errors.UnknownFactor, 2 * [Change("remove_factors", np.array([5]))]),
    "no such variable": (errors.NotInMap, [Change("fix", keys=np.array([symbol("y", 1)]))]),
    "removed before": (
        errors.NotInMap,
        [Change("remove_variables", keys=np.array([symbol("x", 5)])), Change("free", keys=np.array([symbol("x", 5)]))],
    ),
    "not alone": (errors.InUse, [Change("remove_variables", keys=np.array([symbol("x", 5)]), alone=True)]),
    "no such change": (errors.UnknownKind, [Change("unmake")]),
    "no such loss": (errors.BadLoss, [Change("loss", np.array([5]), loss="square", scale=np.ones(1))]),
    "a scale of nothing": (errors.BadLoss, [Change("loss", np.array([5]), loss="dcs", scale=np.zeros(1))]),
    "no scale": (errors.BadShape, [Change("loss", np.array([5]), loss="dcs")]),
    "a weight of nothing": (errors.BadWeight, [Change("weigh", np.array([5]), weight=np.zeros(1))]),
    "a weight that is no number": (errors.BadWeight, [Change("weigh", np.array([5]), weight=np.array([np.nan]))]),
    "a weight that is next to nothing": (errors.BadWeight, [Change("weigh", np.array([5]), weight=np.full(1, 1e-14))]),
    "a weight beyond all": (errors.BadWeight, [Change("weigh", np.array([5]), weight=np.full(1, 1e300))]),
    "a factor twice": (errors.NamedTwice, [Change("weigh", np.array([5, 4, 5]), weight=np.ones(3))]),
    "a factor removed twice": (errors.NamedTwice, [Change("remove_factors", np.array([5, 5]))]),
    "a variable twice": (errors.NamedTwice, [Change("fix", keys=np.array([symbol("x", 2)] * 2))]),
    "a variable placed twice": (
        errors.NamedTwice,
        [Change("place", keys=np.array([symbol("x", 2)] * 2), kind="se2", values=np.zeros((2, 3)))],
    ),
    "a variable marginalized twice": (errors.NamedTwice, [Change("marginalize", keys=np.array([symbol("x", 2)] * 2))]),
    "too few weights": (errors.BadShape, [Change("weigh", np.array([4, 5]), weight=np.ones(1))]),
    "left free": (errors.Underconstrained, [Change("remove_factors", np.array([4, 5]))]),
    "no anchor": (errors.Underconstrained, [Change("free", keys=np.array([symbol("x", 0)]))]),
    "another kind": (
        errors.KindMismatch,
        [Change("place", keys=np.array([symbol("x", 1)]), kind="point2", values=np.zeros((1, 2)))],
    ),
    "nowhere": (
        errors.NotFinite,
        [Change("place", keys=np.array([symbol("x", 1)]), kind="se2", values=np.full((1, 3), np.inf))],
    ),
}


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l"])
@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_is_refused_and_the_map_is_as_it_was(name: str, mode: str) -> None:
    error, changes = BAD[name]
    solver, _ = fed(chain(), mode)
    before, rows = solver.dump(), factor_rows(solver)
    with pytest.raises(error):
        with_changes(solver, [Change("weigh", np.array([0]), weight=np.array([2.0])), *changes])
    with pytest.raises(errors.SolverError):
        with_changes(solver, [Change("weigh", np.array([0]), weight=np.array([2.0]))], Batch(factors=(edge(1, 99),)))
    assert factor_rows(solver) == rows
    assert repr(solver.dump()) == repr(before)
