"""Lenses whose numbers are variables: residuals and Jacobians, what is refused, and what becomes of a wrong lens."""

import gtsam
import numpy as np
import pytest
from naive.dense_factors import boxplus, jacobians, pose_matrix, residual
from naive.dense_least_squares import CONNECTS
from naive.random_lenses import BELIEVED, LENS_KINDS, lens_steps, random_lens_factor

from factorbus.client import Camera, Draft
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changing import with_changes
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.linearized import linearized_factor
from factorbus.solver.graph.observations import inactive

CASES = [
    (kind, camera)
    for kind in LENS_KINDS
    for camera in (BELIEVED if kind.endswith("focal") else ["radtan"])
]  # fmt: skip
UNIT = np.array([[1.0, 0.0, 1.0]])
HERE = (0.0, 0, 0, 0, 0, 0, 1)
PINHOLE = Camera("pinhole", (400.0, 410.0, 320.0, 240.0))


@pytest.mark.parametrize(("kind", "camera"), CASES)
@pytest.mark.parametrize("seed", range(5))
def test_residual_and_jacobians_are_those_of_the_twin(kind: str, camera: str, seed: int) -> None:
    ends, z = random_lens_factor(kind, np.random.default_rng(seed), camera)
    graph, keys = FactorGraph(), np.arange(1, len(ends) + 1)
    variables = [
        Variables(end, keys[n : n + 1], value[None])
        for n, (end, value) in enumerate(zip(FACTOR_KINDS[kind].connects, ends, strict=True))
    ]
    admit(graph, Batch(tuple(variables), (Factors(kind, keys[None], z[None], UNIT),)))
    ours = linearized_factor(graph, 0)
    np.testing.assert_allclose(ours.r, residual(kind, ends, z), atol=1e-9)
    wanted = jacobians(kind, CONNECTS[kind], ends, z)
    for v, J in zip(ours.ends.tolist(), wanted, strict=True):
        np.testing.assert_allclose(ours.jacobian_of(v), J, rtol=1e-7, atol=1e-7 * np.abs(J).max())


@pytest.mark.parametrize("seed", range(20))
def test_a_bundler_lens_is_gtsams_where_it_looks_the_other_way(seed: int) -> None:
    """GTSAM's Cal3Bundler, in a camera that looks along z: pixel, and Jacobians by pose, point and lens."""
    rng = np.random.default_rng(seed)
    ends, z = random_lens_factor("point_seen_bundler", rng, "radtan")
    z[5:7], z[4], z[8:13] = 0.0, z[3], 0.0  # Cal3Bundler's principal point is constant, here 0
    graph = FactorGraph()
    variables = [
        Variables(end, np.array([n + 1]), value[None])
        for n, (end, value) in enumerate(zip(("se3", "point3", "vector3"), ends, strict=True))
    ]
    admit(graph, Batch(tuple(variables), (Factors("point_seen_bundler", np.array([[1, 2, 3]]), z[None], UNIT),)))
    ours = linearized_factor(graph, 0)
    noise = gtsam.noiseModel.Unit.Create(2)
    theirs = gtsam.GeneralSFMFactor2Cal3Bundler(z[:2], noise, 1, 2, 3)
    values = gtsam.Values()
    values.insert(1, gtsam.Pose3(pose_matrix(ends[0])))
    values.insert(2, ends[1])
    values.insert(3, gtsam.Cal3Bundler(*ends[2], 0.0, 0.0))
    J, b = theirs.linearize(values).jacobian()
    np.testing.assert_allclose(ours.r, -b, atol=1e-9)
    found = [ours.jacobian_of(v) for v in ours.ends.tolist()]
    found[0] = found[0][:, [3, 4, 5, 0, 1, 2]]
    np.testing.assert_allclose(np.hstack(found), J, rtol=1e-9, atol=1e-7)


def seen(camera: Camera, **lens: str) -> Draft:
    values = {"focal": [400.0], "bundler": [400.0, 0.0, 0.0], "intrinsics": [400.0, 410, 320, 240, 0, 0, 0, 0, 0]}
    draft = Draft().se3("x0", HERE, fixed=True).point3("l0", (0.1, 0.2, 4.0), fixed=True)
    for name, key in lens.items():
        draft.vector(key, values[name])
    return draft.point_seen("x0", "l0", camera, (330, 260), sigmas=(1, 1), **lens)


@pytest.mark.parametrize("lens", ["bundler", "intrinsics"])
@pytest.mark.parametrize("camera", ["fisheye", "radial"])
def test_numbers_of_one_model_are_not_those_of_another(camera: str, lens: str) -> None:
    with pytest.raises(errors.BadLens, match="numbers of radtan and pinhole"):
        Solver(Options()).stage(seen(BELIEVED[camera], **{lens: "c0"}).batch())


@pytest.mark.parametrize("lens", ["focal", "bundler", "intrinsics"])
@pytest.mark.parametrize("f", [0.0, -400.0])
def test_a_focal_length_that_is_not_above_zero_is_refused(f: float, lens: str) -> None:
    batch = seen(PINHOLE, **{lens: "c0"}).batch()
    numbers = next(group for group in batch.variables if group.kind.startswith("vector"))
    assert numbers.values is not None
    numbers.values[0, 0] = f
    with pytest.raises(errors.BadObservation, match="focal length, a variable, is not above 0"):
        Solver(Options()).stage(batch)


def test_where_a_focal_length_has_become_negative_nothing_is_seen() -> None:
    graph = FactorGraph()
    admit(graph, seen(PINHOLE, focal="c0").batch())
    assert inactive(graph) == []
    graph.values[10] = -1.0  # behind a pose and a point
    (found,) = inactive(graph)
    assert found[2] == "its focal length, a variable, is not above 0"
    ours = linearized_factor(graph, 0)
    assert not ours.r.any()
    assert not any(ours.jacobian_of(v).any() for v in ours.ends.tolist())


def test_the_pixel_need_not_have_a_ray_through_the_lens_as_it_was_believed_to_be() -> None:
    """With k1 = −0.4 no ray goes to this pixel; with k1 = 0, which is the variable's, one does."""
    folding = Camera("radtan", (400.0, 400.0, 320.0, 240.0, -0.4, 0.0, 0.0, 0.0))
    draft = Draft().se3("x0", HERE, fixed=True).point3("l0", (4.0, 0.0, 4.0), fixed=True)
    known = Draft().se3("x0", HERE, fixed=True).point3("l0", (4.0, 0.0, 4.0), fixed=True)
    with pytest.raises(errors.BadObservation, match="one to one"):
        Solver(Options()).stage(known.point_seen("x0", "l0", folding, (720, 240), sigmas=(1, 1)).batch())
    draft.vector("c0", [400.0, 0.0, 0.0]).point_seen("x0", "l0", folding, (720, 240), bundler="c0", sigmas=(1, 1))
    solver = Solver(Options())
    solver.stage(draft.batch())


def test_focal_length_and_distortion_are_found_from_what_three_cameras_see() -> None:
    """Three known poses, thirty points in depth: f to a pixel, k1 and k2 to three standard deviations."""
    rng, truth = np.random.default_rng(2), np.array([1200.0, -0.12, 0.05])
    draft = Draft().vector("c0", [900.0, 0.0, 0.0])
    ways = ([0.0] * 6, [1.0, 0, 0, 0, -0.2, 0.1], [2.0, 0.5, 0, 0.1, -0.4, 0])  # that turn: else f goes with depth
    poses = [boxplus("se3", np.array(HERE), np.array(way)) for way in ways]
    for n, pose in enumerate(poses):
        draft.se3(f"x{n}", pose, fixed=True)
    for k in range(30):
        point = np.array([*rng.uniform(-3, 4, 2), rng.uniform(4, 9)])
        draft.point3(f"l{k}", point + rng.normal(0, 0.2, 3))
        for n, pose in enumerate(poses):
            z = np.array([0.0, 0, *PINHOLE.lens()])
            pixel = residual("point_seen_bundler", [pose, point, truth], z) + rng.normal(0, 0.5, 2)
            draft.point_seen(f"x{n}", f"l{k}", PINHOLE, pixel, bundler="c0", sigmas=(0.5, 0.5))
    solver = Solver(Options())
    solver.stage(draft.batch())
    solver.step(settle=True)
    (found,) = (group.values[0] for group in solver.estimate() if group.kind == "vector3")
    assert abs(found[0] - truth[0]) < 30
    np.testing.assert_allclose(found[1:], truth[1:], atol=0.05)
    assert solver.chi2() < 180


@pytest.mark.parametrize("seed", range(3))
def test_points_may_go_and_the_lenses_stay(seed: int) -> None:
    solver = Solver(Options())
    for batch in lens_steps(seed, 4, noise=0.1):
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    before = {k: v for group in solver.estimate() for k, v in zip(group.keys.tolist(), group.values, strict=True)}
    gone = np.array([symbol("p", 0), symbol("q", 1), symbol("p", 3)])
    after = with_changes(solver, [Change("marginalize", keys=gone)], settle=True)[0]
    left = {k: v for group in after.estimate() for k, v in zip(group.keys.tolist(), group.values, strict=True)}
    assert set(left) == set(before) - set(gone.tolist())
    for key, value in left.items():
        np.testing.assert_allclose(value, before[key], atol=2e-5)  # of lenses pixels
