"""How a step's time and the memory grow with the map: a simulated drive of any length through one of our modes.

What is on the clock is stage, step and `changed`, what a robot gets after every step: a copy of all variables would
grow with the map whatever the solver does.  The world is made by another process, so its memory is not counted.
"""

import gc
import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from factorbus.solver import Options, Solver, SolverError, warm

from .clock import percentiles
from .feed import fed
from .memory import resident_bytes
from .problems import Problem

# Where windows of the drive begin and end, poses; the first and the last one are compared.
EDGES = (500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000, 90_000, 100_000)
_WARM = 300
_TOUCH = 1e-9  # any number but 0: memory counts when it has been written to


def growth(job: dict[str, Any], problem: Problem, tell: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """windows: {from, to, p50, p95, p99, max, mean (ms)}; memory: by number of poses, with the nonzeros of R."""
    warm()
    _drive(Solver(Options(mode=job["mode"])), problem.shortened(_WARM), np.full(_WARM, _TOUCH), lambda *_: None, np.inf)
    seconds, memory = np.full(problem.poses, _TOUCH), []
    solver = Solver(Options(mode=job["mode"]))
    gc.collect()
    gc.freeze()
    gc.disable()
    before = resident_bytes()

    def look(done: int, nonzeros: int) -> None:
        if done in EDGES or done == problem.poses:
            sizes = {"resident": resident_bytes() - before, **_offered(solver)}
            memory.append({"poses": done, "nonzeros": nonzeros, **sizes})
        tell({"done": done, "cpu_s": round(float(seconds[:done].sum()), 2)})

    try:
        done, reason = _drive(solver, problem, seconds, look, float(job["limit_s"]))
    finally:
        gc.enable()
        gc.unfreeze()
    return {
        "status": "done" if done == problem.poses else "failed" if reason else "limit",
        "reason": reason,
        "poses": done,
        "factors": solver.factor_count,
        "cpu_s": float(seconds[:done].sum()),
        "windows": _windows(seconds[:done]),
        "memory": memory,
        "measured_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def _drive(
    solver: Solver, problem: Problem, seconds: np.ndarray, look: Callable[[int, int], None], limit_s: float
) -> tuple[int, str]:
    """(steps done, why it went no further); fills `seconds`."""
    spent = 0.0
    with fed(problem) as steps:
        for k, batch in enumerate(steps):
            start = time.process_time()
            try:
                solver.stage(batch)
                report = solver.step()
                solver.changed()
            except SolverError as problem_seen:
                return k, f"step {k}: {problem_seen.code}: {problem_seen}"
            seconds[k] = time.process_time() - start
            spent += seconds[k]
            look(k + 1, report.nnz_r)
            if spent > limit_s:
                return k + 1, ""
    return problem.poses, ""


def _offered(solver: Solver) -> dict[str, int]:
    """used: what the solver says of the bytes it has in use, where it does."""
    used = getattr(solver, "memory_bytes", None)
    return {} if used is None else {"used": int(used())}


def _windows(seconds: np.ndarray) -> list[dict[str, float]]:
    edges = [edge for edge in EDGES if edge <= len(seconds)]
    if not edges or edges[-1] < len(seconds):
        edges.append(len(seconds))
    if edges[0] == len(seconds):
        edges.insert(0, 0)
    return [
        {"from": a, "to": b, **percentiles(seconds[a:b]), "mean": 1e3 * float(seconds[a:b].mean())}
        for a, b in itertools.pairwise(edges)
    ]
