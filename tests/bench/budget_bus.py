"""Clients that drive on in one large map at once, on a service whose steps have a budget and on one without.

The map has the streets of `bench budget`.  Then every client goes on from its end, each with poses of its own, along
the same way and with the same loops into what was there before.  It sends an insert a period and is timed from there
until the delta with it has come, which is when everybody has an estimate that knows of it.
"""

import json
import queue
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import zenoh

sys.path.insert(0, str(Path(__file__).parents[1]))

from processes import processes

from factorbus.client import Map, connect
from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import manhattan

MAP, MINE = "streets", 1_000_000  # the keys of client n are those of the drive and n MINE
_TOGETHER = 500  # steps that go into one insert, while the map is made
_PATIENCE_S = 300.0
Row = dict[str, Any]


def compare_on_bus(poses: int, budget_ms: float, clients: int, inserts: int, period_s: float, seed: int) -> list[Row]:
    """A row with the budget, and one without."""
    steps = [step.batch for step in manhattan(poses + inserts, seed)]
    rows = [drive(steps, poses, each, clients, period_s) for each in (budget_ms, 0.0)]
    for row in rows:
        row["cpu_ratio"] = row["solver_cpu_s"] / rows[1]["solver_cpu_s"]
    return rows


def drive(steps: Sequence[Batch], poses: int, budget_ms: float, clients: int, period_s: float) -> Row:
    """What clients measure, on a service of their own."""
    with TemporaryDirectory() as folder, processes(Path(folder)) as start:
        service = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--budget-ms", str(budget_ms))
        endpoint = service.ready()[0]
        with connect(endpoint, client="before", timeout_s=_PATIENCE_S) as bus, bus.map(MAP, mirror=False) as driven:
            for begin in range(0, poses, _TOGETHER):
                driven.insert(together(steps[begin : min(begin + _TOGETHER, poses)]))
            driven.settle()
            before = driven.stats()
            watch = Watch(endpoint)
            drivers = [Driver(endpoint, n + 1, steps[poses:], period_s) for n in range(clients)]
            for each in drivers:
                each.start()
            for each in drivers:
                each.join()
            taken = [watch.seen(revision) - began for each in drivers for began, revision in each.sent]
            began, stats = time.perf_counter(), driven.stats()
            while not stats.get("complete", stats["converged"]):
                time.sleep(0.05)  # stats tell nobody that they have changed
                stats = driven.stats()
            idle_s = time.perf_counter() - began
            watch.close()
    p50, p99, most = 1e3 * np.percentile(taken, [50, 99, 100])
    return {
        "world": "manhattan",
        "poses": poses,
        "clients": clients,
        "inserts": len(taken),
        "budget_ms": budget_ms,
        "insert_to_delta_ms": {"p50": float(p50), "p99": float(p99), "max": float(most)},
        "step_ms": watch.step_ms(before["revision"]),
        "work_share": {
            "p99": float(np.percentile(watch.work_shares or [0.0], 99)),
            "max": max(watch.work_shares or [0.0]),
        },
        "left": watch.left / max(len(watch.steps_ms), 1),
        "complete_after_s": idle_s,
        "solver_cpu_s": stats["solver_cpu_s"] - before["solver_cpu_s"],
        "chi2": stats["chi2"],
    }


def together(batches: Sequence[Batch], first: int = 0, new: int = 0) -> Batch:
    """One batch of several, group by group.  Keys from `first` on are moved by `new`, to be another client's."""
    variables: dict[tuple[str, bool], list[Variables]] = {}
    factors: dict[tuple[str, str], list[Factors]] = {}
    for batch in batches:
        for group in batch.variables:
            variables.setdefault((group.kind, group.fixed), []).append(group)
        for group in batch.factors:
            factors.setdefault((group.kind, group.loss), []).append(group)

    def moved(each: np.ndarray) -> np.ndarray:
        return np.where(each >= first, each + new, each) if new else each

    def column(groups: Sequence[Any], name: str) -> Any:
        return None if getattr(groups[0], name) is None else np.concatenate([getattr(g, name) for g in groups])

    return Batch(
        tuple(
            Variables(kind, moved(column(groups, "keys")), column(groups, "values"), fixed)
            for (kind, fixed), groups in variables.items()
        ),
        tuple(
            Factors(
                kind, moved(column(groups, "keys")), column(groups, "measured"), column(groups, "information"), loss,
                column(groups, "scale"),
            )
            for (kind, loss), groups in factors.items()
        ),
    )  # fmt: skip


class Driver(threading.Thread):
    """One client; `sent`: when each of its inserts began, and the revision that has it."""

    def __init__(self, endpoint: str, number: int, steps: Sequence[Batch], period_s: float) -> None:
        super().__init__(daemon=True)
        self._endpoint, self._number, self._steps = endpoint, number, steps
        self._first, self._period_s = int(steps[0].variables[0].keys[0]), period_s
        self.sent: list[tuple[float, int]] = []

    def run(self) -> None:
        name = f"robot{self._number}"
        with connect(self._endpoint, client=name, timeout_s=_PATIENCE_S) as bus, bus.map(MAP, mirror=False) as driven:
            self._drive(driven)

    def _drive(self, driven: Map) -> None:
        due = time.perf_counter() + self._period_s * np.random.default_rng(self._number).uniform()
        for batch in self._steps:
            time.sleep(max(due - time.perf_counter(), 0.0))  # the pace of the drive
            began = time.perf_counter()
            accepted = driven.insert(together([batch], self._first, self._number * MINE))
            self.sent.append((began, accepted.revision))
            due = max(due + self._period_s, time.perf_counter())


class Watch:
    """When each delta of the map came, and what its report says."""

    def __init__(self, endpoint: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        self._came: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        self._at: dict[int, float] = {}
        self.steps_ms: dict[int, float] = {}
        self.left, self.work_shares = 0, list[float]()
        self._session = zenoh.open(config)
        self._session.declare_subscriber(keys.delta_key(MAP), zenoh.handlers.Callback(self._take, indirect=False))

    def _take(self, sample: Any) -> None:
        self._came.put((time.perf_counter(), sample.payload.to_bytes()))

    def seen(self, revision: int) -> float:
        """When the delta of that revision came."""
        while revision not in self._at:
            at, data = self._came.get(timeout=_PATIENCE_S)
            delta = codec.decode_delta(data)
            self._at[delta.revision] = at
            self.steps_ms[delta.revision] = delta.report["step_ms"]
            self.left += not delta.report["complete"]
            if "budget" in delta.report:
                self.work_shares.append(delta.report["work"] / delta.report["budget"])
        return self._at[revision]

    def step_ms(self, after: int) -> Row:
        """Percentiles of the solver's steps."""
        found = [step_ms for revision, step_ms in self.steps_ms.items() if revision > after]
        p50, p99, most = np.percentile(found, [50, 99, 100])
        return {"p50": float(p50), "p99": float(p99), "max": float(most)}

    def close(self) -> None:
        """No more."""
        self._session.close()


def shown_on_bus(row: Row) -> str:
    """A row as a line."""
    delta, steps = row["insert_to_delta_ms"], row["step_ms"]
    return (
        f"{row['world']:18} {row['poses']:6} {row['budget_ms']:5g} ms"
        f"  {row['clients']} clients, {row['inserts']} inserts"
        f"  insert to delta {delta['p50']:.2f} {delta['p99']:.2f} {delta['max']:.2f}"
        f"  steps {steps['p50']:.2f} {steps['p99']:.2f} {steps['max']:.2f}"
        f"  work {row['work_share']['p99']:.2f} {row['work_share']['max']:.2f}"
        f"  left {row['left']:.1%}, complete after {row['complete_after_s']:.2f} s"
        f"  χ² {row['chi2']:.6g}  cpu {row['cpu_ratio']:.2f}"
    )
