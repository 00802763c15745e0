"""Which observation is of which landmark: against trying everything."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_covariances import best_association

from examples import examples
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver, errors
from factorbus.solver.covariance.association import associate
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.gates import threshold
from factorbus.solver.covariance.kernels.compatible import search


@examples(60)
@given(
    seed=st.integers(0, 2**32 - 1), observations=st.integers(1, 4), most=st.integers(0, 3), dim=st.sampled_from([2, 3])
)
def test_the_search_finds_what_trying_everything_finds(seed: int, observations: int, most: int, dim: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = [(i, int(l)) for i in range(observations) for l in rng.permutation(4)[: rng.integers(0, most + 1)]]
    size = len(pairs) * dim
    J = rng.normal(size=(size, size + 2))
    S = J @ J.T / (size + 2) + 0.3 * np.eye(size)
    r = rng.normal(size=size) * 1.5
    tried_at_most = 10**6
    gates = np.concatenate([[0.0], threshold(dim * np.arange(1, observations + 1), 0.9)])
    begin = np.searchsorted(np.array([i for i, _ in pairs], np.int64), np.arange(observations + 1))
    best = np.empty(observations, np.int64)
    landmark = np.array([l for _, l in pairs], np.int64)
    tried = search(begin, landmark, np.ascontiguousarray(S), r.reshape(-1, dim), gates, tried_at_most, best)
    assert tried <= tried_at_most
    d2, wanted = best_association(S, r, pairs, dim, gates)
    assert (best >= 0).sum() == len(wanted)
    found = best[best >= 0]
    rows = (found[:, None] * dim + np.arange(dim)).reshape(-1)
    assert float(r[rows] @ np.linalg.solve(S[np.ix_(rows, rows)], r[rows])) == pytest.approx(d2, rel=1e-9, abs=1e-12)
    assert all(pairs[q][0] == i for i, q in enumerate(best) if q >= 0)


def room(spread: float, sigma: float) -> tuple[Solver, np.ndarray]:
    """A robot that has seen eight landmarks from two places, and what they are."""
    rng = np.random.default_rng(4)
    points = rng.uniform(-spread, spread, (8, 2))
    poses = np.array([[0.0, 0, 0], [1.0, 0.2, 0.3]])
    keys, seen = [], []
    for i, (x, y, t) in enumerate(poses):
        turn = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
        for l, point in enumerate(points):
            keys.append([i, 100 + l])
            seen.append(turn @ (point - [x, y]) + rng.normal(0, sigma, 2))
    weight = np.tile([1 / sigma**2, 0.0, 1 / sigma**2], (len(keys), 1))
    solver = Solver(Options(mode="bayes-tree"))
    solver.stage(
        Batch(
            (
                Variables("se2", np.array([0]), poses[:1], fixed=True),
                Variables("se2", np.array([1]), poses[1:]),
                Variables("point2", 100 + np.arange(8), points),
            ),
            (Factors("landmark_se2", np.array(keys), np.array(seen), weight),),
        )
    )
    solver.step()
    return solver, points


def test_a_common_error_is_found_out_by_looking_at_all_together() -> None:
    """A robot that has slipped: each observation is nearest to a wrong landmark, all together are right."""
    rng = np.random.default_rng(2)
    solver, n = Solver(Options(mode="bayes-tree")), 5
    row = np.column_stack([np.arange(n) * 0.6, np.full(n, 3.0)])
    rough = np.array([[1 / 0.09, 0, 0, 1e4, 0, 1e4]])  # 0.3 m along the row, sure otherwise
    solver.stage(
        Batch(
            (
                Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True),
                Variables("se2", np.array([1]), np.zeros((1, 3))),
                Variables("point2", 100 + np.arange(n), row),
            ),
            (
                Factors(
                    "landmark_se2",
                    np.column_stack([np.zeros(n, int), 100 + np.arange(n)]),
                    row,
                    np.tile([1e6, 0, 1e6], (n, 1)),
                ),
                Factors("between_se2", np.array([[0, 1]]), np.zeros((1, 3)), rough),
            ),
        )
    )
    solver.step()
    seen = row + np.array([0.4, 0.0]) + rng.normal(0, 0.01, (n, 2))
    weight = np.tile([1e4, 0.0, 1e4], (n, 1))
    blocks, landmarks = CovarianceBlocks(solver.covariances.factored()), np.arange(2, 2 + n)
    found = associate(blocks, "landmark_se2", 1, seen, weight, landmarks, 0.99)
    nearest = [found.landmarks[found.observations == i][0] for i in range(n)]
    assert nearest[:-1] == (landmarks[1:]).tolist()
    assert found.landmark.tolist() == landmarks.tolist()
    assert found.complete
    assert found.dims == 2 * n


@pytest.mark.parametrize("kind", ["landmark_se2", "bearing_range_se2"])
def test_observations_are_told_apart_and_strangers_left_out(kind: str) -> None:
    solver, points = room(8.0, 0.05)
    x, y, t = next(values[0] for keys, values in ((g.keys, g.values) for g in solver.estimate()) if keys[0] == 1)
    turn = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
    seen = (points[[5, 0, 3]] - [x, y]) @ turn.T
    seen = np.vstack([seen, [[40.0, 40.0]]])
    if kind == "bearing_range_se2":
        seen = np.column_stack([np.arctan2(seen[:, 1], seen[:, 0]), np.linalg.norm(seen, axis=1)])
    found = associate(
        CovarianceBlocks(solver.covariances.factored()),
        kind,
        1,
        seen,
        np.tile([400.0, 0, 400.0], (4, 1)),
        np.arange(2, 10),
        0.95,
    )
    assert found.landmark.tolist() == [7, 2, 5, -1]
    assert found.distance < threshold(np.array([6]), 0.95)[0]


def test_nothing_to_see_and_nothing_to_choose_from() -> None:
    blocks = CovarianceBlocks(room(8.0, 0.05)[0].covariances.factored())
    none = associate(blocks, "landmark_se2", 1, np.empty((0, 2)), np.empty((0, 3)), np.arange(2, 10), 0.95)
    assert none.landmark.size == 0
    weight = np.array([[1.0, 0, 1.0]])
    assert associate(blocks, "landmark_se2", 1, np.ones((1, 2)), weight, np.empty(0, int), 0.95).landmark.tolist() == [
        -1
    ]


@pytest.mark.parametrize("choices", [0, 1])
def test_observations_of_no_landmark_take_no_part_in_the_search(choices: int) -> None:
    solver, points = room(8.0, 0.05)
    x, y, t = next(values[0] for keys, values in ((g.keys, g.values) for g in solver.estimate()) if keys[0] == 1)
    turn = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
    n, right = 100_000, 70_001  # a matrix of all of them would have 320 GB
    seen = np.full((n, 2), 40.0)
    seen[right] = (points[5] - [x, y]) @ turn.T
    blocks = CovarianceBlocks(solver.covariances.factored())
    landmarks = np.arange(7, 7 + choices)
    found = associate(blocks, "landmark_se2", 1, seen, np.tile([400.0, 0, 400.0], (n, 1)), landmarks, 0.95)
    assert np.flatnonzero(found.landmark >= 0).tolist() == [right] * choices
    assert found.landmark[right] == (7 if choices else -1)


def test_what_cannot_be_is_refused() -> None:
    blocks, weight = CovarianceBlocks(room(8.0, 0.05)[0].covariances.factored()), np.array([[1.0, 0, 1.0]])
    with pytest.raises(errors.KindMismatch):
        associate(blocks, "landmark_se2", 2, np.ones((1, 2)), weight, np.arange(2, 10), 0.95)
    with pytest.raises(errors.KindMismatch):
        associate(blocks, "landmark_se2", 1, np.ones((1, 2)), weight, np.array([0]), 0.95)
    with pytest.raises(errors.NotPositiveDefinite):
        associate(blocks, "landmark_se2", 1, np.ones((1, 2)), -weight, np.arange(2, 10), 0.95)


def test_thresholds_are_those_of_scipy_stats() -> None:
    from scipy.stats import chi2

    dims = np.arange(1, 40)
    np.testing.assert_allclose(threshold(dims, 0.975), chi2.ppf(0.975, dims), rtol=1e-12)
