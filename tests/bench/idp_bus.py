"""Workers: what two do that one does not, and what the way to them costs.

A service, workers and this process as a filter front end, all on this machine.  The front end keeps questions in
flight, large ones, whose rows go through shared memory that is used again.  One worker and two are measured in turns,
many times for half a second; what counts is the median of the pairs.
"""

import statistics
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from naive.random_cameras import random_observations

from factorbus import idp
from factorbus.client import Bus, Features, Growing, Map, connect
from factorbus.idp import minimal

GOAL = 1.7
_FEATURES = 600
_IN_FLIGHT = 6
_ROUNDS, _ROUND_S = 10, 0.6


def measure() -> dict[str, Any]:
    """Questions per second with one worker and with two, their ratio, and the way."""
    with ExitStack() as stack:
        none, one, two = (stack.enter_context(front(count)) for count in (0, 1, 2))
        for each in (none, one, two):
            each.run(_ROUND_S / 2)  # warm
        rates = {"in_place": none.run(_ROUND_S)}
        pairs = [(one.run(_ROUND_S), two.run(_ROUND_S)) for _ in range(_ROUNDS)]
        rates |= {"one": max(first for first, _ in pairs), "two": max(second for _, second in pairs)}
        ratios = [second / first for first, second in pairs]
        way, beyond_s, work_s = one.way(), *one.beyond()
    return {
        "features": _FEATURES,
        "questions_per_s": rates,
        "ratios": ratios,
        "ratio": statistics.median(ratios),
        "goal": GOAL,
        "way_ms": way["latency_ms"],
        "byte_ns": way["byte_ns"],
        "overhead_ms": beyond_s * 1e3,
        "work_ms": work_s * 1e3,
    }


@contextmanager
def front(workers: int) -> Iterator["Front"]:
    """A filter front end of a service of its own with a number of workers, the way to all of which is known."""
    with ExitStack() as stack:
        endpoint = stack.enter_context(process("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--no-warm"))
        for number in range(workers):
            name = f"w{number}"
            stack.enter_context(process("-m", "factorbus.workers", "--connect", endpoint, "--name", name, "--no-warm"))
        bus = stack.enter_context(connect(endpoint, client="bench", timeout_s=60))
        watch = stack.enter_context(bus.map("bench", mirror=False))
        made = Front(bus, watch)
        while sum("latency_ms" in row for row in watch.stats()["workers"]) < workers:
            made.run(0.05)
        yield made


class Front:
    """A filter front end that asks for the features of the same pixels again and again."""

    def __init__(self, bus: Bus, watch: Map) -> None:
        self._watch = watch
        self._observations, self._P = random_observations(5, _FEATURES)
        prior = {name: getattr(self._observations, name) for name in ("rho", "sigma_rho", "sigma_pixel")}
        self._features: Features = bus.features(self._observations.camera, **prior)
        seen = idp.see(self._observations)
        self._expected = minimal.covariance(self._P, self._observations, seen).P

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

    def beyond(self) -> tuple[float, float]:
        """(seconds of an answer beyond those of its slowest worker, these), medians, one at a time."""
        beyond, work = [], []
        for _ in range(40):
            started = time.perf_counter()
            growing = self._send()
            growing.future.result()
            took = time.perf_counter() - started
            work.append(growing.result().seconds)
            beyond.append(took - work[-1])
        return statistics.median(beyond), statistics.median(work)

    def way(self) -> dict[str, float]:
        """What the service has measured of the way to a worker."""
        return self._watch.stats()["workers"][0]

    def _send(self) -> Growing:
        return self._features.send(self._observations.state, self._P, self._observations.pixels)


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
