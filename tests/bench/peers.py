"""Our default mode against GTSAM's iSAM2 on all public data sets, with an estimate of everything after every step.

    python tests/bench/peers.py [--quick] [--only NAME,...] [--json [FILE]] [--repetitions N] [--fresh] [...]

    replays    pose by pose, all eleven data sets: CPU time of `auto`, all variables read after every step, against that
               of iSAM2's `update()` alone, with relinearizeSkip 1 and, as it ships, 10; long steps; χ²/χ²_batch at
               every step (--chi2-every N: at each Nth), in another replay than the timed ones
    worlds     the same on eight simulated worlds, each with the seed that was looked at while constants were chosen and
               with one that is drawn for the run and printed (--seed N: that one)
    bus        the data sets through a service: from an insert to the estimate with it, by the robot's clock, two cores
    growth     a simulated drive of 100,000 poses: the time of a step and the memory as the map grows
    cores      what a second core brings for the longest steps of 20,000 poses, by the clock
    full-pass  relinearize, order, analyse, factorize and solve each final system, against CHOLMOD with OpenBLAS
    overhead   what Python adds to the compiled calls of a step; the start of a process; compiling from nothing

Every run is a process of its own on one core, three repetitions, medians, and is kept in the output folder
(out/bench/peers): a second call goes on where the first was stopped and measures only what is new or changed.
--quick takes two minutes, and does not judge what it shortens.  Without data sets it replays simulated worlds.

NAME is a part (replays, worlds, bus, growth, cores, full-pass, overhead), a data set (intel, w10000, ...) or a solver:
auto, isam2-0.1, isam2-0.1-skip10, and when asked for isam2-0.01, isam2-0.01-skip10, isam2-0.1-adaptive (adaptive
reordering), isam2-0.1-partial (partial relinearization check), gn-loop (one Gauss-Newton step on a fresh block Cholesky
at every loop) or another of our modes (all-batch, inc-l, ...); --judge holds that against the targets.  The exit code
is 1 when a target is missed.
"""

import argparse
import secrets
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.replays import (
    peer_summary,
    peer_table,
    peer_targets,
    problems,
    results_page,
    runner,
    summary,
    targets,
    world_targets,
)
from bench.replays.bars import Begin, Tell, bars
from bench.replays.command import add_options, file_named, hand_out, positive
from bench.replays.contestants import ENTRIES, ISAM2_NAMES, OURS, PEER, SKIPPING, STAND_INS, Entry
from bench.replays.problems import ALL, Problem
from bench.replays.samples import Sampling

from factorbus.service.process.worker_threads import core_count

PARTS = ("replays", "worlds", "bus", "growth", "cores", "full-pass", "overhead")
OUR_MODES = tuple(name for name, entry in ENTRIES.items() if entry.solver == OURS)
SOLVERS = {**{name: name for name in (*OUR_MODES, "gn-loop")}, **ISAM2_NAMES}
GROWTH = Problem("manhattan", "Manhattan", poses=100_000, seed=1)
_QUICK_GROWTH = 2_000
_CORES_POSES = 20_000
_OVERHEAD_POSES = 1_000
_PASSES, _QUICK_PASSES = 15, 5
RARE = 100  # steps between looks at χ² that do not disturb a timed replay


@dataclass(frozen=True, slots=True)
class Plan:
    """What is measured."""

    parts: tuple[str, ...]
    chosen: list[Problem]
    entries: list[Entry]
    repetitions: int
    quick: bool
    judged: str
    chi2_every: int = 1
    worlds: tuple[Problem, ...] = ()

    @property
    def replayed(self) -> list[Problem]:
        """By each solver."""
        return [*(self.chosen if "replays" in self.parts else ()), *self.worlds]

    def times(self, problem: Problem) -> int:
        """How often it is replayed."""
        return 1 if problem in self.worlds else self.repetitions

    def jobs(self) -> int:
        """How many."""
        references = len(self.worlds) + (len(self.chosen) if {"replays", "full-pass"} & set(self.parts) else 0)
        replays = sum(map(self.times, self.replayed)) * len(self.entries)
        growth = self.repetitions if "growth" in self.parts else 0
        passes = len(self.chosen) if "full-pass" in self.parts else 0
        looks = len(self.replayed) * len(self.entries) if self.chi2_every < RARE else 0
        over_bus = len(self.chosen) if "bus" in self.parts else 0
        single = ("cores" in self.parts) + ("overhead" in self.parts)
        return references + replays + looks + over_bus + growth + passes + single


def main() -> None:
    """Measure what is missing, print, draw; exit 1 when a target is missed."""
    options = _options()
    chosen, note = problems.choose(options.quick, ALL)
    plan, absent = _plan(options, chosen)
    sampling = Sampling(every=options.chi2_every if plan.replayed else RARE)
    settings = runner.Settings(options.out, runner.pick_core(), sampling, options.limit_s, options.fresh)
    try:
        with bars(plan.jobs()) as (begin, progress):
            found = measure(settings, plan, begin, progress)
    except runner.Crashed as problem:
        sys.exit(f"bench peers: optima could not be computed: {problem}")
    except KeyboardInterrupt:
        sys.exit(f"bench peers: stopped; what is finished is in {options.out}, and the same call goes on from there")
    document, verdicts = conclude(found, plan, [note, *absent])
    if not options.no_figures:
        document["figures"] = [str(path) for path in draw(options.out, found, document, plan)]
    if options.page is not None:
        Path(options.page).write_text(results_page.page(document, sys.argv[1:]))
    hand_out("peers", document, peer_table.report(document, verdicts), options)
    if targets.missed(verdicts):
        sys.exit(1)


def measure(settings: runner.Settings, plan: Plan, begin: Begin, progress: Tell) -> dict[str, Any]:
    """references and runs by data set; over_bus, growth, cores, full_pass, overhead where they are in the plan."""
    found: dict[str, Any] = {"references": {}, "runs": {}, "growth": [], "full_pass": {}, "over_bus": {}}
    found |= {"cores": None, "overhead": None}
    for problem in dict.fromkeys([*plan.replayed, *(plan.chosen if "full-pass" in plan.parts else ())]):
        begin(f"{problem.key}: optima", problem.steps)
        found["references"][problem.key] = runner.run_reference(settings, problem, progress)
    found["runs"] = _replays(settings, plan, begin, progress)
    if "bus" in plan.parts:
        for problem in plan.chosen:
            begin(f"{problem.key}: over the bus", problem.steps)
            both = replace(settings, core=None)
            found["over_bus"][problem.key] = _measured(both, problem, "over_bus", {}, progress)
    if "growth" in plan.parts:
        world = GROWTH.shortened(_QUICK_GROWTH) if plan.quick else GROWTH
        for repetition in range(plan.repetitions):
            begin(f"growth to {world.poses}", world.poses)
            more = {"limit_s": settings.limit_s, "mode": plan.judged}
            found["growth"].append(_measured(settings, world, "growth", more, progress, repetition))
    if "cores" in plan.parts:
        world = GROWTH.shortened(_QUICK_GROWTH if plan.quick else _CORES_POSES)
        begin(f"cores to {world.poses}", world.poses)
        more = {"mode": plan.judged, "cores": core_count()}
        found["cores"] = _measured(replace(settings, core=None), world, "cores", more, progress)
    if "full-pass" in plan.parts:
        count = _QUICK_PASSES if plan.quick else _PASSES
        for problem in plan.chosen:
            begin(f"{problem.key}: full pass", count)
            more = {"values": found["references"][problem.key]["values"], "repetitions": count}
            found["full_pass"][problem.key] = _measured(settings, problem, "full_pass", more, progress)
    if "overhead" in plan.parts:
        world = GROWTH.shortened(_OVERHEAD_POSES)
        begin("overhead", world.poses)
        more = {"cold": not plan.quick, "mode": plan.judged}
        found["overhead"] = _measured(settings, world, "overhead", more, progress)
    return found


def _replays(settings: runner.Settings, plan: Plan, begin: Begin, progress: Tell) -> dict[str, dict[str, list[Any]]]:
    """Runs by data set and contestant.  The solvers take turns: all of them once before any of them a second time.

    Looks at χ² that are not rare are made in replays that are not timed.
    """
    looked, settings = settings, replace(settings, sampling=Sampling(every=max(plan.chi2_every, RARE)))
    runs: dict[str, dict[str, list[Any]]] = {p.key: {} for p in plan.replayed}
    for repetition in range(plan.repetitions):
        for problem in (each for each in plan.replayed if repetition < plan.times(each)):
            for entry in plan.entries:
                begin(f"{problem.key}: {entry.name}", problem.steps)
                run = runner.run_replay(settings, problem, entry, repetition, progress)
                runs[problem.key].setdefault(entry.name, []).append(run)
                if run["status"] == "failed" and (stand_in := STAND_INS.get(entry.name)):
                    begin(f"{problem.key}: {stand_in}", problem.steps)
                    run = runner.run_replay(settings, problem, ENTRIES[stand_in], repetition, progress)
                    runs[problem.key].setdefault(stand_in, []).append(run)
    if plan.chi2_every < RARE:
        for problem in plan.replayed:
            for name, each in runs[problem.key].items():
                begin(f"{problem.key}: χ² of {name}", problem.steps)
                each[0] = looked_at(looked, problem, each[0], progress)
    return runs


def looked_at(settings: runner.Settings, problem: Problem, run: dict[str, Any], progress: Tell) -> dict[str, Any]:
    """The run with χ² at all samples, up to where it came to."""
    if not run.get("done"):
        return run
    try:
        looks = runner.run_quality(settings, problem, ENTRIES[run["contestant"]], progress)
    except runner.Crashed as crashed:
        return {**run, "chi2": [], "reason": f"{run['reason']}; χ² along the way: {crashed}".strip("; ")}
    return {**run, "chi2": [each for each in looks["chi2"] if each[0] < run["done"]]}


def conclude(found: dict[str, Any], plan: Plan, notes: Sequence[str]) -> tuple[dict[str, Any], list[targets.Verdict]]:
    """The document, and the verdicts."""
    rows, said, ends = [], [note for note in notes if note], {}
    for problem in plan.replayed:
        mine = found["runs"][problem.key]
        firsts = [each[0] for name, each in mine.items() if name not in STAND_INS.values()]
        batch, remarks = summary.best_known(problem, found["references"][problem.key], firsts)
        said += remarks
        ends[problem.key] = batch[max(batch)]
        rows += peer_summary.rows_of(problem, [ENTRIES[name] for name in mine], mine, batch)
    growth, overhead = _together(found["growth"]), found["overhead"]
    crashed = overhead["reason"] if overhead and "step" not in overhead else ""
    if crashed:
        said.append(f"overhead was not measured: {crashed}")
        overhead = None
    verdicts = [
        *peer_targets.judge(rows, ends, plan.judged),
        *world_targets.judge_worlds(rows, plan.worlds, plan.judged),
        *peer_targets.judge_growth(growth),
        *peer_targets.judge_cores(found["cores"], _CORES_POSES),
        *peer_targets.judge_passes(found["full_pass"]),
        *peer_targets.judge_overhead(overhead),
    ]
    return {
        "machine": runner.machine(),
        "notes": said,
        "judged": plan.judged,
        "rows": rows,
        "over_bus": found["over_bus"],
        "growth": growth,
        "cores": found["cores"],
        "full_pass": found["full_pass"],
        "overhead": overhead,
        "targets": [{"what": v.what, "seen": v.seen, "verdict": v.verdict} for v in verdicts],
    }, verdicts


def draw(folder: Path, found: dict[str, Any], document: dict[str, Any], plan: Plan) -> list[Path]:
    """The figures, in `folder`."""
    from bench.replays import figures, peer_figures

    folder.mkdir(parents=True, exist_ok=True)
    paths, titles = [], {p.key: p.label for p in plan.replayed}
    if document["rows"]:
        runs = {key: [each[0] for each in by_name.values()] for key, by_name in found["runs"].items()}
        paths = [folder / f"peers_{name}.png" for name in ("steps", "time", "ratios")]
        peer_figures.steps_figure(paths[0], runs, titles)
        figures.time_figure(paths[1], runs, titles, "")
        peer_figures.ratios_figure(paths[2], document["rows"], plan.judged)
    if document["growth"] and document["growth"]["windows"]:
        paths.append(folder / "peers_growth.png")
        peer_figures.growth_figure(paths[-1], document["growth"], plan.judged)
    return paths


def _measured(
    settings: runner.Settings, problem: Problem, kind: str, more: dict[str, Any], progress: Tell, repetition: int = 0
) -> dict[str, Any]:
    """A measure; one that crashed is a result too, and the others go on."""
    try:
        return runner.run_measure(settings, problem, kind, more, repetition, progress)
    except runner.Crashed as crashed:
        return {"status": "failed", "reason": str(crashed)}


def _together(runs: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Several drives as one: the first that went worst, its windows the medians of all that went as far."""
    if not runs:
        return None
    worst = min(runs, key=lambda run: run.get("poses", 0))
    if "windows" not in worst:
        return {**worst, "poses": 0, "windows": [], "memory": [], "factors": 0, "cpu_s": 0.0}
    windows = [
        {name: median(run["windows"][w][name] for run in runs) for name in window}
        for w, window in enumerate(worst["windows"])
    ]
    return {**worst, "windows": windows, "cpu_s": median(run["cpu_s"] for run in runs)}


def _plan(options: argparse.Namespace, chosen: list[Problem]) -> tuple[Plan, list[str]]:
    """What was asked for, and a line for each solver that cannot run here."""
    words = [word for word in options.only.split(",") if word]
    parts = tuple(word for word in PARTS if word in words)
    names = [SOLVERS[word] for word in words if word in SOLVERS]
    wanted = [p for p in chosen if {p.name, p.key} & set(words)]
    if unknown := [w for w in words if w not in (*PARTS, *SOLVERS) and not any(w in (p.name, p.key) for p in chosen)]:
        sys.exit(
            f"--only {','.join(unknown)}: none of the parts ({', '.join(PARTS)}), of the data sets that are here "
            f"({', '.join(p.name for p in chosen)}) or of the solvers ({', '.join(SOLVERS)})"
        )
    if not parts:
        parts = ("replays",) if wanted or names else tuple(p for p in PARTS if not (options.quick and p == "worlds"))
    entries = [ENTRIES[name] for name in names or (options.judge, PEER, SKIPPING)]
    absent = [f"Not measured: {entry.label} ({entry.missing()})." for entry in entries if entry.missing()]
    entries = [entry for entry in entries if not entry.missing()]
    repetitions = options.repetitions or (1 if options.quick else 3)
    poses = problems.QUICK_POSES if options.quick else problems.WORLD_POSES
    worlds = tuple(problems.drawn(options.seed, poses)) if "worlds" in parts else ()
    plan = Plan(parts, wanted or chosen, entries, repetitions, options.quick, options.judge, options.chi2_every, worlds)
    return plan, [*absent, *[f"Worlds are drawn with seed {options.seed}."] * bool(worlds)]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_options(parser, "peers", repetitions=None)
    parser.add_argument("--chi2-every", type=positive, default=1, metavar="N", help="look at χ² at each Nth step (1)")
    parser.add_argument("--page", type=file_named, metavar="FILE", help="the page of results of the docs, to FILE")
    parser.add_argument("--seed", type=positive, default=secrets.randbelow(1 << 30) + 2, help="of worlds (drawn anew)")
    parser.add_argument("--judge", choices=OUR_MODES, default="auto", help="the mode that the targets are for")
    return parser.parse_args()


if __name__ == "__main__":
    main()
