"""A town that is driven through day after day: how large the map gets that keeps some poses, and what that costs.

    factorbus bench sessions [--drives N] [--poses N] [--seeds N] [--seed S] [--keep POLICY] [--json]

Each day the same way through streets drawn anew (`town_drives`), under a letter of its own, with closures to poses of
the days before that the map has.  Both maps, the one that keeps some and the one that keeps all, get the same
measurements, pose by pose, in process; the first looks for poses to take out every hundred poses and at the end of the
day, as a service does when it is idle.  Of each drive, medians over seeds:

    poses_driven    so far
    variables, factors, and full_variables, full_factors of the map that keeps all; growth, factor_growth: over those of
                    the first drive
    ate_m, full_ate_m   error of the positions of the poses that both have, best laid upon the truth, metres
    ate_ratio       of both, worst: of all seeds
    newest_ratio    error of today's newest pose at every hundredth, best laid as its map is, for that of the other map
    step_ms, full_step_ms   processor time of a step, mean
    keep_s          processor time of looking and taking out
    cpu_s, full_cpu_s       of the day, all together
    loss            what was lost, nats, for each pose that went

The exit code is 1 where after the last drive `growth` is above 1.2, the median of `ate_ratio` above 1.1, or `step_ms`
above 1.5 of the second drive's.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.town_drives import FrontEnd, Town, key_of, town

from factorbus.proto.arrays import F64
from factorbus.proto.keep import try_keep
from factorbus.proto.messages import Batch, Change
from factorbus.solver import Options, Solver
from factorbus.solver.changing import with_changes
from factorbus.solver.graph.groups import Addition
from factorbus.solver.lifelong.plan import plan_removals
from factorbus.solver.lifelong.policy import KeepPolicy

EVERY = 100  # poses between looks
GROWTH, RATIO, STEP = 1.2, 1.1, 1.5  # the targets
_WORST = "worst_ate_ratio"


class KeptMap:
    """A solver that keeps within a policy; None: everything.  cpu_s of its steps, keep_s of what it takes out."""

    def __init__(self, policy: KeepPolicy | None) -> None:
        self.solver, self._policy = Solver(Options()), policy
        self.cpu_s = self.keep_s = self.loss = 0.0
        self.gone = 0

    def insert(self, batch: Batch) -> None:
        """One pose."""
        begun = time.process_time()
        self.solver.stage(batch)
        self.solver.step()
        self.cpu_s += time.process_time() - begun

    def keep(self, front: FrontEnd) -> None:
        """Take out what is redundant, as long as there is any."""
        while self._policy is not None:
            begun = time.process_time()
            plan = plan_removals(self.solver.factor_graph, self._policy)
            if plan.keys.size:
                changes = Change("remove_factors", plan.factors), Change("remove_variables", keys=plan.keys, alone=True)
                self.solver = with_changes(self.solver, changes, Addition((), plan.added))[0]
            self.keep_s += time.process_time() - begun
            if not plan.keys.size:
                return
            self.loss, self.gone = self.loss + plan.loss, self.gone + plan.keys.size
            front.gone(plan.keys)

    def poses(self) -> dict[int, F64]:
        """By key."""
        groups = self.solver.estimate()
        return {key: row for g in groups for key, row in zip(g.keys.tolist(), g.values, strict=True)}


def drive(of: Town, drives: int, policy: KeepPolicy) -> list[dict[str, Any]]:
    """Rows of one seed."""
    front, kept, full, rows = FrontEnd(of.seed), KeptMap(policy), KeptMap(None), list[dict[str, Any]]()
    for day in range(1, drives + 1):
        where, newest, before = of.day(day), list[tuple[float, float]](), (kept.cpu_s, full.cpu_s, kept.keep_s)
        went = kept.loss, kept.gone
        for k in range(len(where)):
            batch = front.step(day, k, where)
            kept.insert(batch)
            full.insert(batch)
            if k % EVERY == EVERY - 1:
                newest.append(_errors(kept, full, front.truth, key_of(day, k))[1])
                kept.keep(front)
        front.end_day()
        kept.keep(front)
        (ate, full_ate), _ = _errors(kept, full, front.truth, key_of(day, len(where) - 1))
        cpu, full_cpu, keep = kept.cpu_s - before[0], full.cpu_s - before[1], kept.keep_s - before[2]
        here, there = np.mean(newest, axis=0)
        rows.append({
            "drive": day, "poses_driven": day * len(where),
            "variables": kept.solver.variable_count, "factors": kept.solver.factor_count,
            "full_variables": full.solver.variable_count, "full_factors": full.solver.factor_count,
            "ate_m": ate, "full_ate_m": full_ate, "ate_ratio": ate / full_ate, "newest_ratio": float(here / there),
            "step_ms": cpu / len(where) * 1e3, "full_step_ms": full_cpu / len(where) * 1e3,
            "keep_s": keep, "cpu_s": cpu + keep, "full_cpu_s": full_cpu,
            "loss": (kept.loss - went[0]) / max(kept.gone - went[1], 1),
        })  # fmt: skip
        rows[-1]["growth"] = rows[-1]["variables"] / rows[0]["variables"]
        rows[-1]["factor_growth"] = rows[-1]["factors"] / rows[0]["factors"]
    return rows


def _errors(
    kept: KeptMap, full: KeptMap, truth: dict[int, F64], newest: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """(of all poses that both have, of the newest) in both maps, metres."""
    mine, other = kept.poses(), full.poses()
    keys = list(mine)
    b = np.array([truth[key][:2] for key in keys])
    found = [_laid(np.array([of[key][:2] for key in keys]), b) for of in (mine, other)]
    at = keys.index(newest)
    (one, two) = (np.linalg.norm(off, axis=1) for off in found)
    return (_rms(one), _rms(two)), (float(one[at]), float(two[at]))


def _rms(errors: F64) -> float:
    return float(np.sqrt((errors**2).mean()))


def _laid(a: F64, b: F64) -> F64:
    """How far positions are off once they are best laid upon the truth."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    return a @ (U @ np.diag([1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt) - b


def medians(runs: Sequence[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Over seeds, of each drive; with the worst ratio of errors."""
    rows = []
    for same in zip(*runs, strict=True):
        row = {name: float(np.median([run[name] for run in same])) for name in same[0]}
        row |= {name: int(row[name]) for name in ("drive", "poses_driven", "variables", "factors")}
        rows.append(row | {_WORST: max(run["ate_ratio"] for run in same)})
    return rows


def met(rows: Sequence[dict[str, Any]]) -> bool:
    """Whether the last drive is within the targets."""
    last, second = rows[-1], rows[min(1, len(rows) - 1)]
    return last["growth"] <= GROWTH and last["ate_ratio"] <= RATIO and last["step_ms"] <= STEP * second["step_ms"]


def main() -> int:
    """Drive and tell; the exit code is 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="factorbus bench sessions", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=10)
    parser.add_argument("--poses", type=int, default=1000, help="of each drive")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seed", type=int, help="the first; without, another one each time")
    parser.add_argument("--keep", default="per_area=2", help="the policy, as `factorbus serve --keep` has it")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    told = parser.parse_args()
    settings = try_keep(told.keep)
    if settings is None:
        parser.error("--keep all: there is nothing to compare; wanted per_area=METRES[:POSES],...")
    policy = KeepPolicy(settings.per_area_m, settings.poses, settings.window, settings.landmarks, settings.loss)
    first = int(np.random.default_rng().integers(2**31)) if told.seed is None else told.seed
    seeds = range(first, first + told.seeds)
    drive(town(100, first), 2, policy)  # loads the kernels
    rows = medians([drive(town(told.poses, seed), told.drives, policy) for seed in seeds])
    if told.json:
        print(json.dumps({"seeds": list(seeds), "keep": told.keep, "rows": rows}))
    else:
        print(f"seeds {seeds.start}..{seeds.stop - 1}")
        for row in rows:
            print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
    return 0 if met(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
