"""Lists of indices in ascending order."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from factorbus.solver.kernels.jit.sorting import SPARSE, put_in_order, sort


@given(st.lists(st.integers(-9, 9) | st.integers(-(2**62), 2**62)))
def test_sort(numbers: list[int]) -> None:
    sorted_ = np.array(numbers, np.int64)
    sort(sorted_)
    assert sorted_.tolist() == sorted(numbers)


@given(st.lists(st.integers(0, 299), min_size=5, unique=True), st.integers(300, 5 * SPARSE))
def test_put_in_order(indices: list[int], count: int) -> None:
    ordered = np.array(indices)
    assert put_in_order(ordered, count)
    assert ordered.tolist() == sorted(indices)


def test_few_stay_as_they_are() -> None:
    few = np.array([7, 3])
    assert not put_in_order(few, 2 * SPARSE + 1)
    assert few.tolist() == [7, 3]
    assert put_in_order(few, 2 * SPARSE)
    assert few.tolist() == [3, 7]
