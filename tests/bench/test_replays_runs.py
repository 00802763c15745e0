"""Runs of the replay benchmark: each in a process of its own, kept on disk, ended at a limit, and the whole command."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from bench.replays import figures, runner
from bench.replays.contestants import ENTRIES
from bench.replays.problems import ALL, Problem, choose, load
from bench.replays.samples import Sampling
from bench.replays.table import table_1

WORLD = Problem("manhattan", "Manhattan", poses=60, seed=2)
EDGE = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
PAPER = Path(__file__).parent / "paper.py"


def settings(folder: Path, **more: object) -> runner.Settings:
    return runner.Settings(folder, runner.pick_core(), Sampling(20), **more)  # type: ignore[arg-type]


def replay(folder: Path, seen: list[int] | None = None, **more: object) -> dict[str, object]:
    tell = (seen if seen is not None else []).append
    return runner.run_replay(settings(folder, **more), WORLD, ENTRIES["all-batch"], 0, lambda done, _: tell(done))


def test_a_run_is_measured_once_and_ended_at_its_limit(tmp_path: Path) -> None:
    ended = replay(tmp_path, limit_s=1e-9)
    assert ended["status"] == "limit"
    assert ended["done"] == 1
    begun: list[int] = []
    run = replay(tmp_path, begun, limit_s=60)  # a larger limit measures again
    assert begun
    assert run["status"] == "done"
    assert run["done"] == run["steps"] == 60
    assert len(run["chi2"]) == 20
    assert run["cpu_s"] == pytest.approx(run["solve_s"] + run["read_s"])
    assert run["peak_mb"] >= run["base_mb"] > 10
    assert run["step_ms"]["p50"] <= run["step_ms"]["p95"] <= run["step_ms"]["max"]
    assert run["compiled_s"] == 0
    again: list[int] = []
    assert replay(tmp_path, again, limit_s=60) == run
    assert not again


def test_a_process_that_ends_early_is_a_row_and_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    (tmp_path / "file").write_text("a file where a folder is wanted")
    monkeypatch.setattr(runner.sys, "executable", "/bin/false")
    run = replay(tmp_path)
    assert run["status"] == "crashed"
    assert "exit code 1" in str(run["reason"])
    assert not list(tmp_path.rglob("all-batch.0.*.json"))


def test_problems_are_worlds_where_there_are_no_data_sets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FACTORBUS_DATASETS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    problems, note = choose(quick=True)
    assert all(problem.is_world for problem in problems)
    assert "simulated worlds" in note
    assert "Not on this machine: manhattan3500, " in note


@pytest.mark.parametrize("folder", ["own", "cache/factorbus/datasets"])
def test_data_sets_are_found_by_name(folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FACTORBUS_DATASETS", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / folder).mkdir(parents=True)
    (tmp_path / folder / "sphere2500.g2o").write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n" + EDGE)
    found, note = choose(quick=False, of=ALL)
    names = [problem.name for problem in found]
    assert "sphere2500" in names
    assert set(names) <= {"sphere2500", "victoria_park", "w10000_toro"}, "the wheel of gtsam may have the last two"
    assert "intel" in note
    assert len(load(found[names.index("sphere2500")])) == 2
    assert load(found[names.index("sphere2500")].shortened(1))[0].variable_count == 1
    with pytest.raises(FileNotFoundError, match="factorbus datasets fetch intel"):
        load(Problem("intel", "Intel"))


def test_the_command_measures_prints_and_draws(tmp_path: Path) -> None:
    environment = {**os.environ, "FACTORBUS_DATASETS": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, str(PAPER), "--quick", "--only", "city_trees,all-batch", "--samples", "30"]
    command += ["--out", str(tmp_path), "--json"]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=110, check=False)
    assert ran.returncode == 0, ran.stderr[-2000:]
    document = json.loads(ran.stdout)
    (row,) = document["rows"]
    assert row["dataset"] == "city_trees-600-1"
    assert row["chi2_ratio"]["max"] == pytest.approx(1, abs=1e-3)
    assert set(row["step_ms"]) == {"p50", "p95", "p99", "max"}
    assert {"factorbus", "numpy", "numba", "python"} <= set(row["versions"])
    assert sum(row["strategies"].values()) == 600
    assert {target["verdict"] for target in document["targets"]} <= {"met", "not measured"}
    assert all(Path(path).stat().st_size > 10_000 for path in document["figures"])
    assert len(document["figures"]) == 5
    assert "all-batch" in (tmp_path / "paper.md").read_text()


def test_the_table_has_data_sets_as_columns_and_marks_the_best() -> None:
    rows = [
        {"dataset": "intel", "title": "Intel", "name": name, "status": status, "cpu_s": cpu, "done": 3, "steps": 9}
        for name, status, cpu in (("isam2-0.1", "done", 0.5), ("all-batch", "done", 0.25), ("g2o-b1", "failed", 0.1))
    ]
    lines = table_1(rows).splitlines()
    assert lines[0] == "|  | Intel |"
    assert "| all-batch Λ | **0.250** |" in lines
    assert "| GTSAM iSAM2, 0.1 | 0.500 |" in lines
    assert "| g2o, batch each step | failed (3 of 9) |" in lines
    assert lines.index("| *ours* |  |") > lines.index("| GTSAM iSAM2, 0.1 | 0.500 |")


def test_every_contestant_has_a_look_of_its_own() -> None:
    looks = [(look["color"], str(look.get("linestyle"))) for look in figures.LOOKS.values()]
    assert set(figures.LOOKS) == set(ENTRIES)
    assert len(set(looks)) == len(looks)
