"""How certain a measurement is: radians everywhere, and nothing that is misspelt or cannot be meant is swallowed."""

import inspect

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive.dense_covariances import DenseCovariance
from naive.dense_least_squares import DenseGraph

from factorbus.client import Camera, Changes, Draft
from factorbus.client.certainty import DEFAULT_SCALES
from factorbus.proto.kinds import LOSSES, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.problems import BadInformation, BadLoss, BadShape, BadSymbol, Problem
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks

IDENTITY = (0, 0, 0, 0, 0, 0, 1)
SIGMAS = (0.1, 0.2, 0.3, 0.01, 0.02, 0.05)


def quaternion(turn: np.ndarray) -> np.ndarray:
    """x y z w of a rotation vector, radians."""
    angle = np.linalg.norm(turn)
    return np.array([*np.sin(angle / 2) * turn / angle, np.cos(angle / 2)])


def pose_of(row: np.ndarray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Quaternion(row[6], *row[3:6]), row[:3])


def loop(draft: Draft, sigmas: np.ndarray) -> list[np.ndarray]:
    """Five poses in space round a bent loop that nearly closes; the measurements in order: 4 steps, and back."""
    steps, pose = [], gtsam.Pose3()
    draft.prior_se3("x0", IDENTITY, sigmas=sigmas).se3("x0", IDENTITY)
    for i in range(1, 6):
        step = np.array([1.0, 0.1 * i, 0.2, *quaternion(np.array([0.1, -0.2, 1.2]))])
        if i == 5:
            back = pose.inverse()
            q = back.rotation().toQuaternion()
            step = np.array([*back.translation() + 0.01, q.x(), q.y(), q.z(), q.w()])
        pose = pose.compose(pose_of(step))
        steps.append(step)
        if i < 5:
            draft.se3(f"x{i}")
        draft.between_se3(f"x{i - 1}", f"x{i % 5}", steps[-1], sigmas=sigmas)
    return steps


def test_the_covariance_of_a_prior_is_that_of_its_sigmas_in_radians() -> None:
    solver = Solver(Options())
    solver.stage(Draft().se3("x0", IDENTITY).prior_se3("x0", IDENTITY, sigmas=SIGMAS).batch())
    solver.step(settle=True)
    found = CovarianceBlocks(solver.covariances.factored()).of(np.array([0]))[0]
    np.testing.assert_allclose(found, np.diag(SIGMAS) ** 2, rtol=1e-9, atol=1e-15)


def test_covariances_of_poses_in_space_are_those_of_gtsam_and_of_a_dense_inverse() -> None:
    draft = Draft()
    steps = loop(draft, np.array(SIGMAS))
    solver = Solver(Options())
    solver.stage(draft.batch())
    solver.step(settle=True)
    ours = {k: v for g in solver.estimate() for k, v in zip(g.keys.tolist(), g.values, strict=True)}
    # GTSAM's tangent space has the rotation first, a rotation vector in radians.
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([*SIGMAS[3:], *SIGMAS[:3]]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise))
    for i, z in enumerate(steps):
        graph.add(gtsam.BetweenFactorPose3(i, (i + 1) % 5, pose_of(z), noise))
    for i in range(5):
        values.insert(i, pose_of(ours[symbol("x", i)]))
    marginals = gtsam.Marginals(graph, gtsam.LevenbergMarquardtOptimizer(graph, values).optimize())
    order = [3, 4, 5, 0, 1, 2]
    batch, (estimate,) = draft.batch(), solver.estimate()
    dense = DenseGraph()
    dense.add(Batch((Variables("se3", estimate.keys, estimate.values),), batch.factors))
    dense.put([estimate])
    exact, blocks = DenseCovariance(dense), CovarianceBlocks(solver.covariances.factored())
    for i in range(5):
        place = solver.covariances.factored().graph.keys.tolist().index(symbol("x", i))
        found = blocks.of(np.array([place]))[0]
        wanted = exact.joint([symbol("x", i)])
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-12)
        theirs = marginals.marginalCovariance(i)[np.ix_(order, order)]
        scale = np.sqrt(np.diag(theirs))
        np.testing.assert_allclose(found / scale / scale[:, None], theirs / scale / scale[:, None], atol=0.01)


@pytest.mark.parametrize("kind", ["prior_se3", "between_se3"])
def test_rotations_in_space_are_in_radians_and_the_wire_has_half_angles(kind: str) -> None:
    keys = ("x0",) if kind == "prior_se3" else ("x0", "x1")
    (group,) = Draft().factor(kind, keys, IDENTITY, sigmas=SIGMAS).batch().factors
    W = np.zeros((6, 6))
    W[np.triu_indices(6)] = group.information[0]
    s = np.array(SIGMAS)
    np.testing.assert_allclose(W, np.diag([*1 / s[:3] ** 2, *4 / s[3:] ** 2]), rtol=1e-14)


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ({"los": ("dcs", 3)}, "'loss'"),
        ({"robust": "huber"}, "'loss'"),
        ({"kernel": "huber"}, "'loss'"),
        ({"sigma": (1, 1, 1)}, "'sigmas'"),
        ({"std": (1, 1, 1)}, "'sigmas'"),
        ({"Sigmas": (1, 1, 1)}, "'sigmas'"),
        ({"covariance": np.eye(3)}, "'information'"),
        ({"cov": np.eye(3)}, "'information'"),
        ({"informations": np.eye(3)}, "'information'"),
        ({"qqq": 1}, "sigmas, information, loss"),
    ],
)
def test_an_unknown_keyword_is_refused_by_name_with_what_was_meant(wrong: dict, meant: str) -> None:
    name = next(iter(wrong))
    draft = Draft()
    for add in (
        lambda **how: draft.between_se2("x0", "x1", (1, 0, 0), **how),
        lambda **how: draft.between_se2("x0", "x1", (1, 0, 0), mount=(1, 0, 0), **how),
        lambda **how: draft.linear(["x0"], [(0, 0, 0)], [np.eye(3)], np.zeros(3), kinds=["se2"], **how),
    ):
        for rest in ({}, {"sigmas": (1, 1, 1)}):
            with pytest.raises(BadInformation, match=f"no keyword '{name}'") as refused:
                add(**rest, **wrong)
            assert meant in refused.value.message
    assert draft.batch().factor_count == 0


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_by_name_alone_has_its_usual_scale(loss: str) -> None:
    (group,) = Draft().heading_se2("x0", 0.1, sigmas=0.1, loss=loss).batch().factors
    assert (group.loss, list(group.scale or ())) == (loss, [DEFAULT_SCALES[loss]])
    (change,) = Changes().loss(4, loss).listed()
    assert (change.factors, change.scale) == (np.array([4]), np.array([DEFAULT_SCALES[loss]]))


@pytest.mark.parametrize(
    ("loss", "text"),
    [
        ("hubre", "did you mean 'huber'"),
        (("huber",), "a name and a scale"),
        (1.345, "a name and a scale"),
        ((1.345, "huber"), "one of huber"),
        (("huber", "1.3"), "the scale '1.3'"),
        (("huber", True), "the scale True"),
        (("huber", 0.0), "above 0"),
        (("huber", float("nan")), "above 0"),
    ],
)
def test_a_loss_that_cannot_be_is_refused(loss: object, text: str) -> None:
    with pytest.raises(BadLoss, match=text):
        Draft().heading_se2("x0", 0.1, sigmas=0.1, loss=loss)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("draw", "problem", "text"),
    [
        (lambda d: d.between_se2("x0", "x1", (1, 0, 0), sigmas=0.1), BadShape, r"sigmas: one number; wanted \(3,\)"),
        (lambda d: d.between_se2("x0", "x1", (1, 0, 0), sigmas="much"), BadShape, "numbers"),
        (lambda d: d.between_se2("x0", "x1", (1, 0, 0), sigmas=[[1], 2, 3]), BadShape, "numbers"),
        (lambda d: d.between_se2("x0", "x1", "there", sigmas=(1, 1, 1)), BadShape, "numbers"),
        (lambda d: d.between_se2("x0", "x1", (1, 0, 0), information={}), BadShape, "numbers"),
        (lambda d: d.heading_se2("x0", 0, sigmas=1e-200), BadInformation, "1e-150"),
        (lambda d: d.se2(1.5, (0, 0, 0)), BadSymbol, "x12"),
        (lambda d: d.se2(True, (0, 0, 0)), BadSymbol, "x12"),
        (lambda d: d.se2(2**63, (0, 0, 0)), BadSymbol, "int64"),
        (lambda d: d.se2(None, (0, 0, 0)), BadSymbol, "x12"),
        (lambda d: Changes().remove_factors([1.5]), BadShape, "whole numbers"),
        (lambda d: Changes().remove_factors("x1"), BadShape, "whole numbers"),
        (lambda d: Changes().remove_factors(-1), BadShape, "0 or more"),
        (lambda d: Changes().weigh(3, "twice"), BadShape, "numbers"),
        (lambda d: Changes().loss([3], "huber", -1), BadLoss, "above 0"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_a_code(draw: object, problem: type[Problem], text: str) -> None:
    with pytest.raises(problem, match=text):
        draw(Draft())  # type: ignore[operator]


def test_one_key_will_do_where_a_list_of_one_is_meant() -> None:
    one, many = Draft(), Draft()
    one.factor("prior_se2", "x12", (0, 0, 0), sigmas=(1, 1, 1))
    many.factor("prior_se2", ["x12"], (0, 0, 0), sigmas=(1, 1, 1))
    assert one.batch().factors[0].keys.tolist() == many.batch().factors[0].keys.tolist() == [[symbol("x", 12)]]
    (change,) = Changes().remove_factors(17).listed()
    assert change.factors is not None
    assert change.factors.tolist() == [17]
    (change,) = Changes().fix("x1", ["x2", "x3"]).listed()
    assert change.keys is not None
    assert change.keys.tolist() == [symbol("x", i) for i in (1, 2, 3)]


WILD = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3), st.lists(st.floats(), max_size=7),
    st.dictionaries(st.text(max_size=2), st.integers(), max_size=2), st.lists(st.lists(st.floats()), max_size=3),
)  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(measured=WILD, sigmas=WILD, information=WILD, loss=WILD, key=WILD)
def test_whatever_is_given_it_is_taken_or_refused_with_a_code(
    measured: object, sigmas: object, information: object, loss: object, key: object
) -> None:
    for kind, ends in (("between_se3", 2), ("heading_se2", 1), ("position_se2", 1)):
        draft, code = Draft(), ""
        try:
            draft.factor(kind, [key, "x1"][:ends], measured, sigmas=sigmas, information=information, loss=loss)  # type: ignore[arg-type]
        except Problem as problem:
            code = problem.code
        assert code in ("", "bad_shape", "bad_information", "bad_loss", "bad_symbol")
        assert draft.batch().factor_count == (0 if code else 1)


CAMERA = Camera("pinhole", (500.0, 500.0, 320.0, 240.0))
EVERY_METHOD = {
    "prior_se2": lambda d, **how: d.prior_se2("x0", (0, 0, 0), **how),
    "prior_se3": lambda d, **how: d.prior_se3("x0", IDENTITY, **how),
    "prior_point2": lambda d, **how: d.prior_point2("l0", (0, 0), **how),
    "prior_point3": lambda d, **how: d.prior_point3("l0", (0, 0, 0), **how),
    "between_se2": lambda d, **how: d.between_se2("x0", "x1", (1, 0, 0), **how),
    "between_se3": lambda d, **how: d.between_se3("x0", "x1", IDENTITY, **how),
    "landmark_se2": lambda d, **how: d.landmark_se2("x0", "l0", (1, 0), **how),
    "landmark_se3": lambda d, **how: d.landmark_se3("x0", "l0", (1, 0, 0), **how),
    "bearing_range_se2": lambda d, **how: d.bearing_range_se2("x0", "l0", (0.1, 2.0), **how),
    "position_se2": lambda d, **how: d.position_se2("x0", (1, 0), **how),
    "position_se3": lambda d, **how: d.position_se3("x0", (1, 0, 0), **how),
    "velocity_frame_se2": lambda d, **how: d.velocity_frame_se2("f0", "v0", (1, 0), **how),
    "velocity_frame_se3": lambda d, **how: d.velocity_frame_se3("f0", "v0", (1, 0, 0), **how),
    "heading_se2": lambda d, **how: d.heading_se2("x0", 0.1, **how),
    "attitude_se3": lambda d, **how: d.attitude_se3("x0", (0, 0, 1), **how),
    "range_se2": lambda d, **how: d.range_se2("x0", "l0", 2.0, **how),
    "range_se3": lambda d, **how: d.range_se3("x0", "l0", 2.0, **how),
    "range_between_se2": lambda d, **how: d.range_between_se2("x0", "x1", 2.0, **how),
    "range_between_se3": lambda d, **how: d.range_between_se3("x0", "x1", 2.0, **how),
    "bearing_se2": lambda d, **how: d.bearing_se2("x0", "l0", 0.1, **how),
    "bearing_se3": lambda d, **how: d.bearing_se3("x0", "l0", (1, 0, 0), **how),
    "prior_so3": lambda d, **how: d.prior_so3("r0", (0, 0, 0, 1), **how),
    "between_so3": lambda d, **how: d.between_so3("r0", "r1", (0, 0, 0, 1), **how),
    "attitude_so3": lambda d, **how: d.attitude_so3("r0", (0, 0, 1), **how),
    "prior_sim3": lambda d, **how: d.prior_sim3("s0", (*IDENTITY, 1), **how),
    "between_sim3": lambda d, **how: d.between_sim3("s0", "s1", (*IDENTITY, 1), **how),
    "landmark_sim3": lambda d, **how: d.landmark_sim3("s0", "l0", (1, 0, 0), **how),
    "position_sim3": lambda d, **how: d.position_sim3("s0", (1, 0, 0), **how),
    "linear": lambda d, **how: d.linear(["x0"], [(0, 0, 0)], [np.eye(3)], np.zeros(3), kinds=["se2"], **how),
    "idp_seen": lambda d, **how: d.idp_seen("x0", "f0", CAMERA, (1, 2), **how),
    "point_seen": lambda d, **how: d.point_seen("x0", "l0", CAMERA, (1, 2), **how),
    "factor": lambda d, **how: d.factor("prior_se2", "x0", (0, 0, 0), **how),
}


def test_every_method_that_takes_a_certainty_is_among_them() -> None:
    kinds = inspect.Parameter.VAR_KEYWORD
    takes = {
        name
        for name, method in inspect.getmembers(Draft, inspect.isfunction)
        if not name.startswith("_") and any(p.kind is kinds for p in inspect.signature(method).parameters.values())
    }
    # An inverse-depth feature has a certainty of its own, `FeatureCertainty`; so has a receiver of GNSS, which takes
    # a covariance: see test_further; of an IMU it follows from the noise: see test_imu.  A variable has none (`Held`).
    assert takes - {"idp_first", "gnss", "imu", "imu_preintegrated", "variable", "vector", *VARIABLE_KINDS} == set(
        EVERY_METHOD
    )


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_no_method_swallows_a_certainty_that_is_misspelt_or_missing(method: str) -> None:
    draft, add = Draft(), EVERY_METHOD[method]
    for wrong in ("los", "robust", "sigma", "covariance", "sigmas_", "Loss", "noise"):
        for rest in ({}, {"information": np.eye(3)}):
            with pytest.raises(BadInformation, match=f"no keyword '{wrong}'"):
                add(draft, **rest, **{wrong: 0.1})
    with pytest.raises(BadInformation, match="sigmas"):
        add(draft)
    assert draft.batch().factor_count == 0
