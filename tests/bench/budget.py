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
    rival                where GTSAM is there: iSAM2 that relinearizes what fits into that time (`budget_rival.py`), its
                         step_ms, chi2_ratio, newest_pose_sigma (of all steps compared), cpu_ratio; held_back_share: the
                         steps in which some variable above iSAM2's threshold had to wait; failed: why it gave up
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.budget_bus import compare_on_bus, shown_on_bus
from bench.replays.columns import F64, I64
from bench.replays.problems import ALL, Problem, choose, load
from naive.solver_parts import graph_in

from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.report import StepReport

if TYPE_CHECKING:
    from bench.budget_rival import Rival

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
    parser.add_argument("--no-isam2", action="store_true", help="without the rival")
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
            rows.append(compare(problem, budget_ms, not told.no_isam2))
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


def compare(problem: Problem, budget_ms: float, with_rival: bool = False) -> Row:
    """A replay by two solvers in turn, one with a budget and one without; and, where it is there, by the rival."""
    free = Solver(Options(clock=time.perf_counter))
    bounded = Solver(Options(clock=time.perf_counter, step_budget=budget_ms * UNITS_PER_MS))
    taken: tuple[list[StepReport], list[StepReport]] = [], []
    cpu_s, sigmas, rival_sigmas = [0.0, 0.0], [], []
    batches = load(problem)
    rival = made_rival(batches, budget_ms) if with_rival else None
    for n, batch in enumerate(batches):
        for k, solver in enumerate((free, bounded)):
            solver.stage(batch)
            began = time.process_time()
            taken[k].append(solver.step())
            cpu_s[k] += time.process_time() - began
        if rival is not None:
            rival.take(batch)
        if n % _LOOK == _LOOK - 1:
            if is_complete(taken[1][-1]):
                sigmas.append(distance(free, newest_position(bounded)))
            if rival is not None and not rival.failed:
                rival_sigmas.append(distance(free, rival.newest_position()))
    optimum = free.step(settle=True).chi2
    began = time.perf_counter()
    end = bounded.chi2()
    for _ in range(_IDLE):
        if not bounded.unfinished:
            break
        end = bounded.step().chi2
    idle_s = time.perf_counter() - began
    row: Row = {
        "world": problem.name,
        "poses": len(taken[0]),
        "budget_ms": budget_ms,
        "step_ms": spread([each.step_ms for each in taken[1]]),
        "free_ms": spread([each.step_ms for each in taken[0]]),
        "work_share": spread([each.work / (budget_ms * UNITS_PER_MS) for each in taken[1]]),
        "chi2_ratio": ratios(*([each.chi2 for each in reports] for reports in taken)),
        "newest_pose_sigma": {"p99": float(np.percentile(sigmas or [math.nan], 99))},
        "steps_to_complete": stretches([not is_complete(each) for each in taken[1]]),
        "idle_s": idle_s,
        "end_chi2": end / optimum - 1.0 if optimum > 0.0 else 0.0,
        "cpu_ratio": cpu_s[1] / cpu_s[0],
    }
    if rival is not None and rival.step_ms:
        row["rival"] = {
            "step_ms": spread(rival.step_ms),
            "chi2_ratio": ratios([each.chi2 for each in taken[0][: len(rival.chi2)]], rival.chi2),
            "newest_pose_sigma": {"p99": float(np.percentile(rival_sigmas or [math.nan], 99))},
            "held_back_share": float(np.mean(np.array(rival.held_back) > 0)),
            "cpu_ratio": rival.cpu_s / cpu_s[0],
            "failed": rival.failed,
        }
    return row


def made_rival(batches: Sequence[Batch], budget_ms: float) -> "Rival | None":
    """iSAM2 that relinearizes what fits, where GTSAM is there."""
    if find_spec("gtsam") is None:
        return None
    from bench.budget_rival import Rival

    return Rival(batches, budget_ms)


def is_complete(report: StepReport) -> bool:
    """Whether nothing was left for later steps."""
    return report.converged and not report.deferred_relinearizations


def newest_position(solver: Solver) -> F64:
    """Of the newest pose, (2,) or (3,)."""
    _, position = _newest(solver)
    return position


def distance(free: Solver, position: F64) -> float:
    """Of a position of the newest pose from where that solver has it, in its largest standard deviation."""
    newest, where = _newest(free)
    Sigma = CovarianceBlocks(free.covariances.factored()).joint(newest)[: len(where), : len(where)]
    # Σ is in the frame of the pose and the gap in that of the map, so only lengths are compared.
    return float(np.linalg.norm(position - where) / math.sqrt(np.linalg.eigvalsh(Sigma)[-1]))


def _newest(solver: Solver) -> tuple[I64, F64]:
    """(its slot (1,), its position) of the newest pose."""
    graph = graph_in(solver)
    kinds = graph.var[: solver.variable_count, at.V_KIND]
    newest = np.flatnonzero((kinds == at.SE2) | (kinds == at.SE3))[-1:]
    first = int(graph.var[newest[0], at.V_AT])
    return newest, graph.values[first : first + (2 if kinds[newest[0]] == at.SE2 else 3)].copy()


def ratios(free: Sequence[float], other: Sequence[float]) -> Row:
    """χ² over χ² of the solver without a budget, where there is any."""
    found = [ours / theirs for ours, theirs in zip(other, free, strict=True) if theirs > 1e-6]
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
    line = (
        f"{row['world']:18} {row['poses']:6} {row['budget_ms']:5g} ms"
        f"  steps {steps['p50']:.2f} {steps['p99']:.2f} {steps['p999']:.2f} {steps['max']:.2f}"
        f" (free {row['free_ms']['p99']:.2f} {row['free_ms']['max']:.2f})"
        f"  work {work['p99']:.2f} {work['p999']:.2f} {work['max']:.2f}"
        f"  χ² {chi2['p50']:.5f} {chi2['p95']:.5f} {chi2['max']:.3f}  σ {row['newest_pose_sigma']['p99']:.3f}"
        f"  left {waits['share']:.1%}, {waits['p50']:g} to {waits['p99']:g} steps"
        f"  idle {row['idle_s']:.2f} s {row['end_chi2']:.0e}  cpu {row['cpu_ratio']:.2f}"
    )
    return f"{line}\n{shown_rival(row['rival'])}" if "rival" in row else line


def shown_rival(row: Row) -> str:
    """The rival's part of a row as a line."""
    steps, chi2 = row["step_ms"], row["chi2_ratio"]
    return (
        f"{'  iSAM2, what fits':33}  steps {steps['p50']:.2f} {steps['p99']:.2f} {steps['p999']:.2f} {steps['max']:.2f}"
        f"  χ² {chi2['p50']:.5f} {chi2['p95']:.5f} {chi2['max']:.3f}  σ {row['newest_pose_sigma']['p99']:.3f}"
        f"  held back {row['held_back_share']:.1%}  cpu {row['cpu_ratio']:.2f}"
        + (f"  gave up at {row['failed']}" if row["failed"] else "")
    )


if __name__ == "__main__":
    sys.exit(main())
