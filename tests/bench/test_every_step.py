"""`bench every-step`: what it says of an estimate is so, and a solver that is sloppy, or untrue, fails its targets."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from bench import every_step
from bench.every import tables
from bench.every.drives import WORLDS
from bench.every.follow import follow
from bench.every.judge import FINE, Judge, Look
from bench.every.motion import PLANE, SPACE, Motion, factor
from bench.every.oracle import Oracle
from bench.every.peer import Isam2Judge, Watched, follow_isam2
from bench.every.rows import far_steps, row_of, together
from bench.every.verdicts import judge
from bench.replays.chi2 import RESIDUALS, into_frame_2d, into_frame_3d
from bench.replays.contestants import Failed
from bench.replays.gtsam_factors import gtsam_factors, pose3
from bench.replays.isam2 import Isam2Settings
from bench.replays.targets import MET, MISSED, NOT_MEASURED

from factorbus.cli.commands import bench
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Group, Options, Solver, StepReport

DRAWN = [name for name, world in WORLDS.items() if world.is_drawn]
SMALL = 60
LOOPING = {"manhattan": 150, "outliers": 250, "ranges_2d": 150}  # poses until loops have closed, or a map has turned
SLOPPY = (
    "relinearize_threshold",
    "relinearize_next_step_share",
    "relinearize_same_step_share",
    "relinearize_max_error",
    "converged_share",
)  # at 1e9: nothing is relinearized


def steps_of(name: str, poses: int = SMALL, seed: int = 3) -> list[Batch]:
    return list(WORLDS[name].make(poses, seed))


def row(name: str, poses: int, options: Options, seed: int = 3) -> dict[str, Any]:
    steps = steps_of(name, poses, seed)
    return row_of(name, seed, len(steps), follow(steps, options), None)


def verdicts_of(rows: Sequence[dict[str, Any]]) -> dict[str, str]:
    """By the first words of each target."""
    return {each.what.split(",")[0].split(":")[-1].strip().split(" is ")[0]: each.verdict for each in judge(rows)}


@pytest.mark.parametrize("name", DRAWN)
def test_the_oracle_finds_the_judge_s_optimum_from_an_estimate_that_is_off(name: str) -> None:
    """Every kind of factor that a world has, and its loss; the estimate is pushed away from the optimum."""
    rng, solver, judged, oracle = np.random.default_rng(4), Solver(), Judge(), Oracle()
    steps = steps_of(name, LOOPING.get(name, SMALL))
    assert any(group.loss for batch in steps for group in batch.factors) == (name == "outliers")
    for batch in steps:
        solver.stage(batch)
        solver.step()
        judged.take_in(batch)
        oracle.take_in(batch)
    off = [_pushed(group, rng) for group in solver.estimate()]
    look, (chi2, optimum) = judged.look(off, coarse=FINE), oracle.optimum(off)
    assert chi2 > 1.01 * optimum + 1e-3, "nothing to find"
    assert look.chi2 == pytest.approx(chi2, rel=1e-9)
    assert look.optimum == pytest.approx(optimum, rel=1e-7, abs=1e-9)


def _pushed(group: Group, rng: np.random.Generator) -> Group:
    if group.fixed:
        return group
    values = group.values + 0.02 * rng.normal(size=group.values.shape)
    if group.kind == "se3":
        values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    return group._replace(values=values)


def test_a_ratio_is_a_share_of_the_optimum_or_below_one_the_excess() -> None:
    assert Look(202.0, 200.0, 0.0, 1).ratio == pytest.approx(1.01)
    assert Look(0.001, 0.0, 0.0, 1).ratio == pytest.approx(1.001)
    assert Look(1e-25, 3e-26, 0.0, 1).ratio == pytest.approx(1.0)
    assert Look(199.0, 200.0, 0.0, 1).ratio == 1.0


def test_odometry_off_its_fit_is_reported_in_standard_deviations() -> None:
    steps = steps_of("manhattan", 3)
    solver, judged = Solver(), Judge()
    for batch in steps:
        solver.stage(batch)
        solver.step()
        judged.take_in(batch)
    sigma = 0.0225
    shifted = [_shifted(group, 2 * sigma) for group in solver.estimate()]
    look = judged.look(shifted)
    assert look.odometry == pytest.approx(2.0, rel=1e-6)
    assert look.chi2 == pytest.approx(4.0, rel=1e-6)
    assert look.optimum == pytest.approx(0.0, abs=1e-9)
    little = judged.look([_shifted(group, 2e-3 * sigma) for group in solver.estimate()])
    assert (little.chi2, little.passes) == (pytest.approx(4e-6, rel=1e-6), 1)
    assert little.optimum == pytest.approx(0.0, abs=1e-9), "also where one pass is enough"


def _shifted(group: Group, by: float) -> Group:
    """The last pose further in x."""
    values = group.values.copy()
    if not group.fixed:
        values[-1, 0] += by
    return group._replace(values=values)


def test_an_estimate_that_lacks_a_variable_or_has_one_too_many_is_refused() -> None:
    judged = Judge()
    for batch in steps_of("manhattan", 3):
        judged.take_in(batch)
    with pytest.raises(ValueError, match="lacks a variable"):
        judged.look([])
    with pytest.raises(ValueError, match="that no step brought"):
        judged.look([Group("se2", np.array([5]), np.zeros((1, 3)))])


def test_the_optimum_of_a_full_settle_is_met_and_all_targets_with_it() -> None:
    found = row("manhattan", 150, Options(mode="all-batch", batch_tolerance=1e-12))
    assert found["steps"] == found["judged"] == 150
    assert (found["unconverged"], found["above_1_001"]) == (0, 0)
    assert verdicts_of([found]) == dict.fromkeys(verdicts_of([found]), MET)


def test_a_sloppy_solver_misses_the_targets() -> None:
    """Nothing is relinearized while it drives, and it says `converged`; left alone it finishes all the same."""
    found = row("manhattan", 300, Options.of(**dict.fromkeys(SLOPPY, 1e9)), seed=2)
    assert found["max"] > 1.01
    assert found["worst_converged"] > 1.001
    assert found["idle_ratio"] <= 1 + 1e-6
    told = [each.verdict for each in judge([found])]
    assert told.count(MISSED) >= 3


def test_a_step_that_says_it_has_not_converged_counts_as_such_and_not_as_untrue() -> None:
    """A batch that is cut off after one iteration says so."""
    found = row("drift", 60, Options(mode="all-batch", max_iterations=1))
    assert found["unconverged"] == 1
    assert found["max"] > 1.001
    assert found["worst_converged"] <= 1.001
    assert found["chi2_untrue"] < 1e-6
    assert found["idle_done"]
    assert found["idle_steps"] >= 2
    assert found["idle_ratio"] == pytest.approx(1.0, abs=1e-6)


def test_after_a_step_that_could_not_finish_the_next_ones_go_on_until_it_is_true_that_they_have() -> None:
    """Along this valley each Gauss-Newton step gains an eighth less than the one before."""
    solver, judged, said = Solver(), Judge(), list[bool]()
    for batch in steps_of("late_3d", 300, 223424827)[:50]:
        solver.stage(batch)
        judged.take_in(batch)
        said.append(solver.step().converged)
        assert not said[-1] or judged.look(solver.estimate()).ratio <= 1.001
    assert not all(said)
    assert said[-1]


@pytest.mark.parametrize("field", ["chi2", "chi2_before"])
def test_untrue_reports_are_seen(monkeypatch: pytest.MonkeyPatch, field: str) -> None:
    true_step = Solver.step

    def step(self: Solver, settle: bool = False) -> StepReport:
        report = true_step(self, settle)
        return report._replace(**{field: 0.5 * getattr(report, field)})

    monkeypatch.setattr(Solver, "step", step)
    found = row("drift", 60, Options(mode="all-batch"))
    assert found["chi2_untrue"] == pytest.approx(0.5, rel=1e-6)
    assert any(each.verdict == MISSED and "report's χ²" in each.what for each in judge([found]))


def test_a_map_that_never_says_it_is_done_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.every.follow.MOST_IDLE_S", 0.01)
    true_step = Solver.step
    monkeypatch.setattr(Solver, "step", lambda self, settle=False: true_step(self, settle)._replace(converged=False))
    found = row("manhattan", 30, Options())
    assert not found["idle_done"]
    assert found["unconverged"] == 30
    missed = [each.what for each in judge([found]) if each.verdict == MISSED]
    assert any("left alone" in what for what in missed)
    assert any("have not converged" in what for what in missed)


def test_isam2_s_problem_is_ours_to_first_order() -> None:
    """Residuals of both conventions agree to first order: χ² of estimates near the optimum is nearly the same."""
    for name in ("manhattan", "city_trees", "sphere", "bearing_range", "outliers"):
        steps = steps_of(name)
        isam2, theirs, ours = Watched(Isam2Settings(0.1, wildfire=1e-5)), Isam2Judge(), Judge()
        for batch in steps:
            isam2.prepare(batch)
            theirs.take_in(*isam2.prepared())
            ours.take_in(batch)
            isam2.step()
            isam2.read()
        look = theirs.look(isam2.estimate)
        estimate = [Group(kind, *both) for kind, both in isam2.values().items()]
        assert ours.look(estimate).optimum == pytest.approx(look.optimum, rel=0.02, abs=1e-3), name


@pytest.mark.parametrize("motion", [PLANE, SPACE])
@pytest.mark.parametrize("kind", ["prior", "position"])
def test_isam2_s_priors_and_positions_are_ours_to_first_order(motion: Motion, kind: str) -> None:
    rng = np.random.default_rng(5)
    key, size = symbol("x", 0), 2 if motion is PLANE else 3
    value = motion.far(rng, 1.0, 2.0, 30.0, 60.0)
    for _ in range(5):
        near = motion.compose(value, motion.small(1e-4 * rng.normal(size=len(motion.sigmas))))
        z, sigmas = near, np.array(motion.weak) * rng.uniform(0.5, 2.0, len(motion.weak))
        if kind == "position":
            z, sigmas = np.concatenate([near[:size], np.zeros(size)]), sigmas[:size]
        group = factor(f"{kind}_{motion.kind}", [key], z, tuple(sigmas))
        judged, values = Judge(), gtsam.Values()
        judged.take_in(Batch((Variables(motion.kind, np.array([key]), value[None]),), (group,)))
        values.insert(key, gtsam.Pose2(*value) if motion is PLANE else pose3(value))
        (theirs,) = gtsam_factors(group)
        ours = judged.chi2([Group(motion.kind, np.array([key]), value[None])])
        assert 2 * theirs.error(values) == pytest.approx(ours, rel=1e-3)


@pytest.mark.parametrize("kind", ["landmark_se2", "landmark_se3", "bearing_se2", "bearing_range_se2", "range_se2"])
def test_isam2_s_sights_of_landmarks_are_ours_to_first_order(kind: str) -> None:
    rng = np.random.default_rng(6)
    space = kind.endswith("se3")
    size, pose, place = (3, "se3", "point3") if space else (2, "se2", "point2")
    value = (SPACE if space else PLANE).far(rng, 1.0, 2.0, 30.0, 60.0)
    keys, values = (symbol("x", 0), symbol("l", 0)), gtsam.Values()
    values.insert(keys[0], pose3(value) if space else gtsam.Pose2(*value))
    for _ in range(5):
        landmark = value[:size] + rng.uniform(2.0, 9.0, size)
        near = landmark + 1e-4 * rng.normal(size=size)
        u = into_frame_3d(value[None], near[None])[0] if space else into_frame_2d(value[None], near[None])[0]
        angle, distance = float(np.arctan2(u[1], u[0])), float(np.linalg.norm(u))
        seen = {"bearing": [angle], "bearing_range": [angle, distance], "range": [distance]}
        z = np.array(seen.get(kind.removesuffix("_se2"), u))
        group = factor(kind, list(keys), z, tuple(rng.uniform(0.05, 0.5, len(z))))
        judged = Judge()
        known = [Group(pose, np.array([keys[0]]), value[None]), Group(place, np.array([keys[1]]), landmark[None])]
        judged.take_in(Batch(tuple(Variables(g.kind, g.keys, g.values) for g in known), (group,)))
        if values.exists(keys[1]):
            values.erase(keys[1])
        values.insert(keys[1], gtsam.Point3(*landmark) if space else gtsam.Point2(*landmark))
        (theirs,) = gtsam_factors(group)
        ours = judged.chi2(known)
        assert 2 * theirs.error(values) == pytest.approx(ours, rel=1e-3)
        assert (RESIDUALS[kind](value[None], landmark[None], z[None]) ** 2).sum() > 0.0


def test_isam2_s_positions_with_a_lever_are_refused() -> None:
    group = factor("position_se2", [symbol("x", 0)], np.array([1.0, 2.0, 0.5, 0.0]), (0.1, 0.1))
    with pytest.raises(Failed, match="lever"):
        list(gtsam_factors(group))


def test_isam2_is_judged_by_gtsam_s_own_batch() -> None:
    steps = steps_of("manhattan", 150)
    isam2, theirs, graph = Watched(Isam2Settings(0.1)), Isam2Judge(), gtsam.NonlinearFactorGraph()
    for batch in steps:
        isam2.prepare(batch)
        graph.push_back(isam2.prepared()[0])
        theirs.take_in(*isam2.prepared())
        isam2.step()
        isam2.read()
        look = theirs.look(isam2.estimate)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    best = gtsam.LevenbergMarquardtOptimizer(graph, isam2.estimate, parameters).optimize()
    assert look.chi2 == pytest.approx(2 * graph.error(isam2.estimate), rel=1e-12)
    assert look.optimum == pytest.approx(2 * graph.error(best), rel=1e-5)


def test_isam2_goes_through_by_qr_where_cholesky_gives_up_and_it_is_said() -> None:
    for seed in range(1, 9):
        looks, note = follow_isam2(steps_of("meetings_2d", SMALL, seed))
        if note:
            assert note.startswith("by QR, since Cholesky gave up at step")
            assert len(looks) == SMALL
            return
    pytest.fail("Cholesky gave up on no prior of a hundred times the weakness")


def test_drives_of_a_world_are_judged_together() -> None:
    rows = [row("manhattan", 60, Options(), seed) for seed in (1, 2)]
    both = together(rows)
    assert (both["drives"], both["steps"], both["judged"]) == (2, 120, 120)
    assert both["max"] == max(each["max"] for each in rows)
    assert {each.verdict for each in judge([row("drift", 40, Options())]) if "ordinary" in each.what} == {NOT_MEASURED}
    assert tables.line(both).startswith("manhattan")


def test_steps_above_the_bar_are_kept_with_what_they_said() -> None:
    steps = steps_of("drift", 60)
    kept = far_steps("drift", 3, follow(steps, Options(mode="all-batch", max_iterations=1)))
    assert kept
    assert kept[0]["step"] == 60
    assert kept[0]["report"]["converged"] is False
    assert kept[0]["report"]["because"]
    assert json.loads(json.dumps(kept)) == kept


def run(folder: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> int | str:
    """The exit code of the command, or what it ended with."""
    monkeypatch.setattr(sys, "argv", ["every_step.py", "--out", str(folder), *words])
    try:
        every_step.main()
    except SystemExit as ended:
        return ended.code or 0
    return 0


def test_the_command_gives_rows_and_seeds_that_repeat_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    good = (
        "--mode",
        "all-batch",
        "--option",
        "batch_tolerance=1e-12",
        "--only",
        "manhattan",
        "--poses",
        "80",
        "--json",
    )
    assert run(tmp_path, monkeypatch, *good, "--seeds", "2") == 0
    told, notes = capsys.readouterr()
    document = json.loads(told)
    assert json.loads((tmp_path / "every-step.json").read_text()) == document
    assert len(document["seeds"]) == len(set(document["seeds"])) == len(document["rows"]) == 2
    assert f"--seed {document['seeds'][0]},{document['seeds'][1]}" in notes
    wanted = "world seed steps p50 p99 max above_1_001 above_1_01 unconverged worst_converged odometry_excess"
    theirs = "isam2_p50 isam2_p99 isam2_max isam2_above_1_001 isam2_above_1_01"
    for each in document["rows"]:
        assert set(f"{wanted} {theirs}".split()) <= set(each)
        assert 0 < each["oracle_off"] < 1e-6
    assert run(tmp_path, monkeypatch, *good, "--seed", str(document["seeds"][1]), "--no-isam2") == 0
    (again,) = json.loads(capsys.readouterr().out)["rows"]
    assert again["p99"] == document["rows"][1]["p99"]
    assert "isam2_p99" not in again


def test_the_command_fails_a_sloppy_solver_and_keeps_the_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sloppy = [word for name in SLOPPY for word in ("--option", f"{name}=1e9")]
    drive = ("--only", "drift", "--poses", "80", "--seed", "3", "--no-isam2")
    assert run(tmp_path, monkeypatch, *sloppy, *drive) == 1
    assert "MISSED" in capsys.readouterr().out
    assert (tmp_path / "far.jsonl").read_text().count("\n") >= 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--only", "mars"), "mars: none of"),
        (("--option", "bnt=1"), "bnt"),
        (("--option", "relinearize_threshold"), "wanted NAME=VALUE"),
        (("--option", "bent=x"), "bent=x"),
        (("--option", "small_loop=900"), "small_loop_threshold"),
        (("--seed", "0"), "wanted 1 or more"),
        (("--out", "/dev/null/out"), "wanted a folder"),
        (("--check", "-1"), "wanted 0 or more"),
        (("--poses", "-1"), "wanted 0 or more"),
    ],
)
def test_what_is_asked_wrongly_is_told(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    told: str,
) -> None:
    ended = run(tmp_path, monkeypatch, *words)
    assert ended != 0
    assert told in str(ended) + capsys.readouterr().err


def test_every_benchmark_of_the_command_line_has_its_file() -> None:
    names = (*bench.BENCHES, *bench.ASKED, *bench.LONG)
    assert "every-step" in names
    assert all((bench.folder() / bench.bench_file(name)).is_file() for name in names)


@pytest.mark.data
def test_a_data_set_is_followed(datasets: Path) -> None:
    assert datasets.is_dir()
    found = row("intel", 300, Options())
    assert found["steps"] == 300
    assert found["p50"] < 1.001
