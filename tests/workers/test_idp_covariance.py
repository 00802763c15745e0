"""Three computations of one covariance: the same result, counted multiplications, the same bits in any shards."""

import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive import dense_idp
from naive.random_cameras import CAMERAS, random_observations

from factorbus import idp
from factorbus.idp import classical, independent, minimal
from factorbus.proto.features import Observations

seeds = st.integers(0, 2**32 - 1)


def everything(observations: Observations, P: np.ndarray) -> tuple[classical.Counted, ...]:
    """(classical, independent, minimal)."""
    seen = idp.see(observations)
    A, B = idp.jacobians(observations, seen)
    padd = idp.padd(observations)
    return (
        classical.covariance(P, A, B, padd),
        independent.covariance(P, A, B, padd),
        minimal.covariance(P, observations, seen),
    )


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(("n", "existing"), [(1, 0), (3, 0), (7, 1), (2, 30)])
def test_the_three_are_one(n: int, existing: int, camera: str) -> None:
    observations, P = random_observations(n, n, existing, camera)
    A, B = idp.jacobians(observations, idp.see(observations))
    wanted = dense_idp.added(P, A, B, idp.padd(observations))
    for found in everything(observations, P):
        np.testing.assert_allclose(found.P, wanted, rtol=0, atol=1e-12 * abs(wanted).max())


@pytest.mark.parametrize(("n", "existing"), [(1, 200), (5, 120), (40, 3)])
def test_the_three_are_one_with_many_features_in_the_state(n: int, existing: int) -> None:
    first, second, third = (found.P for found in everything(*random_observations(n, n, existing)))
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-12 * abs(first).max())
    np.testing.assert_allclose(third, first, rtol=0, atol=1e-12 * abs(first).max())


@settings(max_examples=40)
@given(seed=seeds, n=st.integers(1, 6), existing=st.integers(0, 12))
def test_the_three_are_one_on_random_states(seed: int, n: int, existing: int) -> None:
    observations, P = random_observations(seed, n, existing)
    first, second, third = (found.P for found in everything(observations, P))
    scale = abs(first).max()
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(third, first, rtol=0, atol=1e-12 * scale)


def test_the_paper_s_counts_come_out_and_ours_is_below() -> None:
    counts = [found.multiplications for found in everything(*random_observations(1, 3))]
    assert counts[:2] == [87_702, 10_782]
    assert counts[2] == 468


@pytest.mark.parametrize("n", [1, 2, 5, 20])
def test_counts_follow_the_paper_s_formulas(n: int) -> None:
    """The formulas of its Figure 9; the counts come from the code that runs."""
    classical_, independent_, minimal_ = everything(*random_observations(n, n))
    sizes = [(19 + 6 * k, 16 + 6 * k) for k in range(n)]
    assert classical_.multiplications == sum(a * b * b + a * a * b for a, b in sizes)
    assert independent_.multiplications == 2190 * n + 468 * n * n
    assert minimal_.multiplications == 12 * 13 + 24 + n * (24 + 10 + 4 * 10 + 6) + 8 * n * (n - 1)


COUNTING = """
import numpy as np
from naive.random_cameras import random_observations
from factorbus import idp
from factorbus.idp import classical, independent, minimal
from factorbus.idp.kernels import minimal as kernels
from factorbus.idp.kernels.dense import counted_product
from factorbus.idp.kernels import independent as rows

class Number:
    made = 0
    def __init__(self, x): self.x = x
    def __mul__(self, other): Number.made += 1; return Number(self.x * value(other))
    __rmul__ = __mul__
    def __add__(self, other): return Number(self.x + value(other))
    __radd__ = __add__
    def __sub__(self, other): return Number(self.x - value(other))
    def __rsub__(self, other): return Number(value(other) - self.x)

def value(x): return x.x if isinstance(x, Number) else x
def counting(a): return np.vectorize(Number, otypes=[object])(np.asarray(a, float))
def room(*shape): return np.full(shape, None)
def check(name, said):
    print(name, said, Number.made)
    Number.made = 0

n, m = 4, 25
observations, P = random_observations(9, n, 2)
seen = idp.see(observations)
A, B = idp.jacobians(observations, seen)
padd = idp.padd(observations)
J, padded = classical.step_matrices(P, A[0], B[0], padd)
check("classical", counted_product(counting(J), counting(padded), room(*J.shape)))
At = A.transpose(2, 0, 1).reshape(13, -1)
out = room(m + 6 * n, m + 6 * n)
counts = np.zeros(rows.COUNTS, np.int64)
rows.camera_blocks(0, n, counting(P[:13]), counting(A), out, counts)
rows.feature_blocks(0, n, counting(At), out, counts)
rows.add_own_blocks(0, n, counting(B), counting(padd), room(12, 6), out, counts)
check("independent", counts.sum())
U, S, V, W, own = room(6, m), room(3, 3), room(n, 6), room(n, 6), room(n, 3)
turn, slope = counting(seen.turn), counting(seen.slope)
x = observations.state
check("share", kernels.share(x, counting(P[:13]), U, S))
check("spread", kernels.feature_factors(0, turn, U, S, V, W))
check("own", kernels.own_variances(slope, 1.5, own))
factors = kernels.RowFactors(turn, U, V, W, own)
check("rows", kernels.full_rows(factors, 0, n, 1.0, room(6 * n, m + 6 * n)))
check("half", kernels.half_rows(
    factors, 1, n, 1.0, room(6 * (n - 1), m), room(36 * minimal.blocks_in(n, 1, n))))
"""


def test_what_is_counted_is_what_is_multiplied() -> None:
    """The kernels' own code on numbers that count their multiplications, uncompiled."""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
    ran = subprocess.run(
        [sys.executable, "-c", COUNTING], env=environment, capture_output=True, text=True, timeout=100, check=False
    )
    assert ran.returncode == 0, ran.stderr
    rows = [line.split() for line in ran.stdout.splitlines()]
    assert [name for name, *_ in rows] == ["classical", "independent", "share", "spread", "own", "rows", "half"]
    for name, said, made in rows:
        assert int(said) == int(made) > 0, name


@settings(max_examples=25)
@given(seed=seeds, n=st.integers(1, 30), existing=st.integers(0, 3), data=st.data())
def test_any_shards_have_the_bits_of_the_whole(seed: int, n: int, existing: int, data: st.DataObject) -> None:
    observations, P = random_observations(seed, n, existing)
    seen = idp.see(observations)
    m = observations.width
    whole = minimal.covariance(P, observations, seen).P
    parts = minimal.FeatureRows(observations, seen)
    cuts = sorted({0, n, *data.draw(st.lists(st.integers(0, n), max_size=4))})
    for first, last in pairwise(cuts):
        out = np.full((6 * (last - first), m + 6 * n), np.nan)
        parts.rows(first, last, out)
        assert out.tobytes() == whole[m + 6 * first : m + 6 * last].tobytes()
        half = minimal.FeatureRows(observations, seen, first).half(first, last)
        assert half.cross.tobytes() == np.ascontiguousarray(out[:, :m]).tobytes()
        at = 0
        for i in range(first, last):
            width = 6 * (n - i)
            block = half.blocks[at : at + 6 * width].reshape(6, width)
            at += 6 * width
            np.testing.assert_array_equal(block, out[6 * (i - first) : 6 * (i - first) + 6, m + 6 * i :])
        assert at == half.blocks.size
        factored = minimal.covariance_factors(observations, seen, first, last)
        assert factored.own.tobytes() == minimal.covariance_factors(observations, seen).own[first:last].tobytes()


@settings(max_examples=25)
@given(seed=seeds, n=st.integers(1, 20), existing=st.integers(0, 6))
def test_p_is_symmetric_to_the_bit_and_positive_semidefinite(seed: int, n: int, existing: int) -> None:
    observations, P = random_observations(seed, n, existing)
    after = minimal.covariance(P, observations, idp.see(observations)).P
    assert np.array_equal(after, after.T)
    values = np.linalg.eigvalsh(after)
    assert values[0] >= -1e-13 * values[-1]
    # Three numbers a feature are new (u, v, ρ); its anchor is the camera's position again.
    assert np.linalg.matrix_rank(after, hermitian=True) <= len(P) + 3 * n


def test_the_factored_form_has_o_of_n_numbers_and_gives_every_block() -> None:
    n, existing = 20, 4
    observations, P = random_observations(11, n, existing)
    seen = idp.see(observations)
    found = minimal.covariance_factors(observations, seen)
    numbers = sum(array.size for array in found[:4])
    assert numbers == 6 * observations.width + 9 + 7 * n
    whole = minimal.covariance(P, observations, seen).P
    for i, k in [(0, 0), (3, 17), (17, 3), (19, 19)]:
        G_i, G_k = turned(found.turn[i]), turned(found.turn[k])
        block = np.zeros((6, 6))
        block[:3, :3] = P[:3, :3]
        block[3:5, :3], block[:3, 3:5] = G_i @ found.U[3:, :3], (G_k @ found.U[3:, :3]).T
        block[3:5, 3:5] = G_i @ found.S @ G_k.T
        if i == k:
            block[3:5, 3:5] += found.own[i][[[0, 1], [1, 2]]]
            block[5, 5] = observations.sigma_rho**2
        m = observations.width
        np.testing.assert_allclose(block, whole[m + 6 * i :, m + 6 * k :][:6, :6], atol=1e-14)


def turned(turn: np.ndarray) -> np.ndarray:
    a, b, c, d = turn
    return np.array([[a, 1, b], [c, 0, -d]])


def test_monte_carlo_agrees_with_the_predicted_covariance_of_the_ray() -> None:
    """20,000 initializations of one feature with the noise that P and Padd describe."""
    rng = np.random.default_rng(12)
    observations, P = random_observations(12, 1)
    P = 1e-4 * P  # small enough that the feature is linear in its causes
    observations = Observations(
        observations.camera,
        observations.state,
        P[:13],
        observations.pixels,
        observations.rho,
        observations.sigma_rho,
        0.5,
    )
    predicted = minimal.covariance(P, observations, idp.see(observations)).P[-6:, -6:][3:5, 3:5]
    count = 20_000
    states = rng.multivariate_normal(observations.state, P, count)
    pixels = observations.pixels + 0.5 * rng.normal(size=(count, 2))
    drawn = np.array(
        [
            idp.see(Observations(observations.camera, state, P[:13], uv[None])).y[0, 3:5]
            for state, uv in zip(states, pixels, strict=True)
        ]
    )
    centred = drawn - idp.see(observations).y[0, 3:5]
    # Whitened by the prediction, the sample covariance of N draws is I within a few times √(2/N).
    white = np.linalg.solve(np.linalg.cholesky(predicted), centred.T)
    sampled = white @ white.T / count
    np.testing.assert_allclose(sampled, np.eye(2), atol=4 * np.sqrt(2 / count))
