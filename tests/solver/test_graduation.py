"""Closures weighed by graduated non-convexity: the kernel, its fixed point beside a dense twin, and what is false."""

import itertools

import numpy as np
import pytest
from false_closures import drive_with_false
from naive.graduated import graduated, weight

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver
from factorbus.solver.closures import graduated as module
from factorbus.solver.closures.graduated import GraduatedSolver
from factorbus.solver.closures.graduated_kernel import (
    CONTROL_PARAMETERS,
    GRADUATED_LOSS,
    chi2_of_weights,
    final_weights,
    graduated_split,
    scales_at,
    sig_weights,
    with_final_loss,
)
from factorbus.solver.closures.graduation import GRADUATED, own_chi2
from factorbus.solver.closures.ledger import ACCEPTED, FAILED, OUTWEIGHED, SUSPECT, ClosureLedger
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.errors import NotFinite
from factorbus.solver.report import StepReport

SIGMA = np.array([0.05, 0.05, 0.02])
OMEGA = np.diag(SIGMA**-2.0)
TRIANGLE = OMEGA[np.triu_indices(3)][None]


def between(i: int, j: int, z: np.ndarray, loss: str = "") -> Factors:
    scale = np.ones(1) if loss else None
    return Factors("between_se2", np.array([[i, j]]), z[None], TRIANGLE, loss, scale)


def circle(count: int, rng: np.random.Generator) -> tuple[list[np.ndarray], np.ndarray]:
    """Odometry with noise around a circle twice, and the true poses."""
    angle = 4.0 * np.pi / count
    true = np.array([[3.0 * np.sin(k * angle), 3.0 - 3.0 * np.cos(k * angle), k * angle] for k in range(count)])
    return [seen(true, k, k + 1) + rng.normal(0.0, SIGMA) for k in range(count - 1)], true


def seen(poses: np.ndarray, i: int, j: int) -> np.ndarray:
    a, b = poses[i], poses[j]
    c, s = np.cos(a[2]), np.sin(a[2])
    d = b[:2] - a[:2]
    turn = b[2] - a[2]
    return np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], np.arctan2(np.sin(turn), np.cos(turn))])


def poses_of(solver: Solver) -> np.ndarray:
    groups = solver.estimate()
    keys, values = np.concatenate([g.keys for g in groups]), np.concatenate([g.values for g in groups])
    return values[np.argsort(keys)]


@pytest.mark.parametrize("mu", CONTROL_PARAMETERS)
def test_weights_are_the_derivative_of_the_kernel_and_scales_have_them(mu: float) -> None:
    c2, chi2 = 30.7, np.array([0.1, 1.0, 7.0, 30.0, 400.0, 1e5])
    np.testing.assert_allclose(sig_weights(chi2, mu, c2), [weight(s, mu, c2) for s in chi2], rtol=1e-6)
    k2 = scales_at(chi2, mu, c2) ** 2
    free = k2 > c2 * (1.0 + 1e-12)
    np.testing.assert_allclose(((k2 / (k2 + chi2)) ** 2)[free], sig_weights(chi2, mu, c2)[free], rtol=1e-9)
    assert (k2 >= c2 * (1.0 - 1e-12)).all()


def test_the_schedule_goes_from_quadratic_to_geman_mcclure() -> None:
    for before, after in itertools.pairwise(CONTROL_PARAMETERS):
        assert after == pytest.approx(min(1.0, before + 1.2 * (before + 0.1)))
    chi2 = np.array([0.0, 2.0, 50.0])
    np.testing.assert_allclose(chi2_of_weights(final_weights(chi2, 16.0), 16.0), chi2, atol=1e-12)
    assert final_weights(np.array([16.0]), 16.0)[0] == 0.25


@pytest.mark.parametrize("seed", range(4))
def test_it_comes_to_the_fixed_point_of_a_dense_twin(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 24
    odometry, true = circle(count, rng)
    closures = [(k, k + 12, seen(true, k, k + 12) + rng.normal(0.0, SIGMA), True) for k in range(0, 12, 2)]
    closures += [(1, 16, seen(true, 1, 16) + np.array([2.0, -1.5, 0.7]), False)]
    closures += [(4, 20, seen(true, 4, 20) + np.array([-3.0, 2.5, -1.0]), False)]
    closures.sort(key=lambda closure: closure[1])

    solver = GraduatedSolver(Options())
    solver.insert(Batch((Variables("se2", np.array([0]), np.zeros((1, 3)), True),)))
    start = np.zeros((count, 3))
    for k, z in enumerate(odometry):
        c, s = np.cos(start[k, 2]), np.sin(start[k, 2])
        start[k + 1] = start[k] + [c * z[0] - s * z[1], s * z[0] + c * z[1], z[2]]
        own = [between(i, j, z_ij) for i, j, z_ij, _ in closures if j == k + 1]
        solver.insert(Batch((Variables("se2", np.array([k + 1])),), (between(k, k + 1, z), *own)))
    solver.solver.step(settle=True)

    edges = [(k, k + 1, z, OMEGA, False) for k, z in enumerate(odometry)]
    edges += [(i, j, z, OMEGA, True) for i, j, z, _ in closures]
    c2 = solver.graduation.c2["between_se2"]
    poses, weights = graduated(start, edges, c2, CONTROL_PARAMETERS, 0.01)
    found = poses_of(solver.solver)
    np.testing.assert_allclose(found[:, :2], poses[:, :2], atol=2e-5)
    np.testing.assert_allclose(np.cos(found[:, 2] - poses[:, 2]), 1.0, atol=1e-9)
    ledger = solver.ledger.of_kind["between_se2"]
    own = final_weights(own_chi2(solver.solver, ledger, np.arange(len(closures))), c2)
    np.testing.assert_allclose(own, weights, atol=2e-4)
    assert [c.state == ACCEPTED for c in solver.closures] == [is_right for *_, is_right in closures]


@pytest.mark.parametrize("kind", ["random", "local", "grouped"])
def test_of_closures_of_which_a_third_is_false_it_has_the_right_ones(kind: str) -> None:
    drive = drive_with_false(300, 11, 0.33, kind)
    solver = GraduatedSolver(Options())
    for batch in drive.batches:
        solver.insert(batch)
    is_in = np.array([c.state == ACCEPTED for c in solver.closures])
    np.testing.assert_array_equal(is_in, ~drive.is_false())
    assert all(0.0 <= c.chance < 0.25 for c in solver.suspects())
    assert {c.reason for c in solver.suspects()} == {OUTWEIGHED}


def test_the_same_batches_give_the_same_bits() -> None:
    drive = drive_with_false(200, 5, 0.5, "local")
    ends = []
    for _ in range(2):
        solver = GraduatedSolver(Options())
        for batch in drive.batches:
            solver.insert(batch)
        ends.append((poses_of(solver.solver).tobytes(), [(c.state, c.reason, c.chance) for c in solver.closures]))
    assert ends[0] == ends[1]


def test_a_loss_of_the_client_stays_and_order_and_ids_too() -> None:
    forest = TrustedForest()
    odometry = [between(k, k + 1, np.array([1.0, 0.0, 0.1])) for k in range(6)]
    forest.split(Batch((), tuple(odometry)))
    mixed = Factors(
        "between_se2", np.array([[5, 6], [0, 3], [1, 4], [4, 5]]), np.zeros((4, 3)), np.repeat(TRIANGLE, 4, axis=0)
    )
    batch = Batch((), (mixed, between(2, 5, np.zeros(3), "dcs"), between(0, 5, np.zeros(3))))
    split = graduated_split(forest.split(batch))
    assert split.places == [1, 2, 5]
    made = with_final_loss(batch, split, {"between_se2": 5.5})
    assert [(g.loss, g.keys.tolist()) for g in made.factors] == [
        ("", [[5, 6]]), (GRADUATED_LOSS, [[0, 3], [1, 4]]), ("", [[4, 5]]), ("dcs", [[2, 5]]),
        (GRADUATED_LOSS, [[0, 5]]),
    ]  # fmt: skip


def test_where_a_stage_fails_losses_are_final_and_it_is_graduated_later(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    odometry, true = circle(60, rng)
    solver = GraduatedSolver(Options())
    solver.insert(Batch((Variables("se2", np.array([0]), np.zeros((1, 3)), True),)))
    for k, z in enumerate(odometry):
        z = z + np.array([0.0, 0.0, 0.008])
        solver.insert(Batch((Variables("se2", np.array([k + 1])),), (between(k, k + 1, z),)))
    calls = list[int]()

    def fails_once(*arguments: object) -> tuple[Solver, StepReport]:
        calls.append(1)
        if len(calls) == 2:
            raise NotFinite("a value")
        return step_with(*arguments)  # type: ignore[arg-type]

    step_with = module.step_with
    with monkeypatch.context() as patched:
        patched.setattr(module, "step_with", fails_once)
        solver.insert(Batch((), (between(0, 59, seen(true, 0, 59)),)))
    (closure,) = solver.closures
    assert (closure.state, closure.reason) == (SUSPECT, FAILED)
    c = solver.graduation.final_scales["between_se2"]
    assert solver.solver.factor_graph.factor_named(closure.factor_id).scale == pytest.approx(c)
    solver.insert(Batch((), (between(1, 58, seen(true, 1, 58)),)))
    assert {c.state for c in solver.closures} == {ACCEPTED}
    assert GRADUATED in {c.reason for c in solver.closures}


def test_a_ledger_of_weighed_closures_has_suspects_in_the_map_but_for_outweighed_ones() -> None:
    ledger = ClosureLedger(weighs=True)
    solver = Solver()
    solver.stage(Batch((Variables("se2", np.array([0, 1]), np.zeros((2, 3)), True),)))
    c = ledger.add(between(0, 1, np.zeros(3)), 0, solver.factor_graph, 1)
    assert (c.state, c.is_in) == (SUSPECT, True)
    assert (c.would_be_in("rejected", "user"), c.would_be_in(SUSPECT, OUTWEIGHED)) == (False, False)
    again = ClosureLedger(weighs=True)
    again.load(ledger.dump(), solver.factor_graph)
    assert again.closures[0].is_weighed
