"""Odometry of a sensor off the robot's centre: the same drive, and the weight that the sensor's own error has."""

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorbus.client import Draft
from factorbus.client.lever_arm import transform_se2, transform_se3
from factorbus.proto.messages import Batch
from factorbus.proto.problems import BadInformation, BadShape
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver

PLANE, SPACE = (0.1, 0.05, 0.02), (0.1, 0.05, 0.2, 0.01, 0.02, 0.005)
SEEDS = st.integers(0, 2**32 - 1)


def pose2(row: np.ndarray) -> gtsam.Pose2:
    return gtsam.Pose2(*row)


def pose3(row: np.ndarray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Quaternion(row[6], *row[3:6]), row[:3])


def row2(pose: gtsam.Pose2) -> np.ndarray:
    return np.array([pose.x(), pose.y(), pose.theta()])


def row3(pose: gtsam.Pose3) -> np.ndarray:
    q = pose.rotation().toQuaternion()
    return np.array([*pose.translation(), q.x(), q.y(), q.z(), q.w()])


def residual(error: gtsam.Pose2 | gtsam.Pose3) -> np.ndarray:
    """(t, theta), or (t, v) with w >= 0."""
    if isinstance(error, gtsam.Pose2):
        return row2(error)
    row = row3(error)
    return row[:6] * np.array([1, 1, 1, *[np.copysign(1.0, row[6])] * 3])


def exponential(r: np.ndarray) -> gtsam.Pose2 | gtsam.Pose3:
    """The pose whose residual is r."""
    return pose2(r) if r.size == 3 else pose3(np.array([*r, np.sqrt(1.0 - r[3:] @ r[3:])]))


def random_poses(space: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A measurement and a mount."""
    rng = np.random.default_rng(seed)
    if space == "se2":
        return tuple(rng.normal(size=(2, 3)) * (2.0, 2.0, 1.0))
    return tuple(np.hstack([2.0 * rng.normal(size=(2, 3)), [q / np.linalg.norm(q) for q in rng.normal(size=(2, 4))]]))


def moved(space: str, z: np.ndarray, mount: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return transform_se2(z, mount) if space == "se2" else transform_se3("test", z, mount)


@pytest.mark.parametrize("space", ["se2", "se3"])
@settings(max_examples=50, deadline=None)
@given(seed=SEEDS)
def test_the_measurement_is_moved_exactly_and_its_error_as_numeric_differentiation_says(space: str, seed: int) -> None:
    pose: Callable = pose2 if space == "se2" else pose3
    z, mount = random_poses(space, seed)
    there, A = moved(space, z, mount)
    L = pose(mount)
    assert pose(there).equals(L.compose(pose(z)).compose(L.inverse()), 1e-12)

    def seen(r: np.ndarray) -> np.ndarray:
        """The residual of the sensor where that of the robot is r."""
        return residual(L.inverse().compose(exponential(r)).compose(L))

    h, n = 1e-6, len(A)
    columns = [(seen(h * e) - seen(-h * e)) / (2 * h) for e in np.eye(n)]
    np.testing.assert_allclose(A, np.transpose(columns), atol=1e-8)
    # What (3) misses of the translation is of second order, and no more than was said.
    small = 0.02 * np.random.default_rng(seed).normal(size=n)
    turn = abs(small[2]) if n == 3 else 2.0 * np.linalg.norm(small[3:])
    missed = seen(small) - A @ small
    lever = np.linalg.norm(mount[: 2 if n == 3 else 3])
    assert np.linalg.norm(missed) <= 0.5 * turn**2 * lever * 1.01 + 1e-12


@pytest.mark.parametrize("space", ["se2", "se3"])
def test_the_weight_is_that_of_the_sensor(space: str) -> None:
    sigmas = PLANE if space == "se2" else SPACE
    z, mount = random_poses(space, 3)
    draft = Draft()
    between = draft.between_se2 if space == "se2" else draft.between_se3
    between("x0", "x1", z, mount=mount, sigmas=sigmas, loss=("huber", 1.5))
    (group,) = draft.batch().factors
    assert group.loss == "huber"
    assert group.scale is not None
    assert group.scale.tolist() == [1.5]
    W = np.zeros((len(sigmas), len(sigmas)))
    W[np.triu_indices(len(sigmas))] = group.information[0]
    W += np.triu(W, 1).T
    there, A = moved(space, z, mount)
    assert np.array_equal(group.measured[0], there)
    # The covariance of the sensor's residual, from that of the robot's.
    halves = np.ones(3) if space == "se2" else np.array([1, 1, 1, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(A @ np.linalg.inv(W) @ A.T, np.diag(halves * sigmas) ** 2, rtol=1e-9, atol=1e-12)


def path(space: str, count: int) -> list:
    """Where the robot is: curves, never straight on."""
    rng, poses = np.random.default_rng(5), []
    pose: Any = gtsam.Pose2() if space == "se2" else gtsam.Pose3()
    for _ in range(count):
        poses.append(pose)
        turn = 0.3 * rng.normal()
        if space == "se2":
            pose = pose.compose(gtsam.Pose2(1.0, 0.0, turn))
        else:
            pose = pose.compose(gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1 * turn, -0.2 * turn, turn), np.array([1.0, 0, 0.1])))
    return poses


@pytest.mark.parametrize("space", ["se2", "se3"])
def test_a_drive_by_a_sensor_off_the_centre_ends_where_the_robot_does(space: str) -> None:
    poses = path(space, 60)
    row: Callable = row2 if space == "se2" else row3
    mount = np.array([0.8, -0.4, 0.7]) if space == "se2" else np.array([0.8, -0.4, 1.2, 0.5, -0.5, 0.5, 0.5])
    L = pose2(mount) if space == "se2" else pose3(mount)
    sigmas, dim = (PLANE, 3) if space == "se2" else (SPACE, 6)

    def drive(mounted: bool) -> np.ndarray:
        draft = Draft().variable(space, "x0", row(poses[0]), fixed=True)
        between = draft.between_se2 if space == "se2" else draft.between_se3
        for i in range(1, len(poses)):
            sensor = [pose.compose(L) for pose in poses[i - 1 : i + 1]]
            draft.variable(space, f"x{i}")
            between(
                f"x{i - 1}", f"x{i}", row(sensor[0].between(sensor[1])), sigmas=sigmas, mount=mount if mounted else None
            )
        solver = Solver(Options())
        solver.stage(draft.batch())
        solver.step(settle=True)
        last = {k: v for g in solver.estimate() for k, v in zip(g.keys.tolist(), g.values, strict=True)}
        return last[symbol("x", len(poses) - 1)]

    assert np.linalg.norm((drive(True) - row(poses[-1]))[: dim // 2 + dim % 2]) < 1e-9
    assert np.linalg.norm((drive(False) - row(poses[-1]))[:2]) > 0.5, "the sensor itself went another way"


@pytest.mark.parametrize("space", ["se2", "se3"])
def test_a_loop_is_closed_where_gtsam_closes_it_with_the_sensors_poses_as_variables(space: str) -> None:
    """GTSAM estimates the sensor's poses from the sensor's measurements; the robot's are where that puts them."""
    poses, rng = path(space, 25), np.random.default_rng(8)
    plane = space == "se2"
    row: Callable = row2 if plane else row3
    mount = np.array([0.8, -0.4, 0.7]) if plane else np.array([0.8, -0.4, 1.2, 0.5, -0.5, 0.5, 0.5])
    L = pose2(mount) if plane else pose3(mount)
    sigmas = np.array((0.01, 0.02, 0.005) if plane else (0.01, 0.02, 0.01, 0.004, 0.004, 0.008))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factor: Callable = gtsam.BetweenFactorPose2 if plane else gtsam.BetweenFactorPose3
    # GTSAM's tangent space has the rotation first in space, as a rotation vector.
    theirs = sigmas if plane else np.array([*sigmas[3:], *sigmas[:3]])
    noise = gtsam.noiseModel.Diagonal.Sigmas(theirs)
    equality: Callable = gtsam.NonlinearEqualityPose2 if plane else gtsam.NonlinearEqualityPose3
    graph.add(equality(0, poses[0].compose(L)))
    draft = Draft().variable(space, "x0", row(poses[0]), fixed=True)
    between = draft.between_se2 if plane else draft.between_se3
    for i, pose in enumerate(poses):
        values.insert(i, pose.compose(L))
        if i:
            draft.variable(space, f"x{i}", row(pose))
    pairs = [(i - 1, i) for i in range(1, len(poses))] + [(0, 12), (3, 20), (0, 24)]
    for i, j in pairs:
        error = sigmas * rng.normal(size=sigmas.size)
        z = (
            poses[i]
            .compose(L)
            .between(poses[j].compose(L))
            .compose(exponential(error if plane else error * (1, 1, 1, 0.5, 0.5, 0.5)))
        )
        graph.add(factor(i, j, z, noise))
        between(f"x{i}", f"x{j}", row(z), sigmas=sigmas, mount=mount)
    best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    solver = Solver(Options())
    solver.stage(draft.batch())
    solver.step(settle=True)
    ours = {k: v for g in solver.estimate() for k, v in zip(g.keys.tolist(), g.values, strict=True)}
    at: Callable = best.atPose2 if plane else best.atPose3
    for i in range(len(poses)):
        wanted = row(at(i).compose(L.inverse()))
        moved_by = np.linalg.norm(wanted[:2] - row(poses[i])[:2])
        assert np.linalg.norm(ours[symbol("x", i)][:2] - wanted[:2]) < 1e-4 + 0.02 * moved_by


def test_what_is_no_mount_is_refused() -> None:
    with pytest.raises(BadShape, match="between_se2 x0 x1: mount"):
        Draft().between_se2("x0", "x1", (1, 0, 0), mount=(1, 0), sigmas=PLANE)
    with pytest.raises(BadShape, match="between_se3 x0 x1: mount: quaternion: length 2"):
        Draft().between_se3("x0", "x1", (1, 0, 0, 0, 0, 0, 1), mount=(1, 0, 0, 0, 0, 0, 2), sigmas=SPACE)
    with pytest.raises(BadInformation, match="one of the two"):
        Draft().between_se2("x0", "x1", (1, 0, 0), mount=(1, 0, 0))
    empty: Batch = Draft().batch()
    assert not empty.factors
