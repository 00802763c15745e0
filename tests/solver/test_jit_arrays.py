"""Arrays that compiled kernels are given, make and give back: none goes too soon, none is kept."""

import sys

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

from factorbus.solver.kernels.jit import compile as _jit


@_jit.part
def larger(a, n):
    """`a`, or a copy with room for n: the result may be the argument."""
    if a.size >= n:
        return a
    b = np.zeros(n)
    for k in range(a.size):
        b[k] = a[k]
    return b


@_jit.part
def first_row(rows):
    return rows[0]


@_jit.kernel("float64(float64[:,::1], int64)")
def sum_of_first(rows, n):
    """Of its own arrays none may go too soon, whatever function has passed them on."""
    own = larger(first_row(rows).copy(), 0)
    for k in range(n):
        own = larger(first_row(np.ones((1, 1))) if k == 0 else own, k)
    total = 0.0
    for k in range(own.size):
        total += own[k]
    return total


@_jit.kernel("Tuple((float64, float64[::1]))(float64[:,::1])")
def last_row(rows):
    return rows[0, 0], rows[len(rows) - 1]


@pytest.mark.skipif(_jit.DISABLED, reason="without compilation Python counts")
def test_arrays_live_as_long_as_they_are_used():
    rows = np.ones((2, 3))
    sum_of_first(rows, 0)
    before = sys.getrefcount(rows)
    for n in (0, 5, 5000):
        assert sum_of_first(rows, n) == (3.0 if n == 0 else 1.0)
    assert sys.getrefcount(rows) == before
    _, row = last_row(rows)
    del rows
    spoiled = [np.full((2, 3), 7.0) for _ in range(100)]
    assert row.tolist() == [1.0, 1.0, 1.0]
    assert len(spoiled) == 100
    pair = np.ones((2, 3))
    last_row(pair)
    before = sys.getrefcount(pair)
    for _ in range(10):
        last_row(pair)
    assert sys.getrefcount(pair) == before, "a row that is returned is counted, and released again"


@_jit.kernel("void(float64[:,::1], float64[::1], int64[::1], float64[:,:,::1], int64, uint64, int32)")
def put_numbers(a, b, c, d, i, j, k):
    """Every way in which a kernel names one number of an array: of one, two and three dimensions."""
    a[i, j] = 1
    a[k, 0] = a[i, j] + 1.5
    a[-1, i] = a[0, 2]
    a[1, -1] = True
    b[i] = a[k, 0]
    b[0] += a[-1, i]
    b[-1] = i
    c[j] = 2.75
    c[k] = c[j] + b[i] * 3
    d[i, j, k] = c[k]
    d[0, 1, j - 1] = d[i, j, k] + d[1, -1, 0]


def test_numbers_of_arrays_are_those_that_python_puts_there():
    def arrays():
        return np.arange(12.0).reshape(3, 4), np.arange(4.0), np.arange(5), np.arange(24.0).reshape(2, 3, 4)

    found, wanted = arrays(), arrays()
    put_numbers(*found, 1, np.uint64(2), np.int32(3 - 1))
    getattr(put_numbers, "py_func", put_numbers)(*wanted, 1, 2, 2)
    for ours, pythons in zip(found, wanted, strict=True):
        assert ours.tolist() == pythons.tolist()


@_jit.kernel("float64(float64[:,::1], int64[::1])")
def first_of_chosen(rows, some):
    """A choice of rows is a copy of them, and no call has made it."""
    return rows[some][0, 0]


@_jit.kernel("float64(float64[:,::1])")
def first_of_sum(rows):
    return (rows[0] + rows[1])[0]


@pytest.mark.skipif(_jit.DISABLED, reason="without compilation Python counts")
@pytest.mark.parametrize(("kernel", "more"), [(first_of_chosen, (np.ones(1, int),)), (first_of_sum, ())])
def test_what_is_copied_in_passing_is_given_back(kernel, more):
    rows = np.ones((2, 3))
    assert kernel(rows, *more) == 1.0 + (not more)
    _nrt_python.memsys_enable_stats()
    before, references = rtsys.get_allocation_stats(), sys.getrefcount(rows)
    for _ in range(10):
        kernel(rows, *more)
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0
    assert sys.getrefcount(rows) == references


@_jit.kernel("void(float64[:,::1], float64[::1])")
def put_row(rows, row):
    rows[1] = row


@_jit.kernel("void(float64[:,::1], float64[::1])")
def put_slice(rows, row):
    rows[0, 1:] = row


@pytest.mark.skipif(_jit.DISABLED or _jit.STOCK, reason="Python, and Numba as it is, assign arrays")
@pytest.mark.parametrize("kernel", [put_row, put_slice])
def test_an_array_that_is_assigned_to_a_part_of_another_is_refused(kernel):
    with pytest.raises(
        NotImplementedError, match="assigned to a part of another array; a kernel copies number by number"
    ):
        kernel(np.zeros((2, 3)), np.ones(3))
