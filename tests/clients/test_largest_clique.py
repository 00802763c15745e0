"""The largest set of consistent ones, against going through all sets."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from factorbus.client.largest_clique import largest_clique


def brute_force(consistent: np.ndarray) -> int:
    count, best = len(consistent), 0
    for bits in range(1 << count):
        members = [k for k in range(count) if bits >> k & 1]
        if all(consistent[a, b] for a in members for b in members if a < b):
            best = max(best, len(members))
    return best


@given(st.integers(0, 9), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_it_is_a_clique_and_no_larger_one_exists(count: int, share: float, seed: int) -> None:
    upper = np.triu(np.random.default_rng(seed).random((count, count)) < share, 1)
    consistent = upper | upper.T
    found = largest_clique(consistent)
    assert found == sorted(set(found))
    assert all(consistent[a, b] for a in found for b in found if a != b)
    assert len(found) == brute_force(consistent)


def test_three_hundred_of_which_most_agree_but_for_some_pairs() -> None:
    """An exact search would not end; what is found lacks few."""
    numbers = np.random.default_rng(5)
    upper = np.triu(numbers.random((300, 300)) < 0.02, 1)
    upper[:180, :180] = np.triu(numbers.random((180, 180)) < 0.997, 1)
    consistent = upper | upper.T
    found = largest_clique(consistent)
    assert all(consistent[a, b] for a in found for b in found if a != b)
    assert len(found) > 100
