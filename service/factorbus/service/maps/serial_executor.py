"""A thread that does what it is handed, one thing after the other, in order."""

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

log = logging.getLogger(__name__)


class SerialExecutor:
    """Calls run on one thread of their own, in the order they were handed in."""

    def __init__(self, name: str) -> None:
        self._calls: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._open: deque[None] = deque()  # one for each call that is not done
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Calls that are not done."""
        return len(self._open)

    def hand(self, call: Callable[..., None], *arguments: Any) -> None:
        """Have `call(*arguments)` run after all that was handed in before.  Never blocks."""
        self._open.append(None)
        self._calls.put((call, arguments))

    def hand_or_do(self, call: Callable[..., None], *arguments: Any) -> None:
        """The same, but on this thread, before returning, if all that was handed in before is done."""
        if self._open:
            self.hand(call, *arguments)
        else:
            try:
                call(*arguments)
            except Exception:
                self._log(call)

    def do(self, call: Callable[..., object], *arguments: Any) -> None:
        """Have `call(*arguments)` run behind all that was handed in before, and return when it is done.

        Raises what it raises.
        """
        done: queue.SimpleQueue[Exception | None] = queue.SimpleQueue()

        def run() -> None:
            try:
                call(*arguments)
            except Exception as fault:
                done.put(fault)
            else:
                done.put(None)

        self.hand(run)
        if (fault := done.get()) is not None:
            raise fault

    def close(self) -> None:
        """Return when all that was handed in is done and the thread has ended."""
        self._calls.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (item := self._calls.get()) is not None:
            self._do(*item)
            item = None  # a query kept alive keeps its asker waiting
            self._open.pop()

    def _do(self, call: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        try:
            call(*arguments)
        except Exception:
            # One answer that cannot be given must not silence the executor for all others.
            self._log(call)

    def _log(self, call: Callable[..., None]) -> None:
        log.exception("%s: %s failed", self._thread.name, getattr(call, "__qualname__", call))


class SerialExecutors:
    """Several executors for calls in no order: one that takes long delays few of the others."""

    def __init__(self, name: str, count: int) -> None:
        self._executors = [SerialExecutor(f"{name} {n}") for n in range(count)]

    @property
    def waiting(self) -> int:
        """Calls that are not done."""
        return sum(executor.waiting for executor in self._executors)

    def hand(self, call: Callable[..., None], *arguments: Any) -> None:
        """Have `call(*arguments)` run on the executor that has least to do.  Never blocks."""
        min(self._executors, key=lambda executor: executor.waiting).hand(call, *arguments)

    def settle(self) -> None:
        """Return when all that was handed in before is done."""
        for executor in self._executors:
            reached = threading.Event()
            executor.hand(reached.set)
            reached.wait()

    def close(self) -> None:
        """Return when all that was handed in is done."""
        for executor in self._executors:
            executor.close()
