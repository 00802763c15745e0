"""`bench peers`: its ratios, its bars, its other measures, and the whole command on a simulated world."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import peers
from bench.peer_runs import BATCH, a_run
from bench.replays import (
    child,
    cores,
    full_pass,
    growth,
    peer_summary,
    peer_table,
    peer_targets,
    runner,
)
from bench.replays.columns import columns_of
from bench.replays.contestants import ENTRIES, PEER, SKIPPING, STAND_INS
from bench.replays.peer_targets import BARS
from bench.replays.problems import ALL, Problem, load
from bench.replays.reference import optima
from bench.replays.samples import Sampling
from bench.replays.targets import MET, MISSED, NOT_MEASURED, Verdict
from naive.cholmod import cholmod

from factorbus.solver import Options, Solver

PEERS = Path(__file__).parent / "peers.py"
SILENT = lambda *_: None  # noqa: E731
DIMS = {"se2": 3, "se3": 6, "point2": 2}
RESIDUALS = {"between_se2": 3, "between_se3": 6, "landmark_se2": 2}
ALWAYS = Sampling(every=1).as_json()


def rows(ours: list[dict[str, Any]], peer: list[dict[str, Any]], name: str = "intel") -> list[dict[str, Any]]:
    entries, skipping = [ENTRIES["auto"], ENTRIES[PEER]], [{**run, "contestant": SKIPPING} for run in peer]
    return peer_summary.rows_of(Problem(name, name), entries, {"auto": ours, PEER: peer, SKIPPING: skipping}, BATCH)


def test_the_ratio_is_that_of_the_medians() -> None:
    ours = [a_run("auto", seconds, chi2_settled=10.0) for seconds in (1.0, 9.0, 2.0)]
    peer = [a_run(PEER, seconds, facts={"nnz_r": 3, "read_s": 0.5}) for seconds in (10.0, 20.0, 30.0)]
    mine, theirs = rows(ours, peer)
    assert mine["ratio_to_isam2"] == pytest.approx(0.1)
    assert mine["ratio_spread"] == pytest.approx([2 / 30, 9 / 20])
    assert (mine["ratio_steps"], mine["chi2_settled"]) == (300, 10.0)
    assert (theirs["ratio_to_isam2"], theirs["read_s"]) == (1.0, 0.5)
    assert {"dataset", "solver", "mode", "cpu_s", "wall_s", "step_ms", "chi2_ratio", "versions", "peak_mb"} <= set(mine)


def test_a_peer_that_gave_up_is_compared_as_far_as_it_came() -> None:
    curve = {"cumulative": [[0, 149], [0.0, 5.0]], "chi2": [[99, 10.5]]}
    failed = [a_run(PEER, 5.0, 150, status="failed", reason="step 150: Indeterminate", facts={}, **curve)]
    chi2 = [[99, 10.0], [199, 30.0], [299, 10.0]]
    mine, theirs = rows([a_run("auto", 1.0, chi2=chi2, chi2_settled=10.0)], failed)
    assert mine["ratio_to_isam2"] == pytest.approx(0.25 / 5.0)
    assert mine["ratio_steps"] == 150
    assert (mine["chi2_ratio"]["max"], mine["chi2_ratio_common"]["max"]) == (3.0, 1.0)
    assert theirs["note"].startswith("FAILED: step 150: Indeterminate")
    said = {v.what: v for v in peer_targets.judge([mine, theirs], {"intel": 10.0})}
    (time,) = [v for what, v in said.items() if "of the time of iSAM2" in what and "skip 1)" in what]
    assert time.verdict == MET
    assert "up to step 150, where iSAM2 stopped: FAILED" in time.seen
    (worse,) = [v for what, v in said.items() if "no worse than iSAM2" in what]
    assert worse.verdict == MET


def test_a_stand_in_that_goes_through_takes_the_place_of_a_peer_that_gave_up() -> None:
    failed = [a_run(PEER, 5.0, 150, status="failed", reason="step 150: Indeterminate", chi2=[[99, 10.5]])]
    runs = {
        "auto": [a_run("auto", 1.0, chi2_settled=10.0)],
        PEER: failed,
        STAND_INS[PEER]: [a_run(STAND_INS[PEER], 6.0)],
    }
    found = peer_summary.rows_of(Problem("intel", "Intel"), [ENTRIES[name] for name in runs], runs, BATCH)
    assert {row["ratio_against"] for row in found} == {STAND_INS[PEER]}
    assert found[0]["ratio_to_isam2"] == pytest.approx(1 / 6)
    assert found[0]["ratio_steps"] == 300
    time, skipping, _, _, worse, *_ = peer_targets.judge(found, {"intel": 10.0})
    assert skipping.verdict == NOT_MEASURED
    assert "because without that it gave up" in time.seen
    assert "max 1.000000 against 1.050000" in worse.seen


def test_the_time_of_one_that_skips_is_its_own_or_that_of_its_stand_in() -> None:
    entries, own = [ENTRIES["auto"]], [a_run(SKIPPING, 4.0)]
    runs = {"auto": [a_run("auto")], PEER: [a_run(PEER, 9.0)], SKIPPING: own}
    (row,) = peer_summary.rows_of(Problem("intel", "Intel"), entries, runs, BATCH)
    assert (row["ratio_to_isam2"], row["ratio_to_skip10"]) == (pytest.approx(1 / 9), pytest.approx(1 / 4))
    failed = [a_run(SKIPPING, 4.0, 150, status="failed", reason="step 150")]
    runs |= {SKIPPING: failed, STAND_INS[SKIPPING]: [a_run(STAND_INS[SKIPPING], 2.0)]}
    (row,) = peer_summary.rows_of(Problem("intel", "Intel"), entries, runs, BATCH)
    assert row["ratio_to_skip10"] == pytest.approx(1 / 2)


def test_a_peer_that_never_began_leaves_nothing_to_compare() -> None:
    crashed = [{"contestant": PEER, "status": "crashed", "reason": "exit code -11", "chi2": [], "facts": {}}]
    mine, theirs = rows([a_run("auto", chi2_settled=10.0)], crashed)
    assert mine["ratio_to_isam2"] is None
    verdicts = peer_targets.judge([mine, theirs], {"intel": 10.0})
    assert [v.verdict for v in verdicts] == [
        NOT_MEASURED, NOT_MEASURED, MET, MET, NOT_MEASURED, MET, NOT_MEASURED, NOT_MEASURED,
    ]  # fmt: skip


def judged(**more: Any) -> dict[str, str]:
    """Verdicts on intel by a word of what was wanted; all are met unless `more` spoils our run."""
    ours = a_run("auto", **{"cpu_s": 1.0, "chi2_settled": 10.0, **more})
    verdicts = peer_targets.judge(rows([ours], [a_run(PEER, 5.0)]), {"intel": 10.0})
    words = ("skip 1)", "skip 10)", "p99 of the steps", "at most median", "no worse", "settled", "exception")
    return {word: v.verdict for v in verdicts for word in words if word in v.what}


@pytest.mark.parametrize(
    ("spoiled", "missed"),
    [
        ({}, set()),
        ({"cpu_s": 1.01}, {"skip 1)"}),
        ({"cpu_s": 1.68}, {"skip 1)", "skip 10)"}),
        ({"step_ms": {"p50": 0.1, "p95": 0.5, "p99": 1.01, "max": 2.0}}, {"p99 of the steps"}),
        ({"chi2": [[99, 10.003], [199, 10.003], [299, 10.003]]}, {"at most median", "no worse"}),
        ({"chi2": [[99, 10.0], [199, 10.0], [299, 10.101]]}, {"at most median", "no worse"}),
        ({"chi2": [[99, 10.0], [199, 10.0], [299, 10.00002]]}, {"no worse"}),
        ({"chi2": [[99, 10.0], [199, 10.0], [299, 10.000005]]}, set()),
        ({"chi2_settled": 10.0002}, {"settled"}),
        ({"status": "failed", "reason": "step 7: not_finite"}, {"exception"}),
    ],
)
def test_bars_of_a_data_set(spoiled: dict[str, Any], missed: set[str]) -> None:
    verdicts = judged(**spoiled)
    assert {word for word, verdict in verdicts.items() if verdict == MISSED} == missed
    assert set(verdicts.values()) <= {MET, MISSED}


def test_every_data_set_has_bars_and_the_mean_wants_them_all() -> None:
    assert set(BARS) == {problem.name for problem in ALL}
    all_rows, ends = [], {}
    for name, bar in BARS.items():
        all_rows += rows([a_run("auto", 1.0, chi2_settled=10.0)], [a_run(PEER, bar.times)], name)
        ends[name] = 10.0
    verdicts = peer_targets.judge(all_rows, ends)
    assert {v.verdict for v in verdicts[:-2]} == {MET}
    assert [(v.verdict, v.seen) for v in verdicts[-2:]] == [(MISSED, "6.94 over 11 of 11"), (MET, "6.94 over 11 of 11")]
    assert peer_targets.judge(all_rows[:2], {"intel": 10.0, **dict(list(ends.items())[:1])})[-1].verdict == NOT_MEASURED
    assert peer_targets.judge(rows([a_run("auto")], [a_run(PEER)], "intel-200"), {"intel-200": 10.0}) == []


def drive(last: dict[str, float], **more: Any) -> list[Verdict]:
    windows = [{"from": 1_000, "to": 2_000, "p50": 1.0, "p99": 2.0}, {"from": 90_000, "to": 100_000, **last}]
    memory = [
        {"poses": n, "resident": 7, "used": int(1_000 * n * f), "nonzeros": 50 * n}
        for n, f in ((500, 9), (1_000, 1), (100_000, 1.19))
    ]
    found = {"status": "done", "reason": "", "poses": 100_000, "windows": windows, "memory": memory, **more}
    return peer_targets.judge_growth(found)


def test_growth_is_held_between_the_first_and_the_last_window() -> None:
    assert [v.verdict for v in drive({"p50": 1.49, "p99": 7.9})] == [MET] * 4
    assert [v.verdict for v in drive({"p50": 1.51, "p99": 8.1})] == [MISSED, MISSED, MET, MET]
    coarse = [
        {"poses": n, "resident": int(1_000 * n * f), "nonzeros": 0}
        for n, f in ((1_000, 9), (10_000, 1), (100_000, 1.21))
    ]
    assert [v.verdict for v in drive({"p50": 1.0, "p99": 2.0}, memory=coarse)] == [MET, MET, MISSED, NOT_MEASURED]
    for denser, verdict in ((9, MET), (7, MISSED), (20, MET)):
        memory = [
            {"poses": n, "used": 1_000 * n * f, "nonzeros": 50 * n * g}
            for n, f, g in ((1_000, 1, 1), (100_000, 9, denser))
        ]
        assert [v.verdict for v in drive({"p50": 1.0, "p99": 2.0}, memory=memory)] == [MET, MET, MISSED, verdict]
    assert {v.verdict for v in drive({"p50": 1.0, "p99": 2.0}, poses=50_000)} == {NOT_MEASURED}
    assert {v.verdict for v in drive({}, status="failed", reason="step 3: x")} == {MISSED}
    assert peer_targets.judge_growth(None) == []


def test_growth_of_a_short_drive() -> None:
    seen: list[int] = []
    world = Problem("manhattan", "Manhattan", poses=1200, seed=3)
    found = growth.growth({"limit_s": 100, "mode": "auto"}, world, lambda message: seen.append(message["done"]))
    assert (found["status"], found["poses"], found["factors"]) == ("done", 1200, factors_of(world))
    assert [(w["from"], w["to"]) for w in found["windows"]] == [(500, 1000), (1000, 1200)]
    assert all(0 < w["p50"] <= w["p99"] <= w["max"] for w in found["windows"])
    assert [each["poses"] for each in found["memory"]] == [500, 1000, 1200]
    assert found["memory"][-1]["resident"] > 0
    assert all(10 < row["used"] / row["nonzeros"] < 200 for row in found["memory"])
    assert seen == list(range(1, 1201))
    ended = growth.growth({"limit_s": 1e-9, "mode": "inc-l"}, world, SILENT)
    assert (ended["status"], ended["poses"]) == ("limit", 1)
    text = peer_table.growth_table(found)
    assert "| 1000 to 1200 |" in text


def test_a_second_core_is_judged_by_the_longest_steps() -> None:
    found = {"status": "done", "poses": 900, "same_bits": True}
    found["longest"] = {"steps": 9, "alone": 10.0, "together": 8.9}
    assert [v.verdict for v in peer_targets.judge_cores(found, 900)] == [MET, MET]
    assert [v.verdict for v in peer_targets.judge_cores(found, 901)] == [NOT_MEASURED, MET]
    found |= {"same_bits": False, "longest": {"steps": 9, "alone": 10.0, "together": 9.1}}
    assert [v.verdict for v in peer_targets.judge_cores(found, 900)] == [MISSED, MISSED]
    one = cores.cores({"mode": "auto", "cores": 1}, Problem("manhattan", "Manhattan", poses=9), SILENT)
    assert {v.verdict for v in peer_targets.judge_cores(one, 9)} == {NOT_MEASURED}
    assert "one core" in peer_table.cores_table(one)
    assert peer_targets.judge_cores(None, 9) == []


def test_a_short_drive_on_one_core_and_on_two() -> None:
    found = cores.cores({"mode": "auto", "cores": 2}, Problem("manhattan", "Manhattan", poses=450, seed=3), SILENT)
    assert (found["status"], found["poses"], found["longest"]["steps"]) == ("done", 450, 4)
    assert found["same_bits"]
    assert "| two cores |" in peer_table.cores_table(found)


def factors_of(problem: Problem) -> int:
    return sum(batch.factor_count for batch in load(problem))


def test_a_full_pass_solves_the_whole_graph_at_the_optimum(tmp_path: Path) -> None:
    cholmod()
    world = Problem("city_trees", "CityTrees", poses=150, seed=2)
    steps = load(world)
    columns = columns_of(steps)
    found, last = optima(steps, columns, [len(steps) - 1])
    tables = columns.table(last)
    values = {kind: table[columns.arrival[kind]] for kind, table in tables.items()}
    solver = Solver(Options(mode="all-batch", max_iterations=0))
    solver.stage(full_pass.whole(steps, columns, values))
    assert solver.step().chi2 == pytest.approx(found[-1][1], rel=1e-12)
    ours = full_pass.OurPass(solver)
    laps, delta = ours.run()
    dense = full_pass.system_of(solver).dense()
    np.testing.assert_allclose(delta, np.linalg.solve(dense, ours.eta), atol=1e-9 * np.abs(delta).max())
    assert laps["total"] == pytest.approx(sum(seconds for name, seconds in laps.items() if name != "total"))
    np.savez(tmp_path / "values.npz", **values)
    passed = full_pass.full_pass({"values": str(tmp_path / "values.npz"), "repetitions": 2}, world, SILENT)
    assert passed["residual"]["ours"] < 1e-14
    assert passed["residual"]["ours"] < 10 * passed["residual"][passed["best"]]
    assert passed["ratio"] > 0
    assert len(passed["ms"]) == 4
    assert "city_trees" in peer_table.pass_table({"city_trees": passed})


def a_pass(**more: Any) -> str:
    passed = {
        "ms": {"ours": {"total": 1.0}, "cholmod x": {"total": 1.1}},
        "best": "cholmod x",
        "residual": {"ours": 1e-16},
    }
    passed |= {"ratio": 1.1, "blas": ["/usr/lib/openblas-pthread/libblas.so.3"], **more}
    (verdict,) = peer_targets.judge_passes({"intel": passed})
    return verdict.verdict


def test_a_pass_counts_only_against_openblas_and_with_the_same_solution() -> None:
    assert a_pass() == MET
    assert a_pass(ratio=0.99) == MISSED
    assert a_pass(residual={"ours": 1e-11}) == MISSED
    assert a_pass(blas=["/usr/lib/blas/libblas.so.3"]) == NOT_MEASURED
    (crashed,) = peer_targets.judge_passes({"intel": {"status": "failed", "reason": "exit code 1"}})
    assert (crashed.verdict, crashed.seen) == (MISSED, "exit code 1")


def test_the_command_measures_prints_and_draws(tmp_path: Path) -> None:
    cholmod()
    pytest.importorskip("gtsam")
    environment = {**os.environ, "FACTORBUS_DATASETS": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, str(PEERS), "--quick", "--only", "city_trees,replays,full-pass,auto,isam2-0.1,gn-loop"]
    command += ["--out", str(tmp_path), "--json"]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280, check=False)
    assert ran.returncode in (0, 1), ran.stderr[-2000:]
    document = json.loads(ran.stdout)
    by_name = {row["name"]: row for row in document["rows"]}
    assert set(by_name) == {"auto", PEER, "gn-loop"}
    assert {row["status"] for row in by_name.values()} == {"done"}
    assert by_name[PEER]["ratio_to_isam2"] == 1.0
    assert by_name["auto"]["ratio_to_isam2"] == pytest.approx(by_name["auto"]["cpu_s"] / by_name[PEER]["cpu_s"])
    assert by_name["auto"]["chi2_ratio"]["samples"] == by_name[PEER]["chi2_ratio"]["samples"] == 600
    assert 1.0 <= by_name["auto"]["chi2_ratio"]["median"] <= by_name["auto"]["chi2_ratio"]["p99"]
    assert by_name["auto"]["chi2_settled"] == pytest.approx(by_name["gn-loop"]["chi2_final"], rel=1e-2)
    assert by_name[PEER]["chi2_settled"] is None
    assert by_name["auto"]["work"]["options"]["mode"] == "auto"
    assert document["full_pass"]["city_trees-600-1"]["residual"]["ours"] < 1e-14
    assert document["growth"] is None
    assert document["cores"] is None
    assert document["overhead"] is None
    assert [Path(path).name for path in document["figures"]] == [f"peers_{n}.png" for n in ("steps", "time", "ratios")]
    assert all(Path(path).stat().st_size > 10_000 for path in document["figures"])
    assert "one Gauss-Newton step at loops" in (tmp_path / "peers.md").read_text()
    again = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    repeated = json.loads(again.stdout)
    assert [row["measured_at"] for row in repeated["rows"]] == [row["measured_at"] for row in document["rows"]]


@pytest.mark.parametrize("name", ["auto", PEER])
def test_chi2_of_every_step_is_that_of_the_timed_replay(name: str) -> None:
    world = Problem("manhattan", "Manhattan", poses=80, seed=3)
    rarely = {"contestant": name, "limit_s": 100.0, "sampling": Sampling(every=20).as_json()}
    timed, looked = child.replay(rarely, world, SILENT), child.quality({**rarely, "sampling": ALWAYS}, world, SILENT)
    assert [step for step, _ in looked["chi2"]] == list(range(80))
    assert looked["reason"] == ""
    assert [step for step, _ in timed["chi2"]] == [19, 39, 59, 79]
    every = dict(looked["chi2"])
    for step, chi2 in timed["chi2"]:
        assert every[step] == pytest.approx(chi2, rel=1e-9, abs=1e-12)


def test_optima_of_every_step_are_those_of_settling() -> None:
    steps = load(Problem("city_trees", "CityTrees", poses=120, seed=2))
    columns = columns_of(steps)
    each, last = optima(steps, columns, range(120))
    assert len(each) == 120
    for step in (40, 90, 119):
        ((_, settled),) = optima(steps[: step + 1], columns, [step])[0]
        assert each[step][1] == pytest.approx(settled, rel=1e-8, abs=1e-9)
    assert sum(len(keys) for keys, _ in last.values()) == sum(batch.variable_count for batch in steps)


def test_a_replay_that_is_looked_at_is_a_job_unless_looks_are_rare() -> None:
    world, entries = Problem("manhattan", "Manhattan", poses=80, seed=3), [ENTRIES["auto"], ENTRIES[PEER]]
    plan = peers.Plan(("replays",), [world], entries, 3, False, "auto")
    assert plan.jobs() == 1 + 2 * 3 + 2
    assert replace(plan, chi2_every=peers.RARE).jobs() == 1 + 2 * 3


def test_a_run_whose_looks_crashed_has_no_quality_and_misses_its_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(*_: object) -> dict[str, Any]:
        raise runner.Crashed("exit code -9")

    monkeypatch.setattr(runner, "run_quality", crash)
    world = Problem("intel", "intel")
    run = peers.looked_at(runner.Settings(Path(), None), world, a_run("auto", chi2_settled=10.0), SILENT)
    assert run["chi2"] == []
    assert "exit code -9" in run["reason"]
    assert judged(chi2=[])["at most median"] == MISSED


def test_an_unknown_name_is_refused_with_those_there_are() -> None:
    ran = subprocess.run(
        [sys.executable, str(PEERS), "--only", "intle"], capture_output=True, text=True, timeout=60, check=False
    )
    assert ran.returncode == 1
    assert "--only intle: none of the parts (replays, worlds, bus, growth, cores, full-pass, overhead)" in ran.stderr


@pytest.mark.parametrize(
    "words", [("--page", "nowhere/page.md"), ("--page", "."), ("--json", "nowhere/peers.json"), ("--out", "plain/out")]
)
def test_a_path_that_cannot_be_written_is_told_before_anything_is_measured(
    words: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plain").write_text("")
    monkeypatch.setattr(sys, "argv", ["peers", "--quick", *words])
    with pytest.raises(SystemExit):
        peers._options()
    assert f"argument {words[0]}: '{words[1]}'; wanted a" in capsys.readouterr().err
