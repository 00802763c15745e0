"""Kinds with further variables, such as mounts, biases and other frames: in every mode, with and without losses."""

from collections.abc import Callable, Iterator

import gtsam
import numpy as np
import pytest
from naive.dense_covariances import DenseCovariance
from naive.dense_factors import boxplus, pose_matrix, pose_vector, residual
from naive.dense_least_squares import DenseGraph, distance, full
from naive.random_derived import calibration_steps, true_calibration
from naive.random_lenses import lens_steps, true_lenses
from naive.random_mounts import mount_steps, true_mounts
from naive.random_similar import SIMILAR, similar_steps
from naive.solver_parts import keys_in, kinds_in, linearization_points

from factorbus.client import Camera, Draft
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import FactorGroup, Options, Solver, errors
from factorbus.solver.changes.repair import repair
from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import evaluate_candidates
from factorbus.solver.covariance.why import why_factor, why_variable
from factorbus.solver.errors import printed
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.linearized import linearized_factor

MODES = ["bayes-tree", "inc-l", "all-batch"]
WORLDS: dict[str, Callable[..., Iterator[Batch]]] = {
    "mounts": mount_steps,
    "calibration": lambda seed, steps=4, **more: calibration_steps(seed, min(steps, 4), **more),
    "lenses": lambda seed, steps=4, **more: lens_steps(seed, min(steps, 4), **more),
    "similarities": similar_steps,
}
# How far a settled estimate may be from the optimum: metres, radians; of lenses pixels, of focal lengths of 400.
SETTLED = {"mounts": 1e-7, "calibration": 1e-7, "lenses": 2e-5, "similarities": 1e-7}
# The length of a gravity that is a variable is in maps of an IMU (`test_imu_in_maps`).
DERIVED = {name for name, kind in FACTOR_KINDS.items() if kind.roles and kind.roles != ("axes",)} | SIMILAR
every_world = pytest.mark.parametrize("world", WORLDS)


def by_key(solver: Solver) -> dict[int, tuple[str, np.ndarray]]:
    return {
        key: (group.kind, row)
        for group in solver.estimate()
        for key, row in zip(group.keys.tolist(), group.values, strict=True)
    }


def test_every_kind_with_further_variables_occurs() -> None:
    assert {group.kind for steps in WORLDS.values() for batch in steps(1) for group in batch.factors} >= DERIVED


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("world", "seed", "loss"),
    [
        *(("mounts", seed, loss) for seed in range(3) for loss in ("", "huber", "dcs")),
        *((world, 0, loss) for world in ("calibration", "lenses", "similarities") for loss in ("", "dcs")),
    ],
)
def test_the_settled_estimate_is_the_dense_optimum(world: str, seed: int, loss: str, mode: str) -> None:
    solver, twin = Solver(Options(mode=mode)), DenseGraph()
    for batch in WORLDS[world](seed, loss=loss):
        first = solver.stage(batch)
        report = solver.step()
        assert first == len(twin.factors)
        twin.add(batch)
        twin.put(solver.estimate())
        assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-9)
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-9)
        assert report.new_factors == len(twin.factors) - first
        assert solver.factor_count == len(twin.factors)
    solver.step(settle=True)
    twin.put(solver.estimate())
    assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-9)
    assert twin.gauss_newton(iterations=1) < SETTLED[world]
    for key, (kind, value) in by_key(solver).items():
        assert distance(kind, value, twin.values[key]) < SETTLED[world]


def solved(world: str, seed: int, mode: str = "bayes-tree", steps: int = 6) -> Solver:
    solver = Solver(Options(mode=mode))
    for batch in WORLDS[world](seed, steps):
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    return solver


def dense(solver: Solver) -> DenseCovariance:
    """The twin at the estimate, where a settled solver is linearized."""
    graph, (variables, factors) = DenseGraph(), solver.graph()
    graph.add(Batch(tuple(variables), tuple(factors)))
    graph.kinds = dict(zip(keys_in(solver), kinds_in(solver), strict=True))  # in insertion order
    graph.values |= dict(zip(keys_in(solver), linearization_points(solver), strict=True))
    return DenseCovariance(graph)


def close(found: np.ndarray, wanted: np.ndarray, tell: float) -> None:
    """To a share of the largest entry."""
    np.testing.assert_allclose(found, wanted, rtol=0, atol=tell * np.abs(wanted).max())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("world", "seed"), [("mounts", 0), ("mounts", 1), ("calibration", 0), ("lenses", 0), ("similarities", 0)]
)
def test_covariances_are_those_of_the_dense_inverse(world: str, seed: int, mode: str) -> None:
    solver = solved(world, seed, mode)
    twin, blocks, keys = dense(solver), CovarianceBlocks(solver.covariances.factored()), keys_in(solver)
    diagonal = blocks.diagonal()
    for v, key in enumerate(keys):
        wanted = twin.joint([key])
        close(diagonal[v, : len(wanted), : len(wanted)], wanted, 1e-7)
    some = np.random.default_rng(seed).permutation(len(keys))[:6]
    close(blocks.joint(some), twin.joint([keys[v] for v in some]), 1e-7)


@pytest.mark.parametrize(
    ("world", "seed"), [("mounts", 0), ("mounts", 1), ("calibration", 0), ("lenses", 0), ("similarities", 0)]
)
def test_gates_and_gains_are_those_of_dense_matrices(world: str, seed: int) -> None:
    """Candidates of every such kind, among some of two variables."""
    solver, rng = solved(world, seed), np.random.default_rng(seed)
    twin, blocks, k = dense(solver), CovarianceBlocks(solver.covariances.factored()), 0
    *_, last = WORLDS[world](seed, 6)
    groups = [FactorGroup(g.kind, g.keys, g.measured, 0.1 * g.information) for g in last.factors]
    rng.shuffle(groups)
    mark = blocks.factored.graph.mark()
    found = evaluate_candidates(blocks, groups)
    assert blocks.factored.graph.mark() == mark
    for group in groups:
        for keys, z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            r, T, noise = twin.innovation(group.kind, keys, z, upper)
            assert found.dims[k] == len(r)
            close(found.predicted[k, : len(r), : len(r)], T, 1e-6)
            squared = r @ np.linalg.solve(T + noise, r)
            np.testing.assert_allclose(found.distance[k], squared, rtol=1e-5, atol=1e-12)
            gain = 0.5 * (np.linalg.slogdet(T + noise)[1] - np.linalg.slogdet(noise)[1])
            np.testing.assert_allclose(found.gain[k], gain, rtol=1e-6)
            k += 1
    assert k == len(found.distance)


@every_world
def test_why_says_of_such_a_factor_what_it_says_of_others(world: str) -> None:
    solver = solved(world, 1, steps=5)
    twin, blocks, leverage = dense(solver), CovarianceBlocks(solver.covariances.factored()), 0.0
    for factor, (kind, keys, z, W) in enumerate(_by_id(solver)):
        account = why_factor(blocks, factor)
        r, T, noise = twin.innovation(kind, keys, z, W[np.triu_indices(len(W))])
        assert (account.kind, list(account.keys)) == (kind, keys)
        np.testing.assert_allclose(account.chi2, r @ W @ r, rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(account.leverage, np.trace(W @ T), rtol=1e-6, atol=1e-8)
        leverage += account.leverage
        if account.without is not None:
            np.testing.assert_allclose(account.without, r @ np.linalg.solve(noise - T, r), rtol=1e-4, atol=1e-9)
    assert leverage == pytest.approx(len(twin.sigma), rel=1e-7)
    for v, key in enumerate(keys_in(solver)):
        account = why_variable(blocks, v, keeps_steps=True)
        assert [each.factor for each in account.factors] == [
            n for n, (_, keys, *_) in enumerate(_by_id(solver)) if key in keys
        ]
        assert 0 < account.conditioning <= 1 + 1e-3


def _by_id(solver: Solver) -> list[tuple[str, list[int], np.ndarray, np.ndarray]]:
    """Kind, keys, measurement and information of every factor, in the order of their ids."""
    rows = {}
    for group in solver.graph()[1]:
        assert group.ids is not None
        for n, each in enumerate(group.ids.tolist()):
            rows[each] = group.kind, group.keys[n].tolist(), group.measured[n], full(group.information[n])
    assert sorted(rows) == list(range(len(rows)))
    return [rows[each] for each in sorted(rows)]


@every_world
def test_a_loss_is_told_apart_from_the_residual(world: str) -> None:
    solver = Solver(Options())
    for batch in WORLDS[world](3, loss="huber"):
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    blocks = CovarianceBlocks(solver.covariances.factored())
    mounted = {n: each for n, each in enumerate(_by_id(solver)) if each[0] in DERIVED}
    twin = dense(solver).graph
    for factor, (kind, keys, z, W) in mounted.items():
        r, account = residual(kind, [twin.values[key] for key in keys], z), why_factor(blocks, factor)
        assert account.loss == "huber"
        np.testing.assert_allclose(account.residual, r, atol=1e-8)
        assert account.chi2 == pytest.approx(r @ W @ r, rel=1e-6, abs=1e-9)


@every_world
@pytest.mark.parametrize("mode", MODES)
def test_a_refused_insert_leaves_ids_rows_and_bits_as_they_were(mode: str, world: str) -> None:
    """Also the first one that would have brought such factors."""
    steps = list(WORLDS[world](5))
    plain = Variables("se2", np.array([-9]), np.zeros((1, 3)), fixed=True)
    loose = Variables("point2", np.array([-5]), np.zeros((1, 2)))
    solver, twin = Solver(Options(mode=mode)), Solver(Options(mode=mode))
    for each in (solver, twin):
        each.stage(Batch((plain,)))
        each.step()
    for batch in steps:
        solver.stage(batch)
        solver.stage(Batch((loose,)))
        with pytest.raises(errors.Underconstrained):
            solver.step()
        assert solver.stage(batch) == twin.stage(batch)
        chi2 = twin.step().chi2
        # The modes of the 2013 paper factor anew after a refused step.
        assert solver.step().chi2 == (chi2 if mode == "bayes-tree" else pytest.approx(chi2, rel=1e-6))
    for a, b in zip(solver.graph()[1], twin.graph()[1], strict=True):
        assert a.ids is not None
        assert b.ids is not None
        assert a.ids.tolist() == b.ids.tolist()
        assert a.keys.tolist() == b.keys.tolist()


@pytest.mark.parametrize(
    ("wrong", "error"), [(0, errors.UnknownVariable), (1, errors.KindMismatch), (2, errors.SelfLoop)]
)
@pytest.mark.parametrize("end", range(3))
def test_the_variable_that_is_wrong_is_named(end: int, wrong: int, error: type[errors.SolverError]) -> None:
    solver = Solver(Options())
    keys = np.array([symbol("x", n) for n in range(3)])
    poses = Variables("se2", keys, np.zeros((3, 3)))
    point = Variables("point2", np.array([symbol("l", 0)]), np.zeros((1, 2)))
    row = keys.copy()
    row[end] = (symbol("x", 7), symbol("l", 0), keys[(end + 1) % 3])[wrong]
    edge = Factors("between_se2_mount", row[None], np.zeros((1, 3)), np.array([[1.0, 0, 0, 1, 0, 1]]))
    with pytest.raises(error) as found:
        solver.stage(Batch((poses, point), (edge,)))
    assert printed(int(row[end])) in str(found.value)
    assert (solver.variable_count, solver.factor_count) == (0, 0)


@every_world
def test_a_loaded_solver_goes_on_to_the_bit(world: str) -> None:
    steps, solver = list(WORLDS[world](2)), Solver(Options())
    for batch in steps[:4]:
        solver.stage(batch)
        solver.step()
    other = Solver(Options())
    assert other.load(solver.dump()) is None
    for batch in steps[4:]:
        assert other.stage(batch) == solver.stage(batch)
        assert other.step().chi2 == solver.step().chi2
    for a, b in zip(solver.estimate(), other.estimate(), strict=True):
        assert a.values.tobytes() == b.values.tobytes()


def test_repair_takes_out_what_a_sensor_saw_wrongly_and_keeps_the_mount() -> None:
    """Loop closures of a sensor at a mount, one in seven wrong; the odometry knows nothing of the mount."""
    rng, solver, truth, wrong = np.random.default_rng(4), Solver(Options()), [np.zeros(3)], []
    mount = np.array([0.5, 0.2, 0.3])
    keys = [symbol("x", n) for n in range(40)]
    info = np.array([[1e4, 0, 0, 1e4, 0, 1e4]])
    rough = Variables("se2", np.array([symbol("m", 0)]), mount[None] + 0.05)
    solver.stage(Batch((Variables("se2", np.array(keys[:1]), np.zeros((1, 3)), fixed=True), rough)))
    prior = Factors("prior_se2", np.array([[symbol("m", 0)]]), rough.values, np.array([[100.0, 0, 0, 100, 0, 100]]))
    for n in range(1, 40):
        truth.append(boxplus("se2", truth[-1], np.array([1.0, 0.0, 0.3])))
        z = np.array([[1.0, 0.0, 0.3]]) + rng.normal(0, 0.01, 3)
        factors = [Factors("between_se2", np.array([[keys[n - 1], keys[n]]]), z, info)]
        if n > 5:
            a, b = truth[n - 5], truth[n]
            seen = pose_matrix(mount)
            T = np.linalg.inv(pose_matrix(a) @ seen) @ pose_matrix(b) @ seen
            z = boxplus("se2", pose_vector(T), rng.normal(0, 0.01, 3))
            if n % 7 == 0:
                wrong.append(solver.factor_count + 1)
                z = z + np.array([2.0, -1.0, 0.5])
            factors.append(
                Factors("between_se2_mount", np.array([[keys[n - 5], keys[n], symbol("m", 0)]]), z[None], info)
            )
        if n == 1:
            factors.append(prior)
        solver.stage(Batch((Variables("se2", np.array([keys[n]])),), tuple(factors)))
        solver.step()
    found = repair(solver.content())
    assert found.false.tolist() == wrong
    mounts = next(
        row for g in found.groups for k, row in zip(g.keys.tolist(), g.values, strict=True) if k == symbol("m", 0)
    )
    np.testing.assert_allclose(mounts, mount, atol=0.1)  # of a circle little shows what is forward


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("world", "held"),
    [
        *(("mounts", held) for held in ("poses", "points", "both", "further", "poses and further")),
        *((world, held) for world in ("calibration", "lenses", "similarities") for held in ("poses", "further")),
    ],
)
def test_whatever_is_fixed_the_estimate_is_the_dense_optimum(world: str, held: str, mode: str) -> None:
    """With poses and points held the first row of a factor joins nothing that is free: its χ² is a constant."""
    solver, twin, further = (
        Solver(Options(mode=mode)),
        DenseGraph(),
        {*true_mounts(), *true_calibration(), *true_lenses()},
    )
    known = {"both": ("poses", "points"), "poses and further": ("poses", "further")}.get(held, (held,))
    truth = Solver(Options())
    for batch in WORLDS[world](11, 5):
        truth.stage(batch)
        truth.step()
    truth.step(settle=True)
    at = {key: row + 0.01 for key, (kind, row) in by_key(truth).items() if kind in ("se2", "point2", "point3")}

    def as_held(group: Variables) -> Variables:
        of = "further" if int(group.keys[0]) in further else "points" if group.kind.startswith("point") else "poses"
        if of not in known:
            return group
        value = at.get(int(group.keys[0]), by_key(truth)[int(group.keys[0])][1])
        return group._replace(values=value[None], fixed=True)

    for batch in WORLDS[world](11, 5):
        given = Batch(tuple(as_held(group) for group in batch.variables), batch.factors)
        solver.stage(given)
        report = solver.step()
        twin.add(given)
        twin.put(solver.estimate())
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-9)
    solver.step(settle=True)
    twin.put(solver.estimate())
    assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-9)
    assert twin.gauss_newton(iterations=1) < SETTLED[world]
    # A factor whose pose and point are held gets a loss, and another goes.
    rows = [n for n, each in enumerate(_by_id(solver)) if each[0].startswith("landmark")]
    changes = [
        Change("loss", np.array(rows[:2]), loss="huber", scale=np.ones(2)),
        Change("remove_factors", np.array(rows[2:3])),
    ]
    changed, _, report, counted = with_changes(solver, changes)
    came = try_change(solver, changes)
    assert (counted["edited_factors"], counted["removed_factors"]) == (2, 1)
    assert (came is not None) == (mode == "bayes-tree")
    for each in (changed, solver) if came else (changed,):
        each.step(settle=True)
        left = DenseGraph()
        groups, factors = each.graph()
        left.add(Batch(tuple(groups), tuple(factors)))
        left.put(each.estimate())
        assert each.chi2() == pytest.approx(left.chi2(), rel=1e-9)
        assert left.gauss_newton(iterations=1) < 10 * SETTLED[world]


@pytest.mark.parametrize("seed", range(20))
def test_a_camera_at_a_mount_sees_what_gtsams_sees_with_a_sensor_on_the_body(seed: int) -> None:
    """GTSAM knows mounts that are constant: its pixel, and its Jacobians by pose and point, are those of ours there."""
    rng, camera = np.random.default_rng(seed), Camera("pinhole", (400.0, 390.0, 320.0, 240.0), width=640, height=480)
    pose, mount = (boxplus("se3", np.array([0, 0, 0, 0, 0, 0, 1.0]), rng.normal(0, 0.5, 6)) for _ in range(2))
    ahead = np.array([*rng.uniform(-1, 1, 2), rng.uniform(2, 6), 1.0])
    point, pixel = (pose_matrix(pose) @ pose_matrix(mount) @ ahead)[:3], rng.uniform(100, 400, 2)
    draft = Draft().se3("x0", pose).se3("m0", mount).point3("l0", point)
    draft.point_seen("x0", "l0", camera, pixel, mount="m0", sigmas=(1, 1))
    graph = FactorGraph()
    admit(graph, draft.batch())
    ours = linearized_factor(graph, 0)
    x, l = gtsam.symbol("x", 0), gtsam.symbol("l", 0)
    theirs = gtsam.GenericProjectionFactorCal3_S2(
        pixel, gtsam.noiseModel.Unit.Create(2), x, l, gtsam.Cal3_S2(400, 390, 0, 320, 240),
        gtsam.Pose3(pose_matrix(mount)),
    )  # fmt: skip
    values = gtsam.Values()
    values.insert(x, gtsam.Pose3(pose_matrix(pose)))
    values.insert(l, point)
    J, b = theirs.linearize(values).jacobian()
    np.testing.assert_allclose(ours.r, -b, atol=1e-9)
    names = {int(graph.keys[v]): ours.jacobian_of(v) for v in ours.ends.tolist()}
    np.testing.assert_allclose(names[x][:, [3, 4, 5, 0, 1, 2]], J[:, :6], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(names[l], J[:, 6:], rtol=1e-9, atol=1e-8)
