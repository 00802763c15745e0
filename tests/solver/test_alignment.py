"""One map's frame in another's, of candidates of which most are false: right, and as certain as it says."""

import numpy as np
import pytest
from bench.aligning import WORLDS, draw
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_factors import pose_matrix, pose_vector
from two_maps import SEEN, as_matrices, candidates_of, drive, solved, true_frame, two_drives

from factorbus.client.alignment import ALIGNED, AMBIGUOUS, TOO_FEW, adjoint_of, exp_of, judge, log_of
from factorbus.client.frames import matrix_of_pose, pose_of_matrix

SEEDS = range(3)


@pytest.mark.parametrize("world", WORLDS)
def test_what_is_said_of_each_world(world: str) -> None:
    for seed in SEEDS:
        verdict, off, share = draw(world, seed)
        assert verdict == WORLDS[world][-1], seed
        assert verdict != ALIGNED or off < 5.0, seed
        assert verdict == TOO_FEW or share > 0.7, seed


def test_a_set_of_places_that_look_alike_is_no_rival_if_it_has_less_than_half_as_many() -> None:
    rng = np.random.default_rng(11)
    one, other, given_all = two_drives("se2", 120, (16, 6), 9, rng)
    maps = solved(one.steps), solved(other.steps)
    right = [each for each in given_all if each.is_right]
    wrong = [each for each in given_all if not each.is_right]
    assert judge(as_matrices("se2", *maps, given_all)).verdict == AMBIGUOUS
    judged = judge(as_matrices("se2", *maps, right + wrong[:2] + wrong[-3:]))
    assert judged.verdict == ALIGNED
    assert judged.best is not None
    gap = log_of(np.linalg.inv(judged.best.T) @ true_frame(one, other))
    assert np.abs(gap).max() < 2.0


def test_a_candidate_that_is_there_many_times_counts_once() -> None:
    rng = np.random.default_rng(2)
    one, other = drive("se2", 60, rng), drive("se2", 60, rng)
    (single,) = candidates_of("se2", one, other, (0, 1), 0, rng)
    others = candidates_of("se2", one, other, (0, 9), 0, rng)
    judged = judge(as_matrices("se2", solved(one.steps), solved(other.steps), [single] * 8 + others))
    assert judged.verdict == TOO_FEW
    assert judged.best is not None
    assert judged.best.members.tolist() == list(range(8))


def test_one_guess_made_many_times_does_not_hide_those_that_agree() -> None:
    """A place recognizer that takes one place for another says so whenever the robot is there."""
    rng = np.random.default_rng(2)
    one, other = drive("se2", 60, rng), drive("se2", 60, rng)
    right = candidates_of("se2", one, other, (5, 0), 0, rng)
    (wrong,) = candidates_of("se2", one, other, (0, 1), 0, rng)
    again = [wrong._replace(z=wrong.z + rng.normal(0, 1e-3, 3)) for _ in range(30)]
    maps = solved(one.steps), solved(other.steps)
    judged = judge(as_matrices("se2", *maps, [*again, *right]))
    assert judged.verdict == ALIGNED
    assert judged.best is not None
    assert judged.best.members.tolist() == [30, 31, 32, 33, 34]
    gap = log_of(np.linalg.inv(judged.best.T) @ true_frame(one, other))
    assert np.abs(gap).max() < 2.0
    assert judge(as_matrices("se2", *maps, again + right[:2])).verdict == TOO_FEW


def test_one_or_no_candidate_says_nothing() -> None:
    rng = np.random.default_rng(3)
    one, other = drive("se2", 30, rng), drive("se2", 30, rng)
    maps = solved(one.steps), solved(other.steps)
    judged = judge(as_matrices("se2", *maps, candidates_of("se2", one, other, (0, 1), 0, rng)))
    assert (judged.verdict, judged.best, judged.rival) == (TOO_FEW, None, None)


@given(st.sampled_from([3, 6]), st.integers(0, 2**32 - 1))
def test_tangents_poses_and_matrices(d: int, seed: int) -> None:
    numbers = np.random.default_rng(seed)
    T, x = exp_of(numbers.normal(0, 2, d)), numbers.normal(0, 1e-6, d)
    np.testing.assert_allclose(log_of(T @ exp_of(x) @ np.linalg.inv(T)), adjoint_of(T) @ x, atol=1e-10)
    np.testing.assert_allclose(exp_of(log_of(T)), T, atol=1e-9)
    np.testing.assert_allclose(matrix_of_pose(pose_of_matrix(T)), T, atol=1e-12)
    np.testing.assert_allclose(pose_matrix(pose_of_matrix(T)), T, atol=1e-12)
    assert pose_vector(T).size == pose_of_matrix(T).size


def test_how_certain_a_right_one_is_said_to_be_is_how_far_it_is_off() -> None:
    """Mean d² of the frame over draws: the number of scalars, of right covariances within 99.99 %."""
    off = np.array([draw("plane", 100 + seed)[1] for seed in range(12)])
    assert 1.2 < np.mean(off**2) < 5.6, SEEN
