"""The dense kernels against NumPy: a front of any size, and the vector functions it is made of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.elimination import partial_cholesky

from factorbus.solver.kernels.jit import compile as _jit
from factorbus.solver.kernels.jit import simd_plain
from factorbus.solver.kernels.jit.simd import LANES, Block, Panel, add_run, six, solve_tile, tile, zero
from factorbus.solver.kernels.sparse.fronts import GROUP, SCRATCH, Front, padded_size, update_row, update_size
from factorbus.solver.kernels.sparse.panels import DEPTH
from factorbus.solver.kernels.sparse.partial_cholesky import RAISED, factor_front
from factorbus.solver.sparse.worker_threads import TASK_QUEUE


@given(st.integers(1, 40), st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_a_front_is_factorized_like_a_dense_matrix(p, m, seed):
    assert_front(p, m, seed)


@pytest.mark.parametrize(("p", "m"), [(DEPTH, 70), (DEPTH + 1, 0), (3 * DEPTH + 7, 201), (5, 500)])
def test_fronts_of_several_panels(p, m):
    assert_front(p, m, seed=p + m)


@given(st.integers(1, 30), st.data())
def test_the_failing_pivot_is_the_one_named(p, data):
    bad = data.draw(st.integers(0, p - 1))
    root = np.triu(np.random.default_rng(p).normal(size=(p, p))) + 5.0 * np.eye(p)
    front = root.T @ root
    front[bad, bad] -= root[bad, bad] ** 2 * data.draw(st.sampled_from([1.0 + 1e-9, 2.0, 1e9]))
    assert run(front, p)[0] == bad


def test_floors_are_the_least_pivots():
    front = np.diag([4.0, 9.0, 16.0])
    assert run(front, 3, np.array([3.9, 8.9, 15.9]))[0] == -1
    assert run(front, 3, np.array([3.9, 9.0, 15.9]))[0] == 1


@given(st.integers(1, 30), st.integers(0, 12), st.data())
def test_a_raised_pivot_is_its_floor_and_the_rest_follows_from_it(p, m, data):
    at, floor = data.draw(st.integers(0, p - 1)), data.draw(st.sampled_from([1e-3, 1.0, 30.0]))
    root = np.triu(np.random.default_rng(p).normal(size=(p + m, p + m))) + 5.0 * np.eye(p + m)
    root[at, at] = floor**0.5
    raised = root.T @ root
    front, floors = raised.copy(), np.zeros(p)
    front[at, at] -= data.draw(st.sampled_from([1.5, 1.0, 0.5])) * floor
    floors[at] = -floor
    failed, rows, update = run(front, p, floors)
    assert failed == RAISED
    expected_rows, expected_update = partial_cholesky(raised, p)
    np.testing.assert_allclose(np.triu(rows), expected_rows, atol=1e-7)
    np.testing.assert_allclose(np.triu(update), np.triu(expected_update), atol=1e-6)


def test_only_a_pivot_below_its_floor_is_raised():
    front = np.diag([4.0, 9.0])
    assert run(front, 2, np.array([-3.9, -8.9]))[0] == -1
    assert run(front, 2, np.array([-3.9, -9.1]))[0] == RAISED


@pytest.mark.parametrize("rows", [1, 2, 3, 4])
@pytest.mark.parametrize("vectors", [1, 2, 3])
@pytest.mark.parametrize("depth", [0, 1, 5])
def test_tile(rows, vectors, depth):
    arena = np.random.default_rng(rows).normal(size=900)
    expected, args = arena.copy(), (rows, vectors, Block(3, 41), Panel(300, 29, depth), 500)
    simd_plain.tile(expected, *args)
    _tile(arena, *args)
    np.testing.assert_allclose(arena, expected, atol=1e-13)


@pytest.mark.parametrize("rows", [1, 2, 3, 4])
@pytest.mark.parametrize("vectors", [0, 1, 5])
def test_solve_tile(rows, vectors):
    arena = np.random.default_rng(rows).normal(size=900)
    expected, args = arena.copy(), (rows, vectors, 30, 101, 2)
    simd_plain.solve_tile(expected, *args)
    _solve_tile(arena, *args)
    np.testing.assert_allclose(arena, expected, atol=1e-13)


@pytest.mark.parametrize("depth", [3, 6])
@pytest.mark.parametrize("stride", [1, 6])
def test_six(depth, stride):
    random = np.random.default_rng(depth)
    x, y, out = random.normal(size=50), random.normal(size=60), random.normal(size=20)
    expected = out.copy()
    expected[9:15] = x[7 : 7 + depth * stride : stride] @ y[11 : 11 + 6 * depth].reshape(depth, 6)
    _six(x, Panel(7, stride, depth), y, 11, out, 9)
    np.testing.assert_allclose(out, expected, atol=1e-13)


@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 7, 8, 30])
def test_runs(count):
    arena = np.arange(100.0)
    _add_run(arena, 3, 50, count)
    expected = np.arange(100.0)
    expected[3 : 3 + count] += expected[50 : 50 + count]
    np.testing.assert_array_equal(arena, expected)
    _zero(arena, 3, count)
    expected[3 : 3 + count] = 0.0
    np.testing.assert_array_equal(arena, expected)


def test_lanes_divide_the_padding():
    assert 8 % LANES == 0


def assert_front(p: int, m: int, seed: int) -> None:
    root = np.random.default_rng(seed).normal(size=(p + m + 3, p + m))
    front = root.T @ root + np.eye(p + m)
    failed, rows, update = run(front, p)
    assert failed == -1
    expected_rows, expected_update = partial_cholesky(front, p)
    np.testing.assert_allclose(np.triu(rows), expected_rows, atol=1e-8)
    np.testing.assert_allclose(np.triu(update), np.triu(expected_update), atol=1e-8)


def run(front: np.ndarray, p: int, floors: np.ndarray | None = None) -> tuple[int, np.ndarray, np.ndarray]:
    """Put a front into an arena as `fronts` says, everything around it NaN, and factorize it."""
    n = len(front)
    m, lead = n - p, -p % LANES
    ld, width = lead + p + m + -m % LANES, padded_size(m)
    start, size = SCRATCH + p * ld, update_size(m, width)
    arena = np.full(start + size + 8, np.nan)
    rows = arena[SCRATCH:start].reshape(p, ld)
    rows[:], arena[start : start + size] = 0.0, 0.0
    rows[:, lead : lead + n] = np.triu(front)[:p]
    # Row behind row, each from the column where its group begins.
    update, put = [], start
    for i in range(m):
        first = i - i % GROUP
        assert put == start + update_row(i, width) + first
        update.append(arena[put : put + width - first])
        update[i][: m - first] = front[p + i, p + first :]
        put += width - first
    assert put == start + size
    floors = np.zeros(p) if floors is None else floors
    failed = factor_front(arena, Front(SCRATCH + lead, ld, p, m, start, width), floors, 0, TASK_QUEUE)
    assert np.isnan(arena[-8:]).all()
    result = np.zeros((m, m))
    for i, row in enumerate(update):
        result[i, i:] = row[i % GROUP : i % GROUP + m - i]
    return failed, rows[:, lead : lead + n], result


@_jit.kernel
def _tile(a, rows, vectors, C, X, y):
    tile(a, rows, vectors, C, X, y)


@_jit.kernel
def _six(x, X, y, j, out, to):
    six(x, X, y, j, out, to)


@_jit.kernel
def _solve_tile(a, rows, vectors, c, ld, t):
    solve_tile(a, rows, vectors, c, ld, t)


@_jit.kernel
def _add_run(a, i, j, count):
    add_run(a, i, j, count)


@_jit.kernel
def _zero(a, i, count):
    zero(a, i, count)
