"""What Python adds to the compiled calls of a step, and what a start costs.

Per step: the time of stage and step together, less the time inside compiled calls.  For a step that is what the report
says in `compiled_ms`, where the solver measures it itself.  All others, admission among them, are timed from outside,
so that turning Python's arguments into theirs counts as inside, and the overhead is a lower bound.  Both by the
monotonic clock, whose reading costs 30 ns; medians do not see when another process gets the core.

A start: a new process until its first step is done, with the kernels on disk; and, on request, with an empty cache.
"""

import gc
import importlib
import os
import pkgutil
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

import factorbus.solver
from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver, warm

from .problems import Problem, load

_FIRST_STEP = """
import sys
import numpy as np
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver, compile_seconds
ends = np.array([[0, 1], [1, 2], [0, 2]])
measured = np.array([[1.0, 0.0, 0.1], [1.0, 0.0, 0.1], [2.1, 0.1, 0.2]])
information = np.tile([100.0, 0.0, 0.0, 100.0, 0.0, 400.0], (3, 1))
start = Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True)
solver = Solver(Options(mode=sys.argv[1]))
batch = Batch((start, Variables("se2", np.array([1, 2]))), (Factors("between_se2", ends, measured, information),))
solver.stage(batch)
assert solver.step().iterations > 0
print(compile_seconds())
"""
_STARTS = 5
_STEP = "tree_step"


def overhead(job: dict[str, Any], problem: Problem, tell: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """step: microseconds by kind of step; start: seconds; cold: seconds, when job["cold"]."""
    warm()
    steps = load(problem)
    drive(job["mode"], steps[:100], _nothing_inside)
    with timed_calls() as inside:
        found = drive(job["mode"], steps, inside, lambda k: tell({"done": k}))
    return {"step": found, "start": starts(job["mode"]), "cold": cold_compile() if job["cold"] else None}


def starts(mode: str) -> dict[str, float]:
    """Medians of a few: CPU and wall seconds of a process that makes one step, of a small loop; compiled_s: in it."""
    rows = [_timed([sys.executable, "-c", _FIRST_STEP, mode], dict(os.environ)) for _ in range(_STARTS)]
    return {
        "cpu_s": float(np.median([row[0] for row in rows])),
        "wall_s": float(np.median([row[1] for row in rows])),
        "compiled_s": max(float(row[2]) for row in rows),
    }


def cold_compile() -> dict[str, Any]:
    """`factorbus warm` with an empty cache: seconds, and the lines that announce what it does."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "FACTORBUS_CACHE": folder}
        cpu_s, wall_s, said = _timed([sys.executable, "-m", "factorbus.cli", "warm"], environment)
    lines = said.splitlines()
    return {"cpu_s": cpu_s, "wall_s": wall_s, "announced": lines[:-1], "said": lines[-1] if lines else ""}


@contextmanager
def timed_calls() -> Iterator[Callable[[Any], float]]:
    """Within it, a function that gives the seconds spent in compiled calls since it was asked last."""
    spent = [0, 0]
    replaced = []
    for module in python_modules():
        for name, function in list(vars(module).items()):
            if getattr(function, "factorbus_signatures", ()):
                replaced.append((module, name, function))
                setattr(module, name, _timing(function, spent, int(name == _STEP)))

    def inside(report: Any) -> float:
        others, in_step = spent[0] / 1e9, spent[1] / 1e9
        spent[:] = 0, 0
        measured = getattr(report, "compiled_ms", None)
        return others + (in_step if measured is None else measured / 1e3)

    try:
        yield inside
    finally:
        for module, name, function in replaced:
            setattr(module, name, function)


def drive(
    mode: str, steps: Sequence[Batch], inside: Callable[[Any], float], tell: Callable[[int], None] = lambda _: None
) -> dict[str, Any]:
    solver, rows = Solver(Options(mode=mode, clock=time.perf_counter)), np.zeros((len(steps), 2))
    own = False
    gc.collect()
    gc.disable()
    try:
        for k, batch in enumerate(steps):
            inside(None)
            start = time.perf_counter()
            solver.stage(batch)
            report = solver.step()
            rows[k] = time.perf_counter() - start, inside(report)
            own = getattr(report, "compiled_ms", None) is not None
            tell(k + 1)
    finally:
        gc.enable()
    # A step with as many factors as free variables closes no loop.
    odometry = np.array([0 < b.factor_count <= b.variable_count for b in steps])
    return {
        "by": "the solver's own account" if own else "timing the compiled calls from outside",
        "all": _split(rows),
        "odometry": _split(rows[odometry]),
    }


def _split(seconds: np.ndarray) -> dict[str, float]:
    """Medians in microseconds."""
    total, inside = (float(np.median(column)) * 1e6 for column in seconds.T)
    outside = float(np.median(seconds[:, 0] - seconds[:, 1])) * 1e6
    return {"steps": len(seconds), "total_us": total, "inside_us": inside, "outside_us": outside}


def _nothing_inside(_report: Any) -> float:
    return 0.0


def _timing(function: Callable[..., Any], spent: list[int], which: int) -> Callable[..., Any]:
    def call(*arguments: Any) -> Any:
        start = time.perf_counter_ns()
        found = function(*arguments)
        spent[which] += time.perf_counter_ns() - start
        return found

    return call


def python_modules() -> Iterator[Any]:
    """Modules of the solver that call kernels, not those that define them."""
    for entry in pkgutil.iter_modules(factorbus.solver.__path__):
        if not entry.ispkg:
            yield importlib.import_module(f"factorbus.solver.{entry.name}")


def _timed(command: list[str], environment: dict[str, str]) -> tuple[float, float, str]:
    """(CPU seconds, wall seconds, what it said) of a process that must succeed."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    ran = subprocess.run(
        command, env=environment, check=True, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    wall_s, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, wall_s, ran.stdout
