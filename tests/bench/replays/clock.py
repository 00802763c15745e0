"""What a replay costs: CPU time of the process (all its threads) and wall time of every step."""

import itertools
import time
from typing import Any

import numpy as np

from .columns import F64
from .contestants import Contestant

_POINTS = 400  # of the curve of cumulative time
_STRETCHES = 120  # of the curve of the time per step


class Clock:
    """The solving and the reading of every step, apart."""

    def __init__(self, steps: int) -> None:
        self._solve, self._read, self._wall = np.zeros(steps), np.zeros(steps), np.zeros(steps)
        self._done, self.cpu_s = 0, 0.0

    def run(self, k: int, contestant: Contestant) -> None:
        """Step k.  Raises Failed."""
        wall, start = time.perf_counter(), time.process_time()
        contestant.step()
        solved = time.process_time()
        contestant.read()
        end, wall_end = time.process_time(), time.perf_counter()
        self._solve[k], self._read[k], self._wall[k] = solved - start, end - solved, wall_end - wall
        self.cpu_s += end - start
        self._done = k + 1

    def account(self) -> dict[str, Any]:
        """Sums, percentiles over the steps, and curves along the replay."""
        n = self._done
        cpu = (self._solve + self._read)[:n]
        points = np.unique(np.linspace(0, max(n - 1, 0), min(n, _POINTS)).astype(int))
        return {
            "done": n,
            "cpu_s": float(cpu.sum()),
            "solve_s": float(self._solve.sum()),
            "read_s": float(self._read.sum()),
            "wall_s": float(self._wall.sum()),
            "step_ms": percentiles(cpu),
            "solve_ms": percentiles(self._solve[:n]),
            "step_wall_ms": percentiles(self._wall[:n]),
            "cumulative": [points.tolist(), np.cumsum(cpu)[points].round(6).tolist()] if n else [[], []],
            "along": along(cpu),
        }


def percentiles(seconds: F64) -> dict[str, float]:
    """p50, p95, p99 and max, in milliseconds."""
    if not len(seconds):
        return {}
    p50, p95, p99 = (float(1e3 * value) for value in np.percentile(seconds, (50, 95, 99)))
    return {"p50": p50, "p95": p95, "p99": p99, "max": float(1e3 * seconds.max())}


def along(seconds: F64) -> dict[str, list[float]]:
    """Median and longest step of equal stretches of a replay, in milliseconds; step: the last one of each."""
    edges = np.unique(np.linspace(0, len(seconds), min(len(seconds), _STRETCHES) + 1).astype(int))
    parts = [1e3 * seconds[a:b] for a, b in itertools.pairwise(edges)]
    return {
        "step": (edges[1:] - 1).tolist(),
        "p50": [round(float(np.median(part)), 5) for part in parts],
        "max": [round(float(part.max()), 5) for part in parts],
    }
