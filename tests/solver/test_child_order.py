"""Subtrees in the order by which few update matrices wait: the same R in less memory, if points come before poses."""

import numpy as np

from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.sparse.child_order import with_few_waiting
from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.dissection import analyze_whole
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import Symbolic, analyze


def ring(cameras: int, per_camera: int, seen: int, split: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """dims, rows, cols of Λ of cameras on `split` rings; each has points, which `seen` in a row see."""
    points, each = cameras * per_camera, cameras // split
    at = np.arange(points) // per_camera
    by = (at[:, None] % each + np.arange(seen)) % each + each * (at // each)[:, None]
    both = np.arange(cameras + points)
    seen_by = np.repeat(cameras + np.arange(points), seen)
    rows, cols = np.concatenate([both, by.ravel()]), np.concatenate([both, seen_by])
    return np.where(both < cameras, 6, 3), rows, cols


def by_degree(dims: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> Symbolic:
    return analyze(dims, rows, cols, order(dims, rows, cols))


def test_the_same_fill_and_operations_in_less_memory() -> None:
    for pattern in (ring(60, 40, 8), ring(90, 40, 8, split=3)):
        before = by_degree(*pattern)
        after = with_few_waiting(before, *pattern[1:])
        assert after.arena < 0.6 * before.arena
        assert (after.nnz_r, after.flops) == (before.nnz_r, before.flops)
        np.testing.assert_array_equal(np.sort(after.order), np.arange(len(pattern[0])))
        assert analyze_whole(*pattern).arena == after.arena


def test_it_solves_the_same() -> None:
    dims, rows, cols = ring(30, 40, 6)
    rng, starts = np.random.default_rng(4), np.concatenate([[0], np.cumsum(dims)])
    dense, offsets, data = np.zeros((starts[-1],) * 2), [], []
    for i, j in zip(rows, cols, strict=True):
        block = rng.normal(size=(dims[i], dims[j]))
        block = 200.0 * np.eye(dims[i]) + block @ block.T if i == j else block
        offsets.append(sum(each.size for each in data[-1:]) + (offsets[-1] if offsets else 0))
        data.append(block)
        dense[starts[i] : starts[i + 1], starts[j] : starts[j + 1]] = block
        dense[starts[j] : starts[j + 1], starts[i] : starts[i + 1]] = block.T
    before = by_degree(dims, rows, cols)
    after, cholesky, eta = with_few_waiting(before, rows, cols), Cholesky(), rng.normal(size=int(starts[-1]))
    assert after is not before
    assert cholesky.factorize(after, np.concatenate([each.ravel() for each in data]), np.array(offsets)) < 0
    np.testing.assert_allclose(cholesky.solve(eta), np.linalg.solve(dense, eta), rtol=1e-9, atol=1e-12)


def test_children_come_before_parents_and_roots_stay_apart() -> None:
    pattern = ring(90, 40, 8, split=3)
    fronts = with_few_waiting(by_degree(*pattern), *pattern[1:]).fronts
    inner = fronts[:, fr.PARENT] >= 0
    assert (fronts[inner, fr.PARENT] > np.flatnonzero(inner)).all()
    assert np.count_nonzero(~inner) == 3


def test_where_r_is_what_takes_memory_nothing_is_ordered_again() -> None:
    side = np.arange(400).reshape(20, 20)
    rows = np.concatenate([side.ravel(), side[:, :-1].ravel(), side[:-1].ravel()])
    cols = np.concatenate([side.ravel(), side[:, 1:].ravel(), side[1:].ravel()])
    symbolic = by_degree(np.full(400, 3), rows, cols)
    assert with_few_waiting(symbolic, rows, cols) is symbolic
