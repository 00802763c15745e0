"""Loops, variables and calls of parts in compiled kernels: they come to what Python makes of the same lines."""

from typing import NamedTuple

import numpy as np
import pytest

from factorbus.solver.kernels.jit import compile as _jit


class Pair(NamedTuple):
    """Two arrays that are passed together."""

    rows: np.ndarray
    places: np.ndarray


@_jit.part
def entry(pair, both, k):
    """One number of each array, by way of a record and of a tuple: shapes and strides of what is passed count."""
    rows, places = pair.rows[1:, ::2], both[1]
    return rows[0, k] + 10 * places[-1] + 100 * len(both[0]) + 1000 * pair.rows.size + 10_000 * rows.shape[1]


@_jit.part
def refuse(a, k):
    if a[k] > 8.0:
        raise ValueError("more than eight")
    return a[k]


@_jit.part
def through(a, k):
    """What a part fails with goes through the one that called it."""
    return 2.0 * refuse(a, k)


@_jit.kernel("float64(float64[:,::1], int64[::1], int64)")
def pass_on(rows, places, k):
    return entry(Pair(rows, places), (places, places), k)


@_jit.kernel("float64(float64[::1], int64)")
def doubled(a, k):
    return through(a, k)


@_jit.kernel("int64(int64, int64, int64[::1])")
def walk(begin, end, out):
    """Ranges up, down and by others; one in the other; a variable that a later pass sees as the one before left it."""
    n, last = 0, -7
    for i in range(begin, end):
        for j in range(i):
            out[n] = 100 * i + j + last
            n += 1
        last = i
    for i in range(end, begin, -1):
        out[n], n = i, n + 1
    for i in range(begin, end, 3):
        for j in range(i, begin - 1, -2):
            out[n], n = i - j, n + 1
    if end > begin:
        only = end - begin
        kept = only + 1
    else:
        kept = last
    while kept > 2:
        kept -= 2
        before = kept
        if before == 5:
            continue
        out[n], n = before, n + 1
    return n


def test_parts_see_the_arrays_that_they_are_given():
    rows = np.arange(15.0).reshape(3, 5)
    assert pass_on(rows, np.array([3, 4]), 1) == 7.0 + 40 + 200 + 15_000 + 30_000


@pytest.mark.parametrize(("begin", "end"), [(0, 0), (0, 6), (3, 8), (5, 2), (-4, 1), (2, 3)])
def test_loops_give_the_numbers_that_python_gives(begin, end):
    ours, wanted = np.zeros(300, np.int64), np.zeros(300, np.int64)
    plain = getattr(walk, "py_func", walk)
    assert walk(begin, end, ours) == plain(begin, end, wanted)
    assert ours.tolist() == wanted.tolist()


def test_what_a_part_fails_with_reaches_who_called_the_kernel():
    assert doubled(np.array([4.0, 9.0]), 0) == 8.0
    with pytest.raises(ValueError, match="more than eight"):
        doubled(np.array([4.0, 9.0]), 1)
    assert doubled(np.array([4.0, 8.0]), 1) == 16.0
