"""Steps against the dense twin: the estimate, Λ and η, what is reported as changed, copies, order."""

import numpy as np
import pytest
from counting import count_calls
from naive.dense_factors import boxplus
from naive.dense_least_squares import DenseGraph, distance
from naive.random_graphs import measured, random_information, random_steps, random_value
from naive.solver_parts import graph_in, system_in

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Group, Options, Solver, errors, solve_batch
from factorbus.solver.graph.factors import LENS_AT
from factorbus.solver.kernels.jit.compile import DISABLED
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.lenses.layout import LIMIT
from factorbus.solver.report import PhaseShares

TIGHT = {"batch_tolerance": 0.0, "incremental_tolerance": 0.0, "chi2_epsilon": 1e-20, "max_iterations": 100}


def by_key(groups: list[Group]) -> dict[int, tuple[str, np.ndarray]]:
    return {
        key: (group.kind, value)
        for group in groups
        for key, value in zip(group.keys.tolist(), group.values, strict=True)
    }


@pytest.mark.parametrize("mode", ["all-batch", "inc-l"])
@pytest.mark.parametrize("seed", range(4))
def test_every_step_is_the_dense_gauss_newton_solution(seed: int, mode: str) -> None:
    solver, twin = Solver(Options.of(mode=mode, **TIGHT)), DenseGraph()
    for batch in random_steps(seed):
        solver.stage(batch)
        report = solver.step()
        twin.add(batch)
        twin.put(solver.estimate())
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-10)
        assert report.chi2 <= report.chi2_before
        # From a point that is as good as χ² can tell (below) the second step still goes a fraction of that.
        assert twin.gauss_newton(iterations=2) < 5e-9
        for key, (kind, value) in by_key(solver.estimate()).items():
            assert distance(kind, value, twin.values[key]) < 5e-8  # what χ², good to 1e-16 of it, can tell
        assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_normal_equations_are_the_twins_and_have_the_bits_of_a_fresh_sum(seed: int) -> None:
    solver, twin = Solver(Options(mode="all-batch")), DenseGraph()
    for n, batch in enumerate(random_steps(seed, noise=0.0 if seed % 2 else 0.02)):
        solver.stage(batch)
        if n % 3 == 2:
            solver.step()
        twin.add(batch)
    solver.step()
    twin.put(solver.estimate())
    graph, blocks = graph_in(solver), system_in(solver).blocks
    starts = np.concatenate([[0], np.cumsum(graph.dims[: graph.counts[at.COLUMNS]])])
    dense = np.zeros((starts[-1], starts[-1]))
    for row, col, offset in zip(blocks.rows, blocks.cols, blocks.offsets, strict=True):
        assert row <= col
        r, c = slice(starts[row], starts[row + 1]), slice(starts[col], starts[col + 1])
        block = blocks.data[offset : offset + (r.stop - r.start) * (c.stop - c.start)].reshape(r.stop - r.start, -1)
        dense[r, c], dense[c, r] = block, block.T
    expected, eta = twin.system()
    np.testing.assert_allclose(dense, expected, atol=1e-6, rtol=1e-6)
    np.testing.assert_allclose(blocks.eta[: starts[-1]], eta, atol=1e-6)
    kept = blocks.data[: blocks.fill[1]].tobytes(), blocks.eta[: starts[-1]].tobytes()
    blocks.relinearize(graph, graph.values)
    blocks.swap_lambda()
    blocks.swap_eta()
    assert (blocks.data[: blocks.fill[1]].tobytes(), blocks.eta[: starts[-1]].tobytes()) == kept


@pytest.mark.parametrize(("mode", "solved"), [("all-batch", "all-batch"), ("inc-l", "full")])
def test_composed_odometry_needs_no_solving(mode: str, solved: str) -> None:
    solver = Solver(Options(mode=mode))
    info = np.array([[100.0, 0, 0, 100, 0, 1000]])
    solver.stage(Batch((Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True),)))
    assert solver.step().strategy == "extend"
    z = np.array([[1.0, 0.5, 3.0]])
    for n in range(1, 50):
        edge = Factors("between_se2", np.array([[n - 1, n] if n % 2 else [n, n - 1]]), z, info)
        solver.stage(Batch((Variables("se2", np.array([n])),), (edge,)))
        report = solver.step()
        assert (report.strategy, report.iterations, report.changed) == ("extend", 0, 1)
        assert by_key(solver.changed()).keys() == {n}
    assert solver.chi2() < 1e-18
    loop = Factors("between_se2", np.array([[0, 49]]), 1.1 * z, info)
    solver.stage(Batch((), (loop,)))
    report = solver.step()
    assert report.strategy == solved
    assert report.iterations >= 1
    assert report.eliminated >= 49


def test_values_come_from_the_first_factor_that_reaches_whatever_the_order() -> None:
    rng = np.random.default_rng(4)
    values = [random_value("se3", rng)]
    z = [random_value("se3", rng) for _ in range(40)]
    for step in z:
        tangent = np.concatenate([step[:3], rng.normal(0, 0.5, 3)])
        values.append(boxplus("se3", values[-1], tangent))
    truth = np.array(values)
    ends = np.array([[n, n + 1] if n % 3 else [n + 1, n] for n in range(40)])
    zs = np.array([measured("between_se3", [truth[i], truth[j]], 0.0, rng) for i, j in ends])
    info = np.repeat(random_information(6, rng)[None], 40, 0)
    for order in (np.arange(40), np.arange(40)[::-1], rng.permutation(40)):
        solver = Solver(Options(mode="inc-l"))
        edges = Factors("between_se3", ends[order], zs[order], info)
        first = Variables("se3", np.array([0]), truth[:1], fixed=True)
        solver.stage(Batch((first, Variables("se3", np.arange(1, 41))), (edges,)))
        assert solver.step().strategy == "extend"
        for key, (kind, value) in by_key(solver.estimate()).items():
            assert distance(kind, value, truth[key]) < 1e-9


@pytest.mark.parametrize("mode", ["inc-l", "bayes-tree"])
def test_changed_are_exactly_the_variables_with_other_bits(mode: str) -> None:
    solver = Solver(Options(mode=mode))
    before: dict[int, tuple[str, np.ndarray]] = {}
    for batch in random_steps(3):
        solver.stage(batch)
        report = solver.step()
        now = by_key(solver.estimate())
        expected = {key for key, (_, v) in now.items() if key not in before or before[key][1].tobytes() != v.tobytes()}
        changed = by_key(solver.changed())
        assert changed.keys() == expected
        assert report.changed == len(expected)
        assert all(changed[key][1].tobytes() == now[key][1].tobytes() for key in changed)
        before = now
    solver.step(settle=True)
    solver.step(settle=True)
    assert solver.changed() == []


def test_the_graph_comes_back_as_it_went_in() -> None:
    batches = list(random_steps(8))
    solver = Solver()
    ids = [solver.stage(batch) for batch in batches]
    assert ids == np.cumsum([0] + [batch.factor_count for batch in batches[:-1]]).tolist()
    report = solver.step(settle=True)
    variables, factors = solver.graph()
    assert (solver.variable_count, solver.factor_count) == (report.new_variables, report.new_factors)
    assert sum(len(group.keys) for group in variables) == sum(batch.variable_count for batch in batches)
    for group in factors:
        sent = [f for batch in batches for f in batch.factors if f.kind == group.kind]
        np.testing.assert_array_equal(group.keys, np.concatenate([f.keys for f in sent]))
        np.testing.assert_array_equal(group.information, np.concatenate([f.information for f in sent]))
        given = np.concatenate([f.measured for f in sent])
        if group.kind in LENS_AT:  # a limit of 0 comes back as what the lens has
            given[:, LENS_AT[group.kind] + 1 + LIMIT] = group.measured[:, LENS_AT[group.kind] + 1 + LIMIT]
        np.testing.assert_allclose(group.measured, given, atol=1e-15)
    fixed = [group for group in variables if group.fixed]
    assert [group.keys.size for group in fixed] == [1]
    again = solve_batch(variables, factors)
    assert again.chi2 == pytest.approx(report.chi2, rel=1e-12)


def test_estimates_are_copies() -> None:
    solver = Solver()
    for batch in random_steps(2, steps=2):
        solver.stage(batch)
    solver.step()
    kept = by_key(solver.estimate())
    for group in solver.estimate():
        if not group.fixed:
            group.values[:] = 0.0
    assert all(kept[key][1].tobytes() == value.tobytes() for key, (_, value) in by_key(solver.estimate()).items())


def test_folding_batches_into_one_step_gives_the_same_optimum() -> None:
    one, many = Solver(), Solver()
    for batch in random_steps(5):
        one.stage(batch)
        many.stage(batch)
        many.step()
    assert one.step(settle=True).chi2 == pytest.approx(many.step(settle=True).chi2, rel=1e-12)


@pytest.mark.parametrize(
    ("mode", "phases"),
    [
        ("inc-l", {"linearize", "order", "symbolic", "numeric", "solve"}),
        ("bayes-tree", {"linearize", "mark", "order", "symbolic", "eliminate", "commit", "substitute"}),
    ],
)
def test_the_clock_is_passed_in(mode: str, phases: set[str]) -> None:
    ticks = iter(range(10**6))
    solver = Solver(Options(mode=mode, clock=lambda: float(next(ticks))))
    batches = list(random_steps(1, steps=4))
    for batch in batches:
        solver.stage(batch)
    report = solver.step()
    assert phases <= report.phases_ms.keys()
    assert report.step_ms > 0
    if "numeric" in phases or not DISABLED:  # the tree's phases are shares of counted cycles: plain Python counts none
        assert report.step_ms >= sum(report.phases_ms.values()) > 0
    assert report.as_dict()["phases_ms"] == report.phases_ms
    quiet = Solver()
    quiet.stage(batches[0])
    assert quiet.step().step_ms == 0.0


def test_unknown_modes_are_refused() -> None:
    with pytest.raises(errors.UnknownMode, match="fluid") as caught:
        Options(mode="fluid")
    assert caught.value.code == "unknown_mode"


def chain(n: int) -> Batch:
    """Poses that have no start, and the way from the fixed one to the last, told from its end."""
    keys = np.arange(n + 1)
    z, info = np.tile([1.0, 0.0, 0.001], (n, 1)), np.tile([100.0, 0, 0, 100, 0, 1000], (n, 1))
    edges = Factors("between_se2", np.stack([keys[:-1], keys[1:]], axis=1)[::-1].copy(), z, info)
    return Batch((Variables("se2", keys[:1], np.zeros((1, 3)), fixed=True), Variables("se2", keys[1:])), (edges,))


def test_many_factors_are_staged_in_compiled_loops() -> None:
    """Not with one call for each in Python, and whatever the order they come in."""
    n = 64_000
    solver, batch = Solver(Options(mode="inc-l")), chain(n)
    assert count_calls(lambda: solver.stage(batch)) < n / 10
    assert solver.step().strategy == "extend"


def test_shares_of_a_total() -> None:
    shares = PhaseShares(("order", "eliminate"), [1, 3], 8.0)
    assert shares == {"order": 2.0, "eliminate": 6.0}
    assert PhaseShares(("order",), [0], 0.0) == {"order": 0.0}
    shares = PhaseShares(("order", "mark", "eliminate"), [1, 0, 2], 0.7)
    assert shares.as_dict() == dict(shares)
    with pytest.raises(KeyError):
        shares["commit"]
