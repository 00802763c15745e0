"""False loop closures are found and taken out: a map that they have deformed is as before again."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from naive.dense_factors import residual
from scipy.stats import chi2

from factorbus.formats import read
from factorbus.proto.messages import Batch, Change, Factors
from factorbus.simulate import LoopClosures, manhattan
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changes.repair import find_loops, repair, weigh
from factorbus.solver.changing import with_changes
from factorbus.solver.kernels.jit.compile import DISABLED

POSES = 60 if DISABLED else 400
BOUND = chi2.ppf(0.99, 3)  # c² of a closure in the plane


def streets(seed: int, share: float, poses: int = POSES) -> Iterator[tuple[Batch, dict[int, np.ndarray], list[int]]]:
    """(batch, true values of what is new, which of its factors are false); `share` of the closures are."""
    rng = np.random.default_rng(seed)
    for number, step in enumerate(manhattan(poses, seed, loops=LoopClosures(gap=20))):
        truth = {k: row for g in step.truth for k, row in zip(g.keys.tolist(), g.values, strict=True)}
        groups, count = list(step.batch.factors), step.batch.factor_count
        loops = sum(int((np.abs(g.keys[:, 1] - g.keys[:, 0]) != 1).sum()) for g in groups)
        wrong = int(rng.binomial(loops, share / (1 - share))) if loops else 0
        if wrong:
            last = int(groups[0].keys[0].max())
            ends = np.column_stack([last - number + rng.integers(0, number - 10, wrong), np.full(wrong, last)])
            z = np.column_stack([rng.normal(0, 1, (wrong, 2)), rng.uniform(-np.pi, np.pi, wrong)])
            groups.append(Factors("between_se2", ends, z, np.repeat(groups[0].information[:1], wrong, 0)))
        yield Batch(step.batch.variables, tuple(groups)), truth, list(range(count, count + wrong))


def driven(seed: int, share: float) -> tuple[Solver, dict[int, np.ndarray], set[int]]:
    """A map of the streets, what is true, and the ids of what is false."""
    solver, truth, false = Solver(Options()), {}, set()
    for batch, true, wrong in streets(seed, share):
        first = solver.stage(batch)
        solver.step()
        truth |= true
        false |= {first + each for each in wrong}
    solver.step(settle=True)
    return solver, truth, false


def error_of(solver: Solver, truth: dict[int, np.ndarray]) -> float:
    """Root mean square distance from the truth, after the best rigid motion, metres."""
    found = {k: row for g in solver.estimate() for k, row in zip(g.keys.tolist(), g.values, strict=True)}
    p, q = (np.array([each[key][:2] for key in truth]) for each in (found, truth))
    p, q = p - p.mean(axis=0), q - q.mean(axis=0)
    U, _, Vt = np.linalg.svd(p.T @ q)
    R = Vt.T @ np.diag([1.0, np.sign(np.linalg.det(Vt.T @ U.T))]) @ U.T
    return float(np.sqrt(((p @ R.T - q) ** 2).sum(axis=1).mean()))


def robust_cost(solver: Solver) -> float:
    """Σ min(s, c²) over closures, which join poses that odometry joins already, and χ² of odometry."""
    at = {k: row for g in solver.estimate() for k, row in zip(g.keys.tolist(), g.values, strict=True)}
    cost = 0.0
    for group in solver.graph()[1]:
        for (i, j), z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            r, W = residual(group.kind, [at[i], at[j]], z), np.zeros((3, 3))
            W[np.triu_indices(3)] = upper
            s = float(r @ (W + np.triu(W, 1).T) @ r)
            cost += s if j == i + 1 else min(s, BOUND)
    return cost


@pytest.mark.parametrize("seed", [1, 2])
def test_three_of_ten_closures_false_are_found_and_the_drive_is_as_good_as_without(seed: int) -> None:
    clean, truth, none = driven(seed, 0.0)
    solver, _, false = driven(seed, 0.3)
    assert not none
    assert len(false) > POSES // 20
    right = error_of(clean, truth)
    assert error_of(solver, truth) > 5 * right, "without repair it visibly is not"
    found = repair(solver.content())
    taken = set(found.false.tolist())
    assert false <= taken
    assert len(taken - false) <= 0.05 * found.suspects
    assert found.before == pytest.approx(robust_cost(solver), rel=1e-6)
    assert (found.distance > 0).all()
    placed = [Change("place", keys=g.keys, kind=g.kind, values=g.values) for g in found.groups]
    repaired, *_ = with_changes(solver, [Change("remove_factors", found.false), *placed], settle=True)
    assert found.after == pytest.approx(found.chi2_left + len(taken) * BOUND, rel=1e-9)
    assert found.chi2_left == pytest.approx(repaired.chi2(), rel=1e-6), (
        "of what stays, where it is optimal without them"
    )
    assert error_of(repaired, truth) < 1.2 * right


def test_a_map_without_false_closures_loses_next_to_none() -> None:
    solver, _, _ = driven(3, 0.0)
    found = repair(solver.content(), probability=0.9999)
    assert found.false.size <= 1
    assert found.after == pytest.approx(found.before, rel=0.05)


def test_only_those_named_are_looked_at() -> None:
    solver, _, false = driven(1, 0.3)
    named = np.array(sorted(false))[:4]
    found = repair(solver.content(), named)
    assert found.suspects == 4
    assert set(found.false.tolist()) <= set(named.tolist())
    with pytest.raises(errors.UnknownFactor):
        repair(solver.content(), np.array([10**9]))
    for outside in (1.0, 0.0, -1.0, 1e-300, 5e-324, float("nan"), float("inf")):
        with pytest.raises(errors.BadOption):
            repair(solver.content(), probability=outside)


@pytest.mark.parametrize("probability", [1e-12, 1.0 - 1e-12])
def test_at_the_ends_of_its_range_a_probability_does_no_harm(probability: float) -> None:
    """Nothing is right, or everything."""
    solver, _, _ = driven(1, 0.3)
    found = repair(solver.content(), probability=probability)
    assert 0 <= found.false.size <= found.suspects
    assert np.isfinite([found.before, found.after, *found.distance]).all()
    assert all(np.isfinite(group.values).all() for group in found.groups)


def test_the_graph_that_is_looked_at_stays_as_it_is() -> None:
    solver, _, _ = driven(1, 0.3)
    before = solver.content()
    repair(before)
    assert before.values.tobytes() == solver.content().values.tobytes()
    assert before.payload.tobytes() == solver.content().payload.tobytes()
    assert before.fac.tobytes() == solver.content().fac.tobytes()


def test_loops_are_what_does_not_join_anything_new() -> None:
    solver, _, _ = driven(2, 0.3)
    graph, loops = solver.content(), set(find_loops(solver.content()).tolist())
    ends = graph.fac[: graph.counts[1], 1:3]
    odometry = set(np.flatnonzero(np.abs(ends[:, 1] - ends[:, 0]) == 1).tolist())
    assert loops == set(range(len(ends))) - odometry


def test_an_empty_map_has_nothing_to_repair() -> None:
    found = repair(Solver(Options()).content())
    assert (found.suspects, found.false.size, found.before) == (0, 0, 0.0)


def test_weights_fall_from_one_to_nothing_and_get_sharper() -> None:
    s, bound = np.linspace(0.0, 40.0, 400), np.full(400, 10.0)
    for mu in (0.01, 1.0, 100.0):
        weights = weigh(s, bound, mu)
        assert (np.diff(weights) <= 0).all()
        assert ((weights > 0) & (weights <= 1)).all()
    np.testing.assert_array_equal(weigh(s, bound, 1e9) > 0.5, s < bound)


def with_false_closures(path: Path, share: float, seed: int) -> tuple[Solver, set[int]]:
    """A replay of a data set with closures that nobody has seen among its own; and their ids."""
    rng, solver, false = np.random.default_rng(seed), Solver(Options()), set()
    poses: list[int] = []
    for batch in read(path).steps():
        poses += [int(key) for group in batch.variables for key in group.keys]
        groups = list(batch.factors)
        loops = sum(int((np.abs(group.keys[:, 1] - group.keys[:, 0]) != 1).sum()) for group in groups)
        wrong = int(rng.binomial(loops, share / (1 - share))) if loops and len(poses) > 50 else 0
        if wrong:
            ends = np.column_stack([rng.choice(poses[:-20], wrong), np.full(wrong, poses[-1])])
            z = np.column_stack([rng.normal(0, 1, (wrong, 2)), rng.uniform(-np.pi, np.pi, wrong)])
            groups.append(Factors("between_se2", ends, z, np.repeat(groups[-1].information[:1], wrong, 0)))
        first = solver.stage(Batch(batch.variables, tuple(groups)))
        solver.step()
        count = sum(len(group.keys) for group in groups)
        false |= set(range(first + count - wrong, first + count))
    solver.step(settle=True)
    return solver, false


def test_intel_with_three_of_ten_closures_false_is_intel_again(datasets: Path) -> None:
    """There is no ground truth: the error is the distance from the optimum without false closures."""
    clean, _ = with_false_closures(datasets / "intel.g2o", 0.0, 1)
    solver, false = with_false_closures(datasets / "intel.g2o", 0.3, 1)
    best = {k: row for g in clean.estimate() for k, row in zip(g.keys.tolist(), g.values, strict=True)}
    off = error_of(solver, best)
    found = repair(solver.content())
    placed = [Change("place", keys=g.keys, kind=g.kind, values=g.values) for g in found.groups]
    repaired, *_ = with_changes(solver, [Change("remove_factors", found.false), *placed], settle=True)
    taken = set(found.false.tolist())
    print(f"{len(false)} false of {found.suspects}, {len(false - taken)} missed, {len(taken - false)} right ones taken")
    print(f"{off:.3g} m off, repaired {error_of(repaired, best):.3g} m off")
    assert len(false) > 200
    assert off > 1.0
    assert error_of(repaired, best) < 0.1
