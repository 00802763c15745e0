"""Workers: what two do that one does not, and what the way to them costs.

A service, workers and this process as a filter front end, all on this machine.  The front end keeps questions in
flight, large ones, whose rows go through shared memory that is used again.  One worker and two are measured in turns,
several times, so that what else the machine does meets both.
"""

import statistics
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from naive.random_sightings import random_sighting

from factorbus import idp
from factorbus.client import Bus, Features, Growing, Map, connect
from factorbus.idp import minimal

GOAL = 1.7
_FEATURES = 600
_IN_FLIGHT = 6
_ROUNDS, _ROUND_S = 4, 1.5


def measure() -> dict[str, Any]:
    """Questions per second with one worker and with two, their ratio, and the way."""
    with ExitStack() as stack:
        endpoint = stack.enter_context(process("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0"))
        bus = stack.enter_context(connect(endpoint, client="bench", timeout_s=60))
        watch = stack.enter_context(bus.map("bench", mirror=False))
        front = Front(bus)
        rates: dict[int, list[float]] = {1: [], 2: []}
        alone = front.run(_ROUND_S)
        with worker(endpoint, watch, "first"):
            front.run(_ROUND_S)  # warm
            for _ in range(_ROUNDS):
                rates[1].append(front.run(_ROUND_S))
                with worker(endpoint, watch, "second"):
                    front.run(_ROUND_S / 3)
                    rates[2].append(front.run(_ROUND_S))
            way = next(row for row in watch.stats()["workers"] if row["name"] == "first")
            overhead_s = front.overhead()
        ratios = [two / one for one, two in zip(rates[1], rates[2], strict=True)]
        front.close()
    return {
        "features": _FEATURES,
        "questions_per_s": {"in_place": alone, "one": max(rates[1]), "two": max(rates[2])},
        "ratios": ratios,
        "ratio": statistics.median(ratios),
        "goal": GOAL,
        "way_ms": way["trip_ms"],
        "byte_ns": way["byte_ns"],
        "overhead_ms": overhead_s * 1e3,
        "work_ms": front.work_s * 1e3,
    }


class Front:
    """A filter front end that asks for the features of the same pixels again and again."""

    def __init__(self, bus: Bus) -> None:
        self._sighting, self._P = random_sighting(5, _FEATURES)
        prior = {name: getattr(self._sighting, name) for name in ("rho", "sigma_rho", "sigma_pixel")}
        self._features: Features = bus.features(self._sighting.camera, **prior)
        seen = idp.see(self._sighting)
        self._expected = minimal.covariance(self._P, self._sighting, seen).P
        self.work_s = 0.0

    def run(self, seconds: float) -> float:
        """Questions per second."""
        under_way: deque[Growing] = deque(self._send() for _ in range(_IN_FLIGHT))
        started, done = time.perf_counter(), 0
        while (spent := time.perf_counter() - started) < seconds:
            under_way.popleft().result()
            under_way.append(self._send())
            done += 1
        for growing in under_way:
            grown = growing.result()
        if not np.array_equal(grown.P, self._expected):
            raise RuntimeError("the bench got another covariance than it computed itself")
        return done / spent

    def overhead(self) -> float:
        """Seconds that an answer takes beyond what its slowest worker took, the median; one at a time."""
        beyond, work = [], []
        for _ in range(40):
            started = time.perf_counter()
            growing = self._send()
            growing.future.result()
            took = time.perf_counter() - started
            grown = growing.result()
            beyond.append(took - grown.seconds)
            work.append(grown.seconds)
        self.work_s = statistics.median(work)
        return statistics.median(beyond)

    def close(self) -> None:
        self._features.close()

    def _send(self) -> Growing:
        return self._features.send(self._sighting.state, self._P, self._sighting.pixels)


@contextmanager
def worker(endpoint: str, watch: Map, name: str) -> Iterator[None]:
    """A worker, from when the service knows the way to it until it has left."""
    with process("-m", "factorbus.workers", "--connect", endpoint, "--name", name):
        _until(watch, lambda rows: any(row["name"] == name and "trip_ms" in row for row in rows))
        yield
    _until(watch, lambda rows: all(row["name"] != name for row in rows))


def _until(watch: Map, told: Any) -> None:
    ready = threading.Event()
    while not told(watch.stats()["workers"]):
        ready.wait(0.02)  # there is nothing on the bus to wait for: the measure is the service's own


@contextmanager
def process(*arguments: str) -> Iterator[str]:
    """A Python process that prints `ready WHAT`; it is ended by SIGTERM."""
    command, pipe = [sys.executable, *arguments], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stdin=pipe, stderr=subprocess.DEVNULL, text=True) as started:
        try:
            line = started.stdout.readline() if started.stdout else ""
            if not line.startswith("ready "):
                raise RuntimeError(f"{' '.join(command)} did not get ready: {line!r}")
            yield line.split()[1]
        finally:
            started.terminate()
            started.wait(20)
