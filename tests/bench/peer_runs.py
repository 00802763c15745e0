"""Runs as `bench peers` has them, made up for its tests."""

from typing import Any

BATCH = {99: 10.0, 199: 10.0, 299: 10.0}


def a_run(name: str, cpu_s: float = 1.0, done: int = 300, **more: Any) -> dict[str, Any]:
    """Of 300 steps, of which the second half takes three quarters of the time."""
    parts = {"p50": 0.1, "p95": 0.2, "p99": 0.3, "max": 0.4}
    run: dict[str, Any] = dict.fromkeys(("solve_s", "read_s", "wall_s", "peak_mb", "base_mb", "load_average"), 1.0)
    run |= {"contestant": name, "cpu_s": cpu_s, "done": done, "steps": 300, "status": "done", "reason": ""}
    run |= {"step_ms": parts, "solve_ms": parts, "step_wall_ms": parts, "facts": {"nnz_r": 7}}
    run |= {"cumulative": [[0, 149, 299], [0.0, 0.25 * cpu_s, cpu_s]], "chi2_settled": None}
    return {**run, "chi2": [[99, 10.0], [199, 10.0], [299, 10.0]], **more}
