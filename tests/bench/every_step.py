"""χ² of every published estimate over that of the batch optimum from there.

    python tests/bench/every_step.py [--only WORLD,...] [--seeds N | --seed S,...] [--poses N] [--json]
"""

import argparse
import json
import os
import secrets
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.every.drives import WORLDS
from bench.every.follow import follow
from bench.every.rows import bad_steps, row_of

from factorbus.solver import Options, warm


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(WORLDS), metavar="WORLD,...")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seed", default="", metavar="S,...")
    parser.add_argument("--poses", type=int, default=0)
    parser.add_argument("--mode", default="auto")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--worst", type=Path, default=Path("out/bench/every-step/worst.jsonl"))
    options = parser.parse_args()
    seeds = [int(s) for s in options.seed.split(",") if s] or [secrets.randbelow(2**31) for _ in range(options.seeds)]
    more: dict[str, Any] = {k: json.loads(v) for k, v in (o.split("=", 1) for o in options.option)}
    settings = Options(mode=options.mode, **more)
    warm()
    print(f"seeds {','.join(map(str, seeds))}", file=sys.stderr)
    options.worst.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    if not options.json:
        print(HEAD)
    with options.worst.open("w") as worst:
        for name in options.only.split(","):
            world = WORLDS[name]
            for seed in seeds:
                start = time.perf_counter()
                found = follow(world.make(options.poses or world.poses, seed), settings)
                row = row_of(name, seed, found) | {"wall_s": time.perf_counter() - start}
                rows.append(row)
                for each in bad_steps(name, seed, found):
                    worst.write(json.dumps(each) + "\n")
                worst.flush()
                if not options.json:
                    print(line(row), flush=True)
    if options.json:
        print(json.dumps(rows, indent=1))


HEAD = (
    f"{'world':<14}{'seed':>11}{'steps':>6}{'p50':>10}{'p99':>10}{'max':>10}{'>1.001':>7}{'>1.01':>6}{'unconv':>7}"
    f"{'worst conv':>11}{'odo σ':>7}{'chi2 off':>9}{'idle':>5}{'idle s':>7}{'idle ratio-1':>13}{'s':>6}"
)


def line(row: dict[str, Any]) -> str:
    """For a person."""
    return (
        f"{row['world']:<14}{row['seed']:>11}{row['steps']:>6}{row['p50']:>10.6f}{row['p99']:>10.5f}{row['max']:>10.4f}"
        f"{row['above_1_001']:>7}{row['above_1_01']:>6}{row['unconverged']:>7}{row['worst_converged']:>11.4f}"
        f"{row['odometry_excess']:>7.2f}{row['chi2_untrue']:>9.2g}{row['idle_steps']:>5}{row['idle_s']:>7.2f}"
        f"{row['idle_ratio'] - 1:>13.1e}{row['wall_s']:>6.1f}"
    )


if __name__ == "__main__":
    main()
