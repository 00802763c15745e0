"""Workers killed and frozen in mid-job, again and again: every feature of every question arrives, once, in order.

FACTORBUS_FAULTS says how often (40 by default).
"""

import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random

import numpy as np
import pytest
from naive.random_cameras import random_observations
from processes import Process

from factorbus import idp
from factorbus.client import Features, connect
from factorbus.idp import minimal

Spawn = Callable[..., Process]
FAULTS = int(os.environ.get("FACTORBUS_FAULTS", "40"))
NURSERY = Path(__file__).with_name("nursery.py")
N = 150


class Workers:
    """Two workers, of which one at a time is killed or frozen; there are always two again."""

    def __init__(self, spawn: Spawn, endpoint: str) -> None:
        self._nursery = spawn(str(NURSERY), endpoint)
        self._nursery.ready()
        self._born = 0
        self._timers: list[threading.Timer] = []
        self.pids = [self._bear(), self._bear()]
        self.faults = {"killed": 0, "frozen": 0}

    def hurt(self, chance: Random) -> None:
        """Kill one and bear another; or freeze one for a moment, longer than a shard may take."""
        place = chance.randrange(2)
        pid = self.pids[place]
        if chance.random() < 0.5:
            os.kill(pid, signal.SIGKILL)
            self.pids[place] = self._bear()
            self.faults["killed"] += 1
        else:
            os.kill(pid, signal.SIGSTOP)
            self.faults["frozen"] += 1
            self._thaw(pid, chance.uniform(0.0, 0.4))

    def end(self) -> None:
        for timer in self._timers:
            timer.cancel()
            timer.join()
        for pid in self.pids:
            os.kill(pid, signal.SIGKILL)

    def _thaw(self, pid: int, after_s: float) -> None:
        def thaw() -> None:
            with suppress(ProcessLookupError):  # killed meanwhile
                os.kill(pid, signal.SIGCONT)

        self._timers.append(threading.Timer(after_s, thaw))
        self._timers[-1].start()

    def _bear(self) -> int:
        self._born += 1
        name = f"w{self._born}"
        self._nursery.tell(name)
        return int(self._nursery.line(f"born {name}")[0])


@pytest.fixture
def endpoint(spawn: Spawn, tmp_path: Path) -> str:
    settings = tmp_path / "service.toml"
    settings.write_text("job_deadline_s = 0.15\nwarm = false\n")
    service = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--config", str(settings))
    return service.ready()[0]


@pytest.mark.timeout(60 + 15 * FAULTS)
def test_no_feature_is_lost_doubled_or_out_of_order(spawn: Spawn, endpoint: str) -> None:
    chance = Random(7)
    print("seed 7")
    questions = []
    for seed in range(4):
        observations, P = random_observations(seed, N, seed)
        seen = idp.see(observations)
        questions.append((observations, P, seen.y, minimal.covariance(P, observations, seen).P))
    workers = Workers(spawn, endpoint)
    helped: set[str] = set()
    retried = asked = 0
    try:
        with connect(endpoint, client="camera", timeout_s=60) as bus:
            fronts = [front(bus, q[0]) for q in questions]
            # Under load the first questions are answered before all workers have started, and a fast
            # machine has answered most of them before a fault comes.
            while sum(workers.faults.values()) < FAULTS or len(helped - {"in-place"}) <= 2 or retried < FAULTS // 10:
                under_way = []
                for (observations, P, _, _), features in zip(questions, fronts, strict=True):
                    x = np.concatenate([observations.state, np.zeros(observations.width - 13)])
                    under_way.append(features.send(x, P, observations.pixels))
                    if chance.random() < 0.5:
                        workers.hurt(chance)
                for growing, (_, _, y, after) in zip(under_way, questions, strict=True):
                    grown = growing.result()
                    assert grown.y.tobytes() == y.tobytes()
                    assert grown.P.tobytes() == after.tobytes()
                    helped |= set(grown.workers)
                    asked, retried = asked + 1, retried + (not growing.future.result().clean)
    finally:
        workers.end()
    print(f"{asked} questions, {retried} with a shard done again; {workers.faults}; {len(helped)} workers took part")


def front(bus, observations) -> Features:
    prior = {name: getattr(observations, name) for name in ("rho", "sigma_rho", "sigma_pixel")}
    return bus.features(observations.camera, **prior)
