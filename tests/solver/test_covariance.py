"""Covariances from the tree of cliques, against dense inverses."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from naive.dense_covariances import DenseCovariance
from naive.dense_least_squares import DenseGraph
from naive.random_graphs import random_steps
from naive.solver_parts import fixed_in, graph_in, keys_in, kinds_in, linearization_points

from examples import examples
from factorbus.simulate import city_trees, manhattan
from factorbus.solver import FactorGroup, Group, Options, Solver, errors
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import evaluate_candidates
from factorbus.solver.covariance.relative import relative
from factorbus.solver.covariance.why import why_factor, why_variable
from factorbus.solver.errors import UnknownFactor
from factorbus.solver.graph.factors import FACTOR_KINDS
from factorbus.solver.graph.variables import VARIABLE_KINDS
from factorbus.solver.kernels.model.kinds import BOUNDED

MODES = ("bayes-tree", "inc-l", "all-batch")
DIM = {name: kind.dim for name, kind in VARIABLE_KINDS.items()}


def solved(seed: int, mode: str, steps: int = 6) -> Solver:
    solver = Solver(Options(mode=mode))
    for batch in random_steps(seed, steps=steps):
        solver.stage(batch)
        solver.step()
    return solver


def dense(solver: Solver) -> DenseCovariance:
    """The twin, linearized where the solver's R is."""
    graph = DenseGraph()
    variables, factors = solver.graph()
    graph.add(_Whole(variables, factors))
    keys = keys_in(solver)
    graph.kinds = dict(zip(keys, kinds_in(solver), strict=True))  # in insertion order
    graph.values |= dict(zip(keys, linearization_points(solver), strict=True))
    return DenseCovariance(graph)


class _Whole:
    def __init__(self, variables, factors) -> None:
        self.variables, self.factors = variables, factors


def close(found: np.ndarray, wanted: np.ndarray, tell: float = 1e-8) -> None:
    """To a share `tell` of the largest entry."""
    np.testing.assert_allclose(found, wanted, rtol=0, atol=tell * max(np.abs(wanted).max(initial=0.0), 1e-12))


@examples(30)
@given(seed=st.integers(0, 2**32 - 1), mode=st.sampled_from(MODES))
def test_blocks_are_those_of_the_dense_inverse(seed: int, mode: str) -> None:
    solver = solved(seed, mode)
    twin, blocks = dense(solver), CovarianceBlocks(solver.covariances.factored())
    keys = keys_in(solver)
    for v, found in enumerate(blocks.diagonal()):
        d = DIM[twin.graph.kinds[keys[v]]]
        close(found[:d, :d], twin.joint([keys[v]]), twin.tell)
    rng = np.random.default_rng(seed)
    some = rng.integers(0, len(keys), 5)
    close(blocks.joint(some), twin.joint([keys[v] for v in some]), twin.tell)
    first, second = rng.integers(0, len(keys), (2, 12))
    for a, b, found in zip(first, second, blocks.pairs(first, second), strict=True):
        da, db = (DIM[twin.graph.kinds[keys[v]]] for v in (a, b))
        scale = np.sqrt(np.outer(*(np.diag(twin.joint([keys[v]])).max(initial=1e-12, keepdims=True) for v in (a, b))))
        wanted = twin.joint([keys[a], keys[b]])[:da, da:]
        np.testing.assert_allclose(found[:da, :db], wanted, rtol=0, atol=twin.tell * scale[0, 0])


@examples(20)
@given(seed=st.integers(0, 2**32 - 1))
def test_one_matrix_by_columns_is_that_of_the_joint_covariance(seed: int) -> None:
    """Of many variables columns are made: 1,900 of a map of 10,000 poses took 88 s of a core without."""
    solver, rng = solved(seed, "bayes-tree", steps=12), np.random.default_rng(seed)
    joint, columns, n = (
        CovarianceBlocks(solver.covariances.factored()),
        CovarianceBlocks(solver.covariances.factored()),
        solver.variable_count,
    )
    joint.prefers_columns = lambda *_: False  # type: ignore[method-assign]
    columns.prefers_columns = lambda *_: True  # type: ignore[method-assign]
    sigma = np.sqrt(np.diag(joint.joint(np.arange(n)))) + 1e-12
    starts = np.cumsum(joint.factored.dims) - joint.factored.dims
    places = [starts[v] + np.arange(d) for v, d in enumerate(joint.factored.dims)]
    for few, many in ((3, 9), (9, 3), (1, 1), (n, n)):
        rows, others = rng.integers(0, n, few), rng.integers(0, n, many)
        scale = np.outer(*(sigma[np.concatenate([places[v] for v in each])] for each in (rows, others)))
        found = columns.between(rows, others)
        assert found.flags.c_contiguous
        np.testing.assert_allclose(found / scale, joint.between(rows, others) / scale, rtol=0, atol=1e-9)
    every = columns.joint(np.arange(n))
    assert (every == every.T).all()
    for rows, others in ((np.empty(0, np.int64), np.arange(n)), (np.arange(n), np.empty(0, np.int64))):
        shape = int(joint.factored.dims[rows].sum()), int(joint.factored.dims[others].sum())
        assert CovarianceBlocks(solver.covariances.factored()).between(rows, others).shape == shape


def test_columns_are_made_for_many_variables_and_not_for_few() -> None:
    solver = Solver(Options(mode="bayes-tree"))
    for step in manhattan(400, 4):
        solver.stage(step.batch)
        solver.step()
    blocks, every = CovarianceBlocks(solver.covariances.factored()), np.arange(400)
    assert blocks.prefers_columns(every, every)
    assert blocks.prefers_columns(every[:2], every)
    assert blocks.prefers_columns(every, every[:2])
    assert not blocks.prefers_columns(every[:8], every[:8])
    assert not blocks.prefers_columns(every[:2], every[:5])


@pytest.mark.parametrize("ends", [(5, 1), (1, 5)])
def test_pairs_are_the_right_way_round_whichever_end_repeats(ends: tuple[int, int]) -> None:
    solver = solved(3, "bayes-tree")
    blocks, n = CovarianceBlocks(solver.covariances.factored()), solver.variable_count
    first, second = np.arange(0, 10) % min(ends[0], n), np.arange(0, 10) % min(ends[1], n)
    dims = blocks.factored.dims
    for a, b, found in zip(first, second, blocks.pairs(first, second), strict=True):
        whole = blocks.joint(np.array([a, b]))
        np.testing.assert_allclose(found[: dims[a], : dims[b]], whole[: dims[a], dims[a] :], rtol=1e-9, atol=1e-14)


@examples(20)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_column_that_is_made_with_all_blocks(seed: int) -> None:
    solver = solved(seed, "bayes-tree", steps=12)
    alone, every = CovarianceBlocks(solver.covariances.factored()), np.arange(solver.variable_count)
    diagonal = alone.diagonal()
    for hub in every[:: max(1, len(every) // 4)]:
        blocks, here = CovarianceBlocks(solver.covariances.factored()), np.full(len(every), hub)
        np.testing.assert_array_equal(blocks.diagonal(int(hub)), diagonal)
        wanted = np.stack([pair_by_itself(alone, int(hub), v) for v in every])
        scale = np.sqrt(np.abs(diagonal[hub]).max() * np.abs(diagonal).max()) + 1e-12
        np.testing.assert_allclose(blocks.pairs(here, every), wanted, rtol=0, atol=1e-10 * scale)
        np.testing.assert_allclose(blocks.pairs(every, here), wanted.transpose(0, 2, 1), rtol=0, atol=1e-10 * scale)


def pair_by_itself(blocks: CovarianceBlocks, i: int, j: int) -> np.ndarray:
    """(width, width): between two variables, in the upper left corner; cut out of what both are together."""
    dims, out = blocks.factored.dims, np.zeros((blocks.width, blocks.width))
    out[: dims[i], : dims[j]] = blocks.joint(np.array([i, j]))[: dims[i], dims[i] :]
    return out


def test_in_place_is_what_the_copy_says() -> None:
    solver = Solver(Options(mode="bayes-tree"))
    for step in manhattan(200, 4):
        solver.stage(step.batch)
        solver.step()
        last = solver.variable_count - 1
        if last > 2:
            some = np.array([last, last // 2 + 1])
            found, blocks = solver.covariances.try_joint(some), CovarianceBlocks(solver.covariances.factored())
            assert found is not None
            np.testing.assert_allclose(found, blocks.joint(some), rtol=1e-12, atol=0)
            np.testing.assert_allclose(found[:3, :3], blocks.diagonal()[last, :3, :3], rtol=1e-9, atol=0)
    assert Solver(Options(mode="inc-l")).covariances.try_joint(np.array([0])) is None


def test_a_copy_stays_as_it_is_while_the_map_goes_on() -> None:
    steps = [step.batch for step in manhattan(150, 2)]
    solver = Solver(Options(mode="bayes-tree"))
    for batch in steps[:100]:
        solver.stage(batch)
        solver.step()
    early = CovarianceBlocks(solver.covariances.factored())
    before = CovarianceBlocks(solver.covariances.factored()).diagonal().copy()
    for batch in steps[100:]:
        solver.stage(batch)
        solver.step()
    assert early.diagonal().tobytes() == before.tobytes()


def test_making_r_anew_moves_nothing() -> None:
    solver = solved(5, "inc-l")
    before = [group.values.tobytes() for group in solver.estimate()]
    copy = solver.covariances.factored()
    assert [group.values.tobytes() for group in solver.estimate()] == before
    assert [group.values.tobytes() for group in copy.graph.variables()] == before


def candidates(solver: Solver, seed: int) -> list[FactorGroup]:
    """A few of every kind between variables of the map, off by some."""
    rng, groups = np.random.default_rng(seed), []
    of_kind: dict[str, list[np.ndarray]] = {}
    for group in solver.estimate():
        of_kind.setdefault(group.kind, []).append(group.keys)
    for kind in FACTOR_KINDS.values():
        if not BOUNDED[kind.code]:  # what a camera sees, say, is not drawn by chance
            continue
        ends = [np.concatenate(of_kind[end.name]) for end in kind.connects]
        keys = np.array([[rng.choice(end) for end in ends] for _ in range(3)])
        keys = keys[[len(set(row)) == len(row) for row in keys.tolist()]]
        measured = rng.normal(0, 2, (len(keys), kind.size))
        if kind.size == 7:
            measured[:, 3:] /= np.linalg.norm(measured[:, 3:], axis=1, keepdims=True)
        measured = np.abs(measured) if kind.name == "bearing_range_se2" else measured
        J = rng.normal(size=(len(keys), kind.dim, kind.dim))
        information = (J @ J.transpose(0, 2, 1) + np.eye(kind.dim))[:, *np.triu_indices(kind.dim)]
        groups.append(FactorGroup(kind.name, keys, measured, information))
    return groups


@examples(15)
@given(seed=st.integers(0, 2**32 - 1))
def test_candidates_of_every_kind(seed: int) -> None:
    solver = solved(seed, "all-batch")
    twin, blocks = dense(solver), CovarianceBlocks(solver.covariances.factored())
    groups, k = candidates(solver, seed), 0
    marks = blocks.factored.graph.mark()
    found = evaluate_candidates(blocks, groups)
    assert blocks.factored.graph.mark() == marks
    for group in groups:
        for keys, z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            r, T, noise = twin.innovation(group.kind, keys, z, upper)
            d = len(r)
            assert found.dims[k] == d
            close(found.predicted[k, :d, :d], T, 1e-6)
            np.testing.assert_allclose(found.distance[k], r @ np.linalg.solve(T + noise, r), rtol=1e-5)
            gain = 0.5 * (np.linalg.slogdet(T + noise)[1] - np.linalg.slogdet(noise)[1])
            np.testing.assert_allclose(found.gain[k], gain, rtol=1e-6, atol=1e-8)
            k += 1
    assert k == len(found.distance)


def test_candidates_that_no_insert_could_bring_are_refused() -> None:
    solver = solved(1, "bayes-tree")
    blocks = CovarianceBlocks(solver.covariances.factored())
    group = candidates(solver, 1)[4]
    marks = blocks.factored.graph.mark()
    unknown = FactorGroup(group.kind, group.keys + 1000, group.measured, group.information)
    with pytest.raises(errors.UnknownVariable):
        evaluate_candidates(blocks, [group, unknown])
    with pytest.raises(errors.NotPositiveDefinite):
        evaluate_candidates(blocks, [FactorGroup(group.kind, group.keys, group.measured, -group.information)])
    assert blocks.factored.graph.mark() == marks
    assert evaluate_candidates(blocks, []).distance.size == 0


@examples(15)
@given(seed=st.integers(0, 2**32 - 1))
def test_relative_covariance_is_that_of_the_relative_value(seed: int) -> None:
    """Against differences of x_i⁻¹ x_j in its own tangent space, and the dense joint covariance."""
    from naive.dense_factors import boxplus, pose_matrix, pose_vector

    solver = solved(seed, "all-batch")
    twin, blocks = dense(solver), CovarianceBlocks(solver.covariances.factored())
    rng = np.random.default_rng(seed)
    keys, kinds = keys_in(solver), twin.graph.kinds
    poses = [v for v, key in enumerate(keys) if kinds[key] in ("se2", "se3")]
    pairs = []
    for _ in range(6):
        i = int(rng.choice(poses))
        fits = {"se2": ("se2", "point2"), "se3": ("se3", "point3")}[kinds[keys[i]]]
        pairs.append((i, int(rng.choice([v for v in range(len(keys)) if kinds[keys[v]] in fits and v != i]))))
    first, second = np.array(pairs).T

    def seen(x: np.ndarray, kind: str, y: np.ndarray) -> np.ndarray:
        if kind.startswith("se"):
            return pose_vector(np.linalg.inv(pose_matrix(x)) @ pose_matrix(y))
        return (np.linalg.inv(pose_matrix(x)) @ np.append(y, 1.0))[:-1]

    def change(kind: str, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """δ with a ⊞ δ = b, to first order."""
        if not kind.startswith("se"):
            return b - a
        E = pose_vector(np.linalg.inv(pose_matrix(a)) @ pose_matrix(b))
        return E if len(E) == 3 else np.concatenate([E[:3], 2 * E[3:6]])

    for group in relative(blocks, first, second):
        for row, value, covariance in zip(group.rows, group.values, group.covariance, strict=True):
            i, j = keys[first[row]], keys[second[row]]
            x, y, kind = twin.graph.values[i], twin.graph.values[j], kinds[j]
            z, h, columns = seen(x, kind, y), 1e-6, []
            moved = [(kinds[i], x, True, c) for c in range(DIM[kinds[i]])] + [
                (kind, y, False, c) for c in range(DIM[kind])
            ]
            for which, value_of, is_first, c in moved:
                step = np.zeros(DIM[which])
                step[c] = h
                there, back = boxplus(which, value_of, step), boxplus(which, value_of, -step)
                up = seen(there, kind, y) if is_first else seen(x, kind, there)
                down = seen(back, kind, y) if is_first else seen(x, kind, back)
                columns.append((change(kind, z, up) - change(kind, z, down)) / (2 * h))
            H = np.column_stack(columns)
            wanted = H @ twin.joint([i, j]) @ H.T
            np.testing.assert_allclose(covariance, wanted, rtol=0, atol=1e-6 * np.abs(wanted).max() + 1e-12)
            assert np.abs(change(kind, z, value)).max() < 1e-9


def test_relative_to_a_point_is_refused() -> None:
    solver = solved(2, "bayes-tree")
    blocks, point = CovarianceBlocks(solver.covariances.factored()), kinds_in(solver).index("point2")
    with pytest.raises(errors.KindMismatch):
        relative(blocks, np.array([point]), np.array([0]))
    with pytest.raises(errors.SelfLoop):
        relative(blocks, np.array([0]), np.array([0]))


@examples(8)
@given(seed=st.integers(0, 2**32 - 1))
@example(seed=111)  # a point so near that what little is left to solve would move linearization points off the estimate
def test_why_a_factor(seed: int) -> None:
    """χ² without a factor, and how much of it is known from it, by solving without it."""
    solver = solved(seed, "all-batch", steps=4)
    twin, blocks = dense(solver), CovarianceBlocks(solver.covariances.factored())
    leverage = 0.0
    for factor in range(solver.factor_count):
        explained = why_factor(blocks, factor)
        keys = list(explained.keys)
        kind, _, z, W = next(each for each in twin.graph.factors if each[0] == explained.kind and each[1] == keys)
        r, T, noise = twin.innovation(kind, keys, z, W[np.triu_indices(len(W))])
        np.testing.assert_allclose(explained.chi2, r @ W @ r, rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(explained.leverage, np.trace(W @ T), rtol=1e-6, atol=1e-8)
        leverage += explained.leverage
        if explained.without is not None:
            np.testing.assert_allclose(explained.without, r @ np.linalg.solve(noise - T, r), rtol=1e-4, atol=1e-9)
    # All factors together know as much as there is to know.
    assert leverage == pytest.approx(len(twin.sigma), rel=1e-8)
    with pytest.raises(UnknownFactor):
        why_factor(blocks, solver.factor_count)


@pytest.mark.parametrize("mode", MODES)
def test_why_a_variable(mode: str) -> None:
    solver = solved(7, mode, steps=8)
    twin, blocks = dense(solver), CovarianceBlocks(solver.covariances.factored())
    for v in range(solver.variable_count):
        explained = why_variable(blocks, v, keeps_steps=mode == "bayes-tree")
        assert explained.fixed == fixed_in(solver)[v]
        assert [each.factor for each in explained.factors] == sorted(each.factor for each in explained.factors)
        assert len(explained.factors) == len(graph_in(solver).factors_of(v))
        if explained.fixed:
            assert not explained.sigmas.any()
            continue
        close(explained.sigmas**2, np.diag(twin.joint([explained.key])), twin.tell)
        assert 0 < explained.conditioning <= 1 + 1e-3
        assert explained.pivot >= 1 / explained.sigmas.max() * (1 - 1e-9)
        assert (explained.linearized_step >= 1) == (mode == "bayes-tree")
        assert explained.as_dict()["factors"][0]["keys"]


def kept_up(solver: Solver, batches) -> float:
    """Follow a drive; the largest difference of a block to that from the whole recursion, after any step."""
    upkeep, worst = solver.covariances.try_upkeep(), 0.0
    assert upkeep is not None
    for batch in batches:
        solver.stage(batch)
        solver.step()
        upkeep.update()
        wanted = CovarianceBlocks(solver.covariances.factored()).diagonal()
        width = wanted.shape[1]
        scale = np.abs(wanted).max(axis=(1, 2), initial=1e-300)[:, None, None]
        worst = max(worst, float((np.abs(upkeep.diagonal()[:, :width, :width] - wanted) / scale).max()))
    assert 0 < upkeep.whole < upkeep.anew < solver.variable_count
    return worst


@pytest.mark.parametrize("seed", range(2))
def test_blocks_kept_up_are_those_computed_anew_after_every_step(seed: int) -> None:
    assert kept_up(Solver(Options(mode="bayes-tree")), [step.batch for step in manhattan(400, seed)]) < 1e-8
    assert kept_up(Solver(Options(mode="bayes-tree")), [step.batch for step in city_trees(150, seed)]) < 1e-8


def test_blocks_are_kept_up_over_steps_that_were_missed_or_refused() -> None:
    steps = [step.batch for step in manhattan(120, 8)]
    solver = Solver(Options(mode="bayes-tree"))
    upkeep = solver.covariances.try_upkeep()
    assert upkeep is not None
    for n, batch in enumerate(steps):
        solver.stage(batch)
        solver.step()
        if n % 7 == 3:
            solver.stage(_Whole((Group("point2", np.array([-5]), np.zeros((1, 2))),), ()))
            with pytest.raises(errors.Underconstrained):
                solver.step()
        if n % 3 == 0:
            upkeep.update()
            wanted = CovarianceBlocks(solver.covariances.factored()).diagonal()
            np.testing.assert_allclose(upkeep.diagonal()[:, :3, :3], wanted, rtol=1e-7, atol=1e-12)
