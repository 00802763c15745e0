"""A map on the bus, driven or only looked at by this process, and mirrored in it."""

import threading
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

from factorbus.cli.driving.drive import Compared, DriveStep
from factorbus.cli.process.closures_out import closures_out
from factorbus.client import Changes, Map, PendingInsert
from factorbus.proto.messages import Accepted, Batch, Chi2, Delta, Variables

if TYPE_CHECKING:
    from factorbus.formats import FileNotes

# A step of a large map may take long; a service that is gone is noticed otherwise.
_ANSWER_S = 600.0


class RemoteMap:
    """A joined map.  With a window of 1 an insert is done when its answer and its delta are here."""

    def __init__(self, joined: Map, window: int = 1) -> None:
        self._map, self._window = joined, window
        self._mirror = joined.estimate
        self._out: deque[PendingInsert] = deque()
        self._start = self._waited = self._mirror.revision
        self._received: dict[int, Mapping[str, Any]] = {}
        self._latest: Mapping[str, Any] = {}
        self._lock, self._news = threading.RLock(), False  # entered itself: see `client/interruptible_future.py`
        self._changed = threading.Condition(self._lock)
        self._forget = self._mirror.on_delta(self._on_delta)
        self._comparisons: list[Future[Chi2]] = []

    def send(self, batch: Batch) -> list[DriveStep]:
        """Insert, waiting with a window of 1; otherwise with up to `window` inserts out."""
        if self._window == 1:
            start = time.perf_counter()
            accepted = self._map.insert(batch, timeout_s=_ANSWER_S)
            self.wait_for(accepted.revision)
            return [_stepped(accepted, time.perf_counter() - start)]
        self._out.append(self._map.send(batch, timeout_s=_ANSWER_S))
        return self._collect(wait=False)

    def flush(self) -> list[DriveStep]:
        """Until all are answered and mirrored."""
        steps = self._collect(wait=True)
        if steps:
            self.wait_for(steps[-1].revision)
        return steps

    def settle(self) -> DriveStep:
        """Iterate until converged."""
        start = time.perf_counter()
        accepted = self._map.settle(timeout_s=_ANSWER_S)
        self.wait_for(accepted.revision)
        return _stepped(accepted, time.perf_counter() - start)

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate."""
        return self._map.ask.chi2(batch=False, timeout_s=_ANSWER_S).result(_ANSWER_S).chi2

    def compare(self) -> None:
        """Ask for the batch optimum of the present revision; a worker finds it while the drive goes on.

        The map may go on when what the worker needs has been copied: questions are answered in the order in which they
        come, so it has when a later one is answered.
        """
        self._comparisons.append(self._map.ask.chi2(batch=True, timeout_s=_ANSWER_S))
        self.chi2()

    def optimum(self) -> Compared:
        """The batch optimum of the present revision, waited for."""
        return _compared(self._map.ask.chi2(True, _ANSWER_S, values=True).result(_ANSWER_S))

    def adopt(self, found: Compared) -> DriveStep:
        """Go to an optimum, and settle there."""
        start = time.perf_counter()
        changes = Changes().place(found.variables, carry=True)
        accepted = self._map.change(changes, settle=True, timeout_s=_ANSWER_S)
        self.wait_for(accepted.revision)
        return _stepped(accepted, time.perf_counter() - start)

    def compared(self) -> list[Compared]:
        """All comparisons, by revision."""
        done = [_compared(comparison.result(_ANSWER_S)) for comparison in self._comparisons]
        return sorted(done, key=lambda each: each.revision)

    def estimate(self) -> tuple[Variables, ...]:
        """The mirror's present values."""
        return self._mirror.snapshot().variables()

    def graph(self) -> Batch:
        """The map's graph, from the service."""
        return self._map.graph(timeout_s=_ANSWER_S).batch

    def closures_out(self) -> "FileNotes":
        """Closures of the map that its graph does not have, from the service."""
        return closures_out(self._map, _ANSWER_S)

    def summary(self) -> dict[str, Any]:
        """What the service says of itself, and the deltas that came here of revisions that were waited for."""
        stats = self._map.stats(timeout_s=_ANSWER_S)
        return {
            "solver_cpu_s": stats["solver_cpu_s"],
            "kernels_compiled_s": stats["kernels_compiled_s"],
            "deltas": sum(revision <= self._waited for revision in self._received),
            "closure_states": stats.get("closure_states"),
        }

    @property
    def reports(self) -> list[Mapping[str, Any]]:
        """The report of every step whose delta came here, by revision."""
        return [self._received[revision] for revision in sorted(self._received)]

    @property
    def latest(self) -> Mapping[str, Any]:
        """The report of the last step whose delta came here; empty when there is none."""
        return self._latest

    def wait_for(self, revision: int) -> None:
        """Until the estimate of `revision` is here."""
        self._waited = max(self._waited, revision)
        self._mirror.wait_for(revision, timeout_s=_ANSWER_S)

    def wait_for_delta(self, timeout_s: float) -> int:
        """Wait for a delta, or until time is up; gives the revision that the estimate here is of."""
        with self._lock:
            self._changed.wait_for(lambda: self._news, timeout_s)
            self._news = False
        return self._mirror.revision

    def close(self) -> None:
        """Stop listening."""
        self._forget()

    def _on_delta(self, delta: Delta) -> None:
        """Count a step's own delta; a resynchronization (previous 0, everything in one) is not one."""
        if delta.previous == delta.revision - 1 and delta.revision > self._start:
            self._received[delta.revision] = self._latest = delta.report
        with self._lock:
            self._news = True
            self._changed.notify_all()

    def _collect(self, wait: bool) -> list[DriveStep]:
        steps = []
        while self._out and (wait or self._out[0].done()):
            pending_insert = self._out.popleft()
            accepted = pending_insert.result(_ANSWER_S)
            steps.append(_stepped(accepted, pending_insert.round_trip_s or 0.0))
        return steps


def _stepped(accepted: Accepted, seconds: float) -> DriveStep:
    return DriveStep(accepted.revision, accepted.report, seconds * 1e3 - accepted.report["solver_ms"])


def _compared(answer: Chi2) -> Compared:
    batch = float("nan") if answer.batch is None else answer.batch
    return Compared(
        answer.revision,
        answer.chi2,
        batch,
        answer.worker,
        answer.seconds,
        answer.start,
        answer.variables,
        answer.batch_converged,
    )
