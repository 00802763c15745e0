"""One job in a process of its own, on one core: a replay by one contestant, the optima along it, or another measure.

    python -m bench.replays.child JOB.json        (started by `runner`)

What it finds goes to standard output as lines of JSON, {"done": steps} now and then and {"result": ...} at the end;
whatever libraries print there goes to standard error.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from factorbus.proto.messages import Batch

from . import contestants
from .chi2 import chi2_at
from .clock import Clock
from .collector import no_collection
from .columns import columns_of
from .contestants import Contestant, Rehearsing, Settling
from .memory import peak_mb, reset_peak_mb
from .problems import Problem, load
from .samples import Sampling

_WARM = 30  # steps replayed beforehand, so that no library loads anything on the clock
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

    result = _JOBS[job["kind"]](job, Problem(**job["problem"]), _paced(tell))
    tell({"result": result})


def replay(job: dict[str, Any], problem: Problem, tell: Tell) -> dict[str, Any]:
    """Replay the problem's steps by job["contestant"]."""
    steps = load(problem)
    columns = columns_of(steps)
    name, limit_s = job["contestant"], float(job["limit_s"])
    samples = set(_samples(job, steps))
    _warm_up(name, steps)
    contestant = contestants.make(name)
    if isinstance(contestant, Rehearsing):
        contestant.rehearse(steps, samples, lambda k: tell({"done": k + 1, "cpu_s": 0.0}))
    clock = Clock(len(steps))
    load_before, compiled = os.getloadavg()[0], _compiled_s(name)
    with no_collection():
        base_mb = reset_peak_mb()
        status, reason, chi2 = "done", "", []
        for k, batch in enumerate(steps):
            try:
                contestant.prepare(batch)
                clock.run(k, contestant)
            except contestants.Failed as failed:
                status, reason = "failed", f"step {k}: {failed}"
                break
            if k in samples:
                chi2.append((k, chi2_at(columns, contestant.values(), k)))
            if clock.cpu_s > limit_s and k < len(steps) - 1:
                status, reason = "limit", f"more than {limit_s:g} s of solver time after step {k}"
                break
            tell({"done": k + 1, "cpu_s": round(clock.cpu_s, 2)})
        largest_mb = peak_mb()
    facts = contestant.facts() if status == "done" else {}
    settled = None
    if status == "done" and isinstance(contestant, Settling):
        contestant.settle()
        settled = chi2_at(columns, contestant.values(), len(steps) - 1)
    return {
        "contestant": name,
        "status": status,
        "reason": reason,
        "steps": len(steps),
        "chi2": chi2,
        "chi2_settled": settled,
        "facts": facts,
        "peak_mb": largest_mb,
        "base_mb": base_mb,
        "compiled_s": _compiled_s(name) - compiled,
        "load_average": load_before,
        "measured_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "limit_s": limit_s,
        **clock.account(),
    }


def quality(job: dict[str, Any], problem: Problem, tell: Tell) -> dict[str, Any]:
    """χ² of the estimates of job["contestant"] at the samples, off any clock: a look takes what a step does."""
    steps = load(problem)
    columns, samples, chi2, reason = columns_of(steps), set(_samples(job, steps)), [], ""
    contestant = contestants.make_reading(job["contestant"])
    for k, batch in enumerate(steps):
        try:
            contestant.prepare(batch)
            contestant.step()
            contestant.read()
        except contestants.Failed as failed:
            reason = f"step {k}: {failed}"
            break
        if k in samples:
            chi2.append((k, chi2_at(columns, contestant.values(), k)))
        tell({"done": k + 1})
    return {"contestant": job["contestant"], "chi2": chi2, "reason": reason}


def reference(job: dict[str, Any], problem: Problem, tell: Tell) -> dict[str, Any]:
    """χ²_batch at the samples; the values at the end go to the file job["values"]."""
    from .reference import optima

    steps = load(problem)
    columns = columns_of(steps)
    chi2, last = optima(steps, columns, _samples(job, steps), lambda k: tell({"done": k + 1}))
    tables = columns.table(last)
    np.savez_compressed(job["values"], **{kind: table[columns.arrival[kind]] for kind, table in tables.items()})
    return {"chi2": chi2, "dof": columns.dof(), "steps": len(steps)}


def fill(job: dict[str, Any], problem: Problem, tell: Tell) -> dict[str, Any]:
    """Nonzeros of R for several orderings; their pictures go to the file job["values"]."""
    from .fill import orderings

    numbers, pictures = orderings(columns_of(load(problem)), job["pixels"])
    np.savez_compressed(job["values"], **pictures)
    return numbers


def _measure(kind: str) -> "Job":
    """The function `kind` of the file `kind`."""
    return lambda job, problem, tell: getattr(import_module(f"bench.replays.{kind}"), kind)(job, problem, tell)


Job: TypeAlias = Callable[[dict[str, Any], Problem, Tell], dict[str, Any]]
_JOBS: dict[str, Job] = {
    "replay": replay,
    "quality": quality,
    "reference": reference,
    "fill": fill,
    **{kind: _measure(kind) for kind in ("growth", "cores", "full_pass", "overhead", "over_bus")},
}


def _samples(job: dict[str, Any], steps: Sequence[Batch]) -> tuple[int, ...]:
    return Sampling(**job["sampling"]).steps(len(steps))


def _warm_up(name: str, steps: Sequence[Batch]) -> None:
    """Compile or load kernels, and let every library do what it does the first time."""
    if contestants.ENTRIES[name].runs_our_kernels:
        from factorbus.solver import warm

        warm()
    scratch: Contestant = contestants.make(name)
    if isinstance(scratch, Rehearsing):
        scratch.rehearse(steps[:_WARM], {len(steps[:_WARM]) - 1})
    for batch in steps[:_WARM]:
        scratch.prepare(batch)
        scratch.step()
        scratch.read()


def _compiled_s(name: str) -> float:
    """Seconds spent in compiling kernels so far; a peer's process has none, and does not load Numba."""
    if not contestants.ENTRIES[name].runs_our_kernels:
        return 0.0
    from factorbus.solver import compile_seconds

    return compile_seconds()


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
