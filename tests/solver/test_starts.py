"""The start by averaged rotations: exact where nothing contradicts, the same in every frame, as good as GTSAM's."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_factors import pose_matrix, pose_vector
from naive.random_graphs import camera_steps, random_steps, random_value
from naive.random_others import other_steps

from factorbus.formats import read
from factorbus.proto.kinds import LOSSES
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import Spiral, manhattan, sphere
from factorbus.solver import BatchSearch, Group, Options, Solver, errors, solve_batch
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.starts.averaged import averaged

POSES = ("se2", "se3")


def whole(steps) -> Batch:
    """All steps as one graph, its variables with the values that composition gives them."""
    solver = Solver(Options(mode="all-batch", max_iterations=0))
    for step in steps:
        solver.stage(getattr(step, "batch", step))
    return Batch(*map(tuple, solver.graph()))


def scattered(batch: Batch, seed: int, kinds: tuple[str, ...] = ("se2", "se3", "point2", "point3")) -> Batch:
    """The same, but what is estimated is anywhere."""
    rng = np.random.default_rng(seed)
    moved = [
        g
        if g.fixed or g.kind not in kinds
        else g._replace(values=np.array([random_value(g.kind, rng) for _ in g.keys]))
        for g in batch.variables
    ]
    return Batch(tuple(moved), batch.factors)


def chi2_of(graph: FactorGraph, values: np.ndarray) -> float:
    return sum_chi2(0, int(graph.counts[at.FACTORS]), graph.var, graph.fac, values, graph.payload)


def starts_of(batch: Batch) -> tuple[FactorGraph, list[np.ndarray]]:
    graph = FactorGraph()
    admit(graph, batch)
    return graph, averaged(graph)


def best_of(batch: Batch) -> tuple[float, list[Group]]:
    """χ² and the values of the better of the starts by averaged rotations."""
    graph, starts = starts_of(batch)
    graph.values = min(starts, key=lambda values: chi2_of(graph, values))
    return chi2_of(graph, graph.values), graph.variables()


def poses_of(groups) -> dict[int, np.ndarray]:
    return {
        k: pose_matrix(x) for g in groups if g.kind in POSES for k, x in zip(g.keys.tolist(), g.values, strict=True)
    }


@pytest.mark.parametrize("seed", range(6))
def test_what_contradicts_nothing_is_recovered_wherever_it_was(seed: int) -> None:
    batch = whole(random_steps(seed, 12, noise=0.0))
    chi2, found = best_of(scattered(batch, seed))
    assert chi2 < 1e-15
    truth = poses_of(batch.variables)
    for key, T in poses_of(found).items():
        np.testing.assert_allclose(T, truth[key], atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_positions_headings_attitudes_bearings_and_linear_factors_are_used(seed: int) -> None:
    """Ranges place nobody, and an idp stays where it is to the pose that saw it: the poses come out exactly."""
    batch = whole(other_steps(seed, 10, noise=0.0))
    truth = poses_of(batch.variables)
    linear = Batch(batch.variables, tuple(g for g in batch.factors if not g.kind.startswith("linear")))
    for key, T in poses_of(best_of(scattered(linear, seed))[1]).items():
        np.testing.assert_allclose(T, truth[key], atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_what_a_camera_saw_goes_along_with_its_pose(seed: int) -> None:
    """The prior moves, and says alone where the map is: points and features stay where they are to their poses."""
    batch = whole(camera_steps(seed, noise=0.0))
    turn = pose_matrix(np.array([3.0, -2.0, 1.0, 0.5, -0.5, 0.5, 0.5]))
    factors = [group for group in batch.factors if not group.kind.startswith("prior_point")]
    for n, group in enumerate(factors):
        if group.kind == "prior_se3":
            moved = np.array([pose_vector(turn @ pose_matrix(z)) for z in group.measured])
            factors[n] = Factors(group.kind, group.keys, moved, group.information)
    graph, _ = starts_of(Batch(batch.variables, tuple(factors)))
    assert chi2_of(graph, graph.values) > 1.0
    assert best_of(Batch(batch.variables, tuple(factors)))[0] < 1e-9


def plane_ring(n: int, first: int) -> tuple[Variables, Factors]:
    """A ring of exact relative poses; its values are all zero."""
    angle = 2 * np.pi / n
    z = np.tile([np.cos(angle / 2) * 2 * np.sin(angle / 2), 2 * np.sin(angle / 2) ** 2, angle], (n, 1))
    keys = first + np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    return Variables("se2", first + np.arange(n), np.zeros((n, 3))), Factors(
        "between_se2", keys, z, np.tile([100.0, 0, 0, 100, 0, 400], (n, 1))
    )


def test_a_component_that_only_positions_hold_is_brought_to_them() -> None:
    n, lever = 20, np.array([0.3, -0.2])
    variables, edges = plane_ring(n, 0)
    truth = np.array([[np.sin(a), 1 - np.cos(a), a] for a in 2 * np.pi / n * np.arange(n)])
    truth = np.array([pose_vector(pose_matrix(np.array([50.0, -20.0, 2.5])) @ pose_matrix(x)) for x in truth])
    antenna = np.array([(pose_matrix(x) @ np.append(lever, 1.0))[:2] for x in truth[::3]])
    fixes = Factors(
        "position_se2", np.arange(n)[::3, None], np.concatenate([antenna, np.tile(lever, (len(antenna), 1))], axis=1),
        np.tile([4.0, 0.0, 4.0], (len(antenna), 1)),
    )  # fmt: skip
    chi2, found = best_of(Batch((variables,), (edges, fixes)))
    assert chi2 < 1e-12
    np.testing.assert_allclose(found[0].values[:, :2], truth[:, :2], atol=1e-7)


def test_a_component_in_space_is_brought_to_an_attitude_and_positions_on_a_line() -> None:
    """Positions on a line leave a roll open, which the attitudes close."""
    n = 12
    z = np.tile([1.0, 0, 0, 0, 0, 0, 1], (n - 1, 1))
    edges = Factors(
        "between_se3",
        np.stack([np.arange(n - 1), np.arange(1, n)], 1),
        z,
        np.tile(np.eye(6)[np.triu_indices(6)], (n - 1, 1)),
    )
    T = pose_matrix(random_value("se3", np.random.default_rng(3)))
    truth = [pose_vector(T @ pose_matrix(np.array([float(k), 0, 0, 0, 0, 0, 1]))) for k in range(n)]
    fixes = Factors(
        "position_se3",
        np.arange(n)[:, None],
        np.array([[*x[:3], 0, 0, 0] for x in truth]),
        np.tile(np.eye(3)[np.triu_indices(3)], (n, 1)),
    )
    up = np.array([0.0, 0.0, 1.0])
    level = Factors(
        "attitude_se3", np.array([[4]]), np.array([[*(T[:3, :3].T @ up), *up]]), np.eye(3)[np.triu_indices(3)][None]
    )
    values = np.tile([0, 0, 0, 0, 0, 0, 1.0], (n, 1))
    chi2, found = best_of(Batch((Variables("se3", np.arange(n), values),), (edges, fixes, level)))
    assert chi2 < 1e-12
    for k, x in enumerate(truth):
        np.testing.assert_allclose(pose_matrix(found[0].values[k]), pose_matrix(x), atol=1e-7)


def test_a_component_that_shares_only_landmarks_is_brought_to_them() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-5, 5, (6, 2))
    first, second = plane_ring(8, 0), plane_ring(8, 100)
    other = pose_matrix(np.array([3.0, 4.0, -2.0]))
    origin = Variables("se2", np.array([50]), np.zeros((1, 3)), fixed=True)
    tie = Factors("between_se2", np.array([[50, 0]]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 1, 0, 1]]))
    observations = []
    for base, T in ((0, np.eye(3)), (100, other)):
        for k in range(8):
            a = 2 * np.pi / 8 * k
            X = T @ pose_matrix(np.array([np.sin(a), 1 - np.cos(a), a]))
            seen = (np.linalg.inv(X) @ np.vstack([points.T, np.ones(6)]))[:2].T
            keys = np.stack([np.full(6, base + k), 200 + np.arange(6)], axis=1)
            observations.append(Factors("landmark_se2", keys, seen, np.tile([9.0, 0, 9.0], (6, 1))))
    batch = Batch(
        (origin, first[0], second[0], Variables("point2", 200 + np.arange(6), np.zeros((6, 2)))),
        (tie, first[1], second[1], *observations),
    )
    chi2, found = best_of(batch)
    assert chi2 < 1e-12
    np.testing.assert_allclose(pose_matrix(poses_vector(found, 100)), other, atol=1e-7)


def poses_vector(groups, key: int) -> np.ndarray:
    return pose_vector(poses_of(groups)[key])


@given(seed=st.integers(0, 2**32 - 1))
def test_another_frame_turns_the_start_and_nothing_else(seed: int) -> None:
    """The gauge: what is fixed moved by T moves all of the start by T, noise or not."""
    rng = np.random.default_rng(seed)
    world, pose = ((manhattan, "se2"), (sphere, "se3"))[seed % 2]
    batch = whole(world(poses=60, seed=seed % 1000))
    T = pose_matrix(random_value(pose, rng))
    turned = tuple(
        g._replace(values=np.array([pose_vector(T @ pose_matrix(x)) for x in g.values])) if g.fixed else g
        for g in batch.variables
    )
    here, there = poses_of(best_of(batch)[1]), poses_of(best_of(Batch(turned, batch.factors))[1])
    for key, x in here.items():
        np.testing.assert_allclose(T @ x, there[key], atol=1e-6)


@pytest.mark.parametrize("loss", LOSSES)
def test_false_closures_with_a_loss_do_not_bend_the_start(loss: str) -> None:
    batch = whole(manhattan(poses=300, seed=2))
    keys = np.array([k for g in batch.variables for k in g.keys.tolist()])
    rng = np.random.default_rng(7)
    false = Factors(
        "between_se2", keys[rng.choice(len(keys), (12, 2), replace=False)], rng.uniform(-3, 3, (12, 3)),
        np.tile([400.0, 0, 0, 400, 0, 1600], (12, 1)), loss, np.full(12, 1.0),
    )  # fmt: skip
    _, found = best_of(Batch(batch.variables, (*batch.factors, false)))
    clean = solve_batch(batch.variables, batch.factors)
    places = {k: x[:2] for g in clean.values for k, x in zip(g.keys.tolist(), g.values, strict=True)}
    off = [np.linalg.norm(T[:2, 2] - places[k]) for k, T in poses_of(found).items()]
    assert np.sqrt(np.mean(np.square(off))) < (1.5 if loss == "huber" else 0.5)


def gtsam_chordal(batch: Batch) -> tuple[float, float]:
    """(χ² at GTSAM's chordal start, ours), both by our residuals, in space."""
    graph = gtsam.NonlinearFactorGraph()
    model = gtsam.noiseModel.Unit.Create(6)
    for group in batch.factors:
        for keys, z in zip(group.keys.tolist(), group.measured, strict=True):
            graph.add(gtsam.BetweenFactorPose3(*keys, gtsam.Pose3(pose_matrix(z)), model))
    (fixed,) = [g for g in batch.variables if g.fixed]
    graph.add(gtsam.PriorFactorPose3(int(fixed.keys[0]), gtsam.Pose3(pose_matrix(fixed.values[0])), model))
    theirs = gtsam.InitializePose3.initialize(graph)
    moved = [
        g
        if g.fixed
        else g._replace(values=np.array([pose_vector(theirs.atPose3(k).matrix()) for k in g.keys.tolist()]))
        for g in batch.variables
    ]
    at_theirs = FactorGraph()
    admit(at_theirs, Batch(tuple(moved), batch.factors))
    return chi2_of(at_theirs, at_theirs.values), best_of(batch)[0]


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("seed", [1, 2])
def test_on_spheres_the_start_is_as_good_as_gtsams(seed: int, noise: float) -> None:
    theirs, ours = gtsam_chordal(whole(sphere(poses=300, seed=seed, spiral=Spiral(25, 8), sigma_rotation_rad=noise)))
    assert ours <= 1.05 * theirs


def gtsam_ends(batch: Batch) -> list[tuple[Variables, ...]]:
    """Where GTSAM's Levenberg-Marquardt ends from composed odometry, and from its chordal start; diagonal weights."""
    graph = gtsam.NonlinearFactorGraph()
    for group in batch.factors:
        for keys, z, packed in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            weights = packed[[0, 6, 11, 15, 18, 20]] * [1, 1, 1, 0.25, 0.25, 0.25]  # ours are of half angles
            model = gtsam.noiseModel.Diagonal.Precisions(np.concatenate([weights[3:], weights[:3]]))
            graph.add(gtsam.BetweenFactorPose3(*keys, gtsam.Pose3(pose_matrix(z)), model))
    (fixed,) = [g for g in batch.variables if g.fixed]
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    graph.add(gtsam.PriorFactorPose3(int(fixed.keys[0]), gtsam.Pose3(pose_matrix(fixed.values[0])), tight))
    odometry = gtsam.Values()
    for key, x in ((k, x) for g in batch.variables for k, x in zip(g.keys.tolist(), g.values, strict=True)):
        odometry.insert(key, gtsam.Pose3(pose_matrix(x)))
    ends = []
    for start in (odometry, gtsam.InitializePose3.initialize(graph)):
        end = gtsam.LevenbergMarquardtOptimizer(graph, start, gtsam.LevenbergMarquardtParams()).optimize()
        values = [np.array([pose_vector(end.atPose3(k).matrix()) for k in g.keys.tolist()]) for g in batch.variables]
        ends.append(tuple(g if g.fixed else g._replace(values=x) for g, x in zip(batch.variables, values, strict=True)))
    return ends


@pytest.mark.parametrize("noise", [0.2, 0.25])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_on_spheres_of_much_noise_no_end_of_gtsams_is_lower(seed: int, noise: float) -> None:
    """Nor do the values that are given make it worse, wherever they are."""
    batch = whole(sphere(poses=300, seed=seed, spiral=Spiral(25, 12), sigma_rotation_rad=noise))
    found = solve_batch(batch.variables, batch.factors)
    for values in (*gtsam_ends(batch), scattered(batch, seed).variables):
        assert solve_batch(values, batch.factors).chi2 == pytest.approx(found.chi2, rel=1e-6)


def torus(ring: int, rings: int, seed: int, noise: float) -> Batch:
    """A spiral over a torus, each pose joined to the next and to the one a turn later."""
    rng = np.random.default_rng(seed)
    u = 2 * np.pi * np.arange(ring * rings) / ring
    v = u / rings
    turn = np.array([[np.cos(v), -np.sin(v), 0 * v], [np.sin(v), np.cos(v), 0 * v], [0 * v, 0 * v, 1 + 0 * v]])
    poses = []
    for k in range(ring * rings):
        about = np.array([[np.cos(u[k]), 0, -np.sin(u[k])], [0, 1, 0], [np.sin(u[k]), 0, np.cos(u[k])]])
        T = np.eye(4)
        T[:3, :3] = turn[:, :, k] @ about
        T[:3, 3] = turn[:, :, k] @ [10 + 4 * np.cos(u[k]), 0, 4 * np.sin(u[k])]
        poses.append(T)
    pairs = [(k, k + 1) for k in range(len(poses) - 1)] + [(k, k + ring) for k in range(len(poses) - ring)]
    z = []
    for i, j in pairs:
        off = pose_matrix(np.array([*rng.normal(0, 0.1, 3), 0, 0, 0, 1]))
        vector = rng.normal(0, noise / 2, 3)
        off[:3, :3] = pose_matrix(np.array([0, 0, 0, *vector, np.sqrt(1 - vector @ vector)]))[:3, :3]
        z.append(pose_vector(np.linalg.inv(poses[i]) @ poses[j] @ off))
    omega = np.diag([100.0] * 3 + [4 / noise**2] * 3)[np.triu_indices(6)]
    first = Variables("se3", np.array([0]), pose_vector(poses[0])[None], fixed=True)
    others = Variables("se3", np.arange(1, len(poses)), np.tile([0, 0, 0, 0, 0, 0, 1.0], (len(poses) - 1, 1)))
    return Batch((first, others), (Factors("between_se3", np.array(pairs), np.array(z), np.tile(omega, (len(z), 1))),))


@pytest.mark.parametrize("noise", [0.05, 0.2])
def test_on_tori_the_start_is_as_good_as_gtsams(noise: float) -> None:
    theirs, ours = gtsam_chordal(torus(20, 15, 4, noise))
    assert ours <= 1.05 * theirs


def ring_wound_twice() -> Batch:
    """Values at which a ring is wound once too often: a minimum of its own, far above the true one."""
    free, edges = plane_ring(16, 0)
    values = np.zeros((15, 3))
    values[:, 2] = np.angle(np.exp(2j * 2 * np.pi / 16 * np.arange(1, 16)))
    fixed = Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True)
    return Batch((fixed, Variables("se2", free.keys[1:], values)), (edges,))


def test_the_best_start_wins_and_is_named() -> None:
    wound = ring_wound_twice()
    stuck = Solver(Options(mode="all-batch"))
    stuck.stage(wound)
    assert stuck.step(settle=True).chi2 > 1.0
    found = solve_batch(wound.variables, wound.factors)
    assert found.chi2 < 1e-12
    assert found.start in ("rotations", "odometry")
    assert solve_batch(found.values, wound.factors).start == "values"
    bare = [g if g.fixed else Variables(g.kind, g.keys) for g in wound.variables]
    assert solve_batch(bare, wound.factors).start in ("rotations", "odometry")


def test_values_half_a_turn_from_what_is_measured_are_no_trap() -> None:
    """At 180° the gradient of an angle's residual vanishes, and Λ may be singular there."""
    fixed = Variables("se3", np.array([0]), np.array([[0, 0, 0, 0, 0, 0, 1.0]]), fixed=True)
    free = Variables("se3", np.array([1]), np.array([[1.0, 0, 0, 0, 0, 1, 0]]))
    edge = Factors(
        "between_se3", np.array([[0, 1]]), np.array([[1.0, 0, 0, 0, 0, 0, 1]]), np.eye(6)[np.triu_indices(6)][None]
    )
    assert solve_batch((fixed, free), (edge,)).chi2 < 1e-12


def test_what_nothing_holds_is_refused_by_name() -> None:
    fixed = Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True)
    free = Variables("se2", np.array([1, 2]), np.zeros((2, 3)))
    edge = Factors("between_se2", np.array([[1, 2]]), np.ones((1, 3)), np.array([[1.0, 0, 0, 1, 0, 1]]))
    with pytest.raises(errors.Underconstrained):
        solve_batch((fixed, free), (edge,))


@pytest.mark.data
@pytest.mark.parametrize(
    "name", ["manhattan3500", "w10000", "victoria_park", "sphere2500", "parking_garage", "city10000"]
)
def test_data_sets_are_solved_from_scratch(datasets: Path, name: str) -> None:
    """Without the values of the file; composed odometry alone ends elsewhere on two of them."""
    optimum = {"manhattan3500": 6532.7447, "w10000": 171545.447, "victoria_park": 6184.1206, "sphere2500": 727.1492,
               "parking_garage": 1.238688, "city10000": 31931.4120}[name]  # fmt: skip
    batch = whole(read(datasets / f"{name}.g2o").steps())
    graph, starts = starts_of(batch)
    chi2 = min(chi2_of(graph, values) for values in starts)
    print(f"{name}: χ² {chi2:.6g} at averaged rotations, {chi2_of(graph, graph.values):.6g} by odometry")
    bare = [g if g.fixed else Variables(g.kind, g.keys) for g in batch.variables]
    assert solve_batch(bare, batch.factors).chi2 == pytest.approx(optimum, rel=1e-5)
    graph.values = min(starts, key=lambda values: chi2_of(graph, values))
    assert solve_batch(graph.variables(), batch.factors).chi2 == pytest.approx(optimum, rel=5e-4)


@pytest.mark.data
@pytest.mark.parametrize("name", ["sphere2500", "parking_garage"])
def test_on_data_sets_the_start_is_as_good_as_gtsams(datasets: Path, name: str) -> None:
    theirs, ours = gtsam_chordal(whole(read(datasets / f"{name}.g2o").steps()))
    print(f"{name}: χ² {ours:.6g} at our start, {theirs:.6g} at GTSAM's")
    assert ours <= 1.05 * theirs


def test_pixels_alone_make_no_start_by_rotations() -> None:
    """Cameras that nothing but pixels joins have no rotations to be averaged: what is given is the start there is."""
    lens = (1.0, 400.0, 400.0, 320.0, 240.0, *[0.0] * 6)
    points = np.array([[-1.0, -1.0, 4.0], [1.0, -1.0, 5.0], [-1.0, 1.0, 6.0], [1.0, 1.0, 4.5], [0.0, 0.5, 5.5]])
    cameras = np.array([[0.0, 0, 0, 0, 0, 0, 1], [0.5, 0, 0, 0, 0, 0, 1], [0.0, 0.5, 0, 0, 0, 0, 1]])
    ends = np.array([[x, 10 + p] for x in range(3) for p in range(5)])
    u = points[ends[:, 1] - 10] - cameras[ends[:, 0], :3]
    pixels = 400.0 * u[:, :2] / u[:, 2:] + (320.0, 240.0)
    seen = Factors("point_seen", ends, np.hstack([pixels, np.tile(lens, (15, 1))]), np.tile([1.0, 0.0, 1.0], (15, 1)))
    variables = (
        Variables("se3", np.array([0, 1]), cameras[:2], True),
        Variables("se3", np.array([2]), cameras[2:] + np.array([0.05, 0.02, 0.01, 0, 0, 0, 0])),
        Variables("point3", 10 + np.arange(5), points + 0.05),
    )
    graph = FactorGraph()
    admit(graph, Batch(variables, (seen,)))
    assert averaged(graph) == []
    found = solve_batch(variables, (seen,))
    assert (found.start, found.chi2) == ("values", pytest.approx(0.0, abs=1e-12))
    with pytest.raises(errors.BadOption):
        solve_batch(variables, (seen,), BatchSearch("rotations"))
    prior = Factors("prior_se3", np.array([[2]]), cameras[2:], np.tile(np.eye(6)[np.triu_indices(6)], (1, 1)))
    assert solve_batch(variables, (seen, prior), BatchSearch("rotations")).chi2 == pytest.approx(0.0, abs=1e-12)
