"""Positions, headings, attitudes, ranges, bearings, linear factors: in every mode, with and without losses."""

import numpy as np
import pytest
from naive.dense_least_squares import DenseGraph, distance
from naive.random_others import LINEAR, OTHERS, other_steps

from factorbus.proto import kinds as wire
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factors import FACTOR_KINDS
from factorbus.solver.kernels.model.kinds import FACTOR_MODELS
from factorbus.solver.sparse.elimination import constraint

MODES = ["bayes-tree", "inc-l", "all-batch"]


def by_key(solver: Solver) -> dict[int, tuple[str, np.ndarray]]:
    return {
        key: (group.kind, row)
        for group in solver.estimate()
        for key, row in zip(group.keys.tolist(), group.values, strict=True)
    }


def test_these_are_the_kinds_that_place_nobody() -> None:
    places = {
        n for n, model in FACTOR_MODELS.items() if model.initializes or model.lens_at >= 0 or model.base or model.joined
    }
    assert FACTOR_MODELS.keys() - places == set(OTHERS) - set(LINEAR)
    batches = list(other_steps(1))
    there = {group.kind for batch in batches for group in batch.factors}
    vectors = {"velocity_frame_se2", "velocity_frame_se3", "length_vector3"}  # in the drives of test_derived_kinds
    assert there >= set(OTHERS) - set(LINEAR) - vectors  # and of test_imu_in_maps
    assert {len(wire.FACTOR_KINDS[kind].connects) for kind in there & set(LINEAR)} == {1, 2, 3}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("loss", ["", "huber", "dcs"])
@pytest.mark.parametrize("seed", range(3))
def test_the_settled_estimate_is_the_dense_optimum(seed: int, loss: str, mode: str) -> None:
    solver, twin = Solver(Options(mode=mode)), DenseGraph()
    for batch in other_steps(seed, loss=loss):
        solver.stage(batch)
        report = solver.step()
        twin.add(batch)
        twin.put(solver.estimate())
        assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-9)
        assert report.converged
    solver.step(settle=True)
    twin.put(solver.estimate())
    assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-9)
    assert twin.gauss_newton(iterations=1) < 1e-7
    for key, (kind, value) in by_key(solver).items():
        assert distance(kind, value, twin.values[key]) < 1e-7


@pytest.mark.parametrize("mode", MODES)
def test_positions_alone_hold_a_drive(mode: str) -> None:
    """Odometry and a receiver off the robot's middle: no fixed pose, no prior; the turn is found by driving."""
    rng, solver = np.random.default_rng(1), Solver(Options(mode=mode))
    truth = np.zeros(3)
    keys = [symbol("x", n) for n in range(30)]
    variables, edges, fixes = [], [], []
    for n, key in enumerate(keys):
        if n:
            turn = rng.normal(0, 0.3)
            c, s = np.cos(truth[2]), np.sin(truth[2])
            truth = truth + np.array([c, s, turn])
            edges.append(Factors("between_se2", np.array([[key - 1, key]]), np.array([[1.0, 0.0, turn]]), _info(3)))
        c, s = np.cos(truth[2]), np.sin(truth[2])
        z = np.array([[truth[0] + 0.5 * c, truth[1] + 0.5 * s, 0.5, 0.0]])
        fixes.append(Factors("position_se2", np.array([[key]]), z, _info(2)))
        variables.append(
            Variables("se2", np.array([key]), np.array([[truth[0], truth[1], truth[2]]]) + (0.3 if n == 0 else 0))
        )
    solver.stage(Batch(tuple(variables), (*edges, *fixes)))
    solver.step(settle=True)
    np.testing.assert_allclose(by_key(solver)[keys[-1]][1][:2], truth[:2], atol=1e-6)


def _info(dim: int) -> np.ndarray:
    return 100.0 * np.eye(dim)[np.triu_indices(dim)][None]


def test_a_pose_that_only_a_position_holds_is_refused() -> None:
    solver = Solver(Options())
    z = np.array([[1.0, 2.0, 0.0, 0.0]])
    pose = Variables("se2", np.array([symbol("x", 1)]), np.zeros((1, 3)))
    solver.stage(Batch((pose,), (Factors("position_se2", pose.keys[None], z, _info(2)),)))
    with pytest.raises(errors.Underconstrained):
        solver.step()
    assert solver.variable_count == 0


BAD: dict[str, tuple[str, int, float, type[errors.SolverError]]] = {
    "no range": ("range_se2", 0, 0.0, errors.BadRange),
    "a negative range": ("range_se3", 0, -1.0, errors.BadRange),
    "no range between poses": ("range_between_se2", 0, 0.0, errors.BadRange),
    "a negative range between poses in space": ("range_between_se3", 0, -1.0, errors.BadRange),
    "no direction": ("bearing_se3", 3, 0.0, errors.BadDirection),
    "no direction of the map": ("attitude_se3", 3, 0.0, errors.BadDirection),
    "not a number": ("position_se2", 0, np.nan, errors.NotFinite),
    "no quaternion": ("linear_6_se3", 3, 5.0, errors.BadQuaternion),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_measured_is_refused(name: str) -> None:
    kind, place, wrong, error = BAD[name]
    of, solver = FACTOR_KINDS[kind], Solver(Options())
    z = np.ones((1, of.size))
    z[0, 0 if place == 3 and of.size == 3 else place :] = wrong
    keys = np.arange(1, 1 + len(of.connects))
    ends = tuple(
        Variables(end.name, keys[n : n + 1], np.eye(1, end.size, end.size - 1)) for n, end in enumerate(of.connects)
    )
    with pytest.raises(error):
        solver.stage(Batch(ends, (Factors(kind, keys[None], z, _info(of.dim)),)))
    assert (solver.variable_count, solver.factor_count) == (0, 0)


def test_a_pose_that_is_joined_to_the_last_one_by_a_linear_factor_is_no_landmark() -> None:
    """Landmarks seen from the last pose are ordered right before it, and nothing else is."""
    graph, keys = FactorGraph(), np.arange(1, 5)
    poses = Variables("se2", keys[:3], np.zeros((3, 3)))
    point = Variables("point2", keys[3:], np.zeros((1, 2)))
    pair = Factors("linear_3_se2_se2", keys[[2, 0]][None], np.zeros((1, 27)), _info(3))
    seen = Factors("range_se2", keys[[2, 3]][None], np.ones((1, 1)), _info(1))
    admit(graph, Batch((poses, point), (pair, seen)))
    assert constraint(graph).tolist() == [0, 0, 2, 1]
