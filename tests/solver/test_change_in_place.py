"""A change of factors in the solver that has them: the same map as if it were made anew, or nothing at all."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from naive.dense_least_squares import DenseGraph
from naive.estimates import apart, values
from naive.random_derived import calibration_steps
from naive.random_graphs import camera_steps, random_steps
from naive.random_imu import imu_steps
from naive.random_lenses import lens_steps
from naive.random_mounts import mount_steps
from naive.random_others import other_steps
from naive.random_similar import similar_steps
from naive.solver_parts import graph_in, row_count
from naive.tree_records import stays_at_linearization, tree_of
from naive.tree_solution import assert_is_solution, normal_equations

from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.simulate import manhattan
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.why import why_factor
from factorbus.solver.divergence import copied
from factorbus.solver.graph.factor_rows import is_first, losses_of
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import BOUNDED

WORLDS: dict[str, Callable[[int], Iterator[Batch]]] = {
    "robots": lambda seed: random_steps(seed, steps=9),
    "camera": lambda seed: camera_steps(seed),
    "robust camera": lambda seed: camera_steps(seed, loss="huber"),
    "others": lambda seed: other_steps(seed),
    "mounts": lambda seed: mount_steps(seed),
    "robust mounts": lambda seed: mount_steps(seed, loss="dcs"),
    "calibration": lambda seed: calibration_steps(seed, 6),
    "lenses": lambda seed: lens_steps(seed, 7),
    "similarities": lambda seed: similar_steps(seed),
    "inertial": lambda seed: imu_steps(seed, loss="huber"),
}


def rows_of(solver: Solver) -> dict[int, tuple[Any, ...]]:
    """All there is to know of each factor, by its id."""
    rows: dict[int, tuple[Any, ...]] = {}
    for g in solver.graph()[1]:
        assert g.ids is not None
        for n, each in enumerate(g.ids.tolist()):
            scale = None if g.scale is None else float(g.scale[n])
            numbers = g.keys[n].tobytes(), g.measured[n].tobytes(), g.information[n].tobytes()
            rows[each] = (g.kind, *numbers, g.loss, scale)
    return rows


def bits(solver: Solver) -> dict[int, bytes]:
    return {key: row.tobytes() for key, (_, row) in values(solver).items()}


class Whole:
    def __init__(self, solver: Solver) -> None:
        self.variables, self.factors = solver.graph()


def twin_of(solver: Solver) -> DenseGraph:
    """A dense graph with the factors that are left, at the estimate."""
    twin = DenseGraph()
    twin.add(Whole(solver))
    twin.put(solver.estimate())
    return twin


def assert_is_whole(solver: Solver, chi2: float) -> None:
    """χ², what is kept of each factor and variable, R and covariances are those of the factors that are left."""
    tree, graph, count = tree_of(solver), graph_in(solver), row_count(solver)
    wanted = twin_of(solver).chi2()
    assert chi2 == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    assert solver.chi2() == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    assert tree.factor_errors[:count, tl.E_CHI2].sum() == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    assert tree.state[tl.S_FACTORS] == tree.state[tl.S_TAKEN] == count
    assert tree.state[tl.S_EXACT] == np.count_nonzero(tree.link[:count, tl.L_KIND] >= tl.EXACT)
    robust = losses_of(graph.fac[:count]) != at.NO_LOSS
    exact = robust | (~BOUNDED[graph.fac[:count, at.F_KIND]])
    assert ((tree.link[:count, tl.L_KIND] >= tl.EXACT) == exact).all()
    ends = graph.fac[:count, [at.F_I, at.F_J]]
    for v in range(solver.variable_count):
        slot, found = int(tree.node[v, tl.N_ADJ]), []
        while slot >= 0:
            found.append(slot)
            slot = int(tree.link[slot // 2, tl.L_I + slot % 2])
        assert sorted(found) == sorted(2 * f + e for f, e in np.argwhere(ends == v).tolist())
    information, eta, model, delta = normal_equations(solver)
    if tree_of(solver).raised:  # then R is not quite that of Λ
        return
    # What a chord step has corrected is solved with another right-hand side than that of the linearization points.
    corrected = (tree.factor_errors[:count, tl.E_FORM].astype(int) & int(tl.CORRECTED)).any()
    if not stays_at_linearization(solver) and not corrected:
        assert_is_solution(solver, information, eta, model, delta, least=2e-8)
    scale = np.sqrt(np.diag(information))
    unit = information / scale / scale[:, None]
    whole = np.linalg.inv(unit) / scale / scale[:, None]
    last = int(np.flatnonzero(graph.var[: solver.variable_count, at.V_SCALAR] >= 0)[-1])
    wanted = whole[graph.var[last, at.V_SCALAR] :, graph.var[last, at.V_SCALAR] :]
    tell = max(1e-8, 1e-13 * float(np.linalg.cond(unit))) * np.abs(wanted).max()
    np.testing.assert_allclose(
        CovarianceBlocks(solver.covariances.factored()).joint(np.array([last])), wanted, rtol=0, atol=tell
    )


def assert_is_said(problem: errors.SolverError, wanted: str) -> None:
    assert str(problem) == wanted


def random_change(solver: Solver, rng: np.random.Generator, weighed: list[Change]) -> list[Change]:
    """One to three changes of factors; `weighed` are those of weights, which may be taken back."""
    fac = graph_in(solver).fac[: row_count(solver)]
    able = np.flatnonzero(is_first(fac))
    changes: list[Change] = []
    for _ in range(int(rng.integers(1, 4))):
        rows = rng.choice(able, size=min(int(rng.integers(1, 4)), able.size), replace=False)
        ids, what = graph_in(solver).ids_of(rows), rng.integers(5)
        if what == 0 and not any(change.change == "remove_factors" for change in changes):
            changes.append(Change("remove_factors", ids))
        elif what == 1:
            changes.append(Change("weigh", ids, weight=rng.uniform(0.2, 5.0, ids.size)))
            weighed.append(changes[-1])
        elif what == 2:
            loss = rng.choice(["huber", "cauchy", "dcs"])
            changes.append(Change("loss", ids, loss=str(loss), scale=rng.uniform(1, 3, ids.size)))
        elif what == 3:
            changes.append(Change("loss", ids))
        elif weighed:
            last = weighed.pop()
            assert last.weight is not None
            changes.append(last._replace(weight=1.0 / last.weight))
    return changes


@pytest.mark.parametrize("world", sorted(WORLDS))
@pytest.mark.parametrize("seed", range(2))
def test_after_any_changes_the_map_is_that_of_the_factors_that_are_left(seed: int, world: str) -> None:
    rng, solver, weighed = np.random.default_rng(seed), Solver(Options(wildfire_threshold=0.0)), list[Change]()
    made = compared = 0
    for batch in WORLDS[world](seed % 1000):
        solver.stage(batch)
        solver.step()
        for _ in range(int(rng.integers(3))):
            changes = random_change(solver, rng, weighed)
            before = bits(solver), rows_of(solver)
            refused, came = "", None
            try:
                anew, _, _, counted = with_changes(solver, changes)
            except errors.SolverError as problem:
                refused = str(problem)
            try:
                came = try_change(solver, changes)
            except errors.SolverError as problem:
                assert_is_said(problem, refused)
            if refused:
                assert came is None
                assert (bits(solver), rows_of(solver)) == before
                continue
            if came is None:
                assert (bits(solver), rows_of(solver)) == before
                solver = anew
                continue
            first, report, told = came
            assert (first, told) == (graph_in(solver).next_id, counted)
            assert (report.strategy, report.new_factors, report.new_variables) in {
                (strategy, 0, 0) for strategy in ("tree", "extend", "batch")
            }
            assert rows_of(solver) == rows_of(anew)
            assert_is_whole(solver, report.chi2)
            here, there = copied(solver), copied(anew)
            for each in (here, there):
                each.step(settle=True)
            made += 1
            if here.chi2() == pytest.approx(there.chi2(), rel=1e-3, abs=1e-9):  # else these are two optima
                assert here.chi2() == pytest.approx(there.chi2(), rel=1e-6 if world == "robots" else 1e-4, abs=1e-9)
                assert apart(here, there) < 1e-6 or world != "robots"  # cameras hardly hold some directions
                plain = not any(row[-2] for row in rows_of(solver).values())  # weights of losses converge slowly
                assert report.chi2 <= 1.02 * here.chi2() + 1e-2 or not (report.converged and plain)
                compared += 1
    assert compared >= made - 1 > 3, "nearly all led to one optimum"


def bars() -> tuple[Solver, int]:
    """Three poses that see a point by bearings alone, of which two hold it; and the first of the bearings."""
    keys = np.arange(3)
    poses = Variables("se2", keys, np.array([[0, 0, 0], [4.0, 0, 0], [8.0, 0, 0]]), fixed=True)
    solver = Solver(Options())
    solver.stage(Batch((poses,)))
    solver.step()
    angles = np.arctan2(5.0, 2.0 - 4.0 * keys)[:, None]
    observations = Factors("bearing_se2", np.stack([keys, np.full(3, 10)], 1), angles, np.full((3, 1), 1e4))
    point = Variables("point2", np.array([10]), np.array([[2.0, 5.0]]))
    first = solver.stage(Batch((point,), (observations,)))
    solver.step()
    return solver, first


def test_what_the_numbers_alone_say_is_free_is_left_as_it_was_to_the_bit() -> None:
    solver, first = bars()
    other, _ = bars()
    done = try_change(solver, [Change("remove_factors", np.array([first]))])
    assert done is not None
    assert try_change(other, [Change("remove_factors", np.array([first]))]) is not None
    gone = [Change("remove_factors", np.array([first + 2])), Change("weigh", np.array([first + 1]), weight=np.ones(1))]
    assert try_change(solver, gone) is None, "one bearing does not hold a point"
    with pytest.raises(errors.Underconstrained):
        with_changes(solver, gone)
    assert rows_of(solver) == rows_of(other)
    near = Factors("prior_point2", np.array([[10]]), np.array([[2.1, 5.2]]), np.array([[1.0, 0, 1.0]]))
    for each in (solver, other):
        assert each.stage(Batch(factors=(near,))) == first + 3
        each.step()
        assert_is_whole(each, each.chi2())
    assert bits(solver) == bits(other)
    assert try_change(solver, gone) is not None, "now it is held"


def test_what_nothing_joins_to_the_map_is_not_changed() -> None:
    """A piece of a line of poses: that the numbers would not tell from a poor hold."""
    batches = [step.batch for step in manhattan(60, 3)]
    solver, other = Solver(Options()), Solver(Options())
    for batch in batches[:50]:
        for each in (solver, other):
            each.stage(batch)
            each.step()
    key = int(graph_in(solver).keys[49])
    at_end = [each for each in rows_of(solver) if key in np.frombuffer(rows_of(solver)[each][1], np.int64)]
    assert try_change(solver, [Change("remove_factors", np.array(at_end))]) is None
    with pytest.raises(errors.Underconstrained):
        with_changes(solver, [Change("remove_factors", np.array(at_end))])
    for batch in batches[50:]:
        for each in (solver, other):
            each.stage(batch)
            each.step()
    assert bits(solver) == bits(other)


def test_a_batch_that_is_refused_has_the_change_undone() -> None:
    solver, first = bars()
    other, _ = bars()
    halved = Change("weigh", np.array([first]), weight=np.array([0.5]))
    change = [halved, Change("remove_factors", np.array([first + 1]))]
    floating = Batch((Variables("point2", np.array([11]), np.zeros((1, 2))),))
    assert try_change(solver, change, floating) is None
    unknown = Batch(factors=(Factors("prior_point2", np.array([[99]]), np.zeros((1, 2)), np.array([[1.0, 0, 1]])),))
    with pytest.raises(errors.UnknownVariable):
        try_change(solver, change, unknown)
    assert rows_of(solver) == rows_of(other)
    held = Batch((Variables("point2", np.array([11])),), (
        Factors("landmark_se2", np.array([[0, 11]]), np.array([[1.0, 1.0]]), np.array([[1.0, 0, 1]])),))  # fmt: skip
    results = [try_change(each, change, held) for each in (solver, other)]
    assert results[0] is not None
    assert results[1] is not None
    assert results[0][0] == results[1][0] == first + 3
    assert (results[0][1].new_variables, results[0][1].new_factors) == (1, 1)
    assert bits(solver) == bits(other)
    assert_is_whole(solver, results[0][1].chi2)


@pytest.mark.parametrize("what", ["soundness", "fault"])
def test_what_fails_behind_the_step_is_undone(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that left something out of its bounds; and a fault of the solver itself."""
    solver, first = bars()
    before = values(solver), rows_of(solver), solver.chi2()
    robust = Change("loss", np.array([first + 1]), loss="huber", scale=np.ones(1))
    change = [Change("remove_factors", np.array([first])), robust]
    with monkeypatch.context() as broken:
        if what == "soundness":
            broken.setattr("factorbus.solver.changes.in_place.is_sound", lambda *_: False)
            assert try_change(solver, change) is None
        else:
            broken.setattr(type(tree_of(solver)), "step", lambda *_: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                try_change(solver, change)
    assert rows_of(solver) == before[1]
    assert solver.chi2() == pytest.approx(before[2], abs=1e-12)
    for key, (_, row) in values(solver).items():
        np.testing.assert_allclose(row, before[0][key][1], rtol=0, atol=1e-12)
    came = try_change(solver, change)
    assert came is not None
    assert_is_whole(solver, came[1].chi2)


def drive(count: int, seed: int) -> tuple[Solver, list[int]]:
    """A drive through the simulated Manhattan, and the ids of the factors that close its loops."""
    solver, loops = Solver(Options()), []
    for step in manhattan(count, seed):
        first = solver.stage(step.batch)
        solver.step()
        for group in step.batch.factors:
            ids = first + np.arange(len(group.keys))
            loops += ids[abs(group.keys[:, 1] - group.keys[:, 0]) > 1].tolist() if group.keys.shape[1] > 1 else []
            first += len(group.keys)
    return solver, loops


def test_a_change_costs_what_it_touches() -> None:
    """Flops and cliques of single changes beside those of the whole map."""
    solver, loops = drive(600, 5)
    _, _, whole, _ = with_changes(solver, [Change("weigh", np.array(loops[:1]), weight=np.array([0.5]))])
    flops, eliminated = [], []
    for each in loops[-40:]:
        came = try_change(solver, [Change("loss", np.array([each]), loss="huber", scale=np.ones(1))])
        assert came is not None
        flops.append(came[1].flops)
        eliminated.append(came[1].eliminated)
    assert np.median(flops) < 0.2 * whole.flops
    assert np.median(eliminated) < 0.2 * whole.eliminated
    assert solver.chi2() == pytest.approx(twin_of(solver).chi2(), rel=1e-9)


def test_a_false_loop_taken_out_of_a_large_map_leaves_its_optimum() -> None:
    """χ² falls by far: what is left is solved for in what residuals are like without it."""
    solver, _ = drive(400, 6)
    settled = copied(solver)
    settled.step(settle=True)
    ends = np.array([[int(graph_in(solver).keys[20]), int(graph_in(solver).keys[380])]])
    false = Factors("between_se2", ends, np.array([[30.0, -40.0, 1.0]]), np.array([[400.0, 0, 0, 400, 0, 4000]]))
    first = solver.stage(Batch(factors=(false,)))
    deformed = solver.step()
    assert deformed.chi2 > 10 * settled.chi2()
    came = try_change(solver, [Change("remove_factors", np.array([first]))])
    assert came is not None
    report = came[1]
    for _ in range(50):
        if report.converged:
            break
        report = solver.step()
    assert report.converged
    assert report.chi2 <= 1.001 * settled.chi2() + 1e-3
    assert rows_of(solver) == rows_of(settled)


def test_holes_are_packed_before_they_are_most_of_all() -> None:
    """Losses given and taken: each leaves room that nobody has, and in the end the map is packed anew."""
    solver, loops = drive(120, 1)
    change = Change("loss", np.array(loops[:1]), loss="huber", scale=np.ones(1)), Change("loss", np.array(loops[:1]))
    packed = False
    for n in range(2000):
        used, holes = int(graph_in(solver).counts[at.PAYLOAD]), graph_in(solver).holes
        came = try_change(solver, change[n % 2 : n % 2 + 1])
        if came is None:
            assert holes > 0.5 * used
            solver, *_ = with_changes(solver, change[n % 2 : n % 2 + 1])
            packed = True
            assert graph_in(solver).holes == 0
            break
    assert packed
    again = Solver(Options())
    again.load(solver.dump())
    assert rows_of(again) == rows_of(solver)


def test_a_changed_solver_goes_on_from_its_state_with_the_same_bits() -> None:
    solver, loops = drive(300, 2)
    ids = np.array(loops)
    robust = Change("loss", ids[2:4], loss="dcs", scale=np.ones(2))
    assert try_change(solver, [Change("remove_factors", ids[:2]), robust])
    again = copied(solver)
    for each in (solver, again):
        assert try_change(each, [Change("weigh", ids[3:5], weight=np.array([0.5, 2.0]))])
        came = try_change(each, [Change("remove_factors", ids[4:6]), Change("loss", ids[2:3])])
        assert came is not None
    assert bits(solver) == bits(again)
    assert rows_of(solver) == rows_of(again)
    assert why_factor(CovarianceBlocks(solver.covariances.factored()), int(ids[6])).factor == int(ids[6])
    with pytest.raises(errors.UnknownFactor, match="has been removed"):
        why_factor(CovarianceBlocks(solver.covariances.factored()), int(ids[0]))


def test_diagonal_blocks_are_kept_up_over_changes() -> None:
    solver, loops = drive(300, 4)
    upkeep = solver.covariances.try_upkeep()
    assert upkeep is not None
    upkeep.update()
    for n, each in enumerate(loops[:12]):
        what = [Change("remove_factors", np.array([each])), Change("weigh", np.array([each]), weight=np.array([0.1]))]
        assert try_change(solver, what[n % 2 : n % 2 + 1]) is not None
        upkeep.update()
        wanted = CovarianceBlocks(solver.covariances.factored()).diagonal()
        np.testing.assert_allclose(upkeep.diagonal()[:, :3, :3], wanted, rtol=1e-7, atol=1e-12)
    assert (upkeep.whole, upkeep.anew) == (1, 13), "the first of them only goes through the whole tree"


@pytest.mark.parametrize("mode", ["inc-l", "all-batch"])
def test_other_modes_make_all_changes_anew(mode: str) -> None:
    solver = Solver(Options(mode=mode))
    for batch in random_steps(1, steps=5):
        solver.stage(batch)
        solver.step()
    assert try_change(solver, [Change("weigh", np.array([3]), weight=np.array([0.5]))]) is None
