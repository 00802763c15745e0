"""The quality of every published estimate: its χ² over that of the batch optimum from there, at every step.

    python tests/bench/every_step.py [--only NAME,...] [--seeds N | --seed S,...] [--no-isam2] [--json [FILE]] [...]

    simulated  manhattan, city_trees, sphere, bearing_range: drives of 1,000 poses, drawn anew in each run; the first
               three also as kinds that a client has written as formulas (own_manhattan, ...)
    data       intel, killian_freiburg, manhattan3500, victoria_park, parking_garage, sphere2500; own_parking_garage
    hard       steps that turn much of a map: loops closed after a drift of 60° to 180° (drift), two robots that meet at
               any angle (meetings_2d, _3d), positions that come late (late_2d, _3d), ranges to fixed points that do
               (ranges_2d, _3d), GNSS in a frame that is estimated (frames_2d, _3d), wrong loop closures under Huber's
               loss (outliers)

Our solver takes each drive pose by pose, in this process and without a bus.  After each step full passes over the
whole graph go from its estimate to the optimum: Gauss-Newton, damped where a step would raise χ².  A ratio is
χ²/χ²_batch; where χ²_batch is below 1, 1 + (χ² - χ²_batch), since it is 0 as long as there is only odometry: an excess
of 0.001 is a map that is nowhere off by more than 0.032 standard deviations.  At the end the map is left alone: steps
without anything new, as those of a service, until nothing is left to do.  GTSAM's iSAM2 (relinearizeThreshold 0.1,
relinearizeSkip 1) takes the same drive, and is judged in the same way by its own error function.

The full passes are made of our kernels.  At a few steps of every drive (--check) NumPy and SciPy alone look for the
optimum from the same estimate, and have to come to the same χ².

Seeds are drawn from the operating system and printed; --seed repeats a run.  The steps above 1.001 are in the output
folder, with what they said.  The exit code is 1 when a target is missed.
"""

import argparse
import json
import multiprocessing
import os
import secrets
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TextIO

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one core for everybody
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.every import tables
from bench.every.drives import KINDS, WORLDS, World, chosen, is_here
from bench.every.follow import follow
from bench.every.rows import far_steps, row_of, together
from bench.every.verdicts import judge
from bench.replays.command import folder_named, natural, positive
from bench.replays.own_kinds import in_usual_kinds
from bench.replays.targets import missed

from factorbus.solver import Options, SolverError, warm
from factorbus.solver.options import MODES


class Drive(NamedTuple):
    """One drive to follow.  poses 0: all; every: judge its multiples; check: how many by SciPy too."""

    world: str
    seed: int
    poses: int
    every: int
    check: int
    isam2: bool
    options: dict[str, Any]


def main() -> None:
    """Measure, print; exit 1 when a target is missed."""
    asked = _options()
    try:
        worlds = chosen([word for word in asked.only.split(",") if word])
        settings = {"mode": asked.mode, **dict(_setting(text) for text in asked.option)}
        Options.of(**settings)
    except (ValueError, TypeError, SolverError) as problem:
        sys.exit(f"bench every-step: {problem}")
    absent = [world.name for world in worlds if not is_here(world)]
    seeds = asked.seed or [1 + secrets.randbelow(2**31 - 1) for _ in range(asked.seeds)]
    drives = [drive for world in worlds if is_here(world) for drive in _drives(world, seeds, asked, settings)]
    out = sys.stderr if asked.json == "-" else sys.stdout
    print(f"seeds: --seed {','.join(map(str, seeds))}", file=out)
    if absent:
        print(f"not on this machine: {', '.join(absent)} (factorbus datasets fetch --all)", file=out)
    print(tables.head(not asked.no_isam2), file=out)
    rows = []
    asked.out.mkdir(parents=True, exist_ok=True)
    with (asked.out / "far.jsonl").open("w") as far:
        for row, steps in _measured(drives, asked.jobs):
            rows.append(row)
            far.writelines(json.dumps(step) + "\n" for step in steps)
            far.flush()
            print(tables.line(row), file=out, flush=True)
    document, missing = conclude(rows, seeds, absent, settings)
    (asked.out / "every-step.json").write_text(json.dumps(document, indent=1))
    _tell(document, not asked.no_isam2, out)
    print(f"in {asked.out}: every-step.json, far.jsonl", file=out)
    if asked.json:
        text = json.dumps(document, indent=1)
        print(text) if asked.json == "-" else Path(asked.json).write_text(text)
    if missing:
        sys.exit(1)


def measure(drive: Drive) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The row of a drive, and its steps above 1.001."""
    warm()
    world = WORLDS[drive.world]
    steps = list(world.make(drive.poses or world.poses, drive.seed))
    found = follow(steps, Options.of(**drive.options), drive.every, drive.check)
    isam2 = None
    if drive.isam2:
        from bench.every.peer import follow_isam2  # here, so that without it GTSAM need not be installed

        isam2 = follow_isam2([in_usual_kinds(step) for step in steps], drive.every)
    row = row_of(drive.world, drive.seed, len(steps), found, isam2)
    return row, far_steps(drive.world, drive.seed, found)


def conclude(
    rows: Sequence[dict[str, Any]], seeds: Sequence[int], absent: Sequence[str], settings: dict[str, Any]
) -> tuple[dict[str, Any], bool]:
    """The document, and whether a target was missed."""
    verdicts = judge(rows)
    names = dict.fromkeys(row["world"] for row in rows)
    return {
        "seeds": list(seeds),
        "options": settings,
        "absent": list(absent),
        "rows": [{name: value for name, value in row.items() if not name.endswith("ratios")} for row in rows],
        "worlds": [together([row for row in rows if row["world"] == name]) for name in names],
        "targets": [{"what": v.what, "seen": v.seen, "verdict": v.verdict} for v in verdicts],
    }, bool(missed(verdicts))


def _drives(world: World, seeds: Sequence[int], asked: argparse.Namespace, settings: dict[str, Any]) -> list[Drive]:
    every = 1 if world.is_drawn else asked.every
    each = seeds if world.is_drawn else [0]
    return [Drive(world.name, seed, asked.poses, every, asked.check, not asked.no_isam2, settings) for seed in each]


def _measured(drives: Sequence[Drive], jobs: int) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """In this process, or in a number of others."""
    if jobs == 1:
        yield from map(measure, drives)
        return
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(measure, drives)


def _tell(document: dict[str, Any], isam2: bool, out: TextIO) -> None:
    print(f"\n{tables.head(isam2)}", file=out)
    for row in document["worlds"]:
        print(tables.line(row), file=out)
    print(f"\n{tables.LEGEND}\n\n{tables.targets(document['targets'])}\n", file=out)


def _setting(text: str) -> tuple[str, Any]:
    """NAME=VALUE.  Raises ValueError."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--option {text}: wanted NAME=VALUE, as rounds=1")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        raise ValueError(f"--option {text}: {value!r} is no JSON; a text has its quotes") from None


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ", ".join((*KINDS, *WORLDS))
    parser.add_argument("--only", default="", metavar="NAME,...", help=f"these: {names}")
    parser.add_argument("--seeds", type=positive, default=10, metavar="N", help="drives of each drawn world (10)")
    parser.add_argument("--seed", type=_seeds, metavar="S,...", help="these seeds, to repeat a run")
    parser.add_argument("--poses", type=natural, default=0, metavar="N", help="of each drive; 0: as many as it has")
    parser.add_argument("--every", type=positive, default=1, metavar="N", help="judge each Nth step of data sets (1)")
    parser.add_argument("--check", type=natural, default=3, metavar="N", help="steps of a drive to ask SciPy about (3)")
    parser.add_argument("--jobs", type=positive, default=1, metavar="N", help="drives at a time (1)")
    parser.add_argument("--mode", choices=MODES, default="auto", help="of our solver")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE", help="of our solver")
    parser.add_argument("--no-isam2", action="store_true", help="ours only: a quarter of the time")
    parser.add_argument("--json", nargs="?", const="-", metavar="FILE", help="the document to FILE, or to -")
    parser.add_argument("--out", type=folder_named, default=Path("out/bench/every-step"), help="where results are kept")
    return parser.parse_args()


def _seeds(text: str) -> list[int]:
    return [positive(word) for word in text.split(",")]


if __name__ == "__main__":
    main()
