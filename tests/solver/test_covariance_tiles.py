"""The tiles that move numbers, compiled, against what they mean."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from factorbus.solver.covariance.kernels import tiles, tiles_plain
from factorbus.solver.covariance.kernels.compile import DISABLED, F64, I64, kernel
from factorbus.solver.kernels.jit.simd import LANES

pytestmark = pytest.mark.skipif(DISABLED, reason="without compilation these are the plain ones")


@kernel("void(float64[::1], int64, int64, int64, int64, int64, int64, boolean)")
def turn(a: F64, rows: int, columns: int, source: int, step: int, target: int, ld: int, negative: bool) -> None:
    if negative:
        tiles.transpose_negative(a, rows, columns, source, step, target, ld)
    else:
        tiles.transpose(a, rows, columns, source, step, target, ld)


@kernel("void(float64[::1], int64, int64, int64, int64, int64, int64[::1])")
def move(a: F64, rows: int, target: int, ldt: int, source: int, lds: int, runs: I64) -> None:
    tiles.copy_runs(a, rows, target, ldt, source, lds, runs)


def up(count: int, multiple: int) -> int:
    return -(-count // multiple) * multiple


@examples(100)
@given(rows=st.integers(0, 30), columns=st.integers(0, 30), negative=st.booleans(), seed=st.integers(0, 99))
def test_a_transpose_of_any_size(rows: int, columns: int, negative: bool, seed: int) -> None:
    """All of it is right, and what is behind whole runs of the target's rows, and its other rows, stays."""
    step, ld = up(columns, LANES) + LANES, up(rows, LANES) + LANES
    target = (rows + 1) * step
    a = np.random.default_rng(seed).normal(size=target + (columns + 2) * ld)
    wanted = a.copy()
    (tiles_plain.transpose_negative if negative else tiles_plain.transpose)(wanted, rows, columns, 0, step, target, ld)
    turn(a, rows, columns, 0, step, target, ld, negative)
    for found in (a, wanted):
        found[target:].reshape(-1, ld)[:columns, rows : up(rows, min(4, LANES))] = 0.0
    np.testing.assert_array_equal(a, wanted)


@examples(50)
@given(rows=st.integers(1, 4), count=st.integers(0, 9), seed=st.integers(0, 99))
def test_runs_of_some_rows(rows: int, count: int, seed: int) -> None:
    rng, lds, ldt = np.random.default_rng(seed), 50, 40
    a = rng.normal(size=4 * (lds + ldt))
    runs = np.column_stack([rng.integers(0, lds - 4, count + 1), rng.integers(0, ldt - 4, count + 1)]).reshape(-1)
    wanted = a.copy()
    tiles_plain.copy_runs(wanted, rows, 4 * lds, ldt, 0, lds, runs[2:])
    move(a, rows, 4 * lds, ldt, 0, lds, runs[2:])
    np.testing.assert_array_equal(a, wanted)
