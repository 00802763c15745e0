"""Corrections that are blended: continuous, nearer all the time, exact at the end.  Times are handed in."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from factorbus.client.blending import PoseBlend
from factorbus.client.frames import compose, matrix_of_pose
from factorbus.client.geodesic import along_geodesic, exp_of_twist, length_of_way, log_of_pose

SMOOTH_S = 2.0
seeds = st.integers(0, 2**32 - 1)
sizes = st.sampled_from([3, 7])
seconds = st.floats(0.0, 3.0)


def pose(rng: np.random.Generator, size: int) -> np.ndarray:
    place = rng.normal(size=size // 2 if size == 7 else 2) * 10.0 ** rng.uniform(-3, 3)
    if size == 3:
        return np.array([*place, rng.uniform(-math.pi, math.pi)])
    turn = rng.normal(size=4)
    return np.array([*place, *turn / np.linalg.norm(turn)])


def generator_of(tangent: np.ndarray) -> np.ndarray:
    """The matrix (4, 4) whose exponential the pose is."""
    x, y, z = tangent[3:]
    made = np.zeros((4, 4))
    made[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    made[:3, 3] = tangent[:3]
    return made


@given(seeds, st.sampled_from([1e-9, 1e-5, 0.9e-3, 1.1e-3, 0.1, 1.0, 3.1]))
def test_the_exponential_is_that_of_the_matrix_and_the_logarithm_its_inverse(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=3)
    tangent = np.array([*rng.normal(size=3), *phi * angle / np.linalg.norm(phi)])
    scaled, wanted, term = generator_of(tangent) / 2**10, np.eye(4), np.eye(4)
    for n in range(1, 8):
        term = term @ scaled / n
        wanted = wanted + term
    wanted = np.linalg.matrix_power(wanted, 2**10)
    assert_allclose(matrix_of_pose(exp_of_twist(tangent)), wanted, atol=1e-11)
    assert_allclose(log_of_pose(exp_of_twist(tangent)), tangent, rtol=1e-9, atol=1e-12)


@given(seeds, sizes)
def test_a_way_is_the_same_in_every_frame_on_either_side(seed: int, size: int) -> None:
    """So it does not matter where the origins of the map and of odometry are."""
    rng = np.random.default_rng(seed)
    a, b, left, right = (pose(rng, size) for _ in range(4))
    middle = along_geodesic(a, b, 0.3)

    def moved(T: np.ndarray) -> np.ndarray:
        return compose(compose(left, T[None])[0], right[None])[0]

    whole = along_geodesic(moved(a), moved(b), 0.3)
    scale = sum(float(np.abs(each).max()) for each in (a, b, left, right))
    assert_allclose(matrix_of_pose(whole), matrix_of_pose(moved(middle)), atol=1e-9 * (1.0 + scale))


@given(seeds, sizes, st.floats(-1e6, 1e6))
def test_it_starts_where_it_was_comes_nearer_and_ends_exactly(seed: int, size: int, now_s: float) -> None:
    rng = np.random.default_rng(seed)
    old, new = pose(rng, size), pose(rng, size)
    blend = PoseBlend(old, SMOOTH_S)
    blend.correct(new, now_s)
    assert_array_equal(blend.at(now_s), old)
    assert_array_equal(blend.raw, new)
    whole = length_of_way(old, new)
    distances = [length_of_way(blend.at(now_s + SMOOTH_S * share), new) for share in np.linspace(0.0, 1.0, 21)]
    # At constant speed: 95 %, 90 %, ... of the whole way.
    assert_allclose(distances, whole * np.linspace(1.0, 0.0, 21), atol=1e-8 * (1.0 + np.abs(old).max() + whole))
    assert blend.left_s(now_s) == pytest.approx(SMOOTH_S)
    for later_s in (SMOOTH_S + 1e-9, SMOOTH_S + 1.0, 1e9):
        assert_array_equal(blend.at(now_s + later_s), new)
    assert blend.left_s(now_s + SMOOTH_S + 1e-9) == 0.0


@given(seeds, sizes, st.lists(seconds, min_size=2, max_size=8))
def test_a_further_correction_starts_from_where_the_blend_is(seed: int, size: int, waits: list[float]) -> None:
    rng = np.random.default_rng(seed)
    blend, now_s = PoseBlend(pose(rng, size), SMOOTH_S), 0.0
    for wait_s in waits:
        now_s += wait_s
        before = blend.at(now_s)
        blend.correct(pose(rng, size), now_s)
        assert_array_equal(blend.at(now_s), before)
        assert 0.0 < blend.left_s(now_s) <= SMOOTH_S
    assert_array_equal(blend.at(now_s + SMOOTH_S + 1e-9), blend.raw)


@given(seeds)
def test_small_corrections_do_not_put_off_a_large_one(seed: int) -> None:
    """A map makes a step ten times a second: each corrects a little, and a closed loop arrives all the same."""
    rng = np.random.default_rng(seed)
    blend = PoseBlend(np.zeros(3), SMOOTH_S)
    blend.correct(np.array([5.0, 3.0, 1.0]), 0.0)
    given_now = [blend.at(0.0)]
    for n in range(1, 31):
        now_s = 0.1 * n
        given_now.append(blend.at(now_s))
        blend.correct(np.array([5.0, 3.0, 1.0]) + rng.normal(size=3) * 1e-3, now_s)
    assert length_of_way(given_now[25], blend.raw) < 0.02
    speeds = [length_of_way(a, b) / 0.1 for a, b in pairwise(given_now)]
    alone = length_of_way(given_now[0], np.array([5.0, 3.0, 1.0])) / SMOOTH_S
    assert max(speeds) < 1.1 * alone


@pytest.mark.parametrize(("old", "new", "middle"), [(179.0, -179.0, 180.0), (-170.0, 150.0, 170.0), (90.0, -80.0, 5.0)])
def test_headings_go_the_short_way_round(old: float, new: float, middle: float) -> None:
    blend = PoseBlend(np.array([1.0, 2.0, math.radians(old)]), SMOOTH_S)
    blend.correct(np.array([1.0, 2.0, math.radians(new)]), 10.0)
    half = blend.at(11.0)
    assert math.remainder(half[2] - math.radians(middle), math.tau) == pytest.approx(0.0, abs=1e-12)
    assert_allclose(half[:2], [1.0, 2.0], atol=1e-12)


def test_the_other_sign_of_a_quaternion_is_no_correction() -> None:
    q = np.array([0.5, -0.5, 0.5, 0.5])
    blend = PoseBlend(np.array([1.0, 2.0, 3.0, *q]), SMOOTH_S)
    blend.correct(np.array([1.0, 2.0, 3.0, *-q]), 0.0)
    for now_s in np.linspace(0.0, SMOOTH_S, 5):
        assert_allclose(matrix_of_pose(blend.at(now_s)), matrix_of_pose(blend.raw), atol=1e-12)


def test_what_is_given_is_a_copy() -> None:
    pose_of_caller = np.array([1.0, 2.0, 0.5])
    blend = PoseBlend(pose_of_caller, SMOOTH_S)
    pose_of_caller[:] = 9.0
    blend.at(0.0)[:] = 9.0
    blend.correct(np.array([2.0, 2.0, 0.5]), 0.0)
    blend.at(0.0)[:] = 9.0
    assert_array_equal(blend.at(0.0), [1.0, 2.0, 0.5])
    assert_array_equal(blend.at(SMOOTH_S), [2.0, 2.0, 0.5])
