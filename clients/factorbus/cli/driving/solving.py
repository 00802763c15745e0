"""What `factorbus solve` does: read, choose what counts, optimize, say, write."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorbus.cli.driving.columns import merged
from factorbus.cli.driving.replay_source import source_of
from factorbus.cli.output.console import print_note
from factorbus.cli.output.exits import USAGE, Stopped, output_file
from factorbus.cli.output.starts import NOT_CONVERGED
from factorbus.cli.output.tangents import named_sigmas, sigmas_of, tangent_document
from factorbus.cli.process.reading import COUNTED, GRAPHS, ROBOT_LOGS, say, told_of
from factorbus.proto.messages import Batch
from factorbus.proto.roles import poses_aside
from factorbus.proto.symbols import format_symbol
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.cli.driving.optimum import WorkerCores
    from factorbus.formats import FileNotes

_START = {"file": "values"}  # the solver's word
_WORDS = {"values": "file"}
_SHOWN = 10


@dataclass(frozen=True, slots=True)
class SolveRequest:
    """What the command line asked for.  covariance: a file to write, or keys."""

    file: Path
    out: Path | None = None
    start: str = "best"
    loss: tuple[str, float] | None = None
    gnc: bool = False
    probability: float = 0.99
    covariance: Path | tuple[int, ...] | None = None
    max_iterations: int = 500
    cores: int | None = None
    dialect: str | None = None
    strict: bool = False


def run_solve(request: SolveRequest) -> dict[str, Any]:
    """Do it, with progress on standard error; returns the document.  Raises Stopped, FormatError, SolverError."""
    from factorbus.cli.driving.optimum import WorkerCores, optimum_of, with_loss_on_loops, without_false
    from factorbus.formats import FileNotes, write_whole
    from factorbus.service.process.memory import available
    from factorbus.solver import BatchSearch

    seconds: dict[str, float] = {}
    source, graph = _timed(seconds, "read", lambda: _read(request))
    _check_keys(request, graph)
    result: dict[str, Any] = {"file": str(request.file), "read": source.summary(), **_sizes(graph)}
    if request.loss:
        graph, count = with_loss_on_loops(graph, *request.loss)
        print_note(
            f"{request.loss[0]} loss of scale {request.loss[1]:g} on {counted(count, 'factor')} that close loops"
        )
        result["loss"] = {"name": request.loss[0], "scale": request.loss[1], "factors": count}
    with WorkerCores(request.cores) as cores:
        if request.cores and request.cores > cores.cores:
            print_note(f"--cores {request.cores}: there are {cores.cores} here, all of which are used")
        search = BatchSearch(_START.get(request.start, request.start), request.max_iterations, False, available())
        events = _Said(cores, search.memory_limit_bytes or 0)
        if request.gnc:
            print_note("graduated non-convexity: first roughly, with all factors")
            graph, false = _timed(
                seconds, "gnc", lambda: without_false(graph, request.probability, search.memory_limit_bytes, events)
            )
            result["gnc"] = _told(false.suspects, false.rows, _of_one_variable(graph))
        found, solved = _timed(seconds, "search", lambda: optimum_of(graph, search, events))
    result |= {
        "starts": {_WORDS.get(name, name): chi2 for name, chi2 in found.starts.items()},
        "start": _WORDS.get(found.start, found.start),
        "chi2": found.chi2,
        "left": found.left,
        "iterations": found.iterations,
        "converged": found.converged,
        "memory_bytes": events.memory_bytes,
        "cores": cores.cores,
    }
    if not found.converged:
        print_note(f"{NOT_CONVERGED}; --max-iterations, or another --start")
    written, notes = _write(request.out, solved, source, request.strict) if request.out else ([], FileNotes())
    if request.covariance is not None:
        rows = _timed(seconds, "covariance", lambda: _covariances(solved, request.covariance))
        if isinstance(request.covariance, Path):
            with output_file(request.covariance):
                write_whole(request.covariance, _csv(rows))
            written.append(request.covariance)
        else:
            result["covariance"] = {name: block.tolist() for name, _, block in rows}
            result["covariance_kinds"] = {name: kind for name, kind, _ in rows}
            result["tangent"] = {kind: tangent_document(kind) for _, kind, _ in rows}
    return result | {"seconds": seconds, "written": [str(path) for path in written], **told_of(notes)}


def solution_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(what, how it was), for people."""
    starts = ", ".join(f"{name} {chi2:.6g}" for name, chi2 in result["starts"].items())
    rows = [
        ("graph", ", ".join(counted(result[many], one) for many, one in COUNTED)),
        ("starts, χ²", f"{starts}; taken: {result['start']}"),
        ("χ²", f"{result['chi2']:.10g}" + ("" if result["converged"] else f"  ({NOT_CONVERGED})")),
        ("iterations", str(result["iterations"])),
        ("time", ", ".join(f"{name} {took:.3f} s" for name, took in result["seconds"].items())),
    ]
    if gnc := result.get("gnc"):
        rows.append(("false", f"{len(gnc['false'])} of {counted(gnc['suspects'], 'factor')} that close loops"))
        rows += [
            (" ".join(each["keys"]), f"{each['kind']}, rᵀΩr {each['distance']:.4g}") for each in gnc["false"][:_SHOWN]
        ]
        if len(gnc["false"]) > _SHOWN:
            rows.append(("", f"and {len(gnc['false']) - _SHOWN} more (--json has all)"))
    for name, block in result.get("covariance", {}).items():
        rows.append((f"{name}, σ", named_sigmas(result["covariance_kinds"][name], sigmas_of(np.array(block)))))
    rows += [("written", path) for path in result["written"]]
    return rows


class _Said:
    """What the solver tells, on standard error; worker threads start once it is known how large the graph is."""

    def __init__(self, cores: "WorkerCores", limit: int) -> None:
        self._cores, self._limit, self.memory_bytes = cores, limit, 0

    def on_memory(self, memory_bytes: int) -> None:
        known, self.memory_bytes = self.memory_bytes, max(memory_bytes, self.memory_bytes)
        if memory_bytes <= known:
            return  # without the false factors: as said for all
        print_note(f"memory: {_megabytes(memory_bytes)} needed, {_megabytes(self._limit)} there")
        if memory_bytes <= self._limit:
            self._cores.start(memory_bytes)

    def on_starts(self, chi2: Mapping[str, float]) -> None:
        for name, each in chi2.items():
            print_note(f"start {_WORDS.get(name, name)}: χ² {each:.6g}")

    def on_iteration(self, start: str, iteration: int, chi2: float, damping: float) -> None:
        damped = f", damping {damping:.0e}" if damping else ""
        print_note(f"{_WORDS.get(start, start)} {iteration}: χ² {chi2:.10g}{damped}")


def _read(request: SolveRequest) -> tuple[Any, Batch]:
    """The file, and the whole graph with something that holds it.  Raises Stopped, FormatError, BadRecording."""
    from factorbus.cli.driving.replay_reading import read_steps
    from factorbus.formats import FormatError, GraphFile

    file = source_of(request.file)
    source, steps = read_steps(file, None, request.dialect, request.strict, use_values=False)
    graph = source.whole() if isinstance(source, GraphFile) else merged(steps)
    has_values = any(group.values is not None and not group.fixed for group in graph.variables)
    if request.start == "file" and not has_values:
        raise FormatError(str(file), None, "no value of a variable to start from", "vertices, or another --start")
    return source, graph


def _check_keys(request: SolveRequest, graph: Batch) -> None:
    """Raises Stopped: a covariance of what is not there."""
    if not isinstance(request.covariance, tuple):
        return
    there = np.concatenate([group.keys for group in graph.variables])
    if missing := [key for key in request.covariance if key not in there]:
        raise Stopped(
            "unknown_variable",
            f"--covariance: {request.file} has no variable {format_symbol(missing[0])}; keys are as in x5,l3, or "
            "numbers where the file has no letters",
            USAGE,
            key=missing[0],
        )


def _sizes(graph: Batch) -> dict[str, int]:
    kinds = [(group.kind, len(group.keys)) for group in graph.variables]
    return {
        "poses": sum(count for kind, count in kinds if kind in ("se2", "se3")) - len(poses_aside(graph)),
        "landmarks": sum(count for kind, count in kinds if kind in ("point2", "point3", "idp")),
        "factors": graph.factor_count,
    }


def _of_one_variable(graph: Batch) -> int:
    return sum(len(group.keys) for group in graph.factors if group.keys.shape[1] == 1)


def _told(suspects: int, rows: tuple[tuple[str, tuple[int, ...], float], ...], trusted: int) -> dict[str, Any]:
    if trusted:
        print_note(f"{counted(trusted, 'factor')} of one variable (priors, positions) trusted: see solve --help")
    print_note(f"graduated non-convexity: {len(rows)} of {counted(suspects, 'factor')} that close loops are false")
    false = [{"kind": kind, "keys": [format_symbol(key) for key in keys], "distance": s} for kind, keys, s in rows]
    return {"suspects": suspects, "false": false, "trusted": trusted}


def _covariances(graph: Batch, wanted: Path | tuple[int, ...] | None) -> list[tuple[str, str, Any]]:
    """(key, kind, covariance of its tangent), of some variables, or of all that are free."""
    from factorbus.cli.driving.local import covariances_at

    kinds = {key: group.kind for group in graph.variables for key in group.keys.tolist()}
    if isinstance(wanted, tuple):
        keys = np.array(wanted, np.int64)
    else:
        keys = np.concatenate([np.empty(0, np.int64), *(g.keys for g in graph.variables if not g.fixed)])
    found = covariances_at(graph, keys)
    return [(format_symbol(key), kinds[key], found[key]) for key in keys.tolist()]


def _csv(rows: list[tuple[str, str, Any]]) -> str:
    """A line for each variable: its key, its kind, the upper triangle of its covariance row by row."""
    lines = ["key,kind,upper_triangle"]
    for name, kind, block in rows:
        upper = block[np.triu_indices(len(block))]
        lines.append(",".join([name, kind, *(f"{number:.9g}" for number in upper)]))
    return "\n".join(lines) + "\n"


def _write(out: Path, graph: Batch, source: Any, strict: bool) -> tuple[list[Path], "FileNotes"]:
    """The files, and what was left out of them.  Raises Stopped, FormatError."""
    from factorbus.formats import FileNotes, tum_notes, write_graph, write_kitti, write_tum

    with output_file(out):
        if out.suffix in GRAPHS:
            ids = source.numbering if getattr(source, "numbering", "ids") != "ids" else "auto"
            log = getattr(source, "log", None)
            kept = replace(log, labels=()) if log and out.suffix in ROBOT_LOGS else None
            notes, files = write_graph(out, graph, strict, ids, kept), [out]
        else:
            kitti = out.suffix == ".kitti"
            files = (write_kitti if kitti else write_tum)(out, Batch(graph.variables))
            notes = FileNotes() if kitti else tum_notes(graph, None)
    say(out, notes)
    if files != [out]:
        print_note(f"{out}: one file for each robot: {', '.join(map(str, files))}")
    return files, notes


def _timed(seconds: dict[str, float], name: str, work: Callable[[], Any]) -> Any:
    begun = time.perf_counter()
    done = work()
    seconds[name] = time.perf_counter() - begun
    return done


def _megabytes(size: int) -> str:
    return f"{size / 2**20:.0f} MiB"
