"""Old variables marginalized: what is left has the estimate and the covariances that it had; memory does not grow."""

import numpy as np
import pytest
from naive.dense_least_squares import distance
from naive.solver_parts import graph_in, joined_by
from solver.test_converged import put

from factorbus.client import Changes, Draft
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changing import with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.graph.whitened import whitened
from factorbus.solver.sparse.full_rank import LEAST_EIGENVALUE

SPACES = {"se2": (3, 3), "se3": (7, 6)}


def info(*sigmas: float) -> np.ndarray:
    return np.diag(1.0 / np.array(sigmas) ** 2)[np.triu_indices(len(sigmas))][None]


def start(kind: str) -> Batch:
    value = np.zeros((1, SPACES[kind][0]))
    if kind == "se3":
        value[0, 6] = 1.0
    return Batch((Variables(kind, np.array([symbol("x", 0)]), value, fixed=True),))


def step(kind: str, n: int, rng: np.random.Generator, closure: int = 2) -> Batch:
    """The next pose: odometry, a closure to the pose `closure` before, and now and then a position."""
    size, dim = SPACES[kind]
    key = symbol("x", n)

    def edge(back: int) -> Factors:
        z = np.zeros((1, size))
        if kind == "se3":
            z[0, 3:6] = 0.02 * rng.normal(size=3)
            z[0, 6] = np.sqrt(1.0 - z[0, 3:6] @ z[0, 3:6])
        else:
            z[0, 2] = 0.1 * back + 0.02 * rng.normal()
        z[0, 0] = back + 0.05 * rng.normal()
        return Factors(f"between_{kind}", np.array([[key - back, key]]), z, info(*([0.1] * dim)))

    factors = [edge(1)]
    if n > closure and closure > 1:
        factors.append(edge(closure))
    if n % 5 == 0:
        where = np.zeros((1, 4 if kind == "se2" else 6))
        where[0, :2] = 5.0 * np.cos(0.1 * n), 5.0 * np.sin(0.1 * n)
        factors.append(
            Factors(f"position_{kind}", np.array([[key]]), where, info(*([3.0] * (2 if kind == "se2" else 3))))
        )
    return Batch((Variables(kind, np.array([key])),), tuple(factors))


def driven(kind: str, poses: int, mode: str = "bayes-tree", closure: int = 2) -> tuple[Solver, np.random.Generator]:
    rng, solver = np.random.default_rng(3), Solver(Options(mode=mode))
    solver.stage(start(kind))
    for n in range(1, poses):
        solver.stage(step(kind, n, rng, closure))
        solver.step()
    solver.step(settle=True)
    return solver, rng


def oldest(first: int, last: int) -> list[Change]:
    return [Change("marginalize", keys=np.array([symbol("x", n) for n in range(first, last)]))]


def values(solver: Solver) -> dict[int, tuple[str, np.ndarray]]:
    return {k: (g.kind, row) for g in solver.estimate() for k, row in zip(g.keys.tolist(), g.values, strict=True)}


def covariance(solver: Solver, *names: int) -> np.ndarray:
    """The joint covariance of some poses."""
    blocks = CovarianceBlocks(solver.covariances.factored())
    return blocks.joint(np.array([graph_in(solver).find(symbol("x", n)) for n in names]))


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
@pytest.mark.parametrize("closure", [1, 2])
@pytest.mark.parametrize("kind", SPACES)
def test_what_is_left_stays_where_it_is_and_as_certain_as_it_was(kind: str, closure: int, mode: str) -> None:
    solver, _ = driven(kind, 24, mode, closure)
    before, sure = values(solver), covariance(solver, 20, 21, 23)
    after, _, _, counted = with_changes(solver, oldest(0, 20), settle=True)
    assert counted["removed_variables"] == 20
    assert counted["added_factors"] == 1
    assert len(values(after)) == 4
    for key, (of, row) in values(after).items():
        assert distance(of, row, before[key][1]) < 1e-7
    np.testing.assert_allclose(covariance(after, 20, 21, 23), sure, rtol=1e-5, atol=1e-8 * sure.max())


def test_a_relative_marginal_leaves_its_poses_free_together() -> None:
    """Of poses that only odometry joins, nothing is known but where they are from each other."""
    solver, _ = driven("se2", 12, closure=1)
    middle, _, _, counted = with_changes(solver, oldest(3, 8), settle=True)
    assert counted["added_factors"] >= 1
    for key, (of, row) in values(middle).items():
        assert distance(of, row, values(solver)[key][1]) < 1e-7
    np.testing.assert_allclose(covariance(middle, 2, 9), covariance(solver, 2, 9), rtol=1e-5, atol=1e-10)


def test_a_separator_of_three_has_one_factor_and_marginalizing_comes_first() -> None:
    solver, _ = driven("se2", 20, closure=2)
    solver.stage(Batch(factors=(step("se2", 17, np.random.default_rng(1), 10).factors[1],)))
    solver.step(settle=True)
    before, sure = values(solver), covariance(solver, 9, 10, 17)
    after, _, _, counted = with_changes(solver, oldest(0, 9), settle=True)
    assert counted["added_factors"] == 1
    assert joined_by(after) == [[symbol("x", n) for n in (9, 10, 17)]]
    for key, (of, row) in values(after).items():
        assert distance(of, row, before[key][1]) < 1e-9
    np.testing.assert_allclose(covariance(after, 9, 10, 17), sure, rtol=0, atol=1e-8 * sure.max())
    with pytest.raises(errors.BadOrder):
        with_changes(solver, [Change("weigh", np.array([0]), weight=np.array([2.0])), *oldest(0, 5)])


NO_KEYS = np.empty(0, np.int64)
EARLIER = {
    "a loss": Change("loss", np.array([1]), loss="huber", scale=np.ones(1)),
    "no loss, where none is": Change("loss", np.array([1]), loss=""),
    "a loss of nothing": Change("loss", NO_KEYS, loss=""),
    "a weight": Change("weigh", np.array([1]), weight=np.full(1, 2.0)),
    "a weight of 1": Change("weigh", np.array([1]), weight=np.ones(1)),
    "a weight of nothing": Change("weigh", NO_KEYS, weight=np.empty(0)),
    "a pose fixed": Change("fix", keys=np.array([symbol("x", 6)])),
    "a fixed pose fixed": Change("fix", keys=np.array([symbol("x", 0)])),
    "nothing fixed": Change("fix", keys=NO_KEYS),
    "a pose freed": Change("free", keys=np.array([symbol("x", 0)])),
    "a free pose freed": Change("free", keys=np.array([symbol("x", 3)])),
    "a pose placed": Change("place", keys=np.array([symbol("x", 6)]), kind="se2", values=np.zeros((1, 3))),
    "nothing placed": Change("place", keys=NO_KEYS, kind="se2", values=np.empty((0, 3))),
    "a pose marginalized": Change("marginalize", keys=np.array([symbol("x", 1)])),
    "nothing marginalized": Change("marginalize", keys=NO_KEYS),
}


@pytest.mark.parametrize("earlier", EARLIER)
def test_marginalizing_comes_first_whether_or_not_the_earlier_change_has_an_effect(earlier: str) -> None:
    solver, _ = driven("se2", 8)
    with pytest.raises(errors.BadOrder, match="before any loss, weigh, fix, free, place or marginalize"):
        with_changes(solver, [EARLIER[earlier], *oldest(5, 6)])


def test_removals_may_come_before_marginalizing() -> None:
    solver, _ = driven("se2", 8)
    removed = [Change("remove_factors", NO_KEYS), Change("remove_variables", keys=np.array([symbol("x", 7)]))]
    after, _, _, counted = with_changes(solver, [*removed, *oldest(5, 6)])
    assert counted["removed_variables"] == 2
    assert after.variable_count == 6


def test_landmarks_seen_from_one_pose_that_stays_become_what_it_knows() -> None:
    solver, rng = driven("se2", 8)
    l = np.array([symbol("l", 1)])
    keys = [np.array([[symbol("x", n), l[0]]]) for n in (3, 4, 6)]
    seen = [
        Factors("landmark_se2", k, np.array([[2.0 - n, 1.0]]) + 0.02 * rng.normal(size=2), info(0.1, 0.1))
        for n, k in enumerate(keys)
    ]
    solver.stage(Batch((Variables("point2", l),), tuple(seen)))
    solver.step(settle=True)
    before = values(solver)
    after, *_ = with_changes(solver, [oldest(0, 6)[0]._replace(keys=np.append(oldest(0, 6)[0].keys, l))], settle=True)
    assert sorted(values(after)) == [symbol("x", 6), symbol("x", 7)]
    for key, (of, row) in values(after).items():
        assert distance(of, row, before[key][1]) < 1e-7
    kept, *_ = with_changes(solver, [Change("marginalize", keys=l[:0])])
    assert len(values(kept)) == len(before)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("poses", [1500, pytest.param(100_000, marks=pytest.mark.data)])
def test_a_window_over_a_long_drive_takes_constant_memory(poses: int) -> None:
    rng, solver = np.random.default_rng(3), Solver(Options())
    solver.stage(start("se2"))
    first, sizes, window = 0, [], 100
    for n in range(1, poses):
        solver.stage(step("se2", n, rng))
        solver.step()
        if n - first == 2 * window:
            solver, *_ = with_changes(solver, oldest(first, first + window))
            first += window
            sizes.append(solver.memory_bytes())
    assert solver.variable_count <= 2 * window + 1
    assert graph_in(solver).next_id > poses
    assert max(sizes[1:]) <= 1.2 * sizes[1], "it does not grow with the length of the drive"
    where = values(solver)[symbol("x", poses - 1)][1]
    assert np.hypot(*where[:2]) < 30.0, "the positions hold it, however long ago the first were"


def weakly_held(prior: float) -> Solver:
    """60 poses in a row with short loops, and a first prior of this σ, m and rad."""
    rng, solver, sigmas = np.random.default_rng(3), Solver(Options(mode="bayes-tree")), np.array([0.05, 0.05, 0.01])
    for k in range(60):
        draft = Draft().se2(f"x{k}", (float(k), 0.0, 0.0))
        if k == 0:
            draft.prior_se2("x0", (0.0, 0.0, 0.0), sigmas=[prior] * 3)
        else:
            draft.between_se2(f"x{k - 1}", f"x{k}", [1.0, 0.0, 0.0] + sigmas * rng.normal(size=3), sigmas=sigmas)
        if k % 10 == 9:
            draft.between_se2(f"x{k - 8}", f"x{k}", [8.0, 0.0, 0.0] + sigmas * rng.normal(size=3), sigmas=sigmas)
        put(solver, draft)
    return solver


@pytest.mark.parametrize("settle", [False, True])
@pytest.mark.parametrize("prior", [1e3, 1e4, 1e5])
def test_what_a_weak_prior_says_goes_to_the_next_pose(prior: float, settle: bool) -> None:
    solver = weakly_held(prior)
    made, *_ = with_changes(solver, Changes().marginalize("x0").listed(), None, settle)
    assert made.chi2() == pytest.approx(solver.chi2(), rel=1e-4)
    assert covariance(made, 1).diagonal() == pytest.approx(covariance(solver, 1).diagonal(), rel=1e-2)


@pytest.mark.parametrize("prior", [1e3, 1e4, 3e4, 1e5])
def test_no_marginal_leads_away_from_the_optimum(prior: float) -> None:
    """Where R has to be damped, the estimate stays what it was before R was made without: χ² went up to 1.5 10⁷."""
    solver = weakly_held(prior)
    made, _, report, _ = with_changes(solver, Changes().marginalize("x0", "x3").listed())
    for _ in range(3):
        assert report.chi2 == pytest.approx(solver.chi2(), rel=1e-4)
        report = made.step()


def test_a_marginal_that_cannot_hold_the_map_is_named() -> None:
    with pytest.raises(errors.Underconstrained, match="marginalized may have been all that says where the map is"):
        with_changes(weakly_held(1e5), Changes().marginalize("x0", "x1", "x2").listed())


def triangle(prior: float) -> Solver:
    """Three poses that links of σ 1e-5 join, and a prior of this σ on the first."""
    solver, stiff = Solver(), [1e-5] * 3
    draft = Draft().se2("x0", (0, 0, 0)).prior_se2("x0", (0, 0, 0), sigmas=[prior] * 3)
    draft.se2("x1", (1, 0, 0)).se2("x2", (1, 1, 0))
    for a, b, z in (("x0", "x1", (1, 0, 0)), ("x1", "x2", (0, 1, 0)), ("x0", "x2", (1, 1, 0))):
        draft.between_se2(a, b, z, sigmas=stiff)
    put(solver, draft)
    return solver


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
@pytest.mark.parametrize("prior", [7.0, 9.0])
def test_what_a_dense_solve_has_digits_for_is_taken(prior: float, mode: str) -> None:
    """By Λ, which has the squares of what is known, more was asked for."""
    solver = triangle(prior)
    graph, batch = graph_in(solver), Solver(Options(mode=mode))
    J = whitened(graph, range(4), [graph.find(symbol("x", n)) for n in range(3)]).J
    R = np.linalg.qr(J, mode="r")[3:, 3:]
    assert np.linalg.svd(R / np.sqrt((R * R).sum(0)), compute_uv=False)[-1] ** 2 >= LEAST_EIGENVALUE
    made, *_ = with_changes(solver, Changes().marginalize("x0").listed())
    for key in (symbol("x", 1), symbol("x", 2)):
        assert distance("se2", values(made)[key][1], values(solver)[key][1]) < 1e-6
    batch.stage(Batch(*(tuple(groups) for groups in made.graph())))
    assert batch.step().chi2 == pytest.approx(made.chi2(), abs=1e-9)
