"""Scales, biases, other frames, lever arms, clocks: where values come from, what holds them, what is told of them."""

import numpy as np
import pytest
from naive.dense_derived import base_ends
from naive.dense_factors import boxplus, pose_matrix, pose_vector

from factorbus.client import Draft
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changes.repair import repair
from factorbus.solver.graph.factor_rows import variables_aside
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.starts.averaged import averaged

TWIST = (2.0, 0.0, 0.5)
WAY = np.array([1.0, 0.1, 0.3])


def known(draft: Draft, key: str, value: float, sigma: float = 0.01) -> Draft:
    """A number with a prior."""
    return draft.vector(key, [value]).linear([key], [[value]], [[[1.0]]], [0.0], sigmas=sigma)


def values(solver: Solver) -> dict[int, np.ndarray]:
    return {k: row for g in solver.estimate() for k, row in zip(g.keys.tolist(), g.values, strict=True)}


def staged(*drafts: Draft) -> Solver:
    solver = Solver(Options())
    for draft in drafts:
        solver.stage(draft.batch())
        solver.step()
    return solver


def composed_with(pose: np.ndarray, way: np.ndarray) -> np.ndarray:
    return pose_vector(pose_matrix(pose) @ pose_matrix(way))


@pytest.mark.parametrize("forward", [True, False])
def test_a_pose_without_a_value_is_where_the_scaled_odometry_leads(forward: bool) -> None:
    first, last = ("x0", "x1") if forward else ("x1", "x0")
    draft = known(Draft().se2("x0", (1, 2, 0.5), fixed=True).se2("x1"), "s0", 1.5)
    found = values(staged(draft.between_se2(first, last, WAY, scale="s0", sigmas=[0.1] * 3)))
    scaled = composed_with(np.zeros(3), WAY * (1.5, 1.5, 1))
    way = scaled if forward else pose_vector(np.linalg.inv(pose_matrix(scaled)))
    np.testing.assert_allclose(found[symbol("x", 1)], composed_with(np.array([1, 2, 0.5]), way), atol=1e-9)


def test_a_point_without_a_value_is_where_it_was_seen_when_the_clock_was_late() -> None:
    pose = np.array([1.0, 2.0, 0.5])
    draft = known(Draft().se2("x0", pose, fixed=True).point2("l0"), "d0", 0.2)
    draft.landmark_se2("x0", "l0", (3.0, 1.0), offset="d0", twist=TWIST, sigmas=(0.1, 0.1))
    (seen, _), _ = base_ends("landmark_se2_offset", [pose, np.zeros(2), np.array([0.2])], np.array([3.0, 1.0, *TWIST]))
    found = values(staged(draft))
    np.testing.assert_allclose(found[symbol("l", 0)], (pose_matrix(seen) @ [3, 1, 1])[:2], atol=1e-9)


def in_frame(yaw: float, seed: int = 3) -> tuple[list[Draft], np.ndarray]:
    """A drive with places in a frame of which only the first place is known, and the frame's true pose."""
    rng, f, pose, drafts = np.random.default_rng(seed), np.array([30.0, -20.0, yaw]), np.zeros(3), list[Draft]()
    odometry = np.array([0.02, 0.02, 0.01])
    for n in range(25):
        draft, way = Draft(), np.array([1.0, 0, 0.3 * np.sin(0.5 * n)])
        if n == 0:
            rough = (*f[:2], 0.0)
            draft.se2("x0", pose, fixed=True).se2("f0", rough).prior_se2("f0", rough, sigmas=(100, 100, np.pi))
        else:
            pose = composed_with(pose, way)
            draft.se2(f"x{n}")
            measured = boxplus("se2", way, rng.normal(0, odometry))
            draft.between_se2(f"x{n - 1}", f"x{n}", measured, sigmas=odometry)
        z = (pose_matrix(f) @ np.append(pose[:2], 1))[:2] + rng.normal(0, 0.3, 2)
        drafts.append(draft.position_se2(f"x{n}", z, frame="f0", sigmas=[0.3, 0.3]))
    return drafts, f


@pytest.mark.parametrize("yaw", [0.5, 2.0, 3.0, -3.1])
def test_a_map_turned_by_any_angle_is_turned_by_the_first_few_places(yaw: float) -> None:
    drafts, f = in_frame(yaw)
    solver = staged(*drafts[:6])
    turned = values(solver)[symbol("f", 0)]
    assert abs(np.angle(np.exp(1j * (turned[2] - yaw)))) < 0.5
    for draft in drafts[6:]:
        solver.stage(draft.batch())
        solver.step()
    found = values(solver)[symbol("f", 0)]
    assert abs(np.angle(np.exp(1j * (found[2] - yaw)))) < 0.1
    np.testing.assert_allclose(found[:2], f[:2], atol=0.5)


def test_places_in_a_known_frame_hold_a_map() -> None:
    """No pose of the map is fixed, none has a prior."""
    (first, *rest), f = in_frame(1.0)
    held = Draft().se2("f0", f, fixed=True).se2("x0", np.zeros(3)).se2("x1")
    held.between_se2("x0", "x1", (1, 0, 0), sigmas=(0.1, 0.1, 0.1))
    for n, place in enumerate(((0.0, 0.0), (1.0, 0.0))):
        z = (pose_matrix(f) @ [*place, 1.0])[:2]
        held.position_se2(f"x{n}", z, frame="f0", sigmas=(0.1, 0.1))
    found = values(staged(held))
    np.testing.assert_allclose(found[symbol("x", 1)], [1, 0, 0], atol=1e-6)
    loose = Draft().se2("f0", f).se2("x0", np.zeros(3)).position_se2("x0", (0, 0), frame="f0", sigmas=(1, 1))
    with pytest.raises(errors.Underconstrained):
        staged(loose)
    assert first.batch().factor_count + rest[0].batch().factor_count == 4


def test_a_scale_that_nothing_tells_of_is_refused_by_name() -> None:
    draft = Draft().se2("x0", np.zeros(3), fixed=True).se2("x1").vector("s0", [1.0])
    draft.between_se2("x0", "x1", WAY, scale="s0", sigmas=[0.1] * 3)
    with pytest.raises(errors.Underconstrained):
        staged(draft)


def test_mounts_and_frames_are_no_places() -> None:
    drafts, _ = in_frame(1.0)
    solver = staged(*drafts[:3])
    graph = solver.covariances.factored().graph
    aside = variables_aside(graph.fac[: graph.counts[at.FACTORS]])
    assert graph.keys[aside].tolist() == [symbol("f", 0)]
    velocity = Draft().vector("v0", (1.0, 0.0)).velocity_frame_se2("f0", "v0", (0.5, 0.5), sigmas=(0.1, 0.1))
    solver.stage(velocity.batch())
    solver.step()
    graph = solver.covariances.factored().graph
    aside = variables_aside(graph.fac[: graph.counts[at.FACTORS]])
    assert graph.keys[aside].tolist() == [symbol("f", 0)]


def test_a_map_averaged_anew_takes_scales_as_they_are_and_leaves_frames_where_they_are() -> None:
    draft, pose = known(Draft().se2("x0", np.zeros(3), fixed=True), "s0", 1.5), np.zeros(3)
    draft.se2("f0", (5, 5, 1)).prior_se2("f0", (5, 5, 1), sigmas=(1, 1, 1))
    true = [pose]
    for n in range(1, 6):
        pose = composed_with(pose, WAY)
        true.append(pose)
        draft.se2(f"x{n}", np.zeros(3))
        draft.between_se2(f"x{n - 1}", f"x{n}", WAY / (1.5, 1.5, 1), scale="s0", sigmas=[0.1] * 3)
        z = (pose_matrix(np.array([5.0, 5, 1])) @ np.append(pose[:2], 1))[:2]
        draft.position_se2(f"x{n}", z, frame="f0", sigmas=(1, 1))
    solver = Solver(Options())
    solver.stage(draft.batch())
    graph = solver.content()
    for found in averaged(graph):
        rows = {int(graph.keys[v]): found[graph.var[v, at.V_AT] :] for v in range(graph.counts[at.VARIABLES])}
        for n, pose in enumerate(true):
            np.testing.assert_allclose(rows[symbol("x", n)][:3], pose, atol=1e-9)
        np.testing.assert_array_equal(rows[symbol("f", 0)][:3], [5, 5, 1])


def test_repair_takes_out_false_closures_of_scaled_odometry() -> None:
    """Closures and steps have one scale; one closure in five is wrong."""
    rng, solver, pose, wrong = np.random.default_rng(4), Solver(Options()), np.zeros(3), list[int]()
    sigma, poses = np.array([0.01] * 3), [np.zeros(3)]
    for n in range(30):
        draft = Draft().se2(f"x{n}", pose, fixed=True) if n == 0 else Draft().se2(f"x{n}")
        if n == 0:
            known(draft, "s0", 1.1, 0.2)
        else:
            way = np.array([1.0, 0.0, 0.3])
            poses.append(pose := composed_with(pose, way))
            z = boxplus("se2", way, rng.normal(0, sigma)) / (1.2, 1.2, 1)
            draft.between_se2(f"x{n - 1}", f"x{n}", z, scale="s0", sigmas=sigma)
        if n > 5:
            T = np.linalg.inv(pose_matrix(poses[n - 5])) @ pose_matrix(poses[n])
            z = boxplus("se2", pose_vector(T), rng.normal(0, sigma))
            if n % 5 == 0:
                wrong.append(solver.factor_count + 1)
                z += (2.0, -1.0, 0.5)
            draft.between_se2(f"x{n - 5}", f"x{n}", z, sigmas=sigma)
        solver.stage(draft.batch())
        solver.step()
    assert repair(solver.content()).false.tolist() == wrong
