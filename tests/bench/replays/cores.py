"""What another core brings for the longest steps: a simulated drive through two solvers in turn, one of them with it.

By the clock, as a robot waits: stage, step and `changed`.  Both get the same steps, a stretch of them at a time, and
who was first is second the next time.
"""

import gc
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import islice
from typing import Any

import numpy as np

from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver, warm
from factorbus.solver.sparse.worker_threads import WorkerThread

from .clock import percentiles
from .feed import fed
from .problems import Problem

_STRETCH = 100  # steps
_LONGEST = 0.01  # of them


def cores(job: dict[str, Any], problem: Problem, tell: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """alone, together: p50, p95, p99, max (ms); longest: mean of the longest steps alone, and of the same together."""
    if job["cores"] < 2:
        return {"status": "failed", "reason": "there is one core for this process"}
    warm()
    solvers = [Solver(Options(mode=job["mode"])) for _ in range(2)]
    seconds: tuple[list[float], list[float]] = ([], [])
    gc.collect()
    gc.disable()
    try:
        with fed(problem) as steps:
            for k, stretch in enumerate(iter(lambda: tuple(islice(steps, _STRETCH)), ())):
                for with_worker in (k % 2, 1 - k % 2):
                    with worker_core() if with_worker else nullcontext():
                        seconds[with_worker].extend(_drive(solvers[with_worker], stretch))
                tell({"done": len(seconds[0])})
    finally:
        gc.enable()
    one, two = (1e3 * np.array(each) for each in seconds)
    longest = np.argsort(-one)[: max(int(_LONGEST * len(one)), 1)]
    return {
        "status": "done",
        "reason": "",
        "poses": len(one),
        "alone": percentiles(one / 1e3),
        "together": percentiles(two / 1e3),
        "longest": {"steps": len(longest), "alone": float(one[longest].mean()), "together": float(two[longest].mean())},
        "same_bits": _bits(solvers[0]) == _bits(solvers[1]),
        "measured_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


@contextmanager
def worker_core() -> Iterator[None]:
    """A worker thread runs meanwhile."""
    worker = WorkerThread()
    thread = threading.Thread(target=worker.run)
    thread.start()
    try:
        yield
    finally:
        worker.leave()
        thread.join()


def _drive(solver: Solver, steps: tuple[Batch, ...]) -> Iterator[float]:
    for batch in steps:
        start = time.perf_counter()
        solver.stage(batch)
        solver.step()
        solver.changed()
        yield time.perf_counter() - start


def _bits(solver: Solver) -> list[bytes]:
    return [each.values.tobytes() for each in solver.estimate()]
