"""What a map needs: memory of a pose, CPU time of an insert, and bytes for a viewer, on simulated worlds.

    python tests/bench/sizing.py [--worlds manhattan,city_trees,sphere] [--poses 1000,3000,10000] [--window N] [--json]

A service of its own is started for each world, and a robot drives through it, a pose with its measurements an insert.
A viewer, another session, takes every delta and counts its bytes.  Before that a short drive on another map, which is
dropped, has loaded the kernels.  At each number of poses a row:

memory       resident memory of the service, less what it was before the drive (given as well); a pose's share of it
CPU          user and system time of the service by then, all threads, bus included; inserts in a second of it
delta        bytes published after one insert: the values that the step changed, mean, median, 99 %
estimate     bytes of the whole estimate, which a viewer fetches once when it joins
round trip   from the call of `insert` to its return, when the estimate has what was sent: median

A window above 1 sends without waiting, as a robot that streams does: the service takes what waits in one step.
"""

import argparse
import json
import os
import platform
import queue
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import zenoh
from bus import session
from process_memory import resident
from processes import processes
from zenoh.handlers import Callback

from factorbus.client import connect
from factorbus.client.map import Map
from factorbus.proto import keys
from factorbus.proto.version import __version__
from factorbus.simulate import WORLDS

WARM_UP = 60  # poses
PATIENCE_S = 300.0  # of one step: where a whole map moves, on a machine with other work
CPUCLOCK_SCHED = 2


class Viewer:
    """Takes every delta of a map; says how large each was, once as many have come as are asked for."""

    def __init__(self, bus: zenoh.Session, name: str) -> None:
        self._came: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._subscriber = bus.declare_subscriber(keys.delta_key(name), Callback(self._on_delta, indirect=False))

    def sizes(self, count: int) -> list[int]:
        """Of the next `count` deltas."""
        return [self._came.get(timeout=PATIENCE_S) for _ in range(count)]

    def _on_delta(self, sample: zenoh.Sample) -> None:
        self._came.put(len(sample.payload))


def run(worlds: list[str], marks: list[int], window: int, seed: int) -> dict[str, Any]:
    """A row a world and number of poses."""
    rows = [row for world in worlds for row in drive(world, marks, window, seed)]
    return {
        "window": window,
        "seed": seed,
        "rows": rows,
        "versions": {
            "factorbus": __version__,
            "Python": platform.python_version(),
            **{name: version(name) for name in ("numba", "eclipse-zenoh")},
        },
        "processor": processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }


def drive(world: str, marks: list[int], window: int, seed: int) -> Iterator[dict[str, Any]]:
    """One world, to the last of `marks`; a row at each of them."""
    with service() as (endpoint, pid), session(endpoint) as other, connect(endpoint, client="robot") as bus:
        with bus.map("warm-up") as warm_up:
            for step in WORLDS[world](WARM_UP, seed):
                warm_up.insert(step.batch, timeout_s=PATIENCE_S)
        bus.drop("warm-up")
        viewer, before, began = Viewer(other, "sizing"), resident(pid), cpu_seconds(pid)
        with bus.map("sizing", window=window, mirror=False) as driven:
            steps, done, factors, deltas, trips = WORLDS[world](marks[-1], seed), 0, 0, [], []
            for mark in marks:
                for step in islice(steps, mark - done):
                    factors += step.batch.factor_count
                    trips.append(send(driven, step.batch, window))
                driven.flush(PATIENCE_S)
                if window == 1:
                    deltas += viewer.sizes(mark - done)
                done = mark
                yield {
                    "world": world,
                    "poses": mark,
                    "factors": factors,
                    "idle_bytes": before,
                    "memory_bytes": resident(pid) - before,
                    "cpu_s": round(cpu_seconds(pid) - began, 3),
                    "delta_bytes": [round(float(np.mean(deltas))), *map(int, np.percentile(deltas, (50, 99)))]
                    if deltas
                    else None,
                    "estimate_bytes": estimate_bytes(other),
                    "round_trip_ms": round(1e3 * float(np.median(trips)), 3) if window == 1 else None,
                }


def send(driven: Map, batch: Any, window: int) -> float:
    """Seconds; with a window above 1 until the insert is on its way."""
    began = time.perf_counter()
    if window == 1:
        driven.insert(batch, timeout_s=PATIENCE_S)
    else:
        driven.send(batch, timeout_s=PATIENCE_S)
    return time.perf_counter() - began


def estimate_bytes(bus: zenoh.Session) -> int:
    """Of the answer that has the whole estimate."""
    (reply,) = bus.get(keys.ask_key("sizing", "estimate"), payload=b"\x80", timeout=PATIENCE_S)
    if reply.ok is None:
        raise RuntimeError(f"the estimate was refused: {reply.err.payload.to_bytes() if reply.err else b''!r}")
    return len(reply.ok.payload)


@contextmanager
def service() -> Iterator[tuple[str, int]]:
    """A service without a journal: endpoint, process id."""
    with tempfile.TemporaryDirectory() as folder, processes(Path(folder)) as start:
        process = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0")
        yield process.ready()[0], process.pid


def cpu_seconds(pid: int) -> float:
    """Of a process, all its threads, to the nanosecond: /proc/⟨pid⟩/stat has no more than hundredths."""
    return time.clock_gettime((~pid << 3) | CPUCLOCK_SCHED)  # as clock_getcpuclockid(3) has it


def processor() -> str:
    """What the machine says it has."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def table(result: dict[str, Any]) -> str:
    """The result for a person."""
    lines = [
        f"{'world':<12}{'poses':>8}{'factors':>9}{'MB':>7}{'KB/pose':>9}{'CPU s':>8}{'inserts/CPU s':>15}"
        f"{'KB/delta: mean':>16}{'p50':>8}{'p99':>8}{'KB estimate':>13}{'ms p50':>8}"
    ]
    for row in result["rows"]:
        deltas = [f"{each / 1e3:.2f}" for each in row["delta_bytes"]] if row["delta_bytes"] else ["-"] * 3
        trip = "-" if row["round_trip_ms"] is None else f"{row['round_trip_ms']:.2f}"
        memory, poses = row["memory_bytes"], row["poses"]
        lines.append(
            f"{row['world']:<12}{poses:>8,}{row['factors']:>9,}{memory / 1e6:>7.0f}{memory / 1e3 / poses:>9.1f}"
            f"{row['cpu_s']:>8.2f}{poses / row['cpu_s']:>15,.0f}{deltas[0]:>16}{deltas[1]:>8}{deltas[2]:>8}"
            f"{row['estimate_bytes'] / 1e3:>13.0f}{trip:>8}"
        )
    idle = max((row["idle_bytes"] for row in result["rows"]), default=0)
    lines.append(f"a service before the drive, kernels loaded: {idle / 1e6:.0f} MB")
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    lines.append(
        f"window {result['window']}, seed {result['seed']}; {versions}; "
        f"{result['processor']}, {result['cores']} cores, load {result['load']:.1f}"
    )
    return "\n".join(lines)


def main() -> int:
    """0: it was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(WORLDS), help="by name, separated by commas")
    parser.add_argument("--poses", default="1000,3000,10000", help="where to look, ascending")
    parser.add_argument("--window", type=int, default=1, help="inserts on their way unanswered")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    options = parser.parse_args()
    marks = sorted(int(each) for each in options.poses.split(","))
    result = run(options.worlds.split(","), marks, options.window, options.seed)
    print(json.dumps(result, indent=2) if options.json else table(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
