"""A form over variables of any kinds, and its pieces: they sum to it wherever the variables are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_factors import TANGENT, boxminus, boxplus, residual
from naive.dense_least_squares import full
from naive.random_graphs import random_value

from factorbus.pieces import Pieces, as_pieces, cut, tangent_dims
from factorbus.proto.kinds import FACTOR_KINDS

SPACES = {"plane": ("se2", "point2"), "space": ("se3", "point3", "idp")}
seeds = st.integers(0, 2**32 - 1)


def summed(groups: list[Pieces], at: list[np.ndarray]) -> tuple[float, float]:
    """(χ², the sum of what each counts without its sign) of pieces whose keys are the places in `at`."""
    total = size = 0.0
    for group in groups:
        assert group.measured.shape[1] == FACTOR_KINDS[group.kind].size
        assert group.information.shape[1] == FACTOR_KINDS[group.kind].information_size
        for keys, z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            r = residual(group.kind, [at[key] for key in keys], z)
            chi2 = r @ full(upper) @ r
            total, size = total + chi2, size + abs(chi2)
    return total, size


def drawn(space: str, n: int, rng: np.random.Generator) -> tuple[list[str], list[np.ndarray]]:
    kinds = [str(kind) for kind in rng.choice(SPACES[space], n)]
    return kinds, [random_value(kind, rng) for kind in kinds]


def moved(
    kinds: list[str], y: list[np.ndarray], far: float, rng: np.random.Generator
) -> tuple[list[np.ndarray], np.ndarray]:
    """(values, e = x ⊟ y)."""
    at = [boxplus(kind, row, far * rng.normal(size=TANGENT[kind])) for kind, row in zip(kinds, y, strict=True)]
    return at, np.concatenate([boxminus(kind, x, row) for kind, x, row in zip(kinds, at, y, strict=True)])


@pytest.mark.parametrize("space", SPACES)
@given(seed=seeds)
def test_the_pieces_sum_to_the_form_wherever_its_variables_are(space: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 9))
    kinds, y = drawn(space, n, rng)
    width = sum(tangent_dims(kinds))
    units = 10.0 ** rng.uniform(-2, 3, width)
    A = rng.normal(size=(int(rng.integers(1, width + 1)), width)) * units
    A[:, rng.integers(width)] = 0.0  # something of which nothing is known
    b = rng.normal(size=len(A))
    Lambda, eta = A.T @ A, A.T @ b
    groups = cut(kinds, np.arange(n), y, Lambda, eta)
    assert sum(int((g.information[:, 0] < 0).sum()) for g in groups) == n
    U, told, _ = np.linalg.svd(A / units, full_matrices=False)
    least = float(((U[:, told > 1e-9 * told[0]].T @ b) ** 2).sum())
    for far in (0.0, 1e-3, 0.3):
        at, e = moved(kinds, y, far, rng)
        total, size = summed(groups, at)
        assert abs(total - (e @ Lambda @ e - 2 * eta @ e + least)) < 1e-11 * size + 1e-7 * least


@pytest.mark.parametrize("space", SPACES)
@given(seed=seeds)
def test_any_rows_of_any_variables_are_sent_whole(space: str, seed: int) -> None:
    """In one piece where there are few rows of one or two, in a few of positive weight, in many of both."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 7)), int(rng.integers(1, 20))
    kinds, y = drawn(space, n, rng)
    dims = tangent_dims(kinds)
    H, b = rng.normal(size=(m, sum(dims))), rng.normal(size=m)
    groups = as_pieces(kinds, np.arange(n), y, H, b)
    if n <= 2:
        assert len(groups) == 1 or m > min(dims)
        assert all((g.information[:, 0] > 0).all() for g in groups)
        assert len(groups) <= 3
    for far in (0.0, 1e-3, 0.3):
        at, e = moved(kinds, y, far, rng)
        total, size = summed(groups, at)
        assert abs(total - float(((H @ e + b) ** 2).sum())) < 1e-11 * size + 1e-12


def test_what_is_of_no_one_space_is_refused() -> None:
    with pytest.raises(ValueError, match="all of the plane"):
        tangent_dims(["se2", "point3"])
    with pytest.raises(ValueError, match="no kind of variable"):
        tangent_dims(["se4"])
