"""Back-substitution of one clique against NumPy, whatever lies beside its rows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.back_substitute import solve_rows

ROWS_AT, GAP = 3, 4


@given(st.integers(1, 13), st.integers(0, 20), st.integers(0, 2**32 - 1))
def test_a_clique_is_solved_like_a_dense_system(p: int, m: int, seed: int) -> None:
    assert_solved(p, m, seed)


@pytest.mark.parametrize(("p", "m"), [(300, 0), (301, 7), (302, 500)])
def test_a_wide_one_too(p: int, m: int) -> None:
    assert_solved(p, m, seed=p)


def assert_solved(p: int, m: int, seed: int) -> None:
    """Whatever belongs to nobody is NaN."""
    rng = np.random.default_rng(seed)
    pivots = np.triu(rng.normal(size=(p, p)) / p, 1) + np.diag(rng.choice([-1.0, 1.0], p) * rng.uniform(1.0, 2.0, p))
    separator, above, right = rng.normal(size=(p, m)), rng.normal(size=m), rng.normal(size=p)
    ld = p + m + 1 + GAP
    numbers = np.full(ROWS_AT + p * ld + p + m + GAP, np.nan)
    for i in range(p):
        start = ROWS_AT + i * ld
        numbers[start + i : start + p + m + 1] = *pivots[i, i:], *separator[i], right[i]
    used = ROWS_AT + p * ld
    numbers[used + p : used + p + m] = above
    before = numbers.copy()
    row = np.zeros(tl.C_WIDTH, np.int64)
    row[[tl.C_PIVOTS, tl.C_SEPARATOR_SCALARS, tl.C_ROWS, tl.C_LD, tl.C_USED]] = p, m, ROWS_AT, ld, used
    solve_rows(row, numbers, np.full(p, np.nan))
    expected = np.linalg.solve(pivots, right - separator @ above)
    np.testing.assert_allclose(numbers[used : used + p], expected, rtol=1e-9, atol=1e-9)
    before[used : used + p] = numbers[used : used + p]
    np.testing.assert_array_equal(numbers, before)
