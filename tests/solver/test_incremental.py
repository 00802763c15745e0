"""R, d and δ after every step against Λ and η themselves, for every way of updating R.

Small random maps, densely; `test_every_step.py` has larger and real ones.
"""

import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.block_rows import dense_lambda, dense_r
from naive.cholmod import cholmod
from naive.dense_least_squares import DenseGraph
from naive.random_graphs import factor, random_steps
from naive.solver_parts import graph_in, system_in

from examples import examples
from factorbus.cli.process.options import MODES as CLI_MODES
from factorbus.formats import read
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver, errors
from factorbus.solver.inc_l.incremental import Where
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.modes import MODES
from factorbus.solver.report import StepReport
from factorbus.solver.sparse.elimination import constraint
from factorbus.solver.sparse.fill_in import fill_in

# What makes steps take one way of updating R as long as they can.
WAYS = {
    "omega": {"small_loop_threshold": 10**6, "big_loop_threshold": 10**6, "loop_threshold_share": 1e6},
    "lambda": {"small_loop_threshold": 0, "big_loop_threshold": 10**6, "loop_threshold_share": 1e6},
    "all": {"small_loop_threshold": 6, "big_loop_threshold": 14},
    "full": {"small_loop_threshold": 0, "big_loop_threshold": 0},
}


def assert_is_the_factor(solver: Solver, relative: float = 1e-9) -> bool:
    """RᵀR = PΛPᵀ, d = R⁻ᵀPη, and δ by blocks is the dense solution; False: there is no R in block rows."""
    factor = system_in(solver).factor
    if factor.where is not Where.ROWS:
        return False
    information, eta = dense_lambda(solver)
    R, order, d = dense_r(factor.rows)
    permuted = information[np.ix_(order, order)]
    scale = np.abs(permuted).max()
    np.testing.assert_allclose(R.T @ R, permuted, rtol=0, atol=relative * scale)
    if factor.rows_have_d:
        # η may vanish, but not the rounding errors of residuals of size one.
        np.testing.assert_allclose(R.T @ d, eta[order], rtol=0, atol=relative * max(np.abs(eta).max(), scale * 1e-6))
    delta = factor.rows.back(np.linalg.solve(R.T, eta[order]))
    assert_solves(information, delta, eta, relative)
    out = np.empty(len(eta))
    squared = factor.rows.forward(eta, out)
    assert squared == pytest.approx(float(out @ out), rel=1e-12)
    assert_solves(information, factor.rows.back(out), eta, relative)
    return True


def assert_solves(information: np.ndarray, delta: np.ndarray, eta: np.ndarray, relative: float) -> None:
    """Λδ = η, and δ is the dense solution as far as the condition of Λ lets anybody tell."""
    residual = np.abs(information @ delta - eta).max()
    assert residual <= relative * (np.abs(information).max() * np.abs(delta).max() + 1e-300)
    dense = np.linalg.solve(information, eta)
    tell = max(relative, 1e-14 * np.linalg.cond(information))
    np.testing.assert_allclose(delta, dense, rtol=0, atol=tell * max(np.abs(dense).max(), 1e-300))


def follow(steps: Iterable[Batch], **options) -> tuple[Solver, Counter]:
    """Replay; after every step R is checked.  Gives how often it was there after each strategy."""
    solver, checked, twin = Solver(Options.of(mode="inc-l", **options)), Counter(), DenseGraph()
    for batch in steps:
        solver.stage(batch)
        report = solver.step()
        assert_is_chi2(report, twin, batch, solver)
        assert report.because
        if assert_is_the_factor(solver):
            checked[report.strategy] += 1
    return solver, checked


def assert_is_chi2(report: StepReport, twin: DenseGraph, batch: Batch, solver: Solver) -> None:
    """χ² as a dense twin has it at the estimate, and no step raises it."""
    twin.add(batch)
    twin.put(solver.estimate())
    assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-9, abs=1e-12)
    assert report.chi2 <= report.chi2_before


@pytest.mark.parametrize("way", ["omega", "lambda", "all"])
@pytest.mark.parametrize("seed", range(3))
def test_r_follows_through_a_map_of_all_kinds(seed: int, way: str) -> None:
    _, checked = follow(random_steps(seed, steps=14), incremental_tolerance=1e6, **WAYS[way])
    if way == "all":
        assert checked["omega"] > 0
        assert checked["lambda"] > 0
    else:
        assert checked[way] >= 10


@st.composite
def drives(draw: st.DrawFn) -> list[Batch]:
    """A chain of poses with loops of drawn lengths, several in a step at times; in the plane or in space."""
    plane = draw(st.booleans())
    pose, between = ("se2", "between_se2") if plane else ("se3", "between_se3")
    point, observation = ("point2", "landmark_se2") if plane else ("point3", "landmark_se3")
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    truth: dict[int, np.ndarray] = {0: np.zeros(3) if plane else np.array([0, 0, 0, 0, 0, 0, 1.0])}
    steps = [Batch((Variables(pose, np.array([0]), truth[0][None], fixed=True),))]
    points: list[int] = []
    for n in range(1, draw(st.integers(4, 30))):
        turn = np.array([np.cos(0.5 * n), np.sin(0.5 * n)]) * n * 0.3
        if plane:
            truth[n] = np.array([*turn, 0.5 * n % 3])
        else:
            truth[n] = np.array([*turn, 0.1 * n, 0, 0, np.sin(0.25 * n), np.cos(0.25 * n)])
        factors = [factor(between, [n - 1, n], truth, 0.02, rng)]
        lengths = [length for length in draw(st.lists(st.integers(2, 30), max_size=3)) if length <= n]
        factors += [factor(between, [n, n - length], truth, 0.02, rng) for length in lengths]
        variables = [Variables(pose, np.array([n]))]
        what = draw(st.sampled_from(["nothing", "new point", "old point"]))
        if what == "new point":
            key = 1000 + n
            truth[key] = truth[n][: 2 if plane else 3] + rng.uniform(1, 2, 2 if plane else 3)
            variables.append(Variables(point, np.array([key])))
            points.append(key)
        if what != "nothing" and points:
            seen = points[-1] if what == "new point" else points[draw(st.integers(0, len(points) - 1))]
            factors.append(factor(observation, [n, seen], truth, 0.02, rng))
        steps.append(Batch(tuple(variables), tuple(factors)))
    return steps


@examples(60)
@given(steps=drives(), way=st.sampled_from(sorted(WAYS)), tol=st.sampled_from([0.0, 1e-3, 1e6]))
def test_r_follows_loops_of_any_length(steps: list[Batch], way: str, tol: float) -> None:
    solver, _ = follow(steps, incremental_tolerance=tol, **WAYS[way])
    whole = Solver(Options(mode="all-batch"))
    for batch in steps:
        whole.stage(batch)
    settled = solver.step(settle=True).chi2
    assert settled == pytest.approx(whole.step(settle=True).chi2, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("keep", [True, False])
def test_the_old_factor_is_given_up_at_a_new_point_where_the_paper_has_it_so(keep: bool) -> None:
    counts = Counter()
    solver = Solver(Options.of(mode="inc-l", incremental_tolerance=0.0, max_iterations=1, reuse_factor=keep))
    for batch in random_steps(5, steps=12, noise=0.02):
        solver.stage(batch)
        report = solver.step()
        counts[report.strategy] += 1
        if report.iterations and not keep:
            assert not system_in(solver).factor.have_r
    assert counts["full"] >= (1 if keep else 6)


@pytest.mark.parametrize(("mode", "every"), [("inc-l-b10", 10), ("inc-l-b100", 100)])
def test_forced_batches_come_when_due_and_the_linear_estimate_in_between(mode: str, every: int) -> None:
    solver, batches, twin = Solver(Options(mode=mode)), 0, DenseGraph()
    for batch in random_steps(4, steps=60):
        solver.stage(batch)
        report = solver.step()
        assert_is_chi2(report, twin, batch, solver)
        batches += "a batch is due" in report.because
        assert_is_the_factor(solver)
    assert abs(batches - solver.variable_count // every) <= 60 // every + 1
    settled = solver.step(settle=True)
    assert settled.converged
    whole = Solver(Options(mode="all-batch"))
    for batch in random_steps(4, steps=60):
        whole.stage(batch)
    assert settled.chi2 == pytest.approx(whole.step(settle=True).chi2, rel=1e-9)


def test_modes_by_the_papers_names() -> None:
    assert Solver(Options(mode="inc-l b10")).step().mode == "inc-l-b10"
    assert Solver(Options(mode="auto")).step().mode == "bayes-tree"
    with pytest.raises(errors.UnknownMode, match="inc-l b7"):
        Options(mode="inc-l b7")
    assert CLI_MODES == MODES


@pytest.mark.parametrize(
    "wrong", [{"small_loop_threshold": 9, "big_loop_threshold": 8}, {"constrain_recent_poses": 0}, {"backend": "petsc"}]
)
def test_settings_out_of_range_are_refused(wrong: dict) -> None:
    with pytest.raises(errors.BadOption) as caught:
        Options.of(**wrong)
    assert caught.value.code == "bad_option"


def test_a_refused_step_leaves_values_and_graph_and_the_map_goes_on() -> None:
    solver, spared = Solver(Options(mode="inc-l")), Solver(Options(mode="inc-l"))
    for n, batch in enumerate(random_steps(9, steps=12)):
        for one in (solver, spared):
            one.stage(batch)
            one.step()
        if n % 3 == 2:
            before = [group.values.tobytes() for group in solver.estimate()], solver.chi2(), solver.factor_count
            free = Variables("se2", np.array([-7]), np.zeros((1, 3)))
            observation = Factors("landmark_se2", np.array([[-7, -8]]), np.ones((1, 2)), np.array([[1.0, 0, 1]]))
            solver.stage(Batch((free, Variables("point2", np.array([-8]), np.ones((1, 2)))), (observation,)))
            with pytest.raises(errors.Underconstrained):
                solver.step()
            assert before == (
                [group.values.tobytes() for group in solver.estimate()], solver.chi2(), solver.factor_count,
            )  # fmt: skip
    assert solver.step(settle=True).chi2 == pytest.approx(spared.step(settle=True).chi2, rel=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_cholmod_gives_the_same_r(seed: int) -> None:
    cholmod()
    ours, theirs = Solver(Options.of(mode="inc-l", incremental_tolerance=0.0, reuse_factor=False)), Solver(
        Options.of(mode="inc-l", incremental_tolerance=0.0, reuse_factor=False, backend="cholmod")
    )  # fmt: skip
    for batch in random_steps(seed, steps=12):
        for one in (ours, theirs):
            one.stage(batch)
            one.step()
            assert_is_the_factor(one)
        assert theirs.chi2() == pytest.approx(ours.chi2(), rel=1e-9)
    settled = theirs.step(settle=True)
    assert settled.converged
    assert settled.chi2 == pytest.approx(ours.step(settle=True).chi2, rel=1e-10)


def test_a_backend_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sksparse.cholmod", None)
    with pytest.raises(errors.NoBackend, match=r"scikit-sparse.*pip install 'factorbus\[cholmod\]'") as caught:
        Solver(Options(backend="cholmod"))
    assert caught.value.code == "no_backend"


@pytest.mark.parametrize("name", ["intel"])
def test_orders_by_block_and_by_element_fill_alike(datasets: Path, name: str) -> None:
    solver = Solver(Options(mode="inc-l"))
    for batch in read(datasets / f"{name}.g2o").steps():
        solver.stage(batch)
    solver.step()
    graph, blocks = graph_in(solver), system_in(solver).blocks
    dims = graph.dims[: graph.counts[at.COLUMNS]]
    free, bound = (
        fill_in(dims, blocks.rows, blocks.cols, group)[0] for group in (None, constraint(graph, recent_poses=1))
    )
    by_element = fill_in(dims, blocks.rows, blocks.cols, by_element=True)[0]
    print(f"{name}: nonzeros of R {free}, constrained {bound}, by element {by_element}")
    assert bound < 1.15 * free
    assert abs(by_element - free) < 0.15 * free


def along(steps: list[Batch], mode: str) -> tuple[np.ndarray, np.ndarray]:
    """χ² of every step, and whether it said that it had converged."""
    solver, told = Solver(Options(mode=mode)), []
    for batch in steps:
        solver.stage(batch)
        report = solver.step()
        told.append((report.chi2, report.converged))
    chi2, converged = np.array(told).T
    return chi2, converged.astype(bool)


@pytest.mark.parametrize("name", ["intel"])
def test_chi2_has_spikes_between_forced_batches_and_none_without(datasets: Path, name: str) -> None:
    steps = list(read(datasets / f"{name}.g2o").steps())[:700]
    optimum, _ = along(steps, "all-batch")
    worst = {}
    for mode in ("inc-l", "inc-l-b10", "inc-l-b100"):
        chi2, converged = along(steps, mode)
        ratio = np.where(optimum > 1.0, chi2 / np.maximum(optimum, 1e-300), 1.0)
        worst[mode] = float(ratio.max())
        assert float(ratio[converged].max()) < 1.001, "it is said to have converged"
    print(worst)
    assert worst["inc-l"] < 1.001
    assert worst["inc-l-b100"] > 1.001
