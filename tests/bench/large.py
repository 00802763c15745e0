"""Whole graphs from 10,000 to 1,000,000 poses: time, memory, and how they grow.

    factorbus bench large [--poses N,...] [--seed N] [--peer-up-to N] [--cores N] [--page=FILE] [--json]

Streets, drawn anew at every run (--seed N draws them again), each in a process of its own: the graph in memory, without
values, to the optimum in memory, as `factorbus solve` finds it from composed odometry and averaged rotations, with
worker threads on as many cores as there are.  Memory: the most that was resident, less what the graph took before;
said: what `factorbus solve` says beforehand.  Up to --peer-up-to poses GTSAM's Levenberg-Marquardt (multifrontal
Cholesky) begins at the same averaged rotations, which are not on its clock.

The exponent is the slope of log time over log poses, from the smallest graph to the largest.  Held against: an exponent
of wall time of at most 1.25, an end where another step takes off less than 1e-6 of χ², and GTSAM's time.  The exit code
is 1 where one is missed.
"""

import argparse
import json
import math
import os
import resource
import secrets
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.batch import composed
from bench.batch_solvers import BATCH_SOLVERS, PEER
from bench.replays.contestants import Failed
from bench.replays.runner import machine

from factorbus.cli.driving.columns import merged
from factorbus.cli.driving.optimum import WorkerCores
from factorbus.proto.messages import Batch, Variables
from factorbus.simulate import manhattan
from factorbus.solver import BatchSearch, solve_batch
from factorbus.solver.starts.search import NoEvents

_MOST_EXPONENT, _LEFT, _THERE = 1.25, 1e-6, 1.01
_WORDS = """Streets without values, in memory, to their optimum in memory, as `factorbus solve` finds it: from averaged
rotations or composed odometry, whichever is better, both found on the way. Memory is what it takes beside the graph;
*said* is what `factorbus solve` says beforehand, with the graph. GTSAM's Levenberg-Marquardt (multifrontal
Cholesky) begins at the same averaged rotations, which are not on its clock."""
_SMALL = 30_000  # poses up to which a time is the least of three


class _Lending(NoEvents):
    """Cores once the size is known, as `factorbus solve` has it; how much memory is said."""

    def __init__(self, cores: WorkerCores) -> None:
        self._cores, self.said = cores, 0

    def on_memory(self, memory_bytes: int) -> None:
        self.said = memory_bytes
        self._cores.start(memory_bytes)


def main() -> int:
    """Measure, print; 1 where a bar is missed."""
    told = _options()
    if told.one:
        print(json.dumps(one(told.one, told.seed, told.cores, told.peer_up_to)))
        return 0
    rows = []
    for poses in told.poses:
        words = [sys.executable, __file__, "--one", str(poses), "--seed", str(told.seed)]
        words += ["--peer-up-to", str(told.peer_up_to), *(["--cores", str(told.cores)] if told.cores else [])]
        rows.append(json.loads(subprocess.run(words, check=True, stdout=subprocess.PIPE).stdout))
        print(line_of(rows[-1]), file=sys.stderr, flush=True)  # as it comes
    result = {"machine": machine(), "seed": told.seed, "versions": versions(), "rows": rows, "growth": growth(rows)}
    result["targets"] = judged(rows, result["growth"])
    if told.page:
        Path(told.page).write_text(page(result, [word for word in sys.argv[1:] if not word.startswith("--page")]))
    print(json.dumps(result, indent=1) if told.json else text(result))
    return 0 if all(each["met"] for each in result["targets"]) else 1


def one(poses: int, seed: int, cores: int | None, peer_up_to: int) -> dict[str, Any]:
    """A row."""
    graph = merged([step.batch for step in islice(manhattan(poses, seed), poses)])
    bare = tuple(group if group.fixed else Variables(group.kind, group.keys) for group in graph.variables)
    row: dict[str, Any] = {"poses": poses, "factors": graph.factor_count, "wall_s": math.inf, "cpu_s": math.inf}
    solve_batch(*_tiny(seed))  # loads the kernels
    before = _resident()
    for _ in range(3 if poses <= _SMALL else 1):
        with WorkerCores(cores) as lent:
            events = _Lending(lent)
            wall, cpu = time.perf_counter(), time.process_time()
            found = solve_batch(bare, graph.factors, BatchSearch(polish=False), events)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        row |= {"wall_s": min(row["wall_s"], wall), "cpu_s": min(row["cpu_s"], cpu), "cores": lent.cores}
    row |= {"memory_bytes": _resident() - before, "said_bytes": events.said, "chi2": found.chi2, "left": found.left}
    row |= {"start": found.start, "iterations": found.iterations, "converged": found.converged, "starts": found.starts}
    return row | (_peer(Batch(bare, graph.factors)) if poses <= peer_up_to else {})


def _peer(graph: Batch) -> dict[str, Any]:
    """GTSAM's Levenberg-Marquardt from averaged rotations; nothing where it is not installed."""
    solver = next(each for each in BATCH_SOLVERS if each.name == PEER)
    if solver.missing:
        return {}
    begun = solve_batch(graph.variables, graph.factors, BatchSearch("rotations", max_iterations=0))
    values = tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in begun.values)
    prepared = solver.prepare(composed(graph)._replace(variables=values))
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        end = prepared.run()
    except Failed as problem:
        return {"gtsam": str(problem)}
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {"gtsam_wall_s": wall, "gtsam_cpu_s": cpu, "gtsam_chi2": end.own_chi2, "gtsam_iterations": end.iterations}


def _tiny(seed: int) -> tuple[Sequence[Any], Sequence[Any]]:
    graph = merged([step.batch for step in islice(manhattan(50, seed), 50)])
    return graph.variables, graph.factors


def _resident() -> int:
    """The most that this process has had resident, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def growth(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Exponents of CPU time, wall time and memory from the smallest graph to the largest; empty for one graph."""
    least, most = rows[0], rows[-1]
    if least["poses"] == most["poses"]:
        return {}
    wide = math.log(most["poses"] / least["poses"])
    return {name: math.log(most[name] / max(least[name], 1e-9)) / wide for name in ("cpu_s", "wall_s", "memory_bytes")}


def judged(rows: Sequence[dict[str, Any]], exponents: dict[str, float]) -> list[dict[str, Any]]:
    """What was held against it, what was seen, and whether that is met."""
    verdicts = []
    for row in rows:
        what = f"{row['poses']:,} poses"
        there = row["converged"] and row["left"] <= _LEFT * row["chi2"]
        verdicts.append({"what": f"{what}: at the optimum", "seen": f"{row['left']:.1e} left", "met": there})
        if "gtsam_cpu_s" in row and row["gtsam_chi2"] <= _THERE * row["chi2"]:
            ratio = row["gtsam_cpu_s"] / row["cpu_s"]
            verdicts.append({"what": f"{what}: faster than {PEER}", "seen": f"{ratio:.2f}", "met": ratio > 1.0})
    if exponents:
        seen = exponents["wall_s"]
        verdicts.append(
            {"what": "exponent of wall time at most 1.25", "seen": f"{seen:.2f}", "met": seen <= _MOST_EXPONENT}
        )
    return verdicts


def text(result: dict[str, Any]) -> str:
    """A table, how it grows, and the bars that were missed."""
    lines = [
        "| poses | factors | wall | cpu | memory | said | χ² | from | iterations | gtsam lm, cpu |",
        "|---:|---:|---:|---:|---:|---:|---:|---|---:|---:|",
        *map(line_of, result["rows"]),
        "",
        *(f"exponent of {name}: {each:.2f}" for name, each in result["growth"].items()),
    ]
    targets = result["targets"]
    lines.append(f"{sum(each['met'] for each in targets)} of {len(targets)} bars met, seed {result['seed']}")
    return "\n".join(lines + [f"missed: {each['what']} ({each['seen']})" for each in targets if not each["met"]])


def page(result: dict[str, Any], arguments: Sequence[str]) -> str:
    """Of the docs.  arguments: of the command that measured it."""
    machine, versions = result["machine"], result["versions"]
    return "\n\n".join(
        [
            "# Large graphs",
            f"What `{' '.join(['factorbus bench large', *arguments])}` found, on {time.strftime('%Y-%m-%d')}, on "
            f"{machine['cpu']} ({machine['cores']} cores), seed {result['seed']}, with "
            f"{', '.join(f'{name} {each}' for name, each in sorted(versions.items()))}.",
            _WORDS,
            text(result),
        ]
    ) + "\n"  # fmt: skip


def line_of(row: dict[str, Any]) -> str:
    """A row of the table."""
    told = [f"{row['poses']:,}", f"{row['factors']:,}", f"{row['wall_s']:.2f} s", f"{row['cpu_s']:.2f} s"]
    told += [f"{row['memory_bytes'] / 2**20:.0f} MiB", f"{row['said_bytes'] / 2**20:.0f} MiB", f"{row['chi2']:.9g}"]
    told += [row["start"], str(row["iterations"])]
    told.append(f"{row['gtsam_cpu_s']:.2f} s" if "gtsam_cpu_s" in row else row.get("gtsam", ""))
    return f"| {' | '.join(told)} |"


def versions() -> dict[str, str]:
    """Of what takes part; those that are installed."""
    found = {}
    for package in ("numba", "numpy", "pymetis", "gtsam"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    counts = lambda text: sorted(int(word.replace("_", "")) for word in text.split(","))  # noqa: E731
    usual = "10000,100000,1000000"
    parser.add_argument("--poses", type=counts, default=counts(usual), metavar="N,...", help=f"of each graph ({usual})")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6) + 1, metavar="N", help="of the streets")
    parser.add_argument("--peer-up-to", type=int, default=100_000, metavar="N", help="poses, for GTSAM (100000)")
    parser.add_argument("--cores", type=int, default=os.cpu_count(), metavar="N", help="use N (all there are)")
    parser.add_argument("--page", metavar="FILE", help="the page of the docs with large graphs, to FILE (--page=FILE)")
    parser.add_argument("--one", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true", help="print the document")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
