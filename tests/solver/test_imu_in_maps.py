"""Maps with inertial factors: every mode, losses, covariances, gates, accounts, changes and states, as dense NumPy."""

import numpy as np
import pytest
from naive.dense_covariances import DenseCovariance
from naive.dense_factors import residual
from naive.dense_least_squares import DenseGraph, distance, full
from naive.random_imu import GRAVITY_KEY, MOUNT_KEY, imu_steps, keys_of
from naive.solver_parts import graph_in, keys_in, kinds_in, linearization_points

from factorbus.proto import codec
from factorbus.proto.inertial import ImuForm
from factorbus.proto.messages import Batch, Change, Factors, Insert, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import FactorGroup, Options, Solver
from factorbus.solver.changes.carrying import carry_along
from factorbus.solver.changes.repair import find_loops
from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import evaluate_candidates
from factorbus.solver.covariance.why import why_factor, why_variable
from factorbus.solver.graph.factor_rows import variables_aside
from factorbus.solver.kernels.model import layout as at

MODES = ["bayes-tree", "inc-l", "all-batch"]
FORMS = {
    "samples": None,
    "mounted": ImuForm(1),
    "mount, gravity": ImuForm(1, True, True),
    "gravity": ImuForm(1, False, True),
    "preintegrated": ImuForm(0),
    "preintegrated, mount, gravity": ImuForm(0, True, True),
}


def by_key(solver: Solver) -> dict[int, tuple[str, np.ndarray]]:
    return {
        key: (group.kind, row)
        for group in solver.estimate()
        for key, row in zip(group.keys.tolist(), group.values, strict=True)
    }


def solved(seed: int, mode: str = "bayes-tree", steps: int = 6, form: ImuForm | None = None) -> Solver:
    solver = Solver(Options(mode=mode))
    for batch in imu_steps(seed, steps, of_form=form):
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    return solver


def sent(solver: Solver) -> Batch:
    """The graph as an insert."""
    variables, factors = solver.graph()
    return Batch(
        tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in variables),
        tuple(Factors(g.kind, g.keys, g.measured, g.information, g.loss, g.scale) for g in factors),
    )


def dense(solver: Solver) -> DenseCovariance:
    """The twin at the estimate, where a settled solver is linearized."""
    graph = DenseGraph()
    graph.add(sent(solver))
    graph.kinds = dict(zip(keys_in(solver), kinds_in(solver), strict=True))  # in insertion order
    graph.values |= dict(zip(keys_in(solver), linearization_points(solver), strict=True))
    return DenseCovariance(graph)


def close(found: np.ndarray, wanted: np.ndarray, share: float) -> None:
    """To a share of the largest entry."""
    np.testing.assert_allclose(found, wanted, rtol=0, atol=share * np.abs(wanted).max())


def apart(a: Solver, b: Solver) -> float:
    there = by_key(b)
    return max(distance(kind, row, there[key][1]) for key, (kind, row) in by_key(a).items())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("loss", ["", "huber"])
@pytest.mark.parametrize("form", FORMS)
def test_the_settled_estimate_is_the_dense_optimum(form: str, loss: str, mode: str) -> None:
    solver, twin = Solver(Options(mode=mode)), DenseGraph()
    for batch in imu_steps(1, loss=loss, of_form=FORMS[form]):
        first = solver.stage(batch)
        report = solver.step()
        assert first == len(twin.factors)
        twin.add(batch)
        twin.put(solver.estimate())
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-6)
        assert report.new_factors == len(twin.factors) - first
    solver.step(settle=True)
    twin.put(solver.estimate())
    assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-6)
    assert twin.gauss_newton(iterations=1) < 1e-6
    for key, (kind, value) in by_key(solver).items():
        assert distance(kind, value, twin.values[key]) < 1e-6


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("form", FORMS)
def test_covariances_are_those_of_the_dense_inverse(form: str, mode: str) -> None:
    solver = solved(1, mode, form=FORMS[form])
    twin, blocks, keys = dense(solver), CovarianceBlocks(solver.covariances.factored()), keys_in(solver)
    diagonal = blocks.diagonal()
    for v, key in enumerate(keys):
        wanted = twin.joint([key])
        close(diagonal[v, : len(wanted), : len(wanted)], wanted, 1e-6)
    some = np.random.default_rng(1).permutation(len(keys))[:6]
    close(blocks.joint(some), twin.joint([keys[v] for v in some]), 1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_gates_and_gains_are_those_of_dense_matrices(form: str) -> None:
    solver = solved(2, form=FORMS[form])
    twin, blocks, k = dense(solver), CovarianceBlocks(solver.covariances.factored()), 0
    groups = [
        FactorGroup(g.kind, g.keys, g.measured, 0.1 * g.information)
        for batch in list(imu_steps(2, 6, of_form=FORMS[form]))[4:]
        for g in batch.factors
    ]
    found = evaluate_candidates(blocks, groups)
    for group in groups:
        for keys, z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            r, T, noise = twin.innovation(group.kind, keys, z, upper)
            assert found.dims[k] == len(r)
            close(found.predicted[k, : len(r), : len(r)], T, 1e-5)
            np.testing.assert_allclose(found.distance[k], r @ np.linalg.solve(T + noise, r), rtol=1e-4, atol=1e-9)
            gain = 0.5 * (np.linalg.slogdet(T + noise)[1] - np.linalg.slogdet(noise)[1])
            np.testing.assert_allclose(found.gain[k], gain, rtol=1e-5)
            k += 1
    assert k == len(found.distance)


def _by_id(solver: Solver) -> list[tuple[str, list[int], np.ndarray, np.ndarray]]:
    """Kind, keys, measurement and information of every factor, in the order of their ids."""
    rows = {}
    for group in solver.graph()[1]:
        assert group.ids is not None
        for n, each in enumerate(group.ids.tolist()):
            rows[each] = group.kind, group.keys[n].tolist(), group.measured[n], full(group.information[n])
    return [rows[each] for each in sorted(rows)]


@pytest.mark.parametrize("form", FORMS)
def test_why_accounts_for_it_as_for_any_factor(form: str) -> None:
    solver = solved(1, steps=5, form=FORMS[form])
    twin, blocks, leverage = dense(solver), CovarianceBlocks(solver.covariances.factored()), 0.0
    for factor, (kind, keys, z, W) in enumerate(_by_id(solver)):
        account = why_factor(blocks, factor)
        r, T, noise = twin.innovation(kind, keys, z, W[np.triu_indices(len(W))])
        assert (account.kind, list(account.keys)) == (kind, keys)
        # Samples near their bias are expanded, to 1e-5 standard deviations.
        np.testing.assert_allclose(account.residual, residual(kind, [by_key(solver)[k][1] for k in keys], z), atol=1e-5)
        np.testing.assert_allclose(account.chi2, r @ W @ r, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(account.leverage, np.trace(W @ T), rtol=1e-5, atol=1e-7)
        leverage += account.leverage
        if account.without is not None:
            np.testing.assert_allclose(account.without, r @ np.linalg.solve(noise - T, r), rtol=1e-3, atol=1e-7)
    assert leverage == pytest.approx(len(twin.sigma), rel=1e-6)
    for v, key in enumerate(keys_in(solver)):
        account = why_variable(blocks, v, keeps_steps=True)
        assert [each.factor for each in account.factors] == [
            n for n, (_, keys, *_) in enumerate(_by_id(solver)) if key in keys
        ]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("form", FORMS)
def test_what_is_marginalized_stays_known(form: str, mode: str) -> None:
    """Of the moments that stay, mount and gravity, estimate and covariance are what they were."""
    solver = solved(3, mode, form=FORMS[form])
    gone = np.array(keys_of(0) + keys_of(1))
    left = [key for key in keys_in(solver) if key not in gone]
    before, sure = by_key(solver), dense(solver).joint(left)
    after, *_ = with_changes(solver, [Change("marginalize", keys=gone)], settle=True)
    assert all(distance(kind, row, before[key][1]) < 1e-8 for key, (kind, row) in by_key(after).items())
    blocks, order = CovarianceBlocks(after.covariances.factored()), keys_in(after)
    close(blocks.joint(np.array([order.index(key) for key in left])), sure, 1e-5)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("form", FORMS)
def test_it_is_removed_weighed_and_gets_a_loss_as_any_factor(form: str, mode: str) -> None:
    solver = solved(1, mode, form=FORMS[form])
    factor = next(n for n, (kind, *_) in enumerate(_by_id(solver)) if kind.startswith("imu"))
    ids = np.array([factor])
    for change in (
        Change("weigh", ids, weight=np.array([3.0])),
        Change("loss", ids, loss="huber", scale=np.array([0.5])),
    ):
        after, _, report, _ = with_changes(solver, [change], settle=True)
        twin = DenseGraph()
        twin.add(sent(after))
        twin.put(after.estimate())
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-6)
        assert twin.gauss_newton(iterations=1) < 1e-6
        in_place = solved(1, mode, form=FORMS[form])
        if try_change(in_place, [change]) is not None:
            in_place.step(settle=True)
            assert apart(after, in_place) < 1e-6
    fewer, *_ = with_changes(solver, [Change("remove_variables", keys=np.array(keys_of(5)))], settle=True)
    assert set(by_key(fewer)) == set(by_key(solver)) - set(keys_of(5))
    held, *_ = with_changes(solver, [Change("fix", keys=np.array(keys_of(2)[1:]))], settle=True)
    freed, *_ = with_changes(held, [Change("free", keys=np.array(keys_of(2)[1:]))], settle=True)
    assert apart(freed, solver) < 1e-7
    assert factor not in graph_in(solver).ids_of(find_loops(graph_in(solver))).tolist()


@pytest.mark.parametrize("form", FORMS)
def test_what_is_placed_takes_poses_along_and_leaves_velocities(form: str) -> None:
    solver = solved(1, form=FORMS[form])
    before, there = by_key(solver), np.array([[5.0, 0, 0, 0, 0, np.sin(0.2), np.cos(0.2)]])
    moved, *_ = with_changes(solver, [Change("place", keys=np.array([symbol("x", 0)]), kind="se3", values=there)])
    assert moved.chi2() != solver.chi2()
    after, *_ = with_changes(moved, [], settle=True)
    assert apart(after, solver) < 1e-6
    assert set(before) == set(by_key(moved))


@pytest.mark.parametrize("form", ["mount, gravity", "preintegrated, mount, gravity"])
def test_mount_and_gravity_stay_where_poses_are_taken_along(form: str) -> None:
    graph = graph_in(solved(1, form=FORMS[form]))
    n, m = int(graph.counts[at.VARIABLES]), int(graph.counts[at.FACTORS])
    x0, x1, mount, gravity = (graph.find(key) for key in (symbol("x", 0), symbol("x", 1), MOUNT_KEY, GRAVITY_KEY))
    values, there = graph.values.copy(), graph.var[:n, at.V_AT]
    values[there[x0]] += 5.0
    carried = carry_along(graph, values, np.arange(n) == x0, np.ones(n, bool), np.ones(m, bool)) - graph.values
    assert carried[there[x1]] == pytest.approx(5.0)
    assert not carried[there[mount] : there[mount] + 7].any()
    assert not carried[there[gravity] : there[gravity] + 3].any()
    assert variables_aside(graph.fac[:m]).tolist() == [mount]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("form", FORMS)
def test_a_state_goes_on_bit_for_bit(form: str, mode: str) -> None:
    steps, solver, other = (
        list(imu_steps(4, of_form=FORMS[form])),
        Solver(Options(mode=mode)),
        Solver(Options(mode=mode)),
    )
    for batch in steps[:4]:
        solver.stage(batch)
        solver.step()
    assert other.load(solver.dump()) is None
    for batch in steps[4:]:
        assert other.stage(batch) == solver.stage(batch)
        assert other.step().chi2 == solver.step().chi2
    for a, b in zip(solver.estimate(), other.estimate(), strict=True):
        assert a.values.tobytes() == b.values.tobytes()


@pytest.mark.parametrize("form", FORMS)
def test_it_goes_over_the_wire_and_comes_back_as_it_was_sent(form: str) -> None:
    solver = solved(5, form=FORMS[form])
    came = codec.decode_insert(codec.encode_insert(Insert(1, sent(solver)))).batch
    other = Solver(Options())
    other.stage(came)
    other.step(settle=True)
    assert apart(solver, other) < 1e-7
    for a, b in zip(sent(solver).factors, sent(other).factors, strict=True):
        assert (a.kind, a.keys.tolist()) == (b.kind, b.keys.tolist())
        np.testing.assert_array_equal(a.measured, b.measured)
        np.testing.assert_array_equal(a.information, b.information)
