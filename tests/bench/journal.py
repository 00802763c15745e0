"""What a journal costs: inserts a second with each durability, and without a journal, at a window of inserts in flight.

    python tests/bench/journal.py [--blocks N] [--inserts N] [--window 32] [--folder DIR] [--json]

Four services run side by side, each with a map of its own, and are driven in turn, a block of inserts each, in an
order that changes: so they share whatever else the machine does.  An insert is one pose with its odometry, now and then
a loop; the time is from the first sending of a block to the last answer.  The folder is to be on the disk of the maps:
what an fsync takes there is given beside.

Goal: with `commit` at least half as many inserts a second as with `none`.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from journalled import drafts
from processes import processes

from factorbus.client import connect
from factorbus.client.map import Map

GOAL = 0.5
KINDS = ("commit", "group", "none", "no journal")


def run(blocks: int, inserts: int, window: int, folder: Path) -> dict[str, Any]:
    """Inserts a second by durability."""
    batches = drafts(blocks * inserts + 1)
    with ExitStack() as stack:
        start = stack.enter_context(processes(folder))
        driven = {kind: _join(stack, start, kind, folder, window) for kind in KINDS}
        for each in driven.values():
            each.insert(batches[0], timeout_s=60)
        rates: dict[str, list[float]] = {kind: [] for kind in KINDS}
        chance = np.random.default_rng(1)
        for block in range(blocks):
            for kind in chance.permutation(np.array(KINDS)):
                part = batches[1 + block * inserts : 1 + (block + 1) * inserts]
                rates[str(kind)].append(_drive(driven[str(kind)], part))
        journals = {kind: driven[kind].stats().get("journal", {}) for kind in KINDS}
    settled = {kind: np.array(each[1:]) for kind, each in rates.items()}  # the first block finds cold caches
    ratio = settled["commit"] / settled["none"]
    commits = journals["commit"]
    return {
        "window": window,
        "inserts": blocks * inserts,
        "inserts_per_s": {kind: round(float(np.median(each)), 1) for kind, each in settled.items()},
        "commit_of_none": {f"p{q}": round(float(np.percentile(ratio, q)), 3) for q in (10, 50, 90)},
        "inserts_per_commit": round(commits["inserts"] / commits["commits"], 2),
        "commit_ms": round(commits["commit_ms"] / commits["commits"], 3),
        "fsync_ms": round(_fsync_ms(folder), 3),
        "goal": GOAL,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }


def _join(stack: ExitStack, start: Any, kind: str, folder: Path, window: int) -> Map:
    options = ("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0")
    if kind in KINDS[:3]:
        options += ("--journal", str(folder / kind), "--durability", kind)
    bus = stack.enter_context(connect(start(*options).ready()[0], client="bench", timeout_s=60))
    return stack.enter_context(bus.map("bench", window=window, mirror=False))


def _drive(driven: Map, part: list[Any]) -> float:
    begun = time.perf_counter()
    for batch in part:
        driven.send(batch, timeout_s=60)
    driven.flush(60)
    return len(part) / (time.perf_counter() - begun)


def _fsync_ms(folder: Path) -> float:
    """Of a page written to a file there, the median of many."""
    with (folder / "probe").open("wb", buffering=0) as file:
        took = []
        for _ in range(50):
            begun = time.perf_counter()
            file.write(bytes(4096))
            os.fdatasync(file.fileno())
            took.append(time.perf_counter() - begun)
    return 1e3 * float(np.median(took))


def main() -> int:
    """1: the goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=8)
    parser.add_argument("--inserts", type=int, default=500, help="in a block")
    parser.add_argument("--window", type=int, default=32)
    parser.add_argument("--folder", type=Path, help="on the disk to be measured; default: where temporary files are")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        result = run(options.blocks, options.inserts, options.window, Path(folder))
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        rates = ", ".join(f"{kind} {rate:,.0f}" for kind, rate in result["inserts_per_s"].items())
        print(f"inserts a second at a window of {result['window']}: {rates}")
        spread = result["commit_of_none"]
        print(f"commit / none: {spread['p50']} (p10 {spread['p10']}, p90 {spread['p90']}); goal {GOAL}")
        print(
            f"{result['inserts_per_commit']} inserts in a commit of {result['commit_ms']} ms; "
            f"an fsync of a page takes {result['fsync_ms']} ms; load {result['load']:.1f}"
        )
    return 0 if result["commit_of_none"]["p50"] >= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
