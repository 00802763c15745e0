"""One job in a process of its own, on one core: a replay by one contestant, the optima along it, or orderings.

    python -m bench.replays.child JOB.json        (started by `runner`)

What it finds goes to standard output as lines of JSON, {"done": steps} now and then and {"result": ...} at the end;
whatever libraries print there goes to standard error.
"""

import gc
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factorbus.proto.messages import Batch

from . import contestants
from .chi2 import chi2_at
from .columns import Columns, columns_of
from .problems import Problem, load
from .samples import sample_steps

_WARM = 30  # steps replayed beforehand, so that no library loads anything on the clock
_POINTS = 400  # of the curve of cumulative time
Tell = Callable[[dict[str, Any]], None]


def main() -> None:
    """Do the job of the file that is named on the command line."""
    job = json.loads(Path(sys.argv[1]).read_text())
    if job["core"] is not None:
        os.sched_setaffinity(0, {job["core"]})
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def tell(message: dict[str, Any]) -> None:
        print(json.dumps(message), file=out, flush=True)

    problem = Problem(**job["problem"])
    steps = load(problem)
    columns = columns_of(steps)
    result = _JOBS[job["kind"]](job, steps, columns, _paced(tell))
    tell({"result": result})


def replay(job: dict[str, Any], steps: Sequence[Batch], columns: Columns, tell: Tell) -> dict[str, Any]:
    """Replay `steps` by job["contestant"]; see `_result` for what comes of it."""
    name, limit_s = job["contestant"], float(job["limit_s"])
    samples = set(sample_steps(len(steps), job["samples"]))
    _warm_up(name, steps)
    contestant = contestants.make(name)
    clock = _Clock(len(steps))
    load_before, compiled = os.getloadavg()[0], _compiled_s(name)
    gc.collect()
    gc.freeze()
    gc.disable()  # a collection would fall on some step by chance
    base_mb = _reset_peak_mb()
    status, reason, chi2 = "done", "", []
    for k, batch in enumerate(steps):
        try:
            contestant.prepare(batch)
            clock.run(k, contestant)
        except contestants.Failed as problem:
            status, reason = "failed", f"step {k}: {problem}"
            break
        if k in samples:
            chi2.append((k, chi2_at(columns, contestant.values(), k)))
        if clock.cpu_s > limit_s and k < len(steps) - 1:
            status, reason = "limit", f"more than {limit_s:g} s of solver time after step {k}"
            break
        tell({"done": k + 1, "cpu_s": round(clock.cpu_s, 2)})
    peak_mb = _peak_mb()
    facts = contestant.facts() if status == "done" else {}
    return {
        "contestant": name,
        "status": status,
        "reason": reason,
        "steps": len(steps),
        "chi2": chi2,
        "facts": facts,
        "peak_mb": peak_mb,
        "base_mb": base_mb,
        "compiled_s": _compiled_s(name) - compiled,
        "load_average": load_before,
        "measured_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "limit_s": limit_s,
        **clock.account(),
    }


def reference(job: dict[str, Any], steps: Sequence[Batch], columns: Columns, tell: Tell) -> dict[str, Any]:
    """χ²_batch at the samples; the values at the end go to the file job["values"]."""
    from .reference import optima

    samples = sample_steps(len(steps), job["samples"])
    chi2, last = optima(steps, columns, samples, lambda k: tell({"done": k + 1}))
    tables = columns.table(last)
    np.savez_compressed(job["values"], **{kind: table[columns.arrival[kind]] for kind, table in tables.items()})
    return {"chi2": chi2, "dof": columns.dof(), "steps": len(steps)}


def fill(job: dict[str, Any], steps: Sequence[Batch], columns: Columns, tell: Tell) -> dict[str, Any]:
    """Nonzeros of R for several orderings; their pictures go to the file job["values"]."""
    from .fill import orderings

    numbers, pictures = orderings(columns, job["pixels"])
    np.savez_compressed(job["values"], **pictures)
    return numbers


_JOBS = {"replay": replay, "reference": reference, "fill": fill}


class _Clock:
    """CPU time of the process (all its threads) and wall time of every step, the solving and the reading apart."""

    def __init__(self, steps: int) -> None:
        self._solve, self._read, self._wall = np.zeros(steps), np.zeros(steps), np.zeros(steps)
        self._done, self.cpu_s = 0, 0.0

    def run(self, k: int, contestant: contestants.Contestant) -> None:
        wall, start = time.perf_counter(), time.process_time()
        contestant.step()
        solved = time.process_time()
        contestant.read()
        end, wall_end = time.process_time(), time.perf_counter()
        self._solve[k], self._read[k], self._wall[k] = solved - start, end - solved, wall_end - wall
        self.cpu_s += end - start
        self._done = k + 1

    def account(self) -> dict[str, Any]:
        n = self._done
        cpu = (self._solve + self._read)[:n]
        points = np.unique(np.linspace(0, max(n - 1, 0), min(n, _POINTS)).astype(int))
        return {
            "done": n,
            "cpu_s": float(cpu.sum()),
            "solve_s": float(self._solve.sum()),
            "read_s": float(self._read.sum()),
            "wall_s": float(self._wall.sum()),
            "step_ms": _percentiles(cpu),
            "solve_ms": _percentiles(self._solve[:n]),
            "step_wall_ms": _percentiles(self._wall[:n]),
            "cumulative": [points.tolist(), np.cumsum(cpu)[points].round(6).tolist()] if n else [[], []],
        }


def _percentiles(seconds: np.ndarray) -> dict[str, float]:
    if not len(seconds):
        return {}
    p50, p95, p99 = (float(1e3 * value) for value in np.percentile(seconds, (50, 95, 99)))
    return {"p50": p50, "p95": p95, "p99": p99, "max": float(1e3 * seconds.max())}


def _warm_up(name: str, steps: Sequence[Batch]) -> None:
    """Compile or load kernels, and let every library do what it does the first time."""
    if contestants.ENTRIES[name].solver == contestants.OURS:
        from factorbus.solver import warm

        warm()
    scratch = contestants.make(name)
    for batch in steps[:_WARM]:
        scratch.prepare(batch)
        scratch.step()
        scratch.read()


def _compiled_s(name: str) -> float:
    """Seconds spent in compiling kernels so far; a peer's process has none, and does not load Numba."""
    if contestants.ENTRIES[name].solver != contestants.OURS:
        return 0.0
    from factorbus.solver import compiled_seconds

    return compiled_seconds()


def _reset_peak_mb() -> float:
    """Forget the largest size so far; gives the present one."""
    Path("/proc/self/clear_refs").write_text("5")
    return _peak_mb()


def _peak_mb() -> float:
    """The largest resident size since then."""
    line = next(row for row in Path("/proc/self/status").read_text().splitlines() if row.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def _paced(tell: Tell, every_s: float = 0.25) -> Tell:
    """The same, but not more often than that."""
    last = [0.0]

    def pace(message: dict[str, Any]) -> None:
        now = time.monotonic()
        if now - last[0] > every_s:
            last[0] = now
            tell(message)

    return pace


if __name__ == "__main__":
    main()
