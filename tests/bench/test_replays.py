"""The replay benchmark judges every solver alike: its evaluator, its samples, its contestants and its verdicts."""

import numpy as np
import pytest
from bench.replays import chi2, compose, contestants, fill, samples, summary, table, targets
from bench.replays.columns import Columns, columns_of
from bench.replays.contestants import Failed
from bench.replays.ours import values_of
from bench.replays.problems import Problem
from bench.replays.reference import optima
from hypothesis import given
from hypothesis import strategies as st
from naive.cholmod import cholmod

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import WORLDS, LoopClosures, TreeSensor
from factorbus.solver import Options, Solver

POSES = 70
REPLAYS = {
    "poses": [step.batch for step in WORLDS["manhattan"](POSES, 3, loops=LoopClosures(gap=8))],
    "landmarks": [step.batch for step in WORLDS["city_trees"](POSES, 2)],
    "bearings": [step.batch for step in WORLDS["city_trees"](POSES, 2, sensor=TreeSensor("bearing_range_se2"))],
    "space": [step.batch for step in WORLDS["sphere"](POSES, 2)],
}


def run(name: str, steps: list[Batch]) -> contestants.Contestant:
    contestant = contestants.make(name)
    if isinstance(contestant, contestants.Rehearsing):
        contestant.rehearse(steps, {len(steps) - 1})
    for batch in steps:
        contestant.prepare(batch)
        contestant.step()
        contestant.read()
    return contestant


@pytest.mark.parametrize("kind", REPLAYS)
def test_chi2_is_the_solvers_own_at_every_step(kind: str) -> None:
    steps, solver = REPLAYS[kind], Solver(Options(mode="all-batch"))
    columns = columns_of(steps)
    for k, batch in enumerate(steps):
        solver.stage(batch)
        solver.step()
        seen = chi2.chi2_at(columns, values_of(solver.estimate()), k)
        assert seen == pytest.approx(solver.chi2(), rel=1e-9, abs=1e-12)
    assert seen > 1


@pytest.mark.parametrize("kind", ["poses", "landmarks", "space"])
def test_chi2_is_that_of_g2o_also_far_from_the_optimum(kind: str) -> None:
    pytest.importorskip("g2opy")
    steps = REPLAYS[kind]
    contestant = run("g2o-b10", steps[:-3])
    for batch in steps[-3:]:  # not solved for: composed poses that loops pull at
        contestant.prepare(batch)
    seen = chi2.chi2_at(columns_of(steps), contestant.values(), len(steps) - 1)
    assert seen == pytest.approx(contestant.chi2(), rel=1e-12)  # type: ignore[attr-defined]


@pytest.mark.parametrize("kind", ["poses", "landmarks", "space"])
def test_chi2_is_nearly_that_of_gtsam(kind: str) -> None:
    """GTSAM takes the logarithm of the error, and observations as bearing and range: equal to first order only."""
    pytest.importorskip("gtsam")
    steps = REPLAYS[kind]
    contestant = run("isam2-0.01", steps)
    own = contestant.own_chi2()  # type: ignore[attr-defined]
    assert chi2.chi2_at(columns_of(steps), contestant.values(), len(steps) - 1) == pytest.approx(own, rel=5e-3)


@pytest.mark.parametrize("name", [entry.name for entry in contestants.ENTRIES.values() if not entry.missing()])
@pytest.mark.parametrize("kind", ["poses", "landmarks", "space"])
def test_every_contestant_comes_near_the_optimum(name: str, kind: str) -> None:
    steps = REPLAYS[kind]
    columns, last = columns_of(steps), len(steps) - 1
    best = optima(steps, columns, [last])[0][0][1]
    contestant = run(name, steps)
    found = chi2.chi2_at(columns, contestant.values(), last)
    # Those that wait for a tenth or hundredth pose have not taken in what came since.
    worst = np.inf if name.endswith(("b10", "b100")) else 1.02
    assert best * (1 - 1e-9) <= found <= best * worst
    facts = contestant.facts()
    assert sum(facts["strategies"].values()) == len(steps)
    assert facts["nnz_r"] > 3 * POSES


def test_isam2_says_that_a_system_is_indeterminate() -> None:
    pytest.importorskip("gtsam")
    contestant = contestants.make("isam2-0.1")
    key = np.array([5])
    lonely = Variables("point2", np.array([7]), np.array([[1.0, 0.0]]))
    observation = Factors("bearing_range_se2", np.array([[5, 7]]), np.array([[0.0, 1.0]]), np.array([[1.0, 0.0, 1.0]]))
    contestant.prepare(Batch((Variables("se2", key, np.zeros((1, 3))), lonely), (observation,)))
    with pytest.raises(Failed, match="Indeterminate"):
        contestant.step()


def test_update_alone_comes_to_what_was_rehearsed_and_fails_where_that_failed() -> None:
    pytest.importorskip("gtsam")
    steps = REPLAYS["landmarks"]
    with_estimates, alone = run("isam2-0.1", steps).values(), run("isam2-0.1-update", steps)
    assert alone.facts()["read_s"] > 0
    for kind, (keys, numbers) in alone.values().items():
        np.testing.assert_array_equal(keys, with_estimates[kind][0])
        np.testing.assert_array_equal(numbers, with_estimates[kind][1])
    lonely = Variables("point2", np.array([7]), np.array([[1.0, 0.0]]))
    observation = Factors("bearing_range_se2", np.array([[5, 7]]), np.array([[0.0, 1.0]]), np.array([[1.0, 0.0, 1.0]]))
    broken = [Batch((Variables("se2", np.array([5]), np.zeros((1, 3))), lonely), (observation,))]
    contestant = contestants.make("isam2-0.1-update")
    assert isinstance(contestant, contestants.Rehearsing)
    contestant.rehearse(broken, {0})
    contestant.prepare(broken[0])
    with pytest.raises(Failed, match="Indeterminate"):
        contestant.step()
    with pytest.raises(Failed, match="Indeterminate"):
        contestant.prepare(broken[0])


def test_one_step_at_loops_is_a_gauss_newton_step_of_the_whole_graph() -> None:
    """Sharp loops that one step does not settle: what is left is what a fresh solver leaves after one step."""
    steps = REPLAYS["space"]
    contestant = run("gn-loop", steps[:-1])
    start = contestant.values()["se3"]
    once = run("gn-loop", steps)
    known = {int(k): v for k, v in zip(*start, strict=True)}
    first = compose.first_values(steps[-1], lambda _, key: known[key])
    variables, factors = [], []
    for batch in steps:
        for group in batch.variables:
            values = np.array([known.get(int(k), first.get(int(k), (0, 0))[1]) for k in group.keys])
            variables.append(Variables(group.kind, group.keys, values, group.fixed))
        factors += batch.factors
    solver = Solver(Options(mode="all-batch", max_iterations=1))
    solver.stage(Batch(tuple(variables), tuple(factors)))
    assert solver.step().iterations == 1
    np.testing.assert_allclose(once.values()["se3"][1], values_of(solver.estimate())["se3"][1], atol=1e-9)
    assert once.facts()["strategies"]["batch"] > 10


def test_a_value_that_is_missing_is_not_passed_over() -> None:
    steps = REPLAYS["poses"]
    values = run("all-batch", steps).values()
    keys, numbers = values["se2"]
    with pytest.raises(ValueError, match="no value"):
        chi2.chi2_at(columns_of(steps), {"se2": (keys[:-1], numbers[:-1])}, len(steps) - 1)
    with pytest.raises(ValueError, match="not in the graph"):
        chi2.chi2_at(columns_of(steps), {"se2": (keys + 1, numbers)}, len(steps) - 1)


@pytest.mark.parametrize("kind", REPLAYS)
def test_new_variables_start_where_our_solver_starts_them(kind: str) -> None:
    steps, solver = REPLAYS[kind], Solver(Options(mode="all-batch"))
    known: dict[int, np.ndarray] = {}
    for batch in steps[:25]:
        found = compose.first_values(batch, lambda _, key: known[key])  # noqa: B023  (called at once)
        solver.stage(batch)
        staged = {int(k): x for g in solver.estimate() for k, x in zip(g.keys, g.values, strict=True)}
        for key, (group, value) in found.items():
            difference = value - staged[key]
            difference[2:3] = chi2.wrap(difference[2:3]) if group == "se2" else difference[2:3]
            np.testing.assert_allclose(difference, 0, atol=1e-9)
        solver.step()
        known = {int(k): x for g in solver.estimate() for k, x in zip(g.keys, g.values, strict=True)}


@pytest.mark.parametrize("kind", ["poses", "space"])
def test_an_edge_from_the_new_pose_to_the_old_one_composes_backwards(kind: str) -> None:
    (factors,) = REPLAYS[kind][1].factors
    inverse = compose.inverse_se2 if kind == "poses" else compose.inverse_se3
    (i, j), z = factors.keys[0].tolist(), factors.measured[0]
    old = REPLAYS[kind][0].variables[0].values[0]
    variables = (Variables(REPLAYS[kind][1].variables[0].kind, np.array([j])),)
    turned = Factors(factors.kind, np.array([[j, i]]), inverse(z)[None], factors.information[:1])
    forward = compose.first_values(Batch(variables, (factors,)), lambda *_: old)
    backward = compose.first_values(Batch(variables, (turned,)), lambda *_: old)
    np.testing.assert_allclose(backward[j][1], forward[j][1], atol=1e-12)


@given(st.integers(1, 30000), st.integers(1, 300))
def test_samples_are_spread_and_end_with_the_last_step(steps: int, most: int) -> None:
    picked = samples.sample_steps(steps, most)
    assert picked[-1] == steps - 1
    assert len(picked) <= most
    assert list(picked) == sorted(set(picked))
    assert picked[0] >= 0
    assert max(np.diff(picked), default=0) <= 2 * steps / max(most - 1, 1) + 1


@given(st.integers(1, 5000), st.integers(1, 300))
def test_regular_samples_are_each_nth_step_and_the_last(steps: int, every: int) -> None:
    picked = samples.Sampling(every=every).steps(steps)
    assert set(picked) == {k for k in range(steps) if (k + 1) % every == 0} | {steps - 1}
    assert list(picked) == sorted(set(picked))


def test_samples_see_a_batch_at_every_hundredth_step_at_all_its_moments() -> None:
    phases = np.bincount(np.array(samples.sample_steps(10000, 100)) % 100 // 10, minlength=10)
    assert phases.min() >= 5


@pytest.mark.parametrize("kind", ["poses", "landmarks", "space"])
def test_fill_counts_what_a_dense_factorization_fills(kind: str) -> None:
    columns = columns_of(REPLAYS[kind])
    cholmod()
    numbers, pictures = fill.orderings(columns, pixels=40)
    dims, rows, cols, _ = fill.block_pattern(columns)
    scalar_rows, scalar_cols, _ = fill.scalar_pattern(dims, rows, cols)
    dense = np.zeros((int(dims.sum()),) * 2)
    dense[scalar_rows, scalar_cols] = dense[scalar_cols, scalar_rows] = -1e-3
    np.fill_diagonal(dense, 1)
    in_order = np.count_nonzero(np.linalg.cholesky(dense))
    assert np.count_nonzero(np.triu(dense)) == numbers["nnz_lambda"] <= numbers["nnz"]["blocks"] < in_order
    assert numbers["nnz"]["blocks"] <= numbers["nnz"]["blocks_constrained"] * 1.1
    assert all(0 < picture.max() <= 1 and picture.shape == (40, 40) for picture in pictures.values())


def a_row(dataset: str, name: str, **more: object) -> dict[str, object]:
    quality = {"median": 1.0, "p95": 1.0, "max": 1.0, "mean": 1.0, "samples": 100, "spikes": 0}
    row = {"dataset": dataset, "name": name, "status": "done", "cpu_s": 1.0, "chi2_final": 100.0, "note": ""}
    return {**row, "chi2_ratio": quality, **more}


def verdicts(*rows: dict[str, object], dataset: str = "w10000") -> dict[str, str]:
    judged = targets.judge(rows, {dataset: 100.0}, {})
    words = ("within", "takes", "less time", "never", "no further", "b10 and b100 rise")
    return {word: v.verdict for v in judged for word in words if word in v.what}


def test_targets_are_met_missed_or_not_measured() -> None:
    ours, slow = a_row("w10000", "inc-l"), a_row("w10000", "all-batch", cpu_s=1.81)
    spikes = {**a_row("w10000", "x")["chi2_ratio"], "spikes": 2, "max": 1.3}  # type: ignore[dict-item]
    ten, hundred = (a_row("w10000", name, chi2_ratio=spikes) for name in ("inc-l-b10", "inc-l-b100"))
    assert set(verdicts(ours, slow, ten, hundred).values()) == {targets.MET}
    assert verdicts(ours, ten)["no further"] == verdicts(ours, ten)["b10 and b100 rise"] == targets.NOT_MEASURED
    calm = a_row("w10000", "inc-l-b100")
    assert verdicts(ours, ten, calm)["b10 and b100 rise"] == targets.MISSED
    further = {**ours["chi2_ratio"], "max": 1.001}  # type: ignore[dict-item]
    assert verdicts(a_row("w10000", "inc-l", chi2_ratio=further), ten, calm)["no further"] == targets.MISSED
    assert verdicts(ours, a_row("w10000", "all-batch", cpu_s=1.79))["takes"] == targets.MISSED
    assert verdicts(slow)["within"] == verdicts(ours)["takes"] == targets.NOT_MEASURED
    assert verdicts(a_row("w10000", "inc-l", chi2_final=100.02))["within"] == targets.MISSED
    assert verdicts(a_row("w10000", "inc-l", chi2_final=None, status="limit"), slow)["takes"] == targets.MISSED
    spiky = {**a_row("w10000", "x")["chi2_ratio"], "spikes": 2}  # type: ignore[dict-item]
    assert verdicts(a_row("w10000", "inc-l", chi2_ratio=spiky))["never"] == targets.MISSED
    peer = a_row("intel", "isam2-0.1", cpu_s=0.9)
    assert verdicts(a_row("intel", "inc-l"), peer, dataset="intel")["less time"] == targets.MISSED
    assert verdicts(a_row("intel", "inc-l", cpu_s=0.8), peer, dataset="intel")["less time"] == targets.MET
    assert verdicts(a_row("intel", "inc-l", chi2_final=1e-6), dataset="intel")["within"] == targets.MISSED


def test_a_lower_value_of_a_contestant_replaces_a_reference_in_a_local_minimum() -> None:
    problem = Problem("w", "W", optimum=10.0)
    reference = {"chi2": [[3, 5.0], [9, 20.0]]}
    batch, notes = summary.best_known(problem, reference, [{"contestant": "inc-l", "chi2": [[3, 5.1], [9, 10.0]]}])
    assert batch == {3: 5.0, 9: 10.0}
    assert len(notes) == 1
    assert "local minimum" in notes[0]
    batch, notes = summary.best_known(problem, reference, [])
    assert "published optimum" in notes[0]


def test_ratios_of_rounding_errors_are_one() -> None:
    assert summary.ratio_statistics([[0, 1e-27], [1, 5e-4]], {0: 3e-29, 1: 5.8e-8})["max"] == pytest.approx(1.0005)


def test_columns_refuse_what_the_evaluator_does_not_know() -> None:
    prior = Factors("prior_se2", np.array([[1]]), np.zeros((1, 3)), np.ones((1, 6)))
    with pytest.raises(ValueError, match="prior_se2"):
        columns_of([Batch((Variables("se2", np.array([1])),), (prior,))])
    assert isinstance(columns_of(REPLAYS["poses"]), Columns)


def a_run(**more: object) -> dict[str, object]:
    step = {"p50": 1.0, "p95": 2.0, "p99": 3.0, "max": 4.0}
    run = dict.fromkeys(("cpu_s", "solve_s", "read_s", "wall_s", "peak_mb", "base_mb", "load_average"), 1.0)
    run |= {"step_ms": step, "solve_ms": step, "step_wall_ms": step, "chi2": [[0, 0.0], [9, 12.0]]}
    return {**run, "facts": {"nnz_r": 7}, "status": "done", "reason": "", "steps": 10, "done": 10, **more}


def test_a_row_has_medians_of_times_and_says_what_went_wrong() -> None:
    problem, entry, batch = Problem("w", "W"), contestants.ENTRIES["isam2-0.1"], {0: 0.0, 9: 10.0}
    row = summary.row_of(problem, entry, [a_run(cpu_s=s) for s in (5.0, 1.0, 2.0)], batch)
    assert (row["cpu_s"], row["nnz_r"], row["chi2_final"]) == (2.0, 7, 12.0)
    assert row["chi2_ratio"]["max"] == pytest.approx(1.2)
    assert row["chi2_ratio"]["spikes"] == 1
    gave_up = a_run(status="failed", reason="step 5: Indeterminate", done=5, chi2=[[0, 0.0]], facts={})
    row = summary.row_of(problem, entry, [gave_up], batch)
    assert row["chi2_final"] is None
    assert row["note"].startswith("FAILED: step 5: Indeterminate")
    crashed = {"status": "crashed", "reason": "exit code -11", "chi2": [], "facts": {}}
    row = summary.row_of(problem, entry, [crashed], batch)
    assert row["cpu_s"] is None
    assert row["note"].startswith("CRASHED: exit code -11")
    assert "CRASHED" in table.report([row], {}, [], [], {"cpu": "", "python": ""})
