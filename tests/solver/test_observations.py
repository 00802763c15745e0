"""What cameras in a map see: against dense twins and GTSAM, in every mode; what cannot be seen; losses."""

import gtsam
import numpy as np
import pytest
from naive import dense_idp
from naive.dense_factors import boxplus, camera_of
from naive.dense_least_squares import DenseGraph, distance, rho, weight
from naive.random_camera_factors import CAMERA_KINDS, measurement, random_camera_factor, state_of
from naive.random_cameras import CAMERAS
from naive.random_graphs import camera_steps
from naive.solver_parts import graph_in

from factorbus.proto.camera import Camera
from factorbus.proto.kinds import LOSSES
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.why import why_factor, why_variable
from factorbus.solver.graph.factors import FACTOR_KINDS
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import INACTIVE_CHI2
from factorbus.solver.kernels.model.candidates import evaluate_factors

X, F, P = symbol("x", 0), symbol("f", 0), symbol("p", 0)
LEVEL = np.array([0.0, 0, 0, 0, 0, 0, 1])
PINHOLE = CAMERAS["pinhole"]
TIGHT = {"batch_tolerance": 0.0, "incremental_tolerance": 0.0, "chi2_epsilon": 1e-20, "max_iterations": 200}


def unit(dim: int) -> np.ndarray:
    return np.eye(dim)[np.triu_indices(dim)][None]


def observation_map(
    kind: str, pose: np.ndarray, end: np.ndarray, z: np.ndarray, loss: str = "", scale: float = 1.0
) -> Solver:
    """A map of one camera, one thing that it sees, and priors on all."""
    seen = "point3" if kind == "point_seen" else "idp"
    loose = Factors(kind, np.array([[X, F]]), z[None], unit(6 if kind == "idp_first" else 2))
    factors = [loose._replace(loss=loss, scale=np.array([scale]) if loss else None)]
    factors.append(Factors("prior_se3", np.array([[X]]), pose[None], unit(6)))
    if kind == "point_seen":
        factors.append(Factors("prior_point3", np.array([[F]]), end[None], unit(3)))
    if kind == "idp_seen":
        first = measurement("idp_first", camera_of(z[2:]), z[:2])
        factors.append(Factors("idp_first", np.array([[X, F]]), first[None], unit(6)))
    solver = Solver(Options(mode="all-batch"))
    variables = Variables("se3", np.array([X]), pose[None]), Variables(seen, np.array([F]), end[None])
    solver.stage(Batch(variables, tuple(factors)))
    return solver


def evaluated(solver: Solver, factor: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """r, A, B, whole."""
    graph = graph_in(solver)
    r, A, B, W = (np.zeros((1, *shape)) for shape in ((at.R_SIZE,), (6, 6), (6, 6), (6, 6)))
    evaluate_factors(np.array([factor]), graph.array_table, graph.values, r, A, B, W)
    return r[0], A[0], B[0]


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("kind", CAMERA_KINDS)
def test_every_lens_gives_the_residual_of_the_dense_twin(kind: str, name: str) -> None:
    for seed in range(4):
        camera, (pose, end), z = random_camera_factor(kind, np.random.default_rng(seed), name)
        r, _, _ = evaluated(observation_map(kind, pose, end, z))
        if kind == "point_seen":
            pixel = dense_idp.pixel(camera, dense_idp.matrix(pose[[6, 3, 4, 5]]).T @ (end - pose[:3]))
        else:
            pixel = dense_idp.observed(camera, state_of(pose), end)
        row = 3 if kind == "idp_first" else 0
        np.testing.assert_allclose(r[row : row + 2], pixel - z[:2], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("mode", ["all-batch", "inc-l", "bayes-tree"])
@pytest.mark.parametrize("seed", range(2))
def test_every_step_is_the_dense_optimum(seed: int, mode: str) -> None:
    tree = (
        {"relinearize_threshold": 0.0, "relinearize_same_step_share": 0.0, "wildfire_threshold": 0.0, "max_rounds": 40}
        if mode == "bayes-tree"
        else {}
    )
    solver, twin = Solver(Options.of(mode=mode, **TIGHT, **tree)), DenseGraph()
    for batch in camera_steps(seed):
        solver.stage(batch)
        report = solver.step()
        twin.add(batch)
        twin.put(solver.estimate())
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-7)
        assert twin.gauss_newton(iterations=2) < 1e-7
        assert report.inactive == 0
        for group in solver.estimate():
            for key, value in zip(group.keys.tolist(), group.values, strict=True):
                assert distance(group.kind, value, twin.values[key]) < 1e-6


@pytest.mark.parametrize("mode", ["all-batch", "inc-l", "bayes-tree"])
@pytest.mark.parametrize("loss", LOSSES)
def test_robust_estimates_are_where_the_twins_gradient_is_zero(loss: str, mode: str) -> None:
    solver, twin = Solver(Options(mode=mode)), DenseGraph()
    for batch in camera_steps(3, loss=loss):
        solver.stage(batch)
        twin.add(batch)
        solver.step()
    report = solver.step(settle=True)
    twin.put(solver.estimate())
    assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-9)
    assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-9)
    information, eta = twin.system()
    assert np.abs(eta / np.sqrt(np.diag(information))).max() < 1e-3


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("kind", [*CAMERA_KINDS, "between_se3"])
def test_a_loss_weighs_residual_and_jacobians_by_its_slope(kind: str, loss: str) -> None:
    rng = np.random.default_rng(5)
    for shift in (0.1, 1.0, 3.0, 60.0):
        if kind == "between_se3":
            poses = [LEVEL, boxplus("se3", LEVEL, 0.1 * rng.normal(size=6))]
            z = boxplus("se3", poses[1], np.array([shift, 0, 0, 0, 0, 0]))[None]
            maps = []
            for name in ("", loss):
                factor = Factors("between_se3", np.array([[0, 1]]), z, unit(6), name, np.array([2.0]) if name else None)
                maps.append(Solver())
                maps[-1].stage(Batch((Variables("se3", np.array([0, 1]), np.array(poses)),), (factor,)))
        else:
            _, (pose, end), z = random_camera_factor(kind, rng, "radtan")
            z[0] += shift
            maps = [observation_map(kind, pose, end, z), observation_map(kind, pose, end, z, loss, 2.0)]
        (r, A, B), (r_w, A_w, B_w) = map(evaluated, maps)
        dim = FACTOR_KINDS[kind].dim
        s = r[:dim] @ r[:dim]
        root = np.sqrt(weight(loss, 2.0, s))
        for plain, soft in ((r[:dim], r_w[:dim]), (A[:dim], A_w[:dim]), (B[:dim], B_w[:dim])):
            np.testing.assert_allclose(soft, root * plain, rtol=1e-4, atol=1e-9)
        for solver in maps:
            for group in solver.graph()[1]:
                assert (group.loss, group.scale) == ("", None) or (group.loss, *group.scale) == (loss, 2.0)
        if kind == "between_se3" or root == 0.0:  # with no weight at all a feature is not held
            continue
        priors = maps[0].step().chi2_before - s
        assert maps[1].step().chi2_before == pytest.approx(rho(loss, 2.0, s) + priors, rel=1e-9)


def test_a_feature_without_a_value_is_where_its_first_observation_has_no_residual() -> None:
    for name, camera in CAMERAS.items():
        _, (pose, _), z = random_camera_factor("idp_first", np.random.default_rng(7), name)
        solver = Solver()
        solver.stage(
            Batch(
                (Variables("se3", np.array([X]), pose[None], True), Variables("idp", np.array([F]))),
                (Factors("idp_first", np.array([[X, F]]), z[None], unit(6)),),
            )
        )
        np.testing.assert_allclose(evaluated(solver)[0][:6], 0.0, atol=1e-9)
        y = solver.graph()[0][1].values[0]
        np.testing.assert_allclose(y, dense_idp.feature(camera, state_of(pose), z[:2], z[2]), atol=1e-9)
        assert solver.step().chi2 == pytest.approx(0.0, abs=1e-15)


BEHIND, FOLDING = np.array([0.0, 0, -2]), Camera("radtan", (400.0, 400, 320, 240, -0.3, 0, 0, 0))
CENTRE = np.array([320.0, 240.0])


def point_batch(z: np.ndarray, place: np.ndarray = np.array([0.0, 0, 2])) -> Batch:  # noqa: B008
    variables = Variables("se3", np.array([X]), LEVEL[None], True), Variables("point3", np.array([P]), place[None])
    prior = Factors("prior_point3", np.array([[P]]), place[None], unit(3))
    return Batch(variables, (prior, Factors("point_seen", np.array([[X, P]]), z[None], unit(2))))


def lens(index: int, value: float) -> np.ndarray:
    z = measurement("point_seen", PINHOLE, CENTRE)
    z[2 + index] = value
    return z


def downwards(z: np.ndarray) -> Batch:
    down = np.array([0.0, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    variables = Variables("se3", np.array([X]), down[None], True), Variables("idp", np.array([F]))
    return Batch(variables, (Factors("idp_first", np.array([[X, F]]), z[None], unit(6)),))


REFUSED = {
    "behind": ("bad_observation", "behind", point_batch(measurement("point_seen", PINHOLE, CENTRE), BEHIND)),
    "no ray": (
        "bad_observation",
        "one to one",
        point_batch(measurement("point_seen", FOLDING, np.array([900.0, 240]))),
    ),
    "vertical": ("bad_observation", "azimuth", downwards(measurement("idp_first", PINHOLE, CENTRE))),
    "model": ("bad_lens", "model 7", point_batch(lens(0, 7.0))),
    "focal length": ("bad_lens", "focal", point_batch(lens(1, 0.0))),
    "limit": ("bad_lens", "limit", point_batch(lens(5, -1.0))),
    "NaN": ("not_finite", "point_seen", point_batch(lens(6, np.nan))),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_camera_can_see_is_refused_with_the_reason(name: str) -> None:
    code, says, batch = REFUSED[name]
    solver = Solver()
    with pytest.raises(errors.SolverError, match=says) as caught:
        solver.stage(batch)
    assert caught.value.code == code
    assert (solver.variable_count, solver.factor_count) == (0, 0)


@pytest.mark.parametrize(("loss", "scale"), [("welsch", np.ones(1)), ("huber", None), ("huber", np.zeros(1))])
def test_losses_that_are_none_are_refused(loss: str, scale: np.ndarray | None) -> None:
    batch = point_batch(measurement("point_seen", PINHOLE, CENTRE))
    bad = Batch(batch.variables, (batch.factors[0], batch.factors[1]._replace(loss=loss, scale=scale)))
    with pytest.raises(errors.BadLoss):
        Solver().stage(bad)


@pytest.mark.parametrize("mode", ["all-batch", "inc-l", "bayes-tree"])
def test_an_observation_that_is_lost_counts_for_nothing_and_is_reported(mode: str) -> None:
    """A strong prior pulls a point behind the camera that saw it."""
    solver = Solver(Options(mode=mode))
    solver.stage(point_batch(measurement("point_seen", PINHOLE, CENTRE)))
    assert solver.step(settle=True).inactive == 0
    assert solver.inactive() == []
    solver.stage(Batch((), (Factors("prior_point3", np.array([[P]]), BEHIND[None], 1e6 * unit(3)),)))
    solver.step()
    report = solver.step(settle=True)
    assert report.inactive == 1
    [(factor, text, why)] = solver.inactive()
    assert (factor, text) == (1, "point_seen (x0, p0)")
    assert "behind" in why
    weak, strong = np.array([0.0, 0, 2]), BEHIND
    place = (weak + 1e6 * strong) / (1e6 + 1)
    np.testing.assert_allclose(solver.estimate()[-1].values[0], place, atol=1e-6)
    assert solver.chi2() == pytest.approx(INACTIVE_CHI2 + 16.0, rel=1e-3)
    explained = why_variable(
        CovarianceBlocks(solver.covariances.factored()), graph_in(solver).find(P), keeps_steps=False
    ).factors
    assert [each.inactive for each in explained] == ["", why, ""]
    assert (explained[1].leverage, explained[1].weight, explained[1].rho) == (0.0, 0.0, INACTIVE_CHI2)
    assert (explained[1].residual.tolist(), explained[1].without) == ([0.0, 0.0], INACTIVE_CHI2)


@pytest.mark.parametrize("loss", LOSSES)
def test_why_says_what_a_loss_leaves_of_a_factor(loss: str) -> None:
    """Two priors that contradict each other; the second, weaker one has a loss."""
    for apart in (0.5, 3.0, 40.0):
        places, given = np.array([[0.0, 0, 0], [apart, 0, 0]]), (1e4 * unit(3), unit(3))
        first, second = (
            Factors("prior_point3", np.array([[P]]), place[None], information)
            for place, information in zip(places, given, strict=True)
        )
        solver = Solver()
        soft = second._replace(loss=loss, scale=np.array([2.0]))
        solver.stage(Batch((Variables("point3", np.array([P]), places[:1]),), (first, soft)))
        solver.step(settle=True)
        s = float(np.sum((solver.estimate()[0].values[0] - places[1]) ** 2))
        explained = why_factor(CovarianceBlocks(solver.covariances.factored()), 1)
        assert (explained.loss, explained.inactive) == (loss, "")
        assert explained.weight == pytest.approx(weight(loss, 2.0, s), rel=1e-6)
        assert explained.chi2 == pytest.approx(s, rel=1e-6)
        np.testing.assert_allclose(explained.residual, solver.estimate()[0].values[0] - places[1], rtol=1e-6)
        assert explained.rho + float(
            why_factor(CovarianceBlocks(solver.covariances.factored()), 0).chi2
        ) == pytest.approx(solver.chi2())
        plain = why_factor(CovarianceBlocks(solver.covariances.factored()), 0)
        assert (plain.loss, plain.weight) == ("", 1.0)


def test_a_point_by_two_pixels_and_a_camera_by_its_points_are_held() -> None:
    """None of them has anything else that holds it; nothing is factorized to find that out."""
    rng = np.random.default_rng(2)
    points = rng.uniform((-1, -1, 4), (1, 1, 6), (6, 3))
    cameras = [boxplus("se3", LEVEL, np.array([0.4 * n, 0, 0, 0, 0.02 * n, 0])) for n in range(3)]

    def seen(n: int) -> Factors:
        R, t = dense_idp.matrix(cameras[n][[6, 3, 4, 5]]), cameras[n][:3]
        z = [measurement("point_seen", PINHOLE, dense_idp.pixel(PINHOLE, R.T @ (p - t))) for p in points]
        keys = [[symbol("x", n), symbol("p", k)] for k in range(6)]
        return Factors("point_seen", np.array(keys), np.array(z), np.repeat(unit(2), 6, 0))

    for mode in ("inc-l", "bayes-tree"):
        solver = Solver(Options(mode=mode))
        keys = np.array([symbol("x", 0), symbol("x", 1)])
        fixed = Variables("se3", keys, np.array(cameras[:2]), fixed=True)
        new = Variables("point3", np.array([symbol("p", k) for k in range(6)]), points + 0.05 * rng.normal(size=(6, 3)))
        solver.stage(Batch((fixed, new), (seen(0), seen(1))))
        assert "together" not in solver.step().because
        third = Variables(
            "se3", np.array([symbol("x", 2)]), boxplus("se3", cameras[2], 0.02 * rng.normal(size=6))[None]
        )
        solver.stage(Batch((third,), (seen(2),)))
        assert "together" not in solver.step().because
        assert solver.step(settle=True).chi2 < 1e-12


def test_the_optimum_is_gtsams() -> None:
    """Points seen by cameras through a distorting lens: GTSAM's Cal3DS2 has the same pixels, so the same optimum."""
    camera, rng = CAMERAS["radtan"], np.random.default_rng(4)
    fx, fy, cx, cy, k1, k2, p1, p2, _ = camera.numbers
    camera = Camera("radtan", (fx, fy, cx, cy, k1, k2, p1, p2))
    calibration = gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, k1, k2, p1, p2)
    points = rng.uniform((-1.5, -1, 4), (1.5, 1, 7), (12, 3))
    cameras = [boxplus("se3", LEVEL, np.array([0.3 * n, 0.1 * n, 0, 0, 0.03 * n, 0.01])) for n in range(5)]
    theirs, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pixel_noise = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    keys, measured = [], []
    for n, pose in enumerate(cameras):
        R = gtsam.Rot3.Quaternion(pose[6], *pose[3:6])
        guess = boxplus("se3", pose, 0.02 * rng.normal(size=6)) if n else pose
        start.insert(n, gtsam.Pose3(gtsam.Rot3.Quaternion(guess[6], *guess[3:6]), guess[:3]))
        if n < 2:
            tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)
            theirs.add(gtsam.PriorFactorPose3(n, gtsam.Pose3(R, pose[:3]), tight))
        for k, p in enumerate(points):
            pixel = dense_idp.pixel(camera, dense_idp.matrix(pose[[6, 3, 4, 5]]).T @ (p - pose[:3])) + rng.normal(
                size=2
            )
            factor = gtsam.GenericProjectionFactorCal3DS2(pixel, pixel_noise, n, 100 + k, calibration)
            theirs.add(factor)
            keys.append([n, 100 + k])
            measured.append(measurement("point_seen", camera, pixel))
        cameras[n] = guess if n > 1 else pose
    for k, p in enumerate(points):
        start.insert(100 + k, p)
    solver = Solver()
    fixed = Variables("se3", np.array([0, 1]), np.array(cameras[:2]), fixed=True)
    free = Variables("se3", np.array([2, 3, 4]), np.array(cameras[2:]))
    factors = Factors("point_seen", np.array(keys), np.array(measured), np.repeat(unit(2), len(keys), 0))
    solver.stage(Batch((fixed, free, Variables("point3", np.arange(100, 112), points)), (factors,)))
    report = solver.step(settle=True)
    optimum = gtsam.LevenbergMarquardtOptimizer(theirs, start).optimize()
    assert report.chi2 == pytest.approx(2 * theirs.error(optimum), rel=1e-4)
    found = {
        key: value for group in solver.estimate() for key, value in zip(group.keys.tolist(), group.values, strict=True)
    }
    for k in range(12):
        np.testing.assert_allclose(found[100 + k], optimum.atPoint3(100 + k), atol=2e-3)
