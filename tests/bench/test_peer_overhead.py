"""What `bench peers` says of Python around compiled calls, of starting, and of the bus."""

from collections.abc import Callable
from typing import Any

from bench.replays import over_bus, overhead, peer_table, peer_targets
from bench.replays.problems import Problem, load
from bench.replays.targets import MET, MISSED, NOT_MEASURED

from factorbus.solver import warm

SILENT: Callable[..., None] = lambda *_: None  # noqa: E731


def test_time_inside_compiled_calls_is_part_of_the_step() -> None:
    steps = load(Problem("manhattan", "Manhattan", poses=150, seed=1))
    with overhead.timed_calls() as inside:
        found = overhead.drive("auto", steps, inside)
    for part in ("all", "odometry"):
        row = found[part]
        assert 0 < row["inside_us"] < row["total_us"]
        assert 0 < row["outside_us"] < row["total_us"]
    assert found["odometry"]["steps"] < found["all"]["steps"] == 150
    assert not any(getattr(f, "__name__", "") == "call" for m in overhead.python_modules() for f in vars(m).values())


def test_the_solvers_own_account_of_compiled_time_is_preferred() -> None:
    class Report:
        compiled_ms = 0.25

    with overhead.timed_calls() as inside:
        assert inside(Report()) == 0.25e-3


def test_a_replay_over_the_bus_is_timed_by_the_robot() -> None:
    found = over_bus.over_bus({}, Problem("manhattan", "Manhattan", poses=80, seed=3), SILENT)
    assert found["steps"] == 80
    assert 0 < found["insert_ms"]["p50"] <= found["insert_ms"]["p99"] <= found["insert_ms"]["max"]
    assert "| intel | 80 |" in peer_table.bus_table({"intel": found})
    assert "| intel | exit code 1 |" in peer_table.bus_table({"intel": {"status": "failed", "reason": "exit code 1"}})


def test_a_start_compiles_nothing() -> None:
    warm()
    started = overhead.starts("auto")
    assert started["compiled_s"] == 0.0
    assert started["cpu_s"] > 0


def an_overhead(**more: Any) -> list[str]:
    step = {"by": "x", "all": {"steps": 9, "total_us": 30.0, "inside_us": 20.0, "outside_us": 14.0}}
    step["odometry"] = {"steps": 4, "total_us": 20.0, "inside_us": 9.0, "outside_us": 10.0}
    cold = {"cpu_s": 50.0, "wall_s": 51.0, "announced": ["a", "b", "c", "d"], "said": ""}
    found = {"step": step, "start": {"cpu_s": 1.4, "wall_s": 3.0, "compiled_s": 0.0}, "cold": cold, **more}
    assert "Python" in peer_table.overhead_list(found)
    return [verdict.verdict for verdict in peer_targets.judge_overhead(found)]


def test_bars_of_python_and_starting() -> None:
    assert an_overhead() == [MET] * 4
    assert an_overhead(cold=None) == [MET, MET, MET, NOT_MEASURED]
    assert an_overhead(start={"cpu_s": 1.4, "wall_s": 1.4, "compiled_s": 0.2})[2] == MISSED
    assert an_overhead(cold={"cpu_s": 50.0, "wall_s": 51.0, "announced": [], "said": ""})[3] == MISSED
    slow = {"steps": 9, "total_us": 40.0, "inside_us": 11.0, "outside_us": 16.0}
    assert an_overhead(step={"by": "x", "all": slow, "odometry": slow})[:2] == [MISSED, MISSED]
