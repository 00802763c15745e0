"""A replay over the bus: how long a robot waits from an insert until the estimate with it has come.

By the clock, with the service in a process of its own; the robot sends the next step when it has the estimate of the
last.  A short drive on another map, which is dropped, has loaded what is loaded once.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from processes import processes

from factorbus.client import connect

from .clock import percentiles
from .problems import Problem, load

_WARM_UP = 60
_PATIENCE_S = 300.0  # of one step


def over_bus(_job: dict[str, Any], problem: Problem, tell: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """insert_ms: p50, p95, p99, max over all steps."""
    steps = load(problem)
    seconds = np.zeros(len(steps))
    with tempfile.TemporaryDirectory() as folder, processes(Path(folder)) as start:
        endpoint = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0").ready()[0]
        with connect(endpoint, client="robot", timeout_s=_PATIENCE_S) as bus:
            with bus.map("warm-up") as warm_up:
                for batch in steps[:_WARM_UP]:
                    warm_up.insert(batch)
            bus.drop("warm-up")
            with bus.map("replay") as driven:
                for k, batch in enumerate(steps):
                    began = time.perf_counter()
                    driven.insert(batch)
                    seconds[k] = time.perf_counter() - began
                    tell({"done": k + 1})
    return {"insert_ms": percentiles(seconds), "steps": len(steps)}
