"""Minimum degree: a permutation, groups kept, fill as good as exact minimum degree and as CHOLMOD's AMD."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.block_systems import BlockSystem, from_g2o, grid, random_system, systems
from naive.cholmod import cholmod
from naive.elimination import minimum_degree_nonzeros, row_lengths
from scipy.sparse import csc_matrix

from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import analyze


def ordered(system: BlockSystem, group=None) -> np.ndarray:
    return order(system.dims, system.rows, system.cols, group)


@given(systems())
def test_every_variable_is_eliminated_once(system):
    assert sorted(ordered(system)) == list(range(len(system.dims)))


@given(systems(), st.data())
def test_groups_are_eliminated_one_after_another(system, data):
    n = len(system.dims)
    group = np.array(data.draw(st.lists(st.integers(0, 3), min_size=n, max_size=n)), np.int64)
    perm = ordered(system, group)
    assert sorted(perm) == list(range(n))
    assert np.all(np.diff(group[perm]) >= 0)


@given(systems())
def test_fill_is_near_that_of_exact_minimum_degree(system):
    exact = minimum_degree_nonzeros(system)
    assert row_lengths(system, ordered(system)).sum() <= 1.25 * exact + 50


def test_a_tree_has_no_fill():
    tree = random_system(3, [3] * 200, [((v - 1) // 3, v) for v in range(1, 200)])
    assert row_lengths(tree, ordered(tree)).sum() == 200 * 6 + 199 * 9


def test_a_dense_variable_goes_last():
    star = random_system(1, [3] + [2] * 300, [(0, v) for v in range(1, 301)])
    assert ordered(star)[-1] == 0


def test_a_dense_variable_goes_last_of_its_group():
    star = random_system(1, [3] + [2] * 300, [(0, v) for v in range(1, 301)])
    group = np.zeros(301, np.int64)
    group[7] = 1
    assert list(ordered(star, group)[-2:]) == [0, 7]


@pytest.mark.parametrize("system", [grid(20, 3), grid(30, 6), grid(45, 2)], ids=["20 x 3", "30 x 6", "45 x 2"])
def test_fill_of_grids_is_that_of_cholmod(system):
    assert fill(system) <= 1.05 * cholmod_fill(system)


@pytest.mark.data
@pytest.mark.parametrize("name", ["intel", "manhattan3500", "city10000", "sphere2500", "victoria_park"])
def test_fill_of_real_maps_is_that_of_cholmod(datasets, name):
    system = from_g2o(datasets / f"{name}.g2o")
    assert fill(system) <= 1.05 * cholmod_fill(system)


def test_lists_that_do_not_fit_are_compacted():
    """Many elements are alive at once in a random graph, so the room for lists runs out on the way."""
    rng = np.random.default_rng(5)
    pairs = {tuple(sorted(pair)) for pair in rng.integers(0, 400, (3000, 2)).tolist() if pair[0] != pair[1]}
    system = random_system(2, [1] * 400, sorted(pairs))
    perm = ordered(system)
    assert sorted(perm) == list(range(400))
    assert row_lengths(system, perm).sum() <= 1.05 * cholmod_fill(system)


def test_no_variables():
    nothing = np.empty(0, np.int64)
    assert order(nothing, nothing, nothing).shape == (0,)


@pytest.mark.parametrize(
    ("dims", "rows", "cols", "group", "what"),
    [
        ([3, 0], [0], [1], None, "at least one"),
        ([3, 3], [0, 1], [1], None, "one of each"),
        ([3, 3], [0], [2], None, "only 0 to 1"),
        ([3, 3], [-1], [1], None, "only 0 to 1"),
        ([3, 3], [0], [1], [0], "2 of 0 or more"),
        ([3, 3], [0], [1], [0, -1], "2 of 0 or more"),
        ([[3, 3]], [0], [1], None, "one-dimensional"),
    ],
)
def test_what_the_kernel_could_not_survive_is_refused(dims, rows, cols, group, what):
    with pytest.raises(ValueError, match=what):
        order(np.array(dims), np.array(rows), np.array(cols), None if group is None else np.array(group))


def fill(system: BlockSystem) -> int:
    return analyze(system.dims, system.rows, system.cols, ordered(system)).nnz_r


def cholmod_fill(system: BlockSystem) -> int:
    matrix = csc_matrix(system.sparse())
    factor = cholmod().analyze(matrix, mode="simplicial", ordering_method="amd")
    factor.cholesky_inplace(matrix)
    return factor.L().nnz
