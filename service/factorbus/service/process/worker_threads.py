"""Worker threads for the eliminations of all maps, which are long in large ones.  MATH §9.5."""

import os
import threading
from collections.abc import Callable
from typing import Any

from factorbus.service.process.control_groups import limit_files
from factorbus.solver.sparse.worker_threads import WorkerThread, can_work, count_free


def core_count() -> int:
    """Cores that this process may run on, and has the time of: of its control groups, or of the machine."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    shares = [float(there)]
    for path in limit_files("cpu", "cpu.cfs_quota_us", "cpu.max"):
        try:
            text = path.read_text()
            if path.name != "cpu.max":  # version 1 has the period in a file of its own
                text += path.with_name("cpu.cfs_period_us").read_text()
            quota, period = map(int, text.split())
        except (OSError, ValueError):  # not there, or "max"
            continue
        if quota > 0:
            shares.append(quota / period)
    return max(int(min(shares)), 1)


class WorkerThreads:
    """Until it is closed, an elimination may be at work on `cores` of those that there are at once.

    From when a map has `from_bytes` of memory: the steps of a smaller one are over before another core has brought
    anything.  And from when the kernel that eliminates is at hand: threads that asked for it before would compile it,
    for nobody yet, and a thread that closes this would have to wait for them.
    """

    def __init__(self, cores: int, from_bytes: int) -> None:
        self._more, self._from_bytes = min(cores, core_count()) - 1, from_bytes
        self._workers: list[WorkerThread] = []
        self._threads: list[threading.Thread] = []

    def tick(self, largest: Callable[[], int]) -> None:
        """Time went by: a map may have grown.  largest: returns the bytes of the largest one."""
        if self._threads or not self._more or not can_work() or largest() < self._from_bytes:
            return
        self._workers = [WorkerThread() for _ in range(min(self._more, count_free()))]
        self._threads = [
            threading.Thread(target=worker.run, name=f"core {n}", daemon=True)
            for n, worker in enumerate(self._workers, 1)
        ]
        for thread in self._threads:
            thread.start()

    def counts(self) -> dict[str, Any]:
        """How many that is, with the one that a map's own thread has; pieces of eliminations that the others made."""
        return {"used": 1 + len(self._threads), "pieces": sum(worker.made for worker in self._workers)}

    def close(self) -> None:
        """Eliminations go on alone; returns when the threads have ended."""
        for worker in self._workers:
            worker.leave()
        for thread in self._threads:
            thread.join()
