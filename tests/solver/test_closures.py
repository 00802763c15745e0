"""Closures that are tested when they come: the numbers against dense ones, and drives with false ones."""

import itertools
import math

import numpy as np
import pytest
from false_closures import drive_with_false
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_poses import pose_matrix, pose_vector
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from examples import examples
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver, errors
from factorbus.solver.closures.evidence import (
    ClosureNumbers,
    FalseSpread,
    judge_accepted,
    judge_each,
    judge_pairs,
)
from factorbus.solver.closures.gated import GatedSolver
from factorbus.solver.closures.judging import CONTRADICTED
from factorbus.solver.closures.ledger import ACCEPTED, REJECTED, RESTORED, SUSPECT, Closure
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.closures.motions import inverse_motion, motions_of_poses, tangent_of
from factorbus.solver.closures.naming import NotAClosure
from factorbus.solver.closures.numbers import closure_numbers, unsure_where_unknown
from factorbus.solver.closures.policy import ClosurePolicy

_SPREADS = (FalseSpread(5.0, 0.5), FalseSpread(30.0, math.pi))
_GATE = 16.3  # 99.9 % of χ² of three numbers
seeds, spaces = st.integers(0, 2**32 - 1), st.sampled_from([3, 6])


def random_poses(n: int, d: int, rng: np.random.Generator) -> np.ndarray:
    places = rng.normal(size=(n, 2 if d == 3 else 3)) * 3.0
    turns = rng.uniform(-3.0, 3.0, (n, 1)) if d == 3 else Rotation.random(n, rng).as_quat()
    return np.hstack([places, turns])


def moved(T: np.ndarray, x: np.ndarray) -> np.ndarray:
    """T exp(x), for small x: the translation as it stands."""
    if x.size == 3:
        return T @ pose_matrix(x)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = Rotation.from_rotvec(x[3:]).as_matrix(), x[:3]
    return T @ step


def tangent(T: np.ndarray) -> np.ndarray:
    if len(T) == 3:
        return pose_vector(T)
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def closures_between(n: int, d: int, rng: np.random.Generator, off: float) -> ClosureNumbers:
    """Closures that are nearly right, so that the linear model is of where they are."""
    T = motions_of_poses(random_poses(2 * n, d, rng))
    a, b = T[0::2], T[1::2]
    z = np.array([moved(t, rng.normal(size=d) * off) for t in inverse_motion(a) @ b])
    J = rng.normal(size=(2 * n * d, 2 * n * d)) * 0.1
    root = rng.normal(size=(n, d, d)) * 0.1
    return ClosureNumbers(a, b, z, root @ root.swapaxes(1, 2) + 0.01 * np.eye(d), J @ J.T / n)


def derived(residual, poses: list[np.ndarray], d: int) -> np.ndarray:
    """Central differences by each pose."""
    out, h = np.zeros((d, len(poses) * d)), 1e-6
    for k in range(len(poses) * d):
        ends = []
        for sign in (1.0, -1.0):
            changed = list(poses)
            x = np.zeros(d)
            x[k % d] = sign * h
            changed[k // d] = moved(poses[k // d], x)
            ends.append(residual(*changed))
        out[:, k] = (ends[0] - ends[1]) / (2 * h)
    return out


def allowed(P: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """What is known, what is measured, and the second order of headings."""
    d = len(P)
    size = d // 3 + 1
    out = P + noise
    second_order = 0.75 * np.linalg.eigvalsh(P[:size, :size])[-1] * np.linalg.eigvalsh(P[size:, size:])[-1]
    out[:size, :size] += second_order * np.eye(size)
    return out


@given(seed=seeds, d=spaces)
def test_motions_are_those_of_matrices(seed: int, d: int) -> None:
    values = random_poses(4, d, np.random.default_rng(seed))
    T = motions_of_poses(values)
    np.testing.assert_allclose(T, [pose_matrix(value) for value in values], atol=1e-12)
    np.testing.assert_allclose(inverse_motion(T), np.linalg.inv(T), atol=1e-12)
    np.testing.assert_allclose(tangent_of(T), [tangent(one) for one in T], atol=1e-7)


def test_half_a_turn_has_a_tangent_of_that_length() -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.0, math.pi, 0.0]).as_matrix()
    assert np.linalg.norm(tangent_of(T)) == pytest.approx(math.pi)


@examples(30)
@given(seed=seeds, d=spaces)
def test_one_closure_against_the_map_is_as_with_dense_derivatives(seed: int, d: int) -> None:
    c = closures_between(3, d, np.random.default_rng(seed), 1e-4)
    found = judge_each(c, _SPREADS)
    for k in range(3):
        r = tangent(np.linalg.inv(c.z[k]) @ np.linalg.inv(c.a[k]) @ c.b[k])
        z = c.z[k]
        J = derived(lambda a, b, z=z: tangent(np.linalg.inv(z) @ np.linalg.inv(a) @ b), [c.a[k], c.b[k]], d)
        own = slice(2 * d * k, 2 * d * (k + 1))
        S = allowed(J @ c.known[own, own] @ J.T, c.noise[k])
        assert found.distance[k] == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-2)


@examples(30)
@given(seed=seeds, d=spaces)
def test_two_closures_against_each_other_are_as_with_dense_derivatives(seed: int, d: int) -> None:
    c = closures_between(3, d, np.random.default_rng(seed), 1e-4)
    i, j = np.triu_indices(3, 1)
    found = judge_pairs(c, i, j, _SPREADS)
    for k, (p, q) in enumerate(zip(i.tolist(), j.tolist(), strict=True)):
        ends, measured = [c.a[p], c.b[p], c.a[q], c.b[q]], [c.z[p], c.z[q]]
        J = derived(lambda *x, measured=measured: loop_of(*x, *measured), ends, d)
        W = derived(lambda *z, ends=ends: loop_of(*ends, *z), measured, d)
        rows = np.concatenate([np.arange(2 * d * n, 2 * d * (n + 1)) for n in (p, q)])
        noise = W[:, :d] @ c.noise[p] @ W[:, :d].T + W[:, d:] @ c.noise[q] @ W[:, d:].T
        S, r = allowed(J @ c.known[np.ix_(rows, rows)] @ J.T, np.zeros((d, d))) + noise, loop_of(*ends, *measured)
        assert found.distance[k] == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-2)


def loop_of(*T: np.ndarray) -> np.ndarray:
    """Along the first closure and back along the second; its two poses, those of the second, both measurements."""
    a, b, e, f, z, w = T
    return tangent(np.linalg.inv(z) @ np.linalg.inv(a) @ e @ w @ np.linalg.inv(f) @ b)


@pytest.mark.parametrize("off", [0.0, 0.3])
def test_odds_are_densities_of_false_ones_for_that_of_right_ones(off: float) -> None:
    here, noise = np.eye(3)[None], np.diag([0.01, 0.04, 0.0025])[None]
    c = ClosureNumbers(here, here, pose_matrix(np.array([off, -off, 0.0]))[None], noise, np.zeros((6, 6)))
    found = judge_each(c, _SPREADS)
    right = multivariate_normal(np.zeros(3), noise[0]).pdf([-off, off, 0.0])
    false = [1.0 / (10.0 * 10.0 * 1.0), 1.0 / (60.0 * 60.0 * 2 * math.pi)]
    np.testing.assert_allclose(found.chance[0], np.minimum(np.array(false) / right, 1.0), rtol=1e-9)
    assert found.chance[0, 0] < 1.0
    unsure = judge_each(c._replace(known=100.0 * np.eye(6)), _SPREADS).chance[0]
    assert unsure.tolist() == [1.0, 1.0]  # a map that knows nothing excludes nothing


def test_half_of_the_distance_counts_in_space() -> None:
    here, noise = np.eye(4)[None], np.diag([0.01] * 3 + [0.0025] * 3)[None]
    known = np.zeros((12, 12))
    near = judge_each(ClosureNumbers(here, here, here, noise, known), _SPREADS)
    off = here.copy()
    off[0, 0, 3] = 0.2
    far = judge_each(ClosureNumbers(here, here, off, noise, known), _SPREADS)
    assert far.distance[0] == pytest.approx(4.0)
    assert far.chance[0, 0] / near.chance[0, 0] == pytest.approx(math.e)
    assert near.chance[0, 0] == pytest.approx((2 * math.pi) ** 1.5 * 0.1 * 0.1 * 0.05 / 100.0)


def corridor(length: int, sigma: float = 0.02) -> list[Batch]:
    """There and back again, a metre a pose, odometry without noise; pose 2 n − k is where pose k was, turned."""
    weight = np.diag(np.full(3, sigma**-2))[np.triu_indices(3)][None]
    batches = [Batch((Variables("se2", np.array([0]), np.zeros((1, 3)), True),), ())]
    for k in range(1, 2 * length + 1):
        step = [0.0, 0.0, math.pi] if k == length + 1 else [1.0, 0.0, 0.0]
        odometry = Factors("between_se2", np.array([[k - 1, k]]), np.array([step]), weight)
        batches.append(Batch((Variables("se2", np.array([k])),), (odometry,)))
    return batches


def closure(i: int, j: int, z: list[float], sigma: float = 0.02) -> Batch:
    weight = np.diag(np.full(3, sigma**-2))[np.triu_indices(3)][None]
    return Batch((), (Factors("between_se2", np.array([[i, j]]), np.array([z]), weight),))


def driven(length: int = 8) -> GatedSolver:
    made = GatedSolver(Options())
    for batch in corridor(length):
        made.insert(batch)
    return made


def believe(made: GatedSolver, closure: Closure, reason: str) -> None:
    """It is in, and may go out again."""
    made.accept(closure.factor_id)
    closure.state, closure.reason = ACCEPTED, reason
    made.ledger.of_kind[closure.factor.kind].mark(closure)


def test_a_closure_that_the_map_expects_goes_in_and_another_is_a_suspect() -> None:
    made = driven()
    right = made.insert(closure(1, 16, [0.02, 0.0, math.pi]))
    assert [c.state for c in right.accepted] == [ACCEPTED]
    assert not right.suspects
    assert right.accepted[0].chance < 1e-3
    wrong = made.insert(closure(2, 15, [3.0, 0.0, math.pi]))
    (suspect,) = wrong.suspects
    assert (suspect.state, suspect.reason, suspect.factor_id) == (SUSPECT, "improbable", 17)
    assert suspect.distance > 100.0
    assert suspect.chance == 1.0
    assert made.suspects() == [suspect]
    assert made.solver.factor_count == 17


def test_what_a_user_says_is_for_good() -> None:
    made = driven()
    made.insert(closure(1, 16, [0.02, 0.0, math.pi]))
    made.insert(closure(2, 15, [3.0, 0.0, math.pi]))
    made.reject(16)
    made.accept(17)
    assert [(c.state, c.is_in) for c in made.closures] == [(REJECTED, False), (RESTORED, True)]
    for k in range(3, 7):
        made.insert(closure(k, 17 - k, [0.0, 0.0, math.pi]))
    assert [(c.state, c.is_in) for c in made.closures[:2]] == [(REJECTED, False), (RESTORED, True)]
    assert made.accept(17) is None
    assert made.reject(16) is None
    with pytest.raises(NotAClosure, match="factor 6 is no loop closure that the map tests: it tests 6 closures"):
        made.accept(6)


def test_a_false_one_that_is_in_goes_out_when_others_contradict_it() -> None:
    made = driven()
    made.insert(closure(2, 15, [1.0, 0.0, math.pi]))
    false = made.closures[0]
    assert not false.is_in
    believe(made, false, "passed")  # as if it had passed by chance
    states = []
    for k in (1, 3, 4, 5, 6):
        report = made.insert(closure(k, 17 - k, [0.0, 0.0, math.pi]))
        states += [(c.factor_id, c.reason) for c in report.contradicted]
    assert states == [(16, CONTRADICTED)]
    assert not false.is_in
    assert all(c.is_in for c in made.closures[1:])


def test_rivals_that_agree_at_two_places_replace_what_they_contradict() -> None:
    made = driven(40)
    made.insert(closure(20, 61, [0.3, 3.0, math.pi - 0.15]))
    false = made.closures[0]
    assert (false.reason, false.is_in) == ("unsure", False)  # eighty metres of odometry exclude nothing
    believe(made, false, "agrees")  # as if another false one had agreed with it
    for k in (18, 17, 16, 6, 7, 5, 4, 3):
        made.insert(closure(k, 81 - k, [0.0, 0.0, math.pi]))
    assert (false.state, false.reason) == (SUSPECT, "improbable")
    assert all(c.is_in for c in made.closures[1:])
    assert {c.reason for c in made.closures[1:]} <= {"agrees", "passed"}
    assert all(c.distance < _GATE for c in made.closures[1:])


def test_closures_of_what_a_fixed_pose_joins_are_tested_and_odometry_is_not() -> None:
    made = driven()
    assert not made.closures
    report = made.insert(closure(0, 8, [5.0, 0.0, 0.0]))
    assert [c.reason for c in report.suspects] == ["improbable"]


def test_poses_that_nothing_joins_yet_are_joined_without_a_test() -> None:
    made = driven(3)
    made.insert(Batch((Variables("se2", np.array([50]), np.zeros((1, 3))),), closure(6, 50, [9.0, 9.0, 0.0]).factors))
    assert not made.closures
    assert made.solver.factor_count == 7


@pytest.mark.parametrize(
    ("batch", "wanted"),
    [
        (closure(1, 99, [0.0, 0.0, 0.0]), errors.UnknownVariable),
        (closure(1, 1, [0.0, 0.0, 0.0]), errors.SelfLoop),
        (closure(1, 15, [np.nan, 0.0, 0.0]), errors.NotFinite),
    ],
)
def test_a_batch_with_a_bad_closure_changes_nothing(batch: Batch, wanted: type[errors.SolverError]) -> None:
    made = driven()
    new = Variables("se2", np.array([17]))
    odometry = closure(16, 17, [1.0, 0.0, 0.0]).factors
    with pytest.raises(wanted):
        made.insert(Batch((new,), (*odometry, *batch.factors)))
    assert (made.solver.variable_count, made.solver.factor_count, made.closures) == (17, 16, [])
    made.insert(Batch((new,), odometry))
    assert made.solver.variable_count == 18


@pytest.mark.parametrize(
    "settings_",
    [
        {"closure_chance_max": 0.0}, {"closure_gate_probability": 1.0}, {"closure_spread_m": float("nan")},
        {"closure_revisits": 1.5}, {"closure_retests": -1}, {"closure_out_probability": 0.9},
    ],
)  # fmt: skip
def test_a_policy_out_of_its_range_is_refused(settings_: dict[str, float]) -> None:
    with pytest.raises(errors.BadOption, match=next(iter(settings_))):
        ClosurePolicy(**settings_)  # pyright: ignore[reportArgumentType]


def test_accepted_ones_are_entry_against_the_map_without_them() -> None:
    made = driven()
    for k in (1, 3, 5):
        made.insert(closure(k, 17 - k, [0.01 * k, 0.0, math.pi]))
    ledger = made.ledger.of_kind["between_se2"]
    distance = judge_accepted(closure_numbers(made.solver, ledger, np.array([1])))[0]
    made.reject(17)
    alone = judge_each(closure_numbers(made.solver, ledger, np.array([1])), _SPREADS).distance[0]
    assert distance == pytest.approx(alone, rel=0.02)  # but for the second order of headings


@pytest.mark.parametrize("d", [3, 6])
def test_a_closure_whose_covariance_is_beyond_doubles_is_expected_by_nobody_and_the_others_as_ever(d: int) -> None:
    """In space its eigenvalues were asked for, and no closure of the map was judged any more."""
    c = closures_between(3, d, np.random.default_rng(d), 0.01)
    known = c.known.copy()
    known[:d], known[:, :d] = np.nan, np.inf  # an end of the first one
    found = judge_each(c._replace(known=unsure_where_unknown(known)), _SPREADS)
    wanted = judge_each(c, _SPREADS)
    assert (found.chance[0] == 1.0).all()
    np.testing.assert_array_equal(found.chance[1:], wanted.chance[1:])
    np.testing.assert_array_equal(found.distance[1:], wanted.distance[1:])


def test_drives_with_false_closures_and_without() -> None:
    """Seeds that constants were chosen with; the bench draws others."""
    clean = drive_with_false(300, 2, 0.0, "random")
    made = GatedSolver(Options())
    for batch in clean.batches:
        made.insert(batch)
    assert len(made.closures) > 40
    assert all(c.is_in for c in made.closures)
    for kind in ("random", "local"):
        drive, twice = drive_with_false(300, 2, 0.4, kind), list[bytes]()
        for _ in range(2):
            made = GatedSolver(Options())
            for batch in drive.batches:
                made.insert(batch)
            twice.append(b"".join(group.values.tobytes() for group in made.solver.estimate()))
        is_in, false = np.array([c.is_in for c in made.closures]), drive.is_false()
        assert not (is_in & false).any()
        assert (is_in & ~false).sum() >= 0.98 * (~false).sum()
        assert twice[0] == twice[1]


@given(joins=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)).filter(lambda ij: ij[0] != ij[1]), max_size=12))
def test_what_hangs_together_is_kept_and_found_again_in_the_graph(joins: list[tuple[int, int]]) -> None:
    """Against parts that are merged one by one."""
    keys = np.arange(10) * 10  # none follows another
    made, parts = TrustedForest(), {int(key): {int(key)} for key in keys}
    solver = Solver(Options())
    solver.stage(Batch((Variables("se2", keys, np.zeros((10, 3)), True),)))
    solver.step()
    for i, j in joins:
        factors = closure(int(keys[i]), int(keys[j]), [1.0, 0.0, 0.0]).factors
        split = made.split(Batch((), factors))
        a, b = int(keys[i]), int(keys[j])
        assert len(split.closing) == (b in parts[a])
        for key in (merged := parts[a] | parts[b]):
            parts[key] = merged
        kept = TrustedForest()
        kept.load(made.dump())
        assert len(kept.split(Batch((), factors)).closing) == 1
        made = kept
    made.renew(solver.factor_graph)
    assert all(
        made.split(Batch((), closure(int(a), int(b), [0.0, 0.0, 0.0]).factors)).closing
        for a, b in itertools.combinations(keys, 2)
    ), "what is fixed is joined by the ground"


def test_a_refused_split_leaves_nothing_joined() -> None:
    made, batch = TrustedForest(), closure(1, 9, [1.0, 0.0, 0.0])
    assert not made.split(batch).closing
    made.forget()
    assert not made.split(batch).closing
    assert made.split(batch).closing


def test_factors_are_found_by_ids_in_any_order() -> None:
    made = driven()
    for k in (1, 3, 5):
        made.insert(closure(k, 17 - k, [0.0, 0.0, math.pi]))
    made.reject(16)
    made.insert(closure(6, 11, [0.0, 0.0, math.pi]))
    made.accept(16)
    graph = made.solver.factor_graph
    assert graph.ids_of(np.arange(20)).tolist() == [*range(16), 17, 18, 19, 16]
    assert graph.rows_of(np.array([16, 19, 0, 17, 20, 99])).tolist() == [19, 18, 0, 16, -1, -1]
    (group,) = made.solver.graph()[1]
    assert group.ids is not None
    assert group.ids.tolist() == list(range(20))
    assert group.keys[16:18].tolist() == [[1, 16], [3, 14]]
