"""What a map keeps: which poses go, what is left of what they said, against dense algebra, and that nothing moves."""

import time
from typing import Any

import numpy as np
import pytest
from naive.dense_poses import pose_matrix

from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.simulate import city_trees, manhattan, sphere
from factorbus.solver import Options, Solver
from factorbus.solver.changing import with_changes
from factorbus.solver.errors import BadOption
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import Addition
from factorbus.solver.graph.whitened import whitened
from factorbus.solver.lifelong.eliminating import try_eliminate
from factorbus.solver.lifelong.plan import KeepPlan, plan_removals
from factorbus.solver.lifelong.policy import KeepPolicy
from factorbus.solver.lifelong.redundant import _surplus, find_redundant
from factorbus.solver.lifelong.relative_terms import RelativeTerm, factor_of_term

NOBODY = np.empty(0, np.int64)
WEIGHT = np.diag([400.0, 100.0, 900.0])[np.triu_indices(3)][None]


def poses(keys: list[int], fixed: bool = False) -> Variables:
    values = np.array([[float(key & 0xFFFF), 0.0, 0.0] for key in keys])
    return Variables("se2", np.array(keys), values, fixed)


def between(i: int, j: int, z: list[float]) -> Factors:
    return Factors("between_se2", np.array([[i, j]]), np.array([z]), WEIGHT)


def solved(*batches: Batch) -> Solver:
    solver = Solver(Options())
    for batch in batches:
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    return solver


def line(n: int, letter: int = 0, start: int = 0) -> list[Batch]:
    """Poses a metre apart, the first one fixed."""
    first = letter << 56 | start
    chain = [Batch((poses([first + k]),), (between(first + k - 1, first + k, [1.0, 0.0, 0.0]),)) for k in range(1, n)]
    return [Batch((poses([first], True),)), *chain]


def made(solver: Solver, plan: KeepPlan) -> Solver:
    changes = [Change("remove_factors", plan.factors), Change("remove_variables", keys=plan.keys, alone=True)]
    return with_changes(solver, changes, Addition((), plan.added))[0]


def values(solver: Solver) -> dict[int, np.ndarray]:
    groups = solver.estimate()
    return {key: row for g in groups for key, row in zip(g.keys.tolist(), g.values, strict=True)}


def found(solver: Solver, policy: KeepPolicy) -> list[int]:
    return sorted(solver.factor_graph.keys[find_redundant(solver.factor_graph, policy, NOBODY).poses].tolist())


def test_of_a_street_one_pose_stays_where_the_next_is_as_far_as_asked() -> None:
    solver = solved(*line(20))
    # 0 is fixed; 15 to 19 are the newest.
    assert found(solver, KeepPolicy(2.5, window=5)) == [1, 2, 4, 5, 7, 8, 10, 11, 13, 14]
    assert found(solver, KeepPolicy(2.5, poses=2, window=5)) == [2, 5, 8, 11, 14]
    assert found(solver, KeepPolicy(0.9, window=5)) == []


def test_what_a_pose_has_beside_relative_factors_keeps_it() -> None:
    prior = Factors("prior_se2", np.array([[8]]), np.array([[8.0, 0.0, 0.0]]), WEIGHT)
    solver = solved(*line(20), Batch((), (prior,)))
    assert 8 in found(solved(*line(20)), KeepPolicy(2.5, window=5))
    assert 8 not in found(solver, KeepPolicy(2.5, window=5))


def test_a_letter_that_is_left_behind_keeps_its_last_pose() -> None:
    tie = between(3, 1 << 56, [0.0, 0.5, 0.0])
    today = [Batch((poses([1 << 56]),), (tie,)), *line(12, 1)[1:]]
    both = solved(*line(12), *today)
    # Of today the first that is far enough from yesterday's 1 is none at all: all of the street has poses.
    redundant = found(both, KeepPolicy(2.5, window=5))
    assert 11 not in redundant
    assert {9, 10} & set(redundant)
    assert all(key >> 56 == 0 or key & 0xFFFF < 7 for key in redundant)
    assert {9, 10}.isdisjoint(found(both, KeepPolicy(2.5, window=13)))


def test_an_area_as_large_as_the_map_is_looked_at_as_fast_as_a_small_one() -> None:
    """An insert of a client may have to wait for a look.  Half of the poses stay anyway, as those with GNSS do."""
    places = np.random.default_rng(3).uniform(0.0, 100.0, (6000, 3)) * (1, 1, 0)
    may_go, begun = np.arange(6000) % 2 == 0, time.process_time()
    assert _surplus(places, may_go, KeepPolicy(1000.0)).size == 3000
    assert time.process_time() - begun < 1.0, "all of them count each other where nothing ends that"


def test_a_landmark_that_few_see_keeps_its_poses() -> None:
    upper = np.array([[100.0, 0.0, 100.0]])
    seen = [Factors("landmark_se2", np.array([[k, 1000]]), np.array([[5.0 - k, 1.0]]), upper) for k in (4, 5, 6)]
    tree = Variables("point2", np.array([1000]), np.array([[5.0, 1.0]]))
    solver = solved(*line(20), Batch((tree,), tuple(seen)))
    assert {4, 5} <= set(found(solver, KeepPolicy(2.5, window=5, landmarks=2)))
    assert not {4, 5, 6} & set(found(solver, KeepPolicy(2.5, window=5, landmarks=3)))


def test_a_chain_is_the_composition_of_its_steps() -> None:
    """Between two poses nothing is approximated: mean and covariance are those of the composition."""
    steps = [[1.0, 0.1, 0.3], [0.8, -0.2, 0.4]]
    solver = solved(
        Batch((Variables("se2", np.array([0]), np.zeros((1, 3))),),
              (Factors("prior_se2", np.array([[0]]), np.zeros((1, 3)), WEIGHT),)),
        Batch((Variables("se2", np.array([1])),), (between(0, 1, steps[0]),)),
        Batch((Variables("se2", np.array([2])),), (between(1, 2, steps[1]),)),
    )  # fmt: skip
    graph = solver.factor_graph
    rows = [row for row in range(graph.factor_count) if set(graph.ends_of(row)) in ({0, 1}, {1, 2})]
    done = try_eliminate(graph, [1], rows, {0: (1,), 1: (0, 2), 2: (1,)})
    assert done is not None
    assert done.loss == pytest.approx(0.0, abs=1e-9)
    (term,) = done.terms
    T = pose_matrix(np.array(steps[1]))
    R, t = T[:2, :2], T[:2, 2]
    ad = np.eye(3)  # of T⁻¹: what the first step is off by, at the end of the second
    ad[:2, :2] = R.T
    ad[:2, 2] = R.T @ np.array([-t[1], t[0]])
    each = np.linalg.inv(np.diag([400.0, 100.0, 900.0]))
    assert np.linalg.inv(term.information) == pytest.approx(each + ad @ each @ ad.T, rel=1e-9)


def test_what_is_lost_is_the_divergence_from_the_dense_marginal() -> None:
    """Of a pose with four neighbours: KL of the tree's Gaussian from that of the dense one, first neighbour held."""
    rng = np.random.default_rng(5)
    ends = [k for k in range(5) if k != 2]
    batches = [Batch((poses([0]),), (Factors("prior_se2", np.array([[0]]), np.zeros((1, 3)), WEIGHT),))]
    batches += [Batch((poses([k]),), (between(k - 1, k, [1.0, 0.0, 0.0]),)) for k in range(1, 5)]
    star = [between(2, k, [k - 2.0, *rng.normal(0.0, 0.02, 2)]) for k in (0, 4)]
    solver = solved(*batches, Batch((), tuple(star)))
    graph = solver.factor_graph
    rows = [row for row in range(graph.factor_count) if 2 in graph.ends_of(row)]
    done = try_eliminate(graph, [2], rows, dict.fromkeys(ends, (2,)) | {2: ends})
    assert done is not None
    before, after = dense(graph, rows, ends, 2), np.zeros((9, 9))
    for term in done.terms:
        tree = lambda_of(solver, term)
        after += tree[np.ix_(inside(ends), inside(ends))]
    S = np.linalg.inv(before)
    expected = 0.5 * (np.trace(after @ S) - 9 - np.linalg.slogdet(after @ S)[1])
    assert done.loss == pytest.approx(expected, rel=1e-6)
    assert done.loss > 0.01


def inside(ends: list[int]) -> np.ndarray:
    """Scalars of all but the first of `ends` among five poses."""
    return np.concatenate([3 * k + np.arange(3) for k in ends[1:]])


def dense(graph: FactorGraph, rows: list[int], ends: list[int], gone: int) -> np.ndarray:
    """Λ of the ends but the first, `gone` marginalized, from the factors of all five."""
    whole = whitened(graph, rows, list(range(5)))
    keep, out = inside(ends), 3 * gone + np.arange(3)
    L = whole.information
    return L[np.ix_(keep, keep)] - L[np.ix_(keep, out)] @ np.linalg.solve(L[np.ix_(out, out)], L[np.ix_(out, keep)])


def lambda_of(solver: Solver, term: RelativeTerm) -> np.ndarray:
    """Λ of five poses of the factor of a term, as the solver linearizes it."""
    kind, z, upper = factor_of_term(solver.factor_graph, term)
    other = solved(Batch((poses([0], True), poses([1, 2, 3, 4])),
                         tuple(between(k, k + 1, [1.0, 0.0, 0.0]) for k in range(4))))  # fmt: skip
    other.stage(Batch((), (Factors(kind, np.array([[term.i, term.j]]), z[None], upper[None]),)))
    graph = other.factor_graph
    graph.values[:] = solver.factor_graph.values[: graph.values.size]
    whole = whitened(graph, [4], list(range(5)))
    out = np.zeros((15, 15))
    size = whole.information.shape[0]
    out[:size, :size] = whole.information
    return out


def wrapped(difference: np.ndarray) -> np.ndarray:
    """Of poses in the plane the angle, in [−π, π)."""
    if difference.size == 3:
        difference[2] = (difference[2] + np.pi) % (2 * np.pi) - np.pi
    return difference


WORLDS = {
    "streets": (lambda: [step.batch for step in manhattan(300, 4)], KeepPolicy(2.0, window=20)),
    "trees": (lambda: [step.batch for step in city_trees(200, 3)], KeepPolicy(3.0, window=20, landmarks=1, loss=5.0)),
    "sphere": (lambda: [step.batch for step in sphere(300, 2)], KeepPolicy(3.0, window=20, loss=50.0)),
}


@pytest.mark.parametrize("world", WORLDS)
def test_an_estimate_at_its_optimum_stays_where_it_is(world: str) -> None:
    batches, policy = WORLDS[world]
    solver = solved(*batches())
    gone = 0
    for _ in range(100):
        plan = plan_removals(solver.factor_graph, policy)
        if not plan.keys.size:
            break
        before = values(solver)
        solver = made(solver, plan)
        solver.step(settle=True)
        after, gone = values(solver), gone + plan.keys.size
        assert set(after) == set(before) - set(plan.keys.tolist())
        moved = max(np.abs(wrapped(after[key] - before[key])).max() for key in after)
        assert moved < 1e-5, (gone, moved)
        assert plan.loss >= 0.0
    assert gone > 20
    assert plan_removals(solver.factor_graph, policy).keys.size == 0


def test_poses_next_to_a_fixed_one_go_and_what_they_say_of_it_stays() -> None:
    rng = np.random.default_rng(2)
    ties = [between(0, k, [float(k), *rng.normal(0.0, 0.02, 2)]) for k in (2, 3, 5)]
    solver = solved(*line(20), Batch((), tuple(ties)))
    plan = plan_removals(solver.factor_graph, KeepPolicy(2.5, window=5))
    assert {1, 2, 5} <= set(plan.keys.tolist())
    before = values(solver)
    solver = made(solver, plan)
    solver.step(settle=True)
    after = values(solver)
    assert max(np.abs(after[key] - before[key]).max() for key in after) < 1e-6
    assert any(0 in row for group in solver.graph()[1] for row in group.keys.tolist())


def test_two_poses_have_one_factor_however_often_they_are_driven_by() -> None:
    solver = solved(*[step.batch for step in manhattan(600, 4)])
    while (plan := plan_removals(solver.factor_graph, KeepPolicy(2.0, window=20))).keys.size:
        solver = made(solver, plan)
    pairs = [tuple(sorted(row)) for g in solver.graph()[1] for row in g.keys.tolist() if g.kind == "between_se2"]
    assert len(pairs) == len(set(pairs))


def test_a_pose_stays_that_would_lose_too_much() -> None:
    solver = solved(*[step.batch for step in manhattan(300, 4)])
    some = plan_removals(solver.factor_graph, KeepPolicy(2.0, window=20, loss=100.0), 1000)
    none = plan_removals(solver.factor_graph, KeepPolicy(2.0, window=20, loss=0.0), 1000)
    assert none.keys.size < some.keys.size
    assert none.left > 0
    assert none.loss <= 1e-9


def test_poses_that_are_to_stay_do() -> None:
    solver = solved(*line(20))
    every = plan_removals(solver.factor_graph, KeepPolicy(2.5, window=5))
    some = plan_removals(solver.factor_graph, KeepPolicy(2.5, window=5), staying=every.keys[:1])
    assert int(every.keys[0]) not in some.keys.tolist()


def test_it_goes_some_at_a_time() -> None:
    solver = solved(*line(400))
    plan = plan_removals(solver.factor_graph, KeepPolicy(2.5, window=5), most=20)
    assert 20 <= plan.keys.size < 40


@pytest.mark.parametrize("wrong", [{"spacing_m": 0.0}, {"poses": 0}, {"window": 1.5}, {"landmarks": 0}, {"loss": -1.0}])
def test_a_policy_out_of_its_range_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(BadOption, match=next(iter(wrong))):
        KeepPolicy(**wrong)
