"""Features in inverse depth become points where that is as good, and the estimate stays."""

import numpy as np
import pytest
from naive import dense_idp
from naive.dense_factors import boxplus
from naive.dense_least_squares import DenseGraph
from naive.random_camera_factors import measurement
from naive.random_cameras import CAMERAS

from factorbus.proto.camera import Camera
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changes.convert_to_points import find_convertible
from factorbus.solver.changing import with_changes, with_converted

LEVEL = np.array([0.0, 0, 0, 0, 0, 0, 1])


def unit(dim: int) -> np.ndarray:
    return np.eye(dim)[np.triu_indices(dim)][None]


def drive_past(solver: Solver, frames: int = 8, features: int = 12, noise: float = 0.5) -> Camera:
    """Features ahead of a camera that goes sideways, its first two poses known."""
    rng, camera = np.random.default_rng(9), CAMERAS["radtan"]
    truth = rng.uniform((-0.5, -1, 4), (3.0, 1, 9), (features, 3))
    for n in range(frames):
        pose = boxplus("se3", LEVEL, np.array([0.35 * n, 0, 0, 0, 0.02 * n, 0]))
        R = dense_idp.matrix(pose[[6, 3, 4, 5]])
        variables, factors = [Variables("se3", np.array([symbol("x", n)]), pose[None], fixed=n < 2)], []
        if n >= 2:
            prior = Factors("prior_se3", np.array([[symbol("x", n)]]), pose[None], 1e2 * unit(6))
            factors.append(prior)
        for k, p in enumerate(truth):
            pixel = dense_idp.pixel(camera, R.T @ (p - pose[:3])) + noise * rng.normal(size=2)
            keys = np.array([[symbol("x", n), symbol("f", k)]])
            if n == 0:
                variables.append(Variables("idp", np.array([symbol("f", k)])))
                info = np.diag([1e8, 1e8, 1e8, 4, 4, 1 / 0.25**2])[np.triu_indices(6)][None]
                z = measurement("idp_first", camera, pixel, 0.2)
                factors.append(Factors("idp_first", keys, z[None], info, "huber", np.array([2.0])))
            else:
                z = measurement("idp_seen", camera, pixel)
                factors.append(Factors("idp_seen", keys, z[None], 4 * unit(2), "huber", np.array([2.0])))
        solver.stage(Batch(tuple(variables), tuple(factors)))
        solver.step()
    return camera


@pytest.mark.parametrize("mode", ["all-batch", "inc-l", "bayes-tree"])
def test_features_become_points_and_the_estimate_stays(mode: str) -> None:
    solver = Solver(Options(mode=mode))
    drive_past(solver)
    before = solver.step(settle=True)
    features = next(group for group in solver.estimate() if group.kind == "idp")
    found = find_convertible(solver.factor_graph, 0.1)
    assert found.size > 0
    assert set(found.tolist()) <= set(features.keys.tolist())
    assert find_convertible(solver.factor_graph, 1e9).size == 12
    assert find_convertible(solver.factor_graph, 0.0).size == 0
    made, report = with_converted(solver, features.keys)
    settled = made.step(settle=True)
    assert (made.variable_count, made.factor_count) == (solver.variable_count, solver.factor_count)
    assert settled.chi2 == pytest.approx(before.chi2, rel=0.05)
    assert report.chi2 <= report.chi2_before
    kinds = {group.kind for group in made.estimate()}
    assert kinds == {"se3", "point3"}
    points = next(group for group in made.estimate() if group.kind == "point3")
    np.testing.assert_array_equal(points.keys, features.keys)
    for y, p in zip(features.values, points.values, strict=True):
        assert np.linalg.norm(dense_idp.point(y) - p) < 0.01 * np.linalg.norm(p)
    poses = [next(g for g in s.estimate() if g.kind == "se3" and not g.fixed).values for s in (solver, made)]
    np.testing.assert_allclose(poses[0], poses[1], atol=2e-3)
    # What comes later may still be sent as observations of features.
    camera, key, p = CAMERAS["radtan"], int(points.keys[0]), points.values[0]
    pose = boxplus("se3", LEVEL, np.array([2.9, 0, 0, 0, 0.16, 0]))
    z = measurement(
        "idp_seen", camera, dense_idp.pixel(camera, dense_idp.matrix(pose[[6, 3, 4, 5]]).T @ (p - pose[:3]))
    )
    again = Factors("idp_seen", np.array([[symbol("x", 20), key]]), z[None], unit(2))
    held = Variables("se3", np.array([symbol("x", 20)]), pose[None], fixed=True)
    made.stage(Batch((held,), (again,)))
    assert made.step().chi2 == pytest.approx(settled.chi2, rel=1e-3)
    counts = {(group.kind, group.loss): len(group.keys) for group in made.graph()[1]}
    assert counts == {("point_seen", ""): 1, ("point_seen", "huber"): 12 * 8, ("prior_se3", ""): 6}
    with pytest.raises(errors.KindMismatch, match="idp"):
        with_converted(made, points.keys)
    with pytest.raises(errors.UnknownVariable):
        with_converted(solver, np.array([symbol("f", 99)]))


def test_a_feature_with_a_linear_factor_stays_one() -> None:
    """What a pose that went has left is of a feature's six numbers, and not of a point's three."""
    solver = Solver(Options())
    drive_past(solver)
    before = solver.step(settle=True)
    assert find_convertible(solver.factor_graph, 1e9).size == 12
    after, _, report, _ = with_changes(solver, [Change("marginalize", keys=np.array([symbol("x", 0)]))], settle=True)
    linear = [g for g in after.graph()[1] if g.kind.startswith("linear_") and g.kind.endswith("_idp")]
    assert sum(len(g.keys) for g in linear) == 12
    assert report.chi2 == pytest.approx(before.chi2, rel=1e-9)
    assert find_convertible(after.factor_graph, 1e9).size == 0
    with pytest.raises(errors.KindMismatch, match="linear factor"):
        with_converted(after, np.array([symbol("f", 3)]))


def test_the_linearity_index_is_the_papers() -> None:
    """σ_ρ by the dense inverse of the feature's own information, cameras held."""
    solver, twin = Solver(Options(mode="all-batch")), DenseGraph()
    drive_past(solver)
    solver.step(settle=True)
    variables, factors = solver.graph()
    twin.add(Batch(tuple(variables), tuple(factors)))
    twin.put(variables)
    twin.fixed |= {key for key, kind in twin.kinds.items() if kind == "se3"}
    covariance = np.linalg.inv(twin.system()[0])
    last = twin.values[symbol("x", 7)][:3]
    for key, start in twin.starts().items():
        y = twin.values[key]
        p, sigma = dense_idp.point(y), np.sqrt(covariance[start + 5, start + 5])
        cosine = (p - last) @ dense_idp.direction(y) / np.linalg.norm(p - last)
        index = 4 * sigma / y[5] ** 2 * abs(cosine) / np.linalg.norm(p - last)
        assert key in find_convertible(solver.factor_graph, index * 1.001).tolist()
        assert key not in find_convertible(solver.factor_graph, index * 0.999).tolist()
