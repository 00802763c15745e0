"""Rotations and poses with a scale: ⊞ and composition as a group has them, a monocular loop, what is refused."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive import dense_similar
from naive.dense_factors import boxminus, boxplus, residual
from naive.dense_least_squares import distance
from naive.random_graphs import random_value
from naive.random_mounts import mount_steps
from naive.random_similar import similar_steps
from scipy.optimize import least_squares

from factorbus.client import Draft
from factorbus.client.expressions import SO3, factor, vector_part
from factorbus.formats import Written, as_g2o, as_jrl, as_pyfg
from factorbus.proto.expressions.declaration import BadExpression, type_of
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors, solve_batch
from factorbus.solver.changes.carrying import carry_along
from factorbus.solver.changing import with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.relative import relative
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.retract import move
from factorbus.viz.geometry import points_of, track_of

KINDS = ("so3", "sim3")
DIM = {"so3": 3, "sim3": 7}
MODES = ["bayes-tree", "inc-l", "all-batch"]
HERE = (0.0, 0, 0, 0, 0, 0, 1, 1)
seeds = st.integers(0, 2**32 - 1)
both = pytest.mark.parametrize("kind", KINDS)


def moved(kind: str, x: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """x ⊞ δ by the solver's kernel."""
    var, out = np.zeros((1, at.V_WIDTH), np.int64), np.empty(x.size)
    var[0, at.V_KIND] = at.VARIABLE_CODES[kind]
    move(1, var, x, delta, out)
    return out


def drawn(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Two values, and an increment and another one."""
    rng = np.random.default_rng(seed)
    return (
        random_value(kind, rng),
        random_value(kind, rng),
        rng.normal(0, 0.8, DIM[kind]),
        rng.normal(0, 0.8, DIM[kind]),
    )


@both
@given(seed=seeds)
def test_an_increment_is_a_composition_with_an_element_of_the_group(kind: str, seed: int) -> None:
    x, a, delta, other = drawn(kind, seed)
    matrix = dense_similar.matrix
    identity = np.array([0, 0, 0, 1.0]) if kind == "so3" else np.array(HERE)
    np.testing.assert_allclose(moved(kind, x, np.zeros(DIM[kind])), x, atol=1e-15)  # the neutral element
    X, D = matrix(kind, x), matrix(kind, moved(kind, identity, delta))
    np.testing.assert_allclose(matrix(kind, moved(kind, x, delta)), X @ D, rtol=1e-12, atol=1e-12)
    back = dense_similar.value(kind, np.linalg.inv(D))  # the inverse
    inverse = 2 * dense_similar.error(kind, matrix(kind, back)) if kind == "so3" else boxminus(kind, back, identity)
    turn = slice(0, 3) if kind == "so3" else slice(3, 6)
    inverse[turn] = -delta[turn]
    np.testing.assert_allclose(matrix(kind, moved(kind, moved(kind, x, delta), inverse)), X, rtol=1e-11, atol=1e-11)
    E = matrix(kind, moved(kind, identity, other))  # one after the other: associative
    np.testing.assert_allclose(
        matrix(kind, moved(kind, moved(kind, x, delta), other)), X @ (D @ E), rtol=1e-11, atol=1e-11
    )
    A = matrix(kind, a)  # of the frame it says nothing: a ∘ (x ⊞ δ) = (a ∘ x) ⊞ δ
    ax = dense_similar.value(kind, A @ X)
    np.testing.assert_allclose(
        matrix(kind, moved(kind, ax, delta)), A @ matrix(kind, moved(kind, x, delta)), rtol=1e-11, atol=1e-11
    )


@both
@pytest.mark.parametrize("backward", [False, True])
@given(seed=seeds)
def test_what_has_no_value_gets_the_one_that_was_measured(kind: str, backward: bool, seed: int) -> None:
    x, z, *_ = drawn(kind, seed)
    ends = ("a1", "a0") if backward else ("a0", "a1")
    draft = Draft().variable(kind, "a0", x, fixed=True).variable(kind, "a1")
    draft.factor(f"between_{kind}", ends, z, sigmas=np.ones(DIM[kind]))
    solver = Solver(Options())
    solver.stage(draft.batch())
    solver.step()
    found = values_of(solver)
    r = residual(f"between_{kind}", [found[symbol("a", int(end[1]))] for end in ends], z)
    np.testing.assert_allclose(r, 0, atol=1e-10)


def values_of(solver: Solver) -> dict[int, np.ndarray]:
    return {k: v for group in solver.estimate() for k, v in zip(group.keys.tolist(), group.values, strict=True)}


def monocular(seed: int, noise: float) -> tuple[Draft, list[tuple[str, list[int], np.ndarray]], list[np.ndarray]]:
    """A loop of 24 keyframes whose unit shrinks by 2 % each, closed once; truth, and what was measured."""
    rng, truth = np.random.default_rng(seed), [np.array(HERE)]
    step = np.array([1.0, 0, 0, 0, 0, 2 * np.pi / 24])
    for _ in range(24):
        pose = boxplus("se3", truth[-1][:7], step)
        truth.append(np.append(pose, truth[-1][7] * 0.98))
    sigmas = np.array([0.02] * 3 + [0.01] * 3 + [0.02])
    draft, factors = Draft().sim3("x0", truth[0], fixed=True), []

    def between(i: int, j: int) -> None:
        z = dense_similar.measured("between_sim3", [truth[i], truth[j]], 0.0, rng)
        z = boxplus("sim3", z, noise * sigmas * rng.normal(size=7))
        draft.between_sim3(f"x{i}", f"x{j}", z, sigmas=sigmas)
        factors.append(("between_sim3", [i, j], z))

    for n in range(1, 25):
        draft.sim3(f"x{n}")
        between(n - 1, n)
    between(24, 0)
    between(20, 3)
    return draft, factors, truth


def whitened(factors: list[tuple[str, list[int], np.ndarray]], values: np.ndarray) -> np.ndarray:
    """Of factors between two."""
    sigmas = np.array([0.02] * 3 + [0.005] * 3 + [0.02])  # of half angles
    ends = np.array([pair for _, pair, _ in factors])
    z = np.array([z for _, _, z in factors])
    return (residual("between_sim3", [values[ends[:, 0]], values[ends[:, 1]]], z) / sigmas).ravel()


@pytest.mark.parametrize("mode", MODES)
def test_a_loop_with_scale_drift_closes_where_scipy_closes_it(mode: str) -> None:
    draft, factors, truth = monocular(1, 1.0)
    solver = Solver(Options(mode=mode))
    solver.stage(draft.batch())
    solver.step(settle=True)
    found = values_of(solver)
    start = np.array([found[symbol("x", n)] for n in range(25)])

    def moved_all(steps: np.ndarray) -> np.ndarray:
        return np.concatenate([start[:1], boxplus("sim3", start[1:], steps.reshape(24, 7))])

    best = least_squares(lambda steps: whitened(factors, moved_all(steps)), np.zeros(24 * 7), xtol=1e-14, ftol=1e-14)
    assert solver.chi2() == pytest.approx(2 * best.cost, rel=1e-9)
    assert np.abs(best.x).max() < 1e-6
    assert abs(np.log(start[24][7] / truth[24][7])) < 0.05
    odometry = truth[0]
    for _, (i, j), z in factors[:24]:
        assert j == i + 1
        odometry = dense_similar.value("sim3", dense_similar.matrix("sim3", odometry) @ dense_similar.matrix("sim3", z))
    off = np.linalg.norm(odometry[:3] - truth[24][:3])
    assert np.linalg.norm(start[24][:3] - truth[24][:3]) < 0.5 * off


def test_of_exact_measurements_gtsam_has_the_same_scales() -> None:
    """Its residual is a logarithm, ours is not: where there is no noise both have the truth, from a start far off."""
    draft, factors, truth = monocular(2, 0.0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01] * 3 + [0.02] * 4))
    for _, (i, j), z in factors:
        graph.add(gtsam.BetweenFactorSimilarity3(i, j, similarity(z), noise))
    graph.add(gtsam.PriorFactorSimilarity3(0, similarity(truth[0]), noise))
    rng = np.random.default_rng(3)
    starts = [truth[0], *(boxplus("sim3", x, rng.normal(0, 0.1, 7)) for x in truth[1:])]
    for n, x in enumerate(starts):
        values.insert(n, similarity(x))
    best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    solver = Solver(Options())
    batch = draft.batch()
    free = Variables("sim3", symbol("x", 1) + np.arange(24), np.array(starts[1:]))
    solver.stage(batch._replace(variables=(batch.variables[0], free)))
    solver.step(settle=True)
    assert solver.chi2() < 1e-15
    for n in range(25):
        ours, theirs = values_of(solver)[symbol("x", n)], best.atSimilarity3(n)
        assert ours[7] == pytest.approx(theirs.scale(), rel=1e-6)
        np.testing.assert_allclose(ours[:3], theirs.scale() * theirs.translation(), atol=1e-5)


def similarity(x: np.ndarray) -> gtsam.Similarity3:
    """GTSAM's p ↦ s (R p + t)."""
    return gtsam.Similarity3(gtsam.Rot3.Quaternion(x[6], *x[3:6]), x[:3] / x[7], x[7])


def test_sigmas_are_in_radians() -> None:
    solver = Solver(Options())
    draft = Draft().so3("r0").prior_so3("r0", (0, 0, 0, 1), sigmas=(0.1, 0.2, 0.3))
    draft.sim3("s0").prior_sim3("s0", HERE, sigmas=(1, 2, 3, 0.1, 0.2, 0.3, 0.4))
    draft.so3("r1").between_so3("r0", "r1", (0, 0, 0, 1), sigmas=[0.1] * 3)
    draft.sim3("s1").between_sim3("s0", "s1", HERE, sigmas=(1, 1, 1, 0.1, 0.1, 0.1, 0.1))
    solver.stage(draft.batch())
    solver.step(settle=True)
    blocks = CovarianceBlocks(solver.covariances.factored())
    keys = {int(key): v for v, key in enumerate(blocks.factored.graph.keys[:4])}
    r0, r1, s0, s1 = (keys[symbol(letter, n)] for letter, n in (("r", 0), ("r", 1), ("s", 0), ("s", 1)))
    np.testing.assert_allclose(blocks.joint(np.array([r0])), np.diag([0.01, 0.04, 0.09]), atol=1e-12)
    np.testing.assert_allclose(blocks.joint(np.array([s0])), np.diag([1, 4, 9, 0.01, 0.04, 0.09, 0.16]), atol=1e-9)
    for first, second, wanted in ((r0, r1, [0.01] * 3), (s0, s1, [1, 1, 1, 0.01, 0.01, 0.01, 0.01])):
        (found,) = relative(blocks, np.array([first]), np.array([second]))
        np.testing.assert_allclose(found.covariance[0], np.diag(wanted), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_relative_values_are_those_of_matrices(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = {"r": "so3", "s": "sim3"}
    values = {f"{letter}{n}": random_value(kind, rng) for letter, kind in ends.items() for n in range(2)}
    draft = Draft().point3("p0", rng.normal(size=3)).prior_point3("p0", (0, 0, 0), sigmas=(1, 1, 1))
    for name, value in values.items():
        kind = ends[name[0]]
        draft.variable(kind, name, value).factor(f"prior_{kind}", (name,), value, sigmas=np.ones(DIM[kind]))
    solver = Solver(Options())
    solver.stage(draft.batch())
    solver.step(settle=True)
    blocks, found = CovarianceBlocks(solver.covariances.factored()), values_of(solver)
    index = {int(key): v for v, key in enumerate(blocks.factored.graph.keys[:5])}
    for a, b in (("r0", "r1"), ("s0", "s1"), ("s1", "p0")):
        x, y = symbol(a[0], int(a[1])), symbol(b[0], int(b[1]))
        (seen,) = relative(blocks, np.array([index[x]]), np.array([index[y]]))
        kind = {"r1": "between_so3", "s1": "between_sim3", "p0": "landmark_sim3"}[b]
        np.testing.assert_allclose(residual(kind, [found[x], found[y]], seen.values[0]), 0, atol=1e-9)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1e-13])
def test_a_scale_is_above_zero(scale: float) -> None:
    wrong = (*HERE[:7], scale)
    for draft in (
        Draft().sim3("s0", wrong),
        Draft().sim3("s0", HERE).prior_sim3("s0", wrong, sigmas=[1] * 7),
        Draft().sim3("s0", HERE).linear(["s0"], [wrong], [np.eye(7)], np.zeros(7), kinds=["sim3"], sigmas=[1] * 7),
    ):
        with pytest.raises(errors.OutOfBounds):
            Solver(Options()).stage(draft.batch())
    solver = Solver(Options())
    solver.stage(Draft().sim3("s0", HERE, fixed=True).batch())
    solver.step()
    with pytest.raises(errors.OutOfBounds, match="the scale of sim3 s0"):
        with_changes(solver, [Change("place", keys=np.array([symbol("s", 0)]), kind="sim3", values=np.array([wrong]))])


@both
def test_a_quaternion_is_of_unit_length(kind: str) -> None:
    wrong = np.array([0, 0, 0, 2.0]) if kind == "so3" else np.array([0, 0, 0, 0, 0, 0, 2.0, 1])
    right = wrong.copy()
    right[-1 if kind == "so3" else 6] = 1.0
    for draft in (
        Draft().variable(kind, "a0", wrong),
        Draft().variable(kind, "a0", right).factor(f"prior_{kind}", ("a0",), wrong, sigmas=np.ones(DIM[kind])),
        Draft()
        .linear(["a0"], [wrong], [np.eye(DIM[kind])], np.zeros(DIM[kind]), kinds=[kind], sigmas=np.ones(DIM[kind]))
        .variable(kind, "a0", right),
    ):
        with pytest.raises(errors.BadQuaternion, match="2"):
            Solver(Options()).stage(draft.batch())


def test_what_hangs_on_a_placed_keyframe_goes_along_with_its_scale() -> None:
    solver = Solver(Options())
    for batch in similar_steps(4, 5):
        solver.stage(batch)
        solver.step()
    before = values_of(solver)
    y, r = symbol("y", 2), symbol("r", 2)
    there = boxplus("sim3", before[y], np.array([1.0, -2, 3, 0.3, 0.2, -0.5, 0.7]))
    turned = boxplus("so3", before[r], np.array([0.4, -0.2, 0.3]))
    graph = FactorGraph()
    variables, factors = solver.graph()
    admit(graph, Batch(tuple(group._replace(fixed=False) for group in variables), tuple(factors)))
    count, values = int(graph.counts[at.VARIABLES]), graph.values.copy()
    placed = np.isin(graph.keys[:count], (y, r))
    for key, value in ((y, there), (r, turned)):
        start = graph.var[graph.find(key), at.V_AT]
        values[start : start + value.size] = value
    values = carry_along(graph, values, placed, np.ones(count, bool), np.ones(int(graph.counts[at.FACTORS]), bool))
    after = {}
    for v, key in enumerate(graph.keys[:count].tolist()):
        start = graph.var[v, at.V_AT]
        after[key] = values[start : start + before[key].size]
    M = dense_similar.matrix("sim3", there) @ np.linalg.inv(dense_similar.matrix("sim3", before[y]))
    R = dense_similar.matrix("so3", turned) @ dense_similar.matrix("so3", before[r]).T
    assert set(after) == set(before)
    for key, value in before.items():
        wanted = {
            8: lambda x: dense_similar.value("sim3", M @ dense_similar.matrix("sim3", x)),
            4: lambda x: dense_similar.value("so3", R @ dense_similar.matrix("so3", x)),
            3: lambda x: (M @ np.append(x, 1.0))[:3],
        }[value.size](value)
        kind = {8: "sim3", 4: "so3", 3: "point3"}[value.size]
        assert distance(kind, after[key], wanted) < 1e-9


@factor
def turned_by(a: SO3, b: SO3, z: SO3):
    return vector_part(z.inverse() * (a.inverse() * b))


def test_an_own_kind_may_be_of_rotations() -> None:
    """`between_so3`, written as an own kind: the same optimum."""
    found = []
    for own in (False, True):
        solver = Solver(Options())
        rng = np.random.default_rng(7)
        draft = Draft().so3("r0", (0, 0, 0, 1), fixed=True)
        for n in range(1, 6):
            draft.so3(f"r{n}", random_value("so3", np.random.default_rng(n)))
            draft.prior_so3(f"r{n}", random_value("so3", np.random.default_rng(n)), sigmas=[1] * 3)
        for n in range(1, 6):
            z = random_value("so3", rng)
            kind = turned_by if own else "between_so3"
            draft.factor(kind, (f"r{n - 1}", f"r{n}"), z, information=4 * np.eye(3))
        solver.stage(draft.batch())
        solver.step(settle=True)
        found.append(values_of(solver))
    for key, value in found[0].items():
        assert distance("so3", value, found[1][key]) < 1e-6


def test_a_similarity_is_no_type_of_an_own_kind() -> None:
    with pytest.raises(BadExpression, match="'sim3' is no kind of variable of an expression"):
        type_of("sim3")


def test_a_start_from_averaged_rotations_leaves_them_where_they_are() -> None:
    """Beside a drive in space that has one: both parts end at their optimum."""
    parts, wanted = [list(similar_steps(5, 6)), list(mount_steps(5, 5))], 0.0
    for steps in parts:
        solver = Solver(Options())
        for batch in steps:
            solver.stage(batch)
            solver.step()
        solver.step(settle=True)
        wanted += solver.chi2()
    renamed = [
        Batch(
            tuple(group._replace(keys=group.keys + (n << 40)) for group in batch.variables),
            tuple(group._replace(keys=group.keys + (n << 40)) for group in batch.factors),
        )
        for n, steps in enumerate(parts)
        for batch in steps
    ]
    whole = Solver(Options(mode="all-batch", max_iterations=0))
    for batch in renamed:
        whole.stage(batch)
    variables, factors = whole.graph()
    found = solve_batch(variables, factors)
    assert found.chi2 == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("write", [as_g2o, as_pyfg, as_jrl])
def test_graph_files_leave_them_out_and_say_so(write: Callable[..., Written]) -> None:
    solver = Solver(Options())
    steps = [*similar_steps(1, 3), Draft().se3("x0", HERE[:7], fixed=True).batch()]
    for batch in steps:
        solver.stage(batch)
        solver.step()
    groups, factors = solver.graph()
    written = write(
        Batch(
            tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in groups),
            tuple(Factors(g.kind, g.keys, g.measured, g.information) for g in factors),
        )
    )
    assert (written.left_out["so3"], written.left_out["sim3"], written.left_out["between_sim3"]) == (3, 3, 2)
    assert any("no record for such variables" in note for note in written.notes)


def test_a_picture_has_keyframes_as_it_has_poses() -> None:
    solver = Solver(Options())
    for batch in similar_steps(1, 4):
        solver.stage(batch)
        solver.step()
    estimate = [Variables(g.kind, g.keys, g.values) for g in solver.estimate()]
    track, points = track_of(estimate), points_of(estimate)
    found = values_of(solver)
    np.testing.assert_array_equal(track.keys, symbol("y", 0) + np.arange(4))
    np.testing.assert_array_equal(track.places, [found[key][:3] for key in track.keys.tolist()])
    assert len(points.keys) == 4
