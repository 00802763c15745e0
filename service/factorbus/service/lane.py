"""A thread that does what it is handed, one thing after the other, in order."""

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any

log = logging.getLogger(__name__)


class Lane:
    """Calls run on one thread of their own, in the order they were handed in."""

    def __init__(self, name: str) -> None:
        self._calls: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def hand(self, call: Callable[..., None], *arguments: Any) -> None:
        """Have `call(*arguments)` run after all that was handed in before.  Never blocks."""
        self._calls.put((call, arguments))

    def close(self) -> None:
        """Return when all that was handed in is done and the thread has ended."""
        self._calls.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (item := self._calls.get()) is not None:
            call, arguments = item
            try:
                call(*arguments)
            except Exception:
                # One answer that cannot be given must not silence the lane for all others.
                log.exception("%s: %s failed", self._thread.name, getattr(call, "__qualname__", call))
            finally:
                item = call = arguments = None  # a query kept alive keeps its asker waiting
