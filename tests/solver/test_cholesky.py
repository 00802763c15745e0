"""The factorization and the solves against dense and CHOLMOD ones, damping, failures, reuse of arenas."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.block_systems import BlockSystem, from_edges, from_g2o, grid, pack, random_system, systems
from naive.cholmod import cholmod
from scipy.sparse import csc_matrix

from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import Symbolic, analyze

KEPT = Cholesky()  # all tests share it: what one leaves in the arenas must not reach the next


def analysis(system: BlockSystem, perm=None) -> Symbolic:
    perm = order(system.dims, system.rows, system.cols) if perm is None else perm
    return analyze(system.dims, system.rows, system.cols, perm)


def factorized(system: BlockSystem, perm=None, damping: float = 0.0) -> tuple[Cholesky, Symbolic]:
    symbolic = analysis(system, perm)
    assert KEPT.factorize(symbolic, system.data, system.offsets, damping) == -1
    return KEPT, symbolic


@given(systems(), st.data())
def test_r_is_the_cholesky_factor_in_any_order(system, data):
    perm = np.array(data.draw(st.permutations(range(len(system.dims)))), np.int64)
    cholesky, symbolic = factorized(system, perm)
    R, q = cholesky.R().toarray(), symbolic.scalar_order()
    np.testing.assert_allclose(R, np.linalg.cholesky(system.dense()[q][:, q]).T, atol=1e-9)


@given(systems(), st.integers(0, 2**32 - 1))
def test_solve_is_the_dense_solution(system, seed):
    cholesky, _ = factorized(system)
    eta = np.random.default_rng(seed).normal(size=int(system.dims.sum()))
    np.testing.assert_allclose(cholesky.solve(eta), np.linalg.solve(system.dense(), eta), rtol=1e-8, atol=1e-9)


@given(systems(), st.floats(0.0, 1e3))
def test_damping_multiplies_the_diagonal(system, damping):
    cholesky, _ = factorized(system, damping=damping)
    damped = system.dense() + damping * np.diag(np.diag(system.dense()))
    eta = np.ones(len(damped))
    np.testing.assert_allclose(cholesky.solve(eta), np.linalg.solve(damped, eta), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    "system",
    [
        grid(60, 3),
        grid(25, 6),
        random_system(4, [1] * 40, [(i, j) for i in range(40) for j in range(i + 1, 40)]),
        random_system(5, [6] * 90, [(i, j) for i in range(90) for j in range(i + 1, 90)]),
        random_system(6, [3] * 500, [(v, v + 1) for v in range(499)]),
        random_system(7, [3] + [2] * 400, [(0, v) for v in range(1, 401)]),
    ],
    ids=["60 x 60 of 3", "25 x 25 of 6", "full of 1", "full of 6", "chain", "star"],
)
def test_larger_systems_agree_with_cholmod(system):
    cholesky, _ = factorized(system)
    assert_agrees_with_cholmod(cholesky, system)


@pytest.mark.data
@pytest.mark.parametrize("name", ["intel", "manhattan3500", "city10000", "sphere2500"])
def test_real_maps_agree_with_cholmod(datasets, name):
    system = from_g2o(datasets / f"{name}.g2o")
    cholesky, _ = factorized(system)
    assert_agrees_with_cholmod(cholesky, system)


def test_forward_and_back_are_the_two_halves():
    system = random_system(8, [2, 3, 6, 3], [(0, 1), (1, 2), (2, 3), (0, 3)])
    cholesky, symbolic = factorized(system)
    R, q, eta = cholesky.R().toarray(), symbolic.scalar_order(), np.arange(14.0)
    d = cholesky.forward(eta)
    np.testing.assert_allclose(R.T @ d, eta[q], atol=1e-12)
    delta = cholesky.back(d)
    np.testing.assert_allclose(R @ delta[q], d, atol=1e-12)


def test_new_values_and_new_patterns_in_the_same_arenas():
    cholesky = Cholesky()
    for size in (12, 4, 20, 12):
        system = grid(size)
        symbolic = analysis(system)
        for scale in (1.0, 3.0):
            assert cholesky.factorize(symbolic, scale * system.data, system.offsets) == -1
            eta = np.ones(symbolic.size)
            np.testing.assert_allclose(system.sparse() @ cholesky.solve(eta) * scale, eta, atol=1e-9)


def test_blocks_may_lie_anywhere():
    """Offsets say where, with holes and in any order."""
    system = random_system(9, [3, 2, 6], [(0, 1), (1, 2)])
    data, offsets = np.full(1000, np.nan), system.offsets[::-1] * 5 + 3
    for (_, _, block), at in zip(system.blocks(), offsets.tolist(), strict=True):
        data[at : at + block.size] = block.ravel()
    symbolic = analysis(system)
    assert KEPT.factorize(symbolic, data, offsets) == -1
    np.testing.assert_allclose(KEPT.solve(np.ones(11)), np.linalg.solve(system.dense(), np.ones(11)), rtol=1e-9)


@given(systems(most=8), st.data())
def test_an_indefinite_variable_is_named(system, data):
    """Eliminated last, the variable made indefinite must be the one that is named."""
    n = len(system.dims)
    bad = data.draw(st.integers(0, n - 1))
    blocks = {(i, j): block.copy() for i, j, block in system.blocks()}
    scalar = data.draw(st.integers(0, int(system.dims[bad]) - 1))
    blocks[bad, bad][scalar, scalar] *= -1.0
    broken = pack(system.dims, blocks)
    perm = np.array([v for v in range(n) if v != bad] + [bad], np.int64)
    assert KEPT.factorize(analysis(broken, perm), broken.data, broken.offsets) == bad
    with pytest.raises(ValueError, match="no factor"):
        KEPT.solve(np.ones(int(system.dims.sum())))
    factorized(system)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("scalar", range(6))
def test_what_is_not_a_number_is_named(value, scalar):
    system = random_system(10, [2, 6, 3], [(0, 1), (1, 2)])
    blocks = {(i, j): block.copy() for i, j, block in system.blocks()}
    blocks[1, 1][scalar, scalar] = value
    broken = pack(system.dims, blocks)
    assert KEPT.factorize(analysis(broken, np.array([1, 0, 2])), broken.data, broken.offsets) == 1


@pytest.mark.parametrize("side", [2, 5, 10])
@pytest.mark.parametrize("anchored", [True, False])
def test_a_map_that_nothing_holds_is_singular(side, anchored):
    """Relative measurements alone fix no place: three pivots are zero but for rounding."""
    information, edges = np.diag([100.0, 100.0, 2500.0]), []
    if anchored:
        edges.append((-1, 0, np.eye(3), np.eye(3), information))
    for v in range(side * side):
        if v % side < side - 1:
            edges.append((v, v + 1, -step(1.0, 0.0), np.eye(3), information))
        if v < side * (side - 1):
            edges.append((v, v + side, -step(0.0, 1.0), np.eye(3), information))
    system = from_edges([3] * side**2, edges)
    symbolic = analysis(system)
    failed = KEPT.factorize(symbolic, system.data, system.offsets)
    assert failed == (-1 if anchored else symbolic.order[-1])


def test_a_free_variable_is_named_and_damping_does_not_hide_it():
    system = random_system(11, [3, 3, 2], [(0, 1)])
    blocks = {(i, j): block for i, j, block in system.blocks()}
    blocks[2, 2] = np.zeros((2, 2))
    broken = pack(system.dims, blocks)
    assert KEPT.factorize(analysis(broken), broken.data, broken.offsets) == 2
    assert KEPT.factorize(analysis(broken), broken.data, broken.offsets, 1.0) == 2


def test_a_long_chain_held_at_one_end_is_not_singular():
    """Poor is not singular: eliminated from its anchor on, the last pose leaves a pivot of 3e-10 of its diagonal."""
    information = np.diag([100.0, 100.0, 2500.0])
    edges = [(-1, 0, np.eye(3), np.eye(3), information)]
    edges += [(v, v + 1, -step(1.0, 0.0), np.eye(3), information) for v in range(9999)]
    system = from_edges([3] * 10000, edges)
    assert KEPT.factorize(analysis(system, np.arange(10000)), system.data, system.offsets) == -1


def test_vectors_of_another_length_are_refused():
    system = grid(2)
    cholesky, _ = factorized(system)
    with pytest.raises(ValueError, match="12 scalars"):
        cholesky.solve(np.ones(13))
    with pytest.raises(ValueError, match="no factor"):
        Cholesky().solve(np.ones(1))


def test_blocks_outside_the_data_are_refused():
    system = grid(2)
    symbolic = analysis(system)
    for data, offsets, what in (
        (system.data[:-1], system.offsets, "reach from 0 to"),
        (system.data, system.offsets - 1, "reach from -1"),
        (system.data, system.offsets[1:], "7 offsets for the 8 blocks"),
    ):
        with pytest.raises(ValueError, match=what):
            KEPT.factorize(symbolic, data, offsets)


def test_arrays_that_may_not_be_written_are_taken():
    system = grid(3)
    for array in (system.dims, system.rows, system.cols, system.data, system.offsets):
        array.flags.writeable = False
    cholesky, symbolic = factorized(system)
    eta = np.ones(symbolic.size)
    eta.flags.writeable = False
    np.testing.assert_allclose(system.sparse() @ cholesky.solve(eta), eta, atol=1e-9)


def test_no_variables():
    cholesky, symbolic = factorized(random_system(0, [], []))
    assert symbolic.nnz_r == 0
    assert cholesky.solve(np.empty(0)).shape == (0,)
    assert cholesky.R().shape == (0, 0)


@pytest.mark.parametrize("variable", ["NUMBA_BOUNDSCHECK", "NUMBA_DISABLE_JIT"])
def test_small_systems_with_every_index_checked_and_without_compilation(variable):
    here = Path(__file__).parent
    script = "import naive.small_systems as small; print(small.check())"
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        env={**os.environ, variable: "1", "PYTHONPATH": str(here.parent)},
        capture_output=True,
        text=True,
        timeout=110,
    )
    assert run.returncode == 0, run.stderr
    assert float(run.stdout) < 1e-9


def step(x: float, y: float) -> np.ndarray:
    """Ad(z⁻¹) of a move by (x, y) without a turn."""
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])


def assert_agrees_with_cholmod(cholesky: Cholesky, system: BlockSystem) -> None:
    matrix, eta = csc_matrix(system.sparse()), np.random.default_rng(1).normal(size=int(system.dims.sum()))
    expected = cholmod().analyze(matrix)
    expected.cholesky_inplace(matrix)
    expected = expected(eta)
    assert np.abs(cholesky.solve(eta) - expected).max() <= 1e-10 * np.abs(expected).max()
