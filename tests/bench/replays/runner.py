"""Jobs one after another, each in a process of its own on one core; what is done is kept on disk and not done again."""

import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import factorbus.solver

from .contestants import ISAM2, ISAM2_ALONE, OURS, RIVAL, Entry
from .problems import Problem, fingerprint
from .samples import Sampling

_HERE = Path(__file__).parent
# What a run's numbers depend on in this package.
_MACHINERY = ("child", "chi2", "clock", "collector", "columns", "compose", "contestants", "samples")
_REFERENCE = ("reference", "chi2", "columns", "samples")
_FILL = ("fill", "columns")
_MEASURES = {
    "growth": ("growth", "memory"),
    "cores": ("cores",),
    "full_pass": ("full_pass",),
    "overhead": ("overhead",),
    "over_bus": ("over_bus",),
}
_GRACE_S = 600  # wall seconds on top of twice the limit, before a run that does not answer is ended
Progress = Callable[[int, str], None]


class Crashed(Exception):
    """A job's process ended without a result."""


EVERYWHERE = Sampling()


@dataclass(frozen=True, slots=True)
class Settings:
    """Of all runs.  folder: where results are kept.  sampling: steps at which χ² is looked at.  limit_s: of solver CPU
    time a run.  fresh: measure again what is there."""

    folder: Path
    core: int | None
    sampling: Sampling = EVERYWHERE
    limit_s: float = 1800.0
    fresh: bool = False


def run_replay(
    settings: Settings, problem: Problem, entry: Entry, repetition: int, progress: Progress
) -> dict[str, Any]:
    """One replay, measured or remembered.  A crash comes back as a run of status "crashed", and is not remembered."""
    name = f"{entry.name}.{repetition}.{_run_key(settings, problem, entry)}.json"
    path = settings.folder / "runs" / problem.key / name
    kept = _kept(path, settings)
    if kept is not None and not (kept["status"] == "limit" and kept["limit_s"] < settings.limit_s):
        return kept
    job = {"kind": "replay", "contestant": entry.name, "limit_s": settings.limit_s}
    try:
        run = _do(settings, problem, job, progress, wall_s=2 * settings.limit_s + _GRACE_S)
        if run["compiled_s"] > 0:  # a kernel that warm() does not know was compiled on the clock; now it is on disk
            run = _do(settings, problem, job, progress, wall_s=2 * settings.limit_s + _GRACE_S)
    except Crashed as problem_seen:
        return {"contestant": entry.name, "status": "crashed", "reason": str(problem_seen), "chi2": [], "facts": {}}
    run["versions"] = {**entry.versions(), "python": platform.python_version()}
    _keep(path, run)
    return run


def run_quality(settings: Settings, problem: Problem, entry: Entry, progress: Progress) -> dict[str, Any]:
    """χ² of its estimates at the samples, in a replay of its own.  Raises Crashed."""
    path = settings.folder / "quality" / problem.key / f"{entry.name}.{_run_key(settings, problem, entry)}.json"
    kept = _kept(path, settings)
    if kept is None:
        job = {"kind": "quality", "contestant": entry.name}
        kept = _do(settings, problem, job, progress, wall_s=4 * settings.limit_s + _GRACE_S)
        _keep(path, kept)
    return kept


def run_reference(settings: Settings, problem: Problem, progress: Progress) -> dict[str, Any]:
    """The optima at the samples, and under "values" the file with the map at the end.  Raises Crashed."""
    return _remembered(settings, problem, "reference", _REFERENCE, {}, progress)


def run_fill(settings: Settings, problem: Problem, pixels: int, progress: Progress) -> dict[str, Any]:
    """The numbers of `fill.orderings`, and under "values" the file with the pictures.  Raises Crashed."""
    return _remembered(settings, problem, "fill", _FILL, {"pixels": pixels}, progress)


def run_measure(
    settings: Settings, problem: Problem, kind: str, more: dict[str, Any], repetition: int, progress: Progress
) -> dict[str, Any]:
    """One of the other measures of our solver (`child` has them by `kind`), or what was remembered.  Raises Crashed."""
    said = [fingerprint(problem), more, _cpu_model(), platform.python_version(), *_solver()]
    key = _hash([*said, *_sources(("child", *_MEASURES[kind]))])
    path = settings.folder / kind / f"{problem.key}.{repetition}.{key}.json"
    kept = _kept(path, settings)
    if kept is None:
        kept = _do(settings, problem, {"kind": kind, **more}, progress, wall_s=4 * settings.limit_s + _GRACE_S)
        _keep(path, kept)
    return kept


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "load_average": os.getloadavg(),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


def pick_core() -> int | None:
    """The last core this process may use; None where the system has no such call."""
    return max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None


def _remembered(
    settings: Settings, problem: Problem, kind: str, sources: tuple[str, ...], more: dict[str, Any], progress: Progress
) -> dict[str, Any]:
    key = _hash(
        [fingerprint(problem), settings.sampling.as_json() if kind == "reference" else 0, more, *_sources(sources)]
    )
    path = settings.folder / kind / f"{problem.key}.{key}.json"
    values = path.with_suffix(".npz")
    kept = _kept(path, settings) if values.is_file() else None
    if kept is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = _do(settings, problem, {"kind": kind, "values": str(values), **more}, progress, wall_s=7200)
        _keep(path, kept)
    return {**kept, "values": str(values)}


def _do(settings: Settings, problem: Problem, job: dict[str, Any], progress: Progress, wall_s: float) -> dict[str, Any]:
    """The result of a job in a child process.  Raises Crashed."""
    job = {**job, "problem": problem.as_json(), "sampling": settings.sampling.as_json(), "core": settings.core}
    paths = os.pathsep.join(filter(None, (str(_HERE.parents[1]), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONUNBUFFERED": "1"}
    for library in ("OPENBLAS", "OMP", "MKL"):  # kernels have no threads, and with NUMBA_ settings they are others
        environment[f"{library}_NUM_THREADS"] = "1"
    with tempfile.TemporaryDirectory() as folder, open(Path(folder) / "said", "w+") as said:
        order = Path(folder) / "job.json"
        order.write_text(json.dumps(job))
        command = [sys.executable, "-m", "bench.replays.child", str(order)]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=said, text=True, env=environment)
        watchdog = threading.Timer(wall_s, child.kill)
        watchdog.start()
        try:
            result = _listen(child, progress)
            code = child.wait()
        finally:
            watchdog.cancel()
            child.kill()
            child.wait()
            if child.stdout:
                child.stdout.close()
        if result is None or code:
            said.seek(0)
            last = " | ".join(line.strip() for line in said.read().splitlines()[-3:])
            raise Crashed(f"exit code {code}{': ' + last if last else ''}"[:400])
    return result


def _listen(child: "subprocess.Popen[str]", progress: Progress) -> dict[str, Any] | None:
    result = None
    for line in child.stdout or ():
        message = json.loads(line)
        if "result" in message:
            result = message["result"]
        else:
            progress(message["done"], f"{message['cpu_s']:.1f} s" if "cpu_s" in message else "")
    return result


def _run_key(settings: Settings, problem: Problem, entry: Entry) -> str:
    said: list[Any] = [
        fingerprint(problem),
        entry.versions(),
        entry.settings,
        settings.sampling.as_json(),
        _cpu_model(),
    ]
    isam2 = ("isam2", "gtsam_factors")
    own = {OURS: ("ours",), RIVAL: ("gn_loop",), ISAM2: isam2, ISAM2_ALONE: isam2}.get(entry.solver, ("g2o_batch",))
    said += [platform.python_version(), *_sources((*_MACHINERY, *own))]
    if entry.runs_our_kernels:
        said += _solver()
    return _hash(said)


def _solver() -> list[str]:
    """What our solver's numbers depend on."""
    folder = Path(factorbus.solver.__file__).parent
    sources = [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.rglob("*.py"))]
    return [*sources, metadata.version("scipy")]


def _sources(names: tuple[str, ...]) -> list[str]:
    return [hashlib.sha256((_HERE / f"{name}.py").read_bytes()).hexdigest() for name in names]


def _hash(said: list[Any]) -> str:
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:12]


def _kept(path: Path, settings: Settings) -> dict[str, Any] | None:
    """What is on disk; with `fresh` only what this very run of the benchmark has written."""
    if not path.is_file() or (settings.fresh and path.stat().st_mtime < _STARTED):
        return None
    return json.loads(path.read_text())


def _keep(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    half = path.with_suffix(".part")
    half.write_text(json.dumps(content))
    half.replace(path)


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


_STARTED = time.time()
