"""What holds a variable: maps that are held in roundabout ways pass, those that are not are named."""

import numpy as np
import pytest

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Solver, errors
from factorbus.solver.sparse.full_rank import least_eigenvalue

I2, I3 = np.array([[1.0, 0, 1]]), np.array([[1.0, 0, 0, 1, 0, 1]])
I6 = np.eye(6)[np.triu_indices(6)][None]


def landmarks(*pairs: tuple[int, int], z: list[list[float]]) -> Factors:
    return Factors("landmark_se2", np.array(pairs), np.array(z), np.repeat(I2, len(pairs), 0))


def mapped_points(*points: tuple[float, float]) -> Solver:
    """A fixed pose 0 at the origin that sees points 100, 101, ..."""
    solver = Solver()
    keys = 100 + np.arange(len(points))
    observation = landmarks(*((0, int(key)) for key in keys), z=[list(point) for point in points])
    pose = Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True)
    solver.stage(Batch((pose, Variables("point2", keys)), (observation,)))
    solver.step()
    return solver


def pose(key: int, x: float = 0.0, y: float = 0.0, theta: float = 0.0) -> Variables:
    return Variables("se2", np.array([key]), np.array([[x, y, theta]]))


def test_two_points_hold_a_pose_in_the_plane_and_one_does_not() -> None:
    solver = mapped_points((2.0, 0.0), (0.0, 2.0))
    solver.stage(Batch((pose(1, 0.1, 0.1),), (landmarks((1, 100), (1, 101), z=[[1.0, 0.0], [-1.0, 2.0]]),)))
    report = solver.step(settle=True)
    assert report.converged
    assert report.chi2 == pytest.approx(0.0, abs=1e-20)
    solver.stage(Batch((pose(2, 0.1, 0.1),), (landmarks((2, 100), z=[[1.0, 0.0]]),)))
    with pytest.raises(errors.Underconstrained, match="direction") as caught:
        solver.step()
    assert caught.value.detail["key"] == 2
    assert caught.value.detail["factors"] == ["landmark_se2 (2, 100)"]


def test_two_observations_of_one_point_do_not_hold_a_pose() -> None:
    solver = mapped_points((2.0, 0.0), (0.0, 2.0))
    solver.stage(Batch((pose(1),), (landmarks((1, 100), (1, 100), z=[[2.0, 0.0], [2.1, 0.1]]),)))
    with pytest.raises(errors.Underconstrained):
        solver.step()


def test_a_second_map_joined_through_shared_points_is_held() -> None:
    solver = mapped_points((2.0, 0.0), (0.0, 2.0))
    edge = Factors("between_se2", np.array([[1, 2]]), np.array([[1.0, 0, 0]]), I3)
    both = Batch((pose(1), pose(2, 1.0)), (edge, landmarks((1, 100), (2, 101), z=[[2.0, 0.0], [-1.0, 2.0]])))
    solver.stage(both)
    assert "together" in solver.step().because


def test_the_island_without_an_anchor_is_named() -> None:
    solver = mapped_points((2.0, 0.0))
    chain = Factors("between_se2", np.array([[10, 11], [12, 11]]), np.ones((2, 3)), np.repeat(I3, 2, 0))
    island = Batch((pose(10), Variables("se2", np.array([11, 12]))), (chain,))
    solver.stage(island)
    with pytest.raises(errors.Underconstrained, match="nothing joins it to a fixed variable or a prior") as caught:
        solver.step()
    assert caught.value.detail["key"] == 10
    prior = Factors("prior_se2", np.array([[11]]), np.ones((1, 3)), I3)
    solver.stage(Batch(island.variables, (*island.factors, prior)))
    assert solver.step().converged


def test_an_anchor_may_come_in_a_later_batch_of_the_same_step() -> None:
    solver = mapped_points((2.0, 0.0))
    solver.stage(Batch((pose(10),)))
    solver.stage(Batch((), (Factors("between_se2", np.array([[10, 0]]), np.zeros((1, 3)), I3),)))
    assert solver.step().strategy == "extend"


def test_a_pose_in_space_needs_three_points_off_a_line() -> None:
    def tried(points: np.ndarray) -> float:
        solver = Solver()
        keys = 100 + np.arange(3)
        origin = np.array([[0.0, 0, 0, 0, 0, 0, 1]])
        observations = [
            Factors("landmark_se3", np.stack([np.full(3, key), keys], 1), points, np.repeat(np.eye(3)[np.triu_indices(3)][None], 3, 0))  # noqa: E501
            for key in (0, 1)
        ]  # fmt: skip
        solver.stage(
            Batch(
                (
                    Variables("se3", np.array([0])),
                    Variables("point3", keys, points),
                    Variables("se3", np.array([1]), origin + np.eye(7)[:1] * 0.01),
                ),
                (Factors("prior_se3", np.array([[0]]), origin, I6), *observations),
            )
        )
        return solver.step(settle=True).chi2

    assert tried(np.array([[2.0, 0, 0], [0, 2, 0], [0, 0, 2]])) < 1e-18
    with pytest.raises(errors.Underconstrained) as caught:
        tried(np.array([[1.0, 1, 0], [2, 2, 0], [3, 3, 0]]))
    assert caught.value.detail["key"] in (1, 100, 101, 102)


def test_only_fixed_variables_make_a_map_with_nothing_to_solve() -> None:
    solver = Solver()
    fixed = Variables("se2", np.array([0, 1]), np.array([[0.0, 0, 0], [1, 0, 0]]), fixed=True)
    solver.stage(Batch((fixed,), (Factors("between_se2", np.array([[0, 1]]), np.array([[2.0, 0, 0]]), I3),)))
    report = solver.step(settle=True)
    assert (report.strategy, report.chi2) == ("extend", 1.0)
    assert Solver().step().chi2 == 0.0


@pytest.mark.parametrize("least", [1e-2, 1e-12, 1e-14, 1e-18])
def test_the_least_eigenvalue_is_that_of_singular_values(least: float) -> None:
    """Of JᵀJ in doubles what is below some 1e-15 is rounding."""
    rng, m, n = np.random.default_rng(4), 45, 30
    U, V = (np.linalg.qr(rng.normal(size=(rows, n)))[0] for rows in (m, n))
    J = U * np.sqrt([*rng.uniform(0.1, 1.0, n - 1), least]) @ V.T
    wanted = np.linalg.svd(J / np.sqrt((J * J).sum(0)), compute_uv=False)[-1] ** 2
    rows, columns = np.indices((m, n))
    found = least_eigenvalue(J.reshape(-1), rows.reshape(-1), columns.reshape(-1), (m, n))
    assert found == pytest.approx(wanted, rel=0.2 if least == 1e-2 else 1e-2)


def test_what_has_no_rank_has_no_eigenvalue_to_speak_of() -> None:
    J = np.random.default_rng(4).normal(size=(45, 30))
    J[:, 7] = J[:, 3] - 2.0 * J[:, 20]
    rows, columns = np.indices(J.shape)
    assert least_eigenvalue(J.reshape(-1), rows.reshape(-1), columns.reshape(-1), J.shape) < 1e-25
