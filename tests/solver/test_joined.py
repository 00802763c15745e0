"""What is known of many poses together: marginals with a separator of any size are one linear factor."""

from collections.abc import Iterator

import numpy as np
import pytest
from naive.dense_factors import TANGENT, boxplus, jacobians, residual
from naive.dense_least_squares import DenseGraph, distance
from naive.marginal_windows import (
    MODES,
    SIZE,
    apart,
    covariance,
    information,
    loopy,
    marginalize,
    relative_pose,
    solved,
    twin_of,
    values,
    x,
)
from naive.solver_parts import graph_in, joined_by

from factorbus.proto import codec
from factorbus.proto.kinds import MOST_JOINED
from factorbus.proto.messages import Batch, Change, Factors, Insert, Variables
from factorbus.proto.symbols import symbol
from factorbus.simulate import LoopClosures, manhattan
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changes.repair import find_loops, repair
from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import evaluate_candidates
from factorbus.solver.covariance.why import why_variable
from factorbus.solver.graph.groups import FactorGroup
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.sparse.anchors import find_undetermined


@pytest.mark.parametrize(
    ("kind", "seed", "mode"), [("se2", seed, mode) for seed in (1, 2) for mode in MODES] + [("se3", 3, "bayes-tree")]
)
def test_a_loopy_window_stays_where_it_is_as_certain_as_it_was_and_goes_on_like_a_dense_twin(
    kind: str, seed: int, mode: str
) -> None:
    batch = loopy(kind, 16, seed)
    solver = solved(batch, mode)
    estimate, gone = values(solver), list(range(8))
    names = list(range(8, 16))
    sure = covariance(solver, *names)
    after, _, report, counted = with_changes(solver, marginalize(*gone), settle=True)
    assert counted["removed_variables"] == 8
    (keys,) = joined_by(after)
    assert len(keys) >= 3, "else it shows nothing"
    assert all(distance(of, row, estimate[key][1]) < 1e-9 for key, (of, row) in values(after).items())
    np.testing.assert_allclose(covariance(after, *names), sure, rtol=0, atol=1e-8 * np.abs(sure).max())

    twin = twin_of(batch, estimate, x(*gone))
    assert report.chi2 == pytest.approx(twin.graph.chi2() + twin.d @ twin.d, rel=1e-6)
    assert twin.keys == x(*(n for n in names if symbol("x", n) in twin.keys)).tolist()
    rng, d = np.random.default_rng(seed), TANGENT[kind]
    now = {n: estimate[symbol("x", min(n, 15))][1] for n in (8, 9, 15, 16)}
    more = Batch(
        (Variables(kind, x(16)),),
        tuple(
            Factors(
                f"between_{kind}",
                x(a, b)[None],
                boxplus(kind, relative_pose(kind, now[a], now[b]), 0.05 * rng.normal(size=d))[None],
                information(rng, d),
            )
            for a, b in ((15, 16), (8, 15), (9, 16))
        ),
    )  # fmt: skip
    after.stage(more)
    after.step(settle=True)
    twin.graph.add(more)
    twin.graph.values[symbol("x", 16)] = values(after)[symbol("x", 16)][1]
    twin.settle()
    moved = max(distance(of, row, estimate[key][1]) for key, (of, row) in values(after).items() if key in estimate)
    assert moved > 1e-3
    for key, (of, row) in values(after).items():
        assert distance(of, row, twin.graph.values[key]) < 2e-8


@pytest.mark.parametrize("kind", SIZE)
def test_step_by_step_is_the_same_as_at_once(kind: str) -> None:
    """What is known of many poses goes whole into the next marginal."""
    solver = solved(loopy(kind, 18, 5))
    at_once, *_ = with_changes(solver, marginalize(*range(10)), settle=True)
    slowly = solver
    for n in range(10):
        slowly, *_ = with_changes(slowly, marginalize(n), settle=True)
    assert apart(at_once, slowly) < 1e-9
    a, b = covariance(at_once, *range(10, 18)), covariance(slowly, *range(10, 18))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-8 * np.abs(a).max())
    assert len(joined_by(slowly)) == 1
    assert slowly.chi2() == pytest.approx(at_once.chi2(), rel=1e-6)


def window(mode: str = "bayes-tree") -> tuple[Solver, int]:
    """A map with one linear factor of several poses, and its id."""
    solver, *_ = with_changes(solved(loopy("se2", 16, 1), mode), marginalize(*range(8)), settle=True)
    (group,) = (g for g in solver.graph()[1] if g.kind.startswith("linear_"))
    assert len(group.keys) == 1
    assert group.ids is not None
    return solver, int(group.ids[0])


@pytest.mark.parametrize("mode", MODES)
def test_it_is_removed_weighed_and_gets_a_loss_as_any_factor(mode: str) -> None:
    solver, factor = window(mode)
    before, ids = values(solver), np.array([factor])
    batch = Batch(
        tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in solver.graph()[0]),
        tuple(_sent(g) for g in solver.graph()[1]),
    )
    for change in (
        Change("weigh", ids, weight=np.array([3.0])),
        Change("loss", ids, loss="huber", scale=np.array([0.05])),
    ):
        after, _, report, _ = with_changes(solver, [change], settle=True)
        twin = DenseGraph()
        twin.add(batch)
        twin.put(after.estimate())
        n = next(n for n, (kind, *_) in enumerate(twin.factors) if kind.startswith("linear_"))
        if change.change == "weigh":
            kind, keys, z, W = twin.factors[n]
            twin.factors[n] = kind, keys, z, 3.0 * W
        else:
            twin.losses[n] = "huber", 0.05
        _, eta = twin.system()
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-9)
        assert np.abs(eta).max() < 1e-3 * np.abs(twin.system()[0]).max() * 1e-6, "it is at its optimum"
        if mode == "bayes-tree" and try_change(solver, [change]) is not None:
            solver.step(settle=True)
            assert apart(after, solver) < 1e-7
            solver, _ = window(mode)
    gone = int(graph_in(solver).keys[graph_in(solver).ends_of(int(graph_in(solver).rows_of(ids)[0]))[0]])
    without, *_ = with_changes(solver, [Change("remove_variables", keys=np.array([gone]))])
    assert not joined_by(without)
    held, *_ = with_changes(solver, [Change("fix", keys=x(10))], settle=True)
    freed, *_ = with_changes(held, [Change("free", keys=x(10))], settle=True)
    assert apart(freed, solver) < 1e-9
    assert all(np.array_equal(row, before[key][1]) for key, (_, row) in values(solver).items())


def test_what_asks_about_it_gets_an_answer() -> None:
    solver, factor = window()
    graph, blocks = graph_in(solver), CovarianceBlocks(solver.covariances.factored())
    total = 0.0
    for v in range(solver.variable_count):
        explained = why_variable(blocks, v, True)
        assert explained.pivot > 0.0
        assert 0.0 < explained.conditioning <= 1.0 + 1e-9
        total += sum(f.chi2 / len(f.keys) for f in explained.factors)
        assert all(f.chi2 >= 0.0 and f.leverage >= 0.0 for f in explained.factors)
    assert total == pytest.approx(solver.chi2(), rel=1e-9)
    assert factor not in graph.ids_of(find_loops(graph)).tolist(), "marginals are no suspects of themselves"
    assert repair(graph).false.size == 0
    assert repair(graph, np.array([factor])).suspects == 1
    (group,) = (g for g in graph.factors() if g.kind.startswith("linear_"))
    (found,) = evaluate_candidates(blocks, [group]).distance.tolist()
    twin = DenseGraph()
    twin.add(Batch(tuple(Variables(g.kind, g.keys, g.values) for g in solver.estimate()), (_sent(group),)))
    twin.put(solver.estimate())
    (kind, keys, z, W), ends = twin.factors[0], [values(solver)[key] for key in twin.factors[0][1]]
    r, J = residual(kind, [row for _, row in ends], z), jacobians(kind, [of for of, _ in ends], [r for _, r in ends], z)
    H = np.hstack(J)
    S = H @ covariance(solver, *(key - symbol("x", 0) for key in keys)) @ H.T + np.linalg.inv(W)
    assert found == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-6, abs=1e-9)


def test_the_kept_up_covariance_is_that_from_scratch() -> None:
    solver, _ = window()
    upkeep = solver.covariances.try_upkeep()
    assert upkeep is not None
    upkeep.update()
    rng = np.random.default_rng(1)
    for n in range(16, 22):
        edge = Factors("between_se2", x(n - 1, n)[None], np.array([[1.0, 0, 0.1]]), information(rng, 3))
        solver.stage(Batch((Variables("se2", x(n)),), (edge,)))
        solver.step()
        upkeep.update()
        np.testing.assert_allclose(
            upkeep.diagonal()[:, :3, :3],
            CovarianceBlocks(solver.covariances.factored()).diagonal(),
            rtol=0,
            atol=1e-8 * upkeep.diagonal().max(),
        )


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", SIZE)
def test_it_goes_over_the_wire_and_into_other_maps(kind: str, mode: str) -> None:
    solver, *_ = with_changes(solved(loopy(kind, 16, 1)), marginalize(*range(8)), settle=True)
    variables, factors = solver.graph()
    sent = Batch(
        tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in variables),
        tuple(_sent(g) for g in factors),
    )
    came = codec.decode_insert(codec.encode_insert(Insert(1, sent))).batch
    other = solved(came, mode)
    assert apart(solver, other) < 1e-9
    assert other.chi2() == pytest.approx(solver.chi2(), rel=1e-6)
    assert joined_by(other) == joined_by(solver)
    # As an insert into a map that is there: the poses first.
    late = Solver(Options(mode=mode))
    late.stage(came._replace(factors=tuple(g for g in came.factors if not g.kind.startswith("linear"))))
    late.step()
    late.stage(Batch((), tuple(g for g in came.factors if g.kind.startswith("linear"))))
    late.step(settle=True)
    assert apart(solver, late) < 1e-9


@pytest.mark.parametrize("mode", MODES)
def test_a_state_goes_on_bit_for_bit(mode: str) -> None:
    solver, *_ = with_changes(solved(loopy("se2", 16, 1), mode), marginalize(*range(8)))
    again = Solver(Options(mode=mode))
    again.load(solver.dump())
    for n in (16, 17):
        edge = Factors(
            "between_se2", x(n - 1, n)[None], np.array([[1.0, 0.1, 0.1]]), information(np.random.default_rng(n), 3)
        )
        loop = Factors(
            "between_se2", x(n - 5, n)[None], np.array([[4.0, 0.1, 0.4]]), information(np.random.default_rng(n), 3)
        )
        for each in (solver, again):
            each.stage(Batch((Variables("se2", x(n)),), (edge, loop)))
            each.step()
        assert all(np.array_equal(row, values(again)[key][1]) for key, (_, row) in values(solver).items())
    ones, others = with_changes(solver, marginalize(8, 9))[0], with_changes(again, marginalize(8, 9))[0]
    assert all(np.array_equal(row, values(others)[key][1]) for key, (_, row) in values(ones).items())


def _sent(group: FactorGroup) -> Factors:
    return Factors(group.kind, group.keys, group.measured, group.information)


def test_too_many_and_what_is_no_pose_are_refused_and_named() -> None:
    rng, count = np.random.default_rng(1), MOST_JOINED + 2
    star = tuple(
        Factors("between_se2", x(0, n)[None], np.array([[1.0 * n, 0, 0]]), information(rng, 3)) for n in range(1, count)
    )
    solver = solved(Batch((Variables("se2", x(*range(count))),), (*star, loopy("se2", 2, 1).factors[-2])))
    with pytest.raises(errors.TooConnected) as refused:
        with_changes(solver, marginalize(0))
    assert refused.value.detail["separator"] == x(*range(1, count)).tolist()
    after, *_ = with_changes(solver, marginalize(0, 1), settle=True)
    assert [len(keys) for keys in joined_by(after)] == [MOST_JOINED]
    assert apart(after, solver) < 1e-9
    l = np.array([symbol("l", 1)])
    seen = [
        Factors("landmark_se2", np.array([[k, l[0]]]), np.ones((1, 2)), np.eye(2)[np.triu_indices(2)][None])
        for k in x(0, 1)
    ]
    solver.stage(Batch((Variables("point2", l),), tuple(seen)))
    solver.step()
    with pytest.raises(errors.TooConnected):
        with_changes(solver, marginalize(0))


@pytest.mark.timeout(600)
@pytest.mark.parametrize("poses", [400, pytest.param(4000, marks=pytest.mark.data)])
def test_a_window_over_manhattan_with_its_loops_takes_constant_memory(poses: int) -> None:
    """Loops of up to 60 poses are inside the window; those that reach further back are left out."""
    keep, every = 60, 15
    solver, rest, first, sizes, widest, loops = Solver(Options()), Solver(Options()), 0, [], 0, 0
    for n, step in enumerate(_steps(poses, keep)):
        for each in (solver, rest):
            each.stage(step)
            each.step()
        loops += step.factor_count - 1
        if n - first == keep + every:
            solver, *_ = with_changes(solver, marginalize(*range(first, first + every)))
            first += every
            sizes.append(solver.memory_bytes())
            widest = max([widest, *(len(keys) for keys in joined_by(solver))])
    assert widest >= 4, "loops make it more than a chain"
    assert loops > poses / 10
    half = len(sizes) // 2
    assert max(sizes[half:]) <= 2.0 * max(sizes[:half]), "it does not grow with the length of the drive"
    solver.step(settle=True)
    rest.step(settle=True)
    here, there = values(solver), values(rest)
    last = here[symbol("x", poses - 1)][1], there[symbol("x", poses - 1)][1]
    for key in here:
        seen, wanted = (relative_pose("se2", of[key][1], end) for of, end in zip((here, there), last, strict=True))
        assert distance("se2", seen, wanted) < 1e-3, "the window is what it is in the whole map"
    if poses < 1000:
        assert np.hypot(*(last[0] - last[1])[:2]) < 0.1, "and where it is there, but for what was linearized once"


def _steps(poses: int, keep: int) -> Iterator[Batch]:
    """A pose a step, with the factors to those at most `keep` before it."""
    for step in manhattan(poses=poses, seed=3, loops=LoopClosures(share=0.8, gap=8), block_m=3, sigma_theta_rad=0.005):
        near = []
        for g in step.batch.factors:
            cut = np.ptp(g.keys, axis=1) <= keep
            near.append(g._replace(keys=g.keys[cut], measured=g.measured[cut], information=g.information[cut]))
        yield step.batch._replace(factors=tuple(g for g in near if len(g.keys)))


@pytest.mark.parametrize("kind", SIZE)
def test_a_long_drive_is_held_by_the_marginal_of_what_held_it(kind: str) -> None:
    """What is known of where it begins is in a factor of two poses then: they are held together, the rest by them."""
    poses, d = 300, TANGENT[kind]
    ahead = [np.zeros(SIZE[kind]) for _ in range(2)]
    for n, z in enumerate(ahead):
        z[0] = n + 1.0
        z[6:] = 1.0
    sigmas = np.diag(np.full(d, 1e4))[np.triu_indices(d)][None]
    at_all = np.zeros((poses, SIZE[kind]))
    at_all[:, 0] = np.arange(poses)
    at_all[:, 6:] = 1.0
    factors = [Factors(f"prior_{kind}", x(0)[None], at_all[:1], sigmas)]
    for n, z in enumerate(ahead):
        keys = np.stack([x(*range(poses - n - 1)), x(*range(n + 1, poses))], axis=1)
        factors.append(Factors(f"between_{kind}", keys, np.tile(z, (len(keys), 1)), np.tile(sigmas, (len(keys), 1))))
    solver = solved(Batch((Variables(kind, x(*range(poses)), at_all),), tuple(factors)))
    after, *_ = with_changes(solver, marginalize(0), settle=True)
    assert [g.keys.tolist() for g in after.graph()[1] if g.kind.startswith("linear")] == [[x(1, 2).tolist()]]
    assert not find_undetermined(graph_in(after), (0,) * at.COUNTS).size, "nothing is left to the numbers"
    again, *_ = with_changes(after, [Change("fix", keys=x(9))])
    assert apart(again, solver) < 1e-9
