"""Whole graphs, from file values, composed odometry or values given, by ours and by other libraries.

    factorbus bench batch [--quick] [--only NAME,...] [--solvers NAME;...] [--repetitions N] [--seed N] [--page FILE]
                          [--json]

Everyone gets the same graph with the same values in memory; reading and making a library's own objects are not on the
clock, ordering is.  In one process on one core, the solvers in turn, the least of --repetitions; CPU and wall seconds.

    factorbus              as `factorbus solve`: from the start given, composed odometry or averaged rotations
    factorbus, this start  from the start given and no other
    gtsam lm, gtsam gn     Levenberg-Marquardt and Gauss-Newton, multifrontal Cholesky; `gtsam lm, qr`: when asked for
    g2o lm, g2o gn         Eigen's sparse Cholesky, which is what its wheel has

χ² is that of the end of each in g2o's convention; own_chi2 that of GTSAM's factors, whose residuals are other ones.
Simulated worlds are drawn anew at every run (--seed N draws them again): streets of 10,000 and 100,000 poses, a sphere
of 10,000, a sphere and a torus of 2,500 with so much noise in their rotations, 0.2 rad, that odometry leads nowhere,
and bundle adjustment: 300 cameras and 5,000 points, pixels with 1 px of noise, from values 5 cm, 1° and 10 cm off.

A solver that takes more than 20 s runs once.

Held against: of `factorbus` the lowest χ² of all to 1e-6, on every graph from every start; of `factorbus, this start`,
which begins where the others do, less CPU time than every other whose χ² is within 1 % of the lowest, where its own is;
in the geometric mean a third of that of `gtsam lm`.  The exit code is 1 where one is missed.
"""

import argparse
import json
import os
import platform
import secrets
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.batch_page import ELSEWHERE, page
from bench.batch_solvers import BATCH_SOLVERS, OURS, OURS_ALONE, PEER, BatchSolver, chi2_at_end
from bench.bundle_world import bundle
from bench.replays.contestants import Failed
from bench.replays.problems import ALL, choose, file_of
from bench.replays.runner import machine, pick_core
from bench.replays.worlds import batches, torus

from factorbus.cli.driving.columns import merged
from factorbus.formats import read
from factorbus.proto.messages import Batch, Variables
from factorbus.simulate import Spiral, manhattan, sphere
from factorbus.solver import Options, Solver, chi2_at

_LOWEST, _MEAN = 1e-6, 3.0
_LONG_S = 20.0
_THERE = ELSEWHERE  # an end below this, in χ² of the lowest, is the optimum, perhaps of a slightly different sum
_ON_REQUEST = ("gtsam lm, qr",)
_QUICK_SETS = ("intel", "manhattan3500", "killian")
_NOISY_RAD = 0.2  # about each axis, from a pose to the next
_NOISY = np.array([0.1] * 3 + [_NOISY_RAD / 2] * 3)  # metres, and the vector part of a quaternion: half the angle
DRIVES: dict[str, tuple[int, Callable[[int, int], Iterator[Batch]]]] = {
    "streets": (10_000, lambda poses, seed: batches(manhattan(poses, seed))),
    "streets-large": (100_000, lambda poses, seed: batches(manhattan(poses, seed))),
    "sphere": (10_000, lambda poses, seed: batches(sphere(poses, seed, spiral=Spiral(100, 100)))),
    "sphere-noisy": (2_500, lambda poses, seed: batches(sphere(poses, seed, sigma_rotation_rad=_NOISY_RAD))),
    "torus-noisy": (2_500, lambda poses, seed: torus(poses, seed, _NOISY)),
}
BUNDLES: dict[str, tuple[int, Callable[[int, int], Batch]]] = {"bundle": (300, bundle)}
_QUICK_WORLDS = {"streets": 2_000, "sphere-noisy": 500, "torus-noisy": 500, "bundle": 60}


@dataclass(frozen=True, slots=True)
class Started:
    """A graph with values for all, and what these are: "file", "odometry" or "given"."""

    dataset: str
    start: str
    graph: Batch


def main() -> int:
    """Measure, print; 1 where a bar is missed."""
    told = _options()
    if (core := pick_core()) is not None:
        os.sched_setaffinity(0, {core})
    solvers, notes = _solvers(told.solvers)
    rows = []
    for started in graphs(told.quick, told.only, told.seed):
        here = measured(started, solvers, told.repetitions or (1 if told.quick else 5))
        print("\n".join(map(line_of, here)), file=sys.stderr, flush=True)  # as it comes: all takes its time
        rows += here
    verdicts = judged(rows)
    result = {"machine": machine(), "python": platform.python_version(), "seed": told.seed, "notes": notes}
    result |= {"rows": rows, "targets": verdicts, "best_of_starts": all_starts(rows)}
    if told.page:
        Path(told.page).write_text(page(result, _measured_by()))
    print(json.dumps(result, indent=1) if told.json else text(result))
    return 0 if all(each["met"] for each in verdicts) else 1


def graphs(quick: bool, only: Sequence[str], seed: int) -> Iterator[Started]:
    """The public data sets that are here, and worlds."""
    chosen, _ = choose(False, ALL)
    for problem in chosen:
        if (only and problem.name not in only) or problem.is_world or (quick and problem.name not in _QUICK_SETS):
            continue
        graph = read(file_of(problem.name)).whole()
        yield Started(problem.name, "odometry", composed(graph))
        if all(group.values is not None for group in graph.variables):
            yield Started(problem.name, "file", graph)
    for name, (size, world) in (DRIVES | BUNDLES).items():
        if (only and name not in only) or (quick and name not in _QUICK_WORLDS):
            continue
        size = _QUICK_WORLDS[name] if quick else size
        made = world(size, seed)
        if isinstance(made, Batch):
            yield Started(f"{name}-{size}", "given", made)
        else:
            yield Started(f"{name}-{size}", "odometry", composed(merged([*islice(made, size)])))


def composed(graph: Batch) -> Batch:
    """The same with every free variable as the factors compose it."""
    bare = [group if group.fixed else Variables(group.kind, group.keys) for group in graph.variables]
    solver = Solver(Options(mode="inc-l", max_iterations=0))
    solver.stage(Batch(tuple(bare), graph.factors))
    solver.step()
    return Batch(tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in solver.estimate()), graph.factors)


def measured(started: Started, solvers: Sequence[BatchSolver], repetitions: int) -> list[dict[str, Any]]:
    """A row for each solver; the solvers take turns."""
    graph, best, ready = started.graph, dict[str, dict[str, Any]](), {}
    at_start = chi2_at(graph.variables, graph.factors, graph.variables)
    for solver in solvers:
        row = {"dataset": started.dataset, "start": started.start, "solver": solver.name, "status": "done"}
        row |= {"chi2_start": at_start, "cpu_s": inf, "wall_s": inf, "iterations": 0, "chi2": inf, "own_chi2": None}
        best[solver.name] = row | {"versions": {solver.package: solver.version}, "repetitions": repetitions}
        try:
            ready[solver.name] = solver.prepare(graph)
        except Failed as problem:
            best[solver.name]["status"] = f"failed: {problem}"
    for repetition in range(repetitions + 1):  # the first loads kernels, and is not counted
        for name, prepared in list(ready.items()):
            prepared.reset()
            wall, cpu = time.perf_counter(), time.process_time()
            try:
                end = prepared.run()
            except Failed as problem:
                best[name]["status"] = f"failed: {problem}"
                del ready[name]
                continue
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            row, once = best[name], cpu > _LONG_S
            if repetition == 0:
                row |= {"iterations": end.iterations, "chi2": chi2_at_end(graph, end), "own_chi2": end.own_chi2}
            if once:
                row["repetitions"] = 1
                del ready[name]
            if repetition > 0 or once:
                row |= {"cpu_s": min(row["cpu_s"], cpu), "wall_s": min(row["wall_s"], wall)}
    return [
        row if row["status"] == "done" else row | {"cpu_s": None, "wall_s": None, "chi2": None} for row in best.values()
    ]


def judged(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What was held against it, what was seen, and whether that is met."""
    verdicts, ratios = [], []
    for ours in (row for row in rows if row["solver"] == OURS):
        alone = next((row for row in rows if _is_beside(row, ours) and row["solver"] == OURS_ALONE), ours)
        here = [row for row in rows if _is_beside(row, ours)]
        done = [row for row in here if row["status"] == "done"]
        where = f"{ours['dataset']}, {ours['start']}"
        lowest = min(row["chi2"] for row in done)
        seen = ours["chi2"] / lowest - 1.0 if lowest > 0.0 else 0.0
        verdicts.append({"what": f"{where}: lowest χ² to 1e-6", "seen": f"{seen:.1e} above", "met": seen <= _LOWEST})
        for row in done:
            if row["solver"].startswith(OURS) or max(row["chi2"], alone["chi2"]) > _THERE * lowest:
                continue
            ratio = row["cpu_s"] / alone["cpu_s"]
            verdicts.append(
                {"what": f"{where}: faster than {row['solver']}", "seen": f"{ratio:.2f}", "met": ratio > 1.0}
            )
            if row["solver"] == PEER:
                ratios.append(ratio)
    if ratios:
        mean = float(np.exp(np.mean(np.log(ratios))))
        what = f"{PEER} over ours, geometric mean of {len(ratios)}"
        verdicts.append({"what": what, "seen": f"{mean:.2f}", "met": mean >= _MEAN})
    return verdicts


def all_starts(rows: Sequence[dict[str, Any]]) -> float:
    """How many times as long `gtsam lm` takes as ours from the best of three starts, in the geometric mean."""
    pairs = [(row, ours) for row in rows for ours in rows if _is_beside(row, ours) and ours["solver"] == OURS]
    told = [
        row["cpu_s"] / ours["cpu_s"]
        for row, ours in pairs
        if row["solver"] == PEER and row["status"] == "done" and row["chi2"] <= _THERE * ours["chi2"]
    ]
    return float(np.exp(np.mean(np.log(told)))) if told else 0.0


def _is_beside(row: dict[str, Any], other: dict[str, Any]) -> bool:
    return (row["dataset"], row["start"]) == (other["dataset"], other["start"])


def text(result: dict[str, Any]) -> str:
    """A table, and the bars that were missed."""
    lines = [
        *result["notes"],
        "| graph | start | solver | cpu | wall | iterations | χ² |",
        "|---|---|---|---:|---:|---:|---:|",
    ]
    lines += map(line_of, result["rows"])
    missed = [f"missed: {each['what']} ({each['seen']})" for each in result["targets"] if not each["met"]]
    met = len(result["targets"]) - len(missed)
    mean = [f"{each['what']}: {each['seen']}" for each in result["targets"][-1:]]
    mean.append(f"and over ours from the best of three starts: {result['best_of_starts']:.2f}")
    return "\n".join([*lines, "", *mean, f"{met} of {len(result['targets'])} bars met, seed {result['seed']}", *missed])


def line_of(row: dict[str, Any]) -> str:
    """A row of the table."""
    told = [row["dataset"], row["start"], row["solver"]]
    if row["status"] == "done":
        told += [f"{1e3 * row['cpu_s']:.1f} ms", f"{1e3 * row['wall_s']:.1f} ms", str(row["iterations"])]
        told.append(f"{row['chi2']:.9g}")
    else:
        told += [row["status"], "", "", ""]
    return f"| {' | '.join(told)} |"


def _solvers(names: Sequence[str]) -> tuple[list[BatchSolver], list[str]]:
    """Those that are asked for and here, and a line for each that is not here."""
    wanted = [each for each in BATCH_SOLVERS if (each.name in names if names else each.name not in _ON_REQUEST)]
    if unknown := sorted(set(names) - {each.name for each in BATCH_SOLVERS}):
        sys.exit(f"--solvers {','.join(unknown)}: there are {'; '.join(each.name for each in BATCH_SOLVERS)}")
    absent = [f"Not measured: {each.name} ({each.package} is not installed)." for each in wanted if each.missing]
    return [each for each in wanted if not each.missing], absent


def _measured_by() -> list[str]:
    """The arguments, but for where the page went."""
    words = sys.argv[1:]
    return [word for n, word in enumerate(words) if "--page" not in (word, words[n - 1] if n else "")]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    listed = lambda text: [word.strip() for word in text.split(",") if word.strip()]  # noqa: E731
    solvers = lambda text: [word.strip() for word in text.split(";") if word.strip()]  # noqa: E731
    parser.add_argument("--quick", action="store_true", help="three small data sets and four small worlds: two minutes")
    parser.add_argument("--only", type=listed, default=[], metavar="NAME,...", help="these data sets and worlds")
    parser.add_argument("--solvers", type=solvers, default=[], metavar="NAME;...", help="these solvers")
    parser.add_argument("--repetitions", type=int, default=0, metavar="N", help="of each; the least counts (5)")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6) + 1, metavar="N", help="of the worlds")
    parser.add_argument("--page", metavar="FILE", help="the page of the docs with whole graphs, to FILE")
    parser.add_argument("--json", action="store_true", help="print the document")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
