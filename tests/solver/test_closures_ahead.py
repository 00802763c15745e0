"""Closures judged before the step of their batch, and on numbers alone, against what a step gives."""

import math

import numpy as np
import pytest
from naive.dense_poses import pose_matrix, pose_vector

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver
from factorbus.solver.closures import ahead
from factorbus.solver.closures.evidence import (
    ClosureNumbers,
    FalseSpread,
    exact_weights_without,
    judge_each,
    numbers_without,
    odds_without,
    volume_of,
    weights_without,
)
from factorbus.solver.closures.gated import GatedSolver
from factorbus.solver.closures.ledger import ACCEPTED, SUSPECT, Closure, ClosureLedger
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.closures.motions import motions_of_poses
from factorbus.solver.closures.numbers import closure_numbers
from factorbus.solver.closures.switching import without_factors
from factorbus.solver.kernels.closures.ahead import (
    J_ALLOWED,
    J_BOUND,
    J_MEASURED,
    J_NOISE,
    J_ODDS,
    J_SIZE,
    believe_ahead,
)
from factorbus.solver.kernels.model import layout as at

_SPREAD = FalseSpread(5.0, 0.5)
_WEIGHT = np.array([[2500.0, 300.0, -200.0, 1600.0, 100.0, 3600.0]])  # no axis is as well known as another


def between(i: int, j: int, z: list[float]) -> Factors:
    return Factors("between_se2", np.array([[i, j]]), np.array([z]), _WEIGHT)


def circle(poses: int, rng: np.random.Generator) -> list[Batch]:
    """Ten poses a turn, with noise; after a turn each pose is where the one of ten before was."""
    batches = [Batch((Variables("se2", np.array([0]), np.array([[1.0, 2.0, 0.5]]), True),), ())]
    for k in range(1, poses):
        step = np.array([1.0, 0.0, math.pi / 5.0]) + rng.normal(0.0, 0.02, 3)
        batches.append(Batch((Variables("se2", np.array([k])),), (between(k - 1, k, step.tolist()),)))
    return batches


def driven(poses: int, closures: tuple[tuple[int, int], ...]) -> GatedSolver:
    """Once around and on, with closures that are believed whatever they are."""
    rng, made = np.random.default_rng(3), GatedSolver(Options())
    for batch in circle(poses, rng):
        made.insert(batch)
    for i, j in closures:
        report = made.insert(Batch((), (between(i, j, rng.normal(0.0, 0.02, 3).tolist()),)))
        assert [c.state for c in report.accepted] == [ACCEPTED]
    return made


@pytest.mark.parametrize("new", [1, 2])
@pytest.mark.parametrize("partner", [0, 7])  # the first is fixed
def test_before_the_step_a_closure_is_judged_as_after_it(new: int, partner: int) -> None:
    solver, forest = Solver(Options()), TrustedForest()
    for batch in circle(16, np.random.default_rng(3)):
        forest.split(batch)
        solver.stage(batch)
        solver.step()
    solver.stage(Batch((), (between(2, 12, [0.03, 0.01, 0.0]),)))
    solver.step()
    keys = list(range(16, 16 + new))
    odometry = [between(k - 1, k, [1.02, -0.03, 0.6]) for k in keys]
    (group,) = [group for group in solver.estimate() if not group.fixed]
    poses = {0: np.array([1.0, 2.0, 0.5])} | dict(zip(group.keys.tolist(), group.values, strict=True))
    there = np.linalg.inv(pose_matrix(poses[partner])) @ pose_matrix(poses[15])
    for factor in odometry:
        there = there @ pose_matrix(factor.measured[0])
    closing = between(partner, keys[-1], (pose_vector(there) + np.array([0.02, -0.03, 0.01])).tolist())
    batch = Batch((Variables("se2", np.array(keys)),), (*odometry, closing))
    split, before = forest.split(batch), solver._graph.counts.copy()
    first = solver.stage(batch)
    limits = np.array([16.0, 30.0, 1.0, volume_of(_SPREAD)])
    ledgers = ClosureLedger()
    ledger = ledgers.of_kind["between_se2"]
    staged = np.array([before[at.VARIABLES], before[at.FACTORS], 0, 1, first + new])
    foreseen = ahead._foresee(solver, ledger, split, staged, limits)
    assert foreseen is not None
    assert foreseen.believed == 1
    ends = ledger.ends[0].copy()
    for found, wanted in ((ledger.noise, J_NOISE), (ledger.bound, J_BOUND), (ledger.z, J_MEASURED)):
        np.testing.assert_array_equal(found[0], foreseen.numbers[0, wanted : wanted + 3])
    solver._graph.forget(tuple(before.tolist()))
    solver.stage(batch._replace(factors=tuple(split.trusted)))
    solver.step()
    ledgers.add(split.closing[0], first + new, solver._graph, 0)
    numbers = closure_numbers(solver, ledgers.of_kind["between_se2"], np.array([0]))
    after = judge_each(numbers, [_SPREAD])
    judged = foreseen.numbers[0]
    np.testing.assert_allclose(judged[J_ALLOWED:J_NOISE], after.allowed[0], rtol=5e-3, atol=1e-5)
    np.testing.assert_allclose(judged[J_NOISE : J_NOISE + 3], numbers.noise[0], rtol=1e-9)
    np.testing.assert_allclose(judged[J_MEASURED:], numbers.z[0], rtol=1e-12)
    distance, chance, believed = foreseen.odds[0].tolist()
    assert distance == pytest.approx(after.distance[0], rel=1e-2)
    assert chance == pytest.approx(after.chance[0, 0], rel=5e-2)
    assert believed == 1.0
    ends = solver._graph.var[ends, at.V_AT] // 3
    assert ends.tolist() == [partner, keys[-1]]
    # When it is in, what it was judged by says what the map is without it.
    solver.stage(Batch((), (closing,)))
    solver.step()
    then = exact_weights_without(closure_numbers(solver, ledgers.of_kind["between_se2"], np.array([0])))
    np.testing.assert_allclose(judged[J_BOUND:J_MEASURED] / then.max(), then[0] / then.max(), atol=0.15)


@pytest.mark.parametrize(
    "further",
    [
        Factors("position_se2", np.array([[12]]), np.array([[1.0, 1.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 1.0]])),
        between(12, 13, [1.0, 0.0, 0.0]),
    ],
)
def test_what_more_than_odometry_holds_is_judged_after_a_step(further: Factors) -> None:
    made = driven(12, ((0, 10),))
    more = further.kind == "between_se2"
    new = [Variables("se2", np.array([12, 13] if more else [12]))]
    batch = Batch(tuple(new), (between(11, 12, [1.0, 0.0, 0.6283]), further, between(2, 12, [0.0, 0.0, 0.0])))
    split = made._joined.split(batch)
    made._joined.forget()
    before = made.solver._graph.counts.copy()
    first = made.solver.stage(batch)
    ledger = made.ledger.of_kind["between_se2"]
    staged = np.array([before[at.VARIABLES], before[at.FACTORS], ledger.count, 1, first + 2])
    assert (ahead._foresee(made.solver, ledger, split, staged, np.ones(4)) is None) != more
    made.solver._graph.forget(tuple(before.tolist()))
    report = made.insert(batch)
    assert [c.keys for c in report.accepted] == [(2, 12)]
    assert made.solver.factor_count == 15


def test_a_batch_goes_in_with_what_is_believed_and_every_factor_has_the_id_of_its_place() -> None:
    made = driven(12, ((0, 10), (1, 11)))
    closing = [between(2, 12, [0.0, 0.0, 0.0]), between(3, 12, [9.0, 0.0, 0.0]), between(1, 12, [1.0, 0.0, 0.6283])]
    batch = Batch(
        (Variables("se2", np.array([12])),), (closing[0], closing[1], between(11, 12, [1.0, 0.0, 0.6283]), closing[2])
    )
    report = made.insert(batch)
    assert [(c.factor_id, c.keys) for c in report.accepted] == [(13, (2, 12)), (16, (1, 12))]
    assert [(c.factor_id, c.keys, c.reason) for c in report.suspects] == [(14, (3, 12), "improbable")]
    assert report.step.new_factors == 3  # with one step
    assert made.solver._graph.factor_named(15).keys.tolist() == [[11, 12]]
    assert made.solver._graph.factor_named(16).keys.tolist() == [[1, 12]]
    made.accept(14)
    made.reject(13)
    assert made.solver.factor_count == 16
    assert made.solver._graph.factor_named(14).measured.tolist() == [[9.0, 0.0, 0.0]]


def test_without_some_closures_the_numbers_are_those_of_a_map_without_them() -> None:
    made = driven(24, ((0, 10), (4, 14), (3, 13), (12, 22)))
    ledger = made.ledger.of_kind["between_se2"]
    found = numbers_without(closure_numbers(made.solver, ledger, np.array([1, 2, 0, 3])), 2)
    without = without_factors(made.solver, [made.closures[1].factor_id, made.closures[2].factor_id])
    wanted = closure_numbers(without, ledger, np.array([0, 3]))
    moved = np.abs(closure_numbers(made.solver, ledger, np.array([0, 3])).b - wanted.b).max()
    assert moved > 1e-2
    np.testing.assert_allclose(found.a, wanted.a, atol=0.1 * moved)
    np.testing.assert_allclose(found.b, wanted.b, atol=0.1 * moved)
    scale = np.abs(wanted.known).max()
    np.testing.assert_allclose(found.known / scale, wanted.known / scale, atol=0.02)


def test_weights_without_a_closure_are_the_exact_ones_but_for_axes_that_it_alone_holds() -> None:
    made = driven(24, ((0, 10), (4, 14), (3, 13), (12, 22)))
    numbers = closure_numbers(made.solver, made.ledger.of_kind["between_se2"], np.arange(4))
    exact = exact_weights_without(numbers)
    np.testing.assert_allclose(weights_without(numbers), exact, rtol=1e-9)
    alone = numbers._replace(known=np.zeros((24, 24)))
    np.testing.assert_allclose(weights_without(alone), np.linalg.inv(numbers.noise), rtol=1e-9)
    held = np.eye(3)[None]
    c = ClosureNumbers(held, held, held, np.diag([1.0, 1.0, 4.0])[None], np.diag([0.0] * 3 + [1.0, 0.5, 1.0]))
    np.testing.assert_allclose(weights_without(c)[0], np.diag([0.0, 2.0, 1.0 / 3.0]), atol=1e-12)
    np.testing.assert_allclose(exact_weights_without(c)[0], np.diag([0.0, 2.0, 1.0 / 3.0]), atol=1e-12)


def test_the_odds_of_one_that_is_in_are_those_against_the_map_without_it() -> None:
    made = driven(24, ((0, 10), (4, 14), (12, 22)))
    ledger = made.ledger.of_kind["between_se2"]
    found = odds_without(closure_numbers(made.solver, ledger, np.array([1])), _SPREAD)[0]
    without = without_factors(made.solver, [made.closures[1].factor_id])
    wanted = judge_each(closure_numbers(without, ledger, np.array([1])), [_SPREAD]).chance[0, 0]
    assert found == pytest.approx(wanted, rel=0.1)
    assert found < 1e-2


def test_the_odds_before_are_even_until_closures_have_been_right() -> None:
    ledgers = ClosureLedger()
    ledger = ledgers.of_kind["between_se2"]
    factor = between(0, 1, [0.0, 0.0, 0.0])
    assert ledger.odds() == (1.0, 1.0)
    for k, (state, reason, wanted) in enumerate(
        [
            (SUSPECT, "improbable", (1.0, 1.0)), (ACCEPTED, "passed", (1.0, 10 / 11)),
            (ACCEPTED, "passed", (2 / 3, 10 / 12)), (SUSPECT, "unsure", (2 / 3, 10 / 12)),
            (ACCEPTED, "agrees", (2 / 4, 10 / 13)), (SUSPECT, "rival", (3 / 4, 11 / 13)),
        ]
    ):  # fmt: skip
        ledger.add(Closure(k, 0, factor, 0, state, reason), (0, 1), 0)  # pyright: ignore[reportArgumentType]
        assert ledger.odds() == pytest.approx(wanted)
    first, last = ledger.closures[0], ledger.closures[-1]
    first.state = last.state = ACCEPTED
    ledger.mark(first)
    ledger.mark(last)
    assert ledger.odds() == pytest.approx((1 / 6, 10 / 15))


def test_a_motion_without_closures_is_moved_in_space_too() -> None:
    """One pose between a fixed one and another, in space: without one of two closures it is where the other says."""
    weight = np.diag([100.0] * 3 + [400.0] * 3)[np.triu_indices(6)][None]
    values = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    made = Solver(Options())
    made.stage(Batch((Variables("se3", np.array([0]), values, True), Variables("se3", np.array([2]), values)), ()))
    turned = [0.3, 0.1, 0.0, 0.0, 0.0, math.sin(0.1), math.cos(0.1)]
    for z in ([0.0] * 6 + [1.0], turned):
        made.stage(Batch((), (Factors("between_se3", np.array([[0, 2]]), np.array([z]), weight),)))
    made.step()
    made.step(settle=True)
    ledgers = ClosureLedger()
    for k, factor in enumerate(made.graph()[1][0].measured):
        group = Factors("between_se3", np.array([[0, 2]]), factor[None], weight)
        ledgers.add(group, k, made._graph, 0)  # pyright: ignore[reportArgumentType]
    numbers = closure_numbers(made, ledgers.of_kind["between_se3"], np.array([0, 1]))
    found = numbers_without(numbers, 1)
    np.testing.assert_allclose(found.b[0], motions_of_poses(np.array([turned]))[0], atol=0.02)
    assert np.abs(found.b[0] - numbers.b[1]).max() > 0.1


@pytest.mark.parametrize(
    ("told", "believed"),
    [
        ([(1.0, 0.01), (16.0, 1e-9)], [1.0, 1.0]),
        ([(1.0, 0.01), (31.0, 1e-9)], [1.0, 0.0]),  # beyond what any agreement allows: it says nothing of the other
        ([(1.0, 0.01), (17.0, 1e-9)], [0.0, 0.0]),  # outside the gate, and may be right
        ([(1.0, 0.01), (1.0, 0.3)], [0.0, 0.0]),  # within it, and may be false
        ([(1.0, 1e9), (400.0, 1e9)], [0.0, 0.0]),  # odds are even at most
    ],
)
def test_none_goes_in_before_the_step_where_one_may_speak_against_the_others(
    told: list[tuple[float, float]], believed: list[float]
) -> None:
    judged = np.zeros((2, J_SIZE, 3))
    judged[:, J_ODDS, :2] = told
    judged[:, J_ODDS, 1] *= 50.0
    assert believe_ahead(np.array([16.5, 30.0, 0.02, 50.0]), judged) == sum(believed)
    assert judged[:, J_ODDS, 2].tolist() == believed
    np.testing.assert_allclose(judged[:, J_ODDS, 1], np.minimum([p for _, p in told], 1.0))
