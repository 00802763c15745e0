"""Steps with a budget beside the same steps without one: how long they take, and how good the estimate is meanwhile.

    factorbus bench budget                               streets, trees, a sphere, and the public sets that are there
    factorbus bench budget --only manhattan --poses 20000 --budget-ms 10,5
    factorbus bench budget --bus --poses 20000           eight clients in one map of streets, on a service with a
                                                         budget and on one without: `budget_bus.py`

A step may take 10⁸ units of work for each millisecond of the budget.  A row has, of a world and a budget,

    step_ms              p50, p99, p999 and max of the solver's steps, and `free_ms` of those without a budget
    work_share           the same of what the steps took of their budget, in units of work
    chi2_ratio           p50, p95 and max of χ² over that of the solver without a budget, after every step
    newest_pose_sigma    p99 of the distance of the newest pose from where that solver has it, in its largest
                         standard deviation, in the steps after which nothing is left for later
    steps_to_complete    p50 and p99: how many steps in a row ended with something left
    idle_s, end_chi2     the further steps after the last insert: their time, and χ² over the optimum then, less 1
    cpu_ratio            processor time of all steps, over that without a budget
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.budget_bus import compare_on_bus, shown_on_bus
from bench.replays.problems import ALL, Problem, choose, load
from naive.solver_parts import graph_in

from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.report import StepReport

UNITS_PER_MS = 1e8
_WORLDS = ("manhattan", "city_trees", "sphere")
_LOOK = 25  # steps between two comparisons of the newest pose
_IDLE = 200  # further steps, at most

Row = dict[str, Any]


def main() -> int:
    """Parse, drive, print a row each."""
    parser = argparse.ArgumentParser(prog="factorbus bench budget", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="", help="NAME,...: these worlds and data sets")
    parser.add_argument("--poses", type=int, default=3000, help="of a world (3000)")
    parser.add_argument("--seed", type=int, default=5, help="of a world (5)")
    parser.add_argument("--budget-ms", default="10,2", help="MS,...: budgets (10,2)")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    parser.add_argument("--bus", action="store_true", help="clients of a service, which drive in one map")
    parser.add_argument("--clients", type=int, default=8, help="with --bus (8)")
    parser.add_argument("--inserts", type=int, default=60, help="with --bus: of each client (60)")
    parser.add_argument("--period-s", type=float, default=0.5, help="with --bus: between inserts of a client (0.5)")
    told = parser.parse_args()
    if told.bus:
        return on_bus(told)
    only = [each for each in told.only.split(",") if each]
    worlds = [Problem(name, name, told.poses, None, told.seed) for name in _WORLDS]
    sets = [each for each in choose(False, ALL)[0] if not each.is_world]
    rows: list[Row] = []
    for problem in [each for each in (*worlds, *sets) if not only or each.name in only]:
        for budget_ms in [float(each) for each in told.budget_ms.split(",")]:
            rows.append(compare(problem, budget_ms))
            if not told.json:
                print(shown(rows[-1]), flush=True)
    if told.json:
        print(json.dumps(rows, indent=1))
    return 0


def on_bus(told: argparse.Namespace) -> int:
    """Rows of clients of a service."""
    rows: list[Row] = []
    for budget_ms in [float(each) for each in told.budget_ms.split(",")]:
        rows += compare_on_bus(told.poses, budget_ms, told.clients, told.inserts, told.period_s, told.seed)
        if not told.json:
            print(*map(shown_on_bus, rows[-2:]), sep="\n", flush=True)
    if told.json:
        print(json.dumps(rows, indent=1))
    return 0


def compare(problem: Problem, budget_ms: float) -> Row:
    """A replay by two solvers in turn, one with a budget and one without."""
    free = Solver(Options(clock=time.perf_counter))
    bounded = Solver(Options(clock=time.perf_counter, step_budget=budget_ms * UNITS_PER_MS))
    taken: tuple[list[StepReport], list[StepReport]] = [], []
    cpu_s, sigmas = [0.0, 0.0], []
    for n, batch in enumerate(load(problem)):
        for k, solver in enumerate((free, bounded)):
            solver.stage(batch)
            began = time.process_time()
            taken[k].append(solver.step())
            cpu_s[k] += time.process_time() - began
        if n % _LOOK == _LOOK - 1 and is_complete(taken[1][-1]):
            sigmas.append(distance(free, bounded))
    optimum = free.step(settle=True).chi2
    began = time.perf_counter()
    end = bounded.chi2()
    for _ in range(_IDLE):
        if not bounded.unfinished:
            break
        end = bounded.step().chi2
    idle_s = time.perf_counter() - began
    return {
        "world": problem.name,
        "poses": len(taken[0]),
        "budget_ms": budget_ms,
        "step_ms": spread([each.step_ms for each in taken[1]]),
        "free_ms": spread([each.step_ms for each in taken[0]]),
        "work_share": spread([each.work / (budget_ms * UNITS_PER_MS) for each in taken[1]]),
        "chi2_ratio": ratios(*taken),
        "newest_pose_sigma": {"p99": float(np.percentile(sigmas or [math.nan], 99))},
        "steps_to_complete": stretches([not is_complete(each) for each in taken[1]]),
        "idle_s": idle_s,
        "end_chi2": end / optimum - 1.0 if optimum > 0.0 else 0.0,
        "cpu_ratio": cpu_s[1] / cpu_s[0],
    }


def is_complete(report: StepReport) -> bool:
    """Whether nothing was left for later steps."""
    return report.converged and not report.deferred_relinearizations


def distance(free: Solver, bounded: Solver) -> float:
    """Of the newest pose in one solver from that in the other, in its largest standard deviation."""
    graph, other = graph_in(free), graph_in(bounded)
    kinds = graph.var[: free.variable_count, at.V_KIND]
    newest = np.flatnonzero((kinds == at.SE2) | (kinds == at.SE3))[-1:]
    dim = 2 if kinds[newest[0]] == at.SE2 else 3
    first = int(graph.var[newest[0], at.V_AT])
    gap = other.values[first : first + dim] - graph.values[first : first + dim]
    Sigma = CovarianceBlocks(free.covariances.factored()).joint(newest)[:dim, :dim]
    # Σ is in the frame of the pose and the gap in that of the map, so only lengths are compared.
    return float(np.linalg.norm(gap) / math.sqrt(np.linalg.eigvalsh(Sigma)[-1]))


def ratios(free: Sequence[StepReport], bounded: Sequence[StepReport]) -> Row:
    """χ² with a budget over χ² without, where there is any."""
    found = [ours.chi2 / theirs.chi2 for ours, theirs in zip(bounded, free, strict=True) if theirs.chi2 > 1e-6]
    p50, p95, most = np.percentile(found or [1.0], [50, 95, 100])
    return {"p50": float(p50), "p95": float(p95), "max": float(most)}


def stretches(left: Sequence[bool]) -> Row:
    """How long runs of True are."""
    found, run = [], 0
    for each in (*left, False):
        if each:
            run += 1
        elif run:
            found.append(run)
            run = 0
    p50, p99 = np.percentile(found or [0], [50, 99])
    return {"p50": float(p50), "p99": float(p99), "share": float(np.mean(left))}


def spread(numbers: Sequence[float]) -> Row:
    """Percentiles."""
    p50, p99, p999, most = np.percentile(numbers, [50, 99, 99.9, 100])
    return {"p50": float(p50), "p99": float(p99), "p999": float(p999), "max": float(most)}


def shown(row: Row) -> str:
    """A row as a line."""
    steps, work, chi2, waits = row["step_ms"], row["work_share"], row["chi2_ratio"], row["steps_to_complete"]
    return (
        f"{row['world']:18} {row['poses']:6} {row['budget_ms']:5g} ms"
        f"  steps {steps['p50']:.2f} {steps['p99']:.2f} {steps['p999']:.2f} {steps['max']:.2f}"
        f" (free {row['free_ms']['p99']:.2f} {row['free_ms']['max']:.2f})"
        f"  work {work['p99']:.2f} {work['p999']:.2f} {work['max']:.2f}"
        f"  χ² {chi2['p50']:.5f} {chi2['p95']:.5f} {chi2['max']:.3f}  σ {row['newest_pose_sigma']['p99']:.3f}"
        f"  left {waits['share']:.1%}, {waits['p50']:g} to {waits['p99']:g} steps"
        f"  idle {row['idle_s']:.2f} s {row['end_chi2']:.0e}  cpu {row['cpu_ratio']:.2f}"
    )


if __name__ == "__main__":
    sys.exit(main())
