"""Whose certainty is shown, how it is asked for, and the tree that a loop closure goes up."""

from concurrent.futures import Future

import numpy as np
import pytest
from naive.dense_covariances import DenseCovariance
from naive.dense_least_squares import DenseGraph

from factorbus.cli.driving.columns import merged
from factorbus.cli.driving.local import covariances_at
from factorbus.cli.output.sparsity import last_loop, pattern_of
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol
from factorbus.simulate import city_trees, manhattan
from factorbus.solver import solve_batch
from factorbus.viz.certainty import chosen
from factorbus.viz.rate_limit import RateLimited
from factorbus.viz.tree import parents_of, places_of, reached_from


def test_the_last_pose_of_every_robot_is_among_the_chosen_and_features_are_not() -> None:
    poses = [Variables("se2", symbol(robot, 0) + np.arange(70), np.zeros((70, 3))) for robot in "ab"]
    trees = Variables("point2", symbol("l", 0) + np.arange(5), np.zeros((5, 2)))
    features = Variables("idp", symbol("f", 0) + np.arange(5), np.zeros((5, 6)))
    keys = chosen([*poses, trees, features], 10)
    assert {symbol("a", 69), symbol("b", 69), symbol("l", 0), symbol("l", 4)} <= set(keys.tolist())
    assert len(set(keys.tolist())) == keys.size == 10 + 1 + 5
    assert chosen([Variables("se2", poses[0].keys)], 10).size == 0


def test_a_question_is_put_one_at_a_time_and_what_was_waited_for_is_not_overwritten() -> None:
    asked: list[Future[int]] = []

    def ask() -> Future[int]:
        asked.append(Future())
        return asked[-1]

    rate_limited = RateLimited(ask, 0)
    assert (rate_limited.refresh(lambda had: had < 1), rate_limited.refresh(lambda had: had < 1), len(asked)) == (
        0,
        0,
        1,
    )
    asked[0].set_exception(RuntimeError("the service went"))
    assert rate_limited.refresh(lambda _: False) == 0
    assert rate_limited.refresh(lambda had: had < 1) == 0
    assert len(asked) == 1, "there is a pause first"
    rate_limited = RateLimited(ask, 0)
    rate_limited.refresh(lambda had: had < 1)
    rate_limited.put(7)
    asked[-1].set_result(3)
    assert rate_limited.refresh(lambda _: False) == 7


def test_covariances_at_a_files_values_are_those_of_a_dense_inverse() -> None:
    drive = merged(step.batch for step in city_trees(poses=40, seed=1))
    solved = solve_batch(drive.variables, drive.factors)
    values = tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in solved.values)
    at_optimum = Batch(values, drive.factors)
    keys = chosen(at_optimum.variables, 100)
    found = covariances_at(at_optimum, keys)
    graph = DenseGraph()
    graph.add(at_optimum)
    for group in values:
        graph.values |= dict(zip(group.keys.tolist(), group.values, strict=True))
    twin = DenseCovariance(graph)
    for key in keys.tolist():
        wanted = twin.joint([key])
        np.testing.assert_allclose(found[key], wanted, rtol=0, atol=1e-6 * np.abs(wanted).max(initial=1e-6))


def test_the_tree_is_that_of_r_and_a_loop_reaches_its_ancestors() -> None:
    graph = merged(step.batch for step in manhattan(poses=200, seed=3))
    pattern = pattern_of(graph)
    parents = parents_of(pattern)
    rows: dict[int, set[int]] = {}
    for i, j in (*pattern.eliminated.tolist(), *pattern.fill.tolist()):
        rows.setdefault(i, set()).add(j)
    assert parents.tolist() == [min(rows[i]) if i in rows else -1 for i in range(pattern.n)]
    touched = last_loop(graph, pattern)
    assert touched.size == 2
    reached = reached_from(parents, touched)
    assert set(touched.tolist()) <= set(reached.tolist())
    assert all(parents[column] in reached for column in reached if parents[column] >= 0)
    places = places_of(parents)
    assert len({tuple(place) for place in places.tolist()}) == pattern.n, "no two columns in one place"
    child = np.flatnonzero(parents >= 0)
    np.testing.assert_array_equal(places[child, 1], places[parents[child], 1] - 1)


def test_a_graph_without_a_loop_has_nothing_touched() -> None:
    graph = merged(step.batch for step in manhattan(poses=5, seed=3))
    pattern = pattern_of(graph)
    assert last_loop(graph, pattern).size == 0
    assert reached_from(parents_of(pattern), last_loop(graph, pattern)).size == 0


@pytest.mark.parametrize("seed", [1, 2])
def test_a_random_forest_is_laid_out_without_two_columns_in_one_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parents = np.array([rng.integers(i + 1, 60) if i < 57 and rng.random() < 0.9 else -1 for i in range(60)])
    places = places_of(parents)
    assert len({tuple(place) for place in places.tolist()}) == 60
