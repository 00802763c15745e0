"""A stream of inserts into a map, measured: what `replay` and the demo's robot do.

Where the map is (on the bus, in this process) is the target's business; both give the same summary.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from factorbus.proto.messages import Batch, Variables
from factorbus.proto.problems import BetterOptimum
from factorbus.proto.roles import poses_aside

if TYPE_CHECKING:
    from factorbus.formats import FileNotes


@dataclass(frozen=True, slots=True)
class DriveStep:
    """One insert that is in: from `revision` on.  bus_ms: waited beyond the solver's time; None without a bus."""

    revision: int
    report: Mapping[str, Any]
    bus_ms: float | None


@dataclass(frozen=True, slots=True)
class Compared:
    """χ² at `revision` beside the optimum of the same graph found from scratch, by `worker` in `seconds`.

    start: what led to that optimum; variables: the optimum, if it was asked for.  batch_converged: false where the
    search for it ended before it had converged.
    """

    revision: int
    chi2: float
    batch: float
    worker: str
    seconds: float
    start: str = ""
    variables: tuple[Variables, ...] = ()
    batch_converged: bool = True

    @property
    def ratio(self) -> float:
        """χ² over the batch optimum: 1.0 is as good as it gets, if that has converged."""
        return self.chi2 / self.batch if self.batch else float(self.chi2 > 0) + 1.0

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        told = ("revision", "chi2", "batch", "ratio", "worker", "seconds", "start", "batch_converged")
        return {name: getattr(self, name) for name in told} | {"better_optimum": self.notice is not None}

    @property
    def notice(self) -> BetterOptimum | None:
        """What is to be said where the map is well above that optimum."""
        return BetterOptimum.or_none(self.chi2, self.batch, self.start)


class Target(Protocol):
    """A map to drive into."""

    def send(self, batch: Batch) -> list[DriveStep]:
        """Insert `batch`; gives the inserts whose answers came since the last call, oldest first."""
        ...

    def flush(self) -> list[DriveStep]:
        """Wait until all inserts are answered and their estimate is here; gives those not given yet."""
        ...

    def settle(self) -> DriveStep:
        """Iterate until converged."""
        ...

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate; a report has that of the linear problem."""
        ...

    def compare(self) -> None:
        """Have the present χ² held against the batch optimum; the result is in `compared` sooner or later."""
        ...

    def optimum(self) -> Compared:
        """The same with the optimum itself, waited for."""
        ...

    def adopt(self, found: Compared) -> DriveStep:
        """Go to an optimum, and settle there."""
        ...

    def compared(self) -> list[Compared]:
        """Wait for the comparisons still out; gives all of them, by revision."""
        ...

    def estimate(self) -> tuple[Variables, ...]:
        """All variables, as they are now."""
        ...

    def graph(self) -> Batch:
        """All variables and factors, as they are now."""
        ...

    def closures_out(self) -> "FileNotes":
        """What a file of the graph leaves out of the closures of the map."""
        ...

    def summary(self) -> dict[str, Any]:
        """solver_cpu_s, kernels_compiled_s, deltas (received) and whatever else the target knows of itself."""
        ...


@dataclass(slots=True)
class Driven:
    """What came of a drive."""

    seconds: float = 0.0
    inserts: int = 0
    poses: int = 0
    landmarks: int = 0
    factors: int = 0
    steps: list[DriveStep] = field(default_factory=list)
    aside: set[int] = field(default_factory=set)

    def add(self, batch: Batch) -> None:
        """Count `batch`."""
        self.inserts += 1
        # Mounts, and the map's pose in the frame of GNSS, also where they came before the factor that tells.
        found = set(poses_aside(batch).tolist()) - self.aside
        self.aside |= found
        for group in batch.variables:
            if group.kind in ("se2", "se3"):
                self.poses += int((~np.isin(group.keys, list(self.aside))).sum())
                found.difference_update(group.keys.tolist())
            elif not group.kind.startswith("vector"):
                self.landmarks += len(group.keys)
        self.poses -= len(found)
        self.factors += batch.factor_count

    def measures(self) -> dict[str, Any]:
        """Counts, times and strategies, for JSON.  A step that applied several inserts counts once."""
        reports = list({step.revision: step.report for step in self.steps}.values())
        bus = [step.bus_ms for step in self.steps if step.bus_ms is not None]
        return {
            "poses": self.poses,
            "landmarks": self.landmarks,
            "factors": self.factors,
            "steps": len(reports),
            "inserts": self.inserts,
            "revision": self.steps[-1].revision if self.steps else 0,
            "seconds": self.seconds,
            "poses_per_s": self.poses / self.seconds if self.seconds else 0.0,
            "step_ms": percentiles([report["step_ms"] for report in reports]),
            "bus_ms": percentiles(bus) if bus else None,
            "strategies": dict(Counter(report["strategy"] for report in reports)),
            "mode": reports[-1]["mode"] if reports else "",
        }


def insert_steps(
    target: Target, batches: Iterable[Batch], every: int = 0, show: Callable[[int, str], None] | None = None
) -> Driven:
    """Insert `batches` one after the other; with `every`, hold χ² against the batch optimum at every Nth.

    show(poses so far, a word on how it goes) is called now and then.
    """
    driven, window = Driven(), _Recent()
    start = time.perf_counter()
    for batch in batches:
        driven.add(batch)
        driven.steps += target.send(batch)
        if every and driven.inserts % every == 0:
            driven.steps += target.flush()  # what is held against the optimum is this step, not one before it
            target.compare()
        if show is not None and window.due():
            show(driven.poses, window.word(driven))
    driven.steps += target.flush()
    driven.seconds = time.perf_counter() - start
    if show is not None:
        show(driven.poses, window.word(driven))
    return driven


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """p50, p95, p99 and the largest of `values`; zeros where there are none."""
    if not values:
        return {"p50": 0.0, "p95": 0.0, "p99": 0.0, "max": 0.0}
    p50, p95, p99 = np.percentile(values, (50, 95, 99)).tolist()
    return {"p50": p50, "p95": p95, "p99": p99, "max": float(max(values))}


class _Recent:
    """How it goes, over the last second or so."""

    def __init__(self) -> None:
        self._since = self._shown = time.perf_counter()
        self._poses = 0

    def due(self) -> bool:
        return time.perf_counter() - self._shown > 0.1

    def word(self, driven: Driven) -> str:
        now = self._shown = time.perf_counter()
        rate = (driven.poses - self._poses) / max(now - self._since, 1e-9)
        if now - self._since > 1.0:
            self._since, self._poses = now, driven.poses
        recent = driven.steps[-500:]
        if not recent:
            return f"{rate:.0f}/s"
        p99 = percentiles([step.report["step_ms"] for step in recent])["p99"]
        return f"{rate:.0f}/s χ² {recent[-1].report['chi2']:.6g} p99 {p99:.1f} ms"
