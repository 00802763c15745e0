"""Deltas handed from the mirror's thread to a reader that may be slow, without ever skipping one silently."""

import threading
from collections import deque
from collections.abc import Callable

from factorbus.client.mirror import Mirror
from factorbus.proto.messages import Delta

# Deltas that may wait for the reader; when it falls further behind it gets the whole estimate instead.
_BACKLOG = 1024


class DeltaStream:
    """A queue of deltas.  `wake` is called, on the mirror's thread, when there is something to take."""

    def __init__(self, mirror: Mirror, wake: Callable[[], None], backlog: int = _BACKLOG) -> None:
        self._mirror, self._wake, self._backlog = mirror, wake, backlog
        self._waiting: deque[Delta] = deque()
        self._behind = False
        self._at = (0, 0)
        self._lock = threading.Lock()
        self._forget = mirror.on_delta(self.hear)

    def hear(self, delta: Delta) -> None:
        """A delta was applied."""
        with self._lock:
            if len(self._waiting) >= self._backlog:
                self._waiting.clear()
                self._behind = True
            if not self._behind:
                self._waiting.append(delta)
        self._wake()

    def try_take(self) -> Delta | None:
        """The next delta, if there is one; one with `previous` 0 holds the whole estimate."""
        with self._lock:
            behind, self._behind = self._behind, False
        if behind:
            return self._whole()
        while True:
            with self._lock:
                if not self._waiting:
                    return None
                delta = self._waiting.popleft()
            # Of one revision there are several where the rest of a part of the map follows.
            more = delta.previous == delta.revision
            if delta.epoch != self._at[0] or delta.revision > self._at[1] or more:
                return delta

    def close(self) -> None:
        """Hear no more."""
        self._forget()

    def _whole(self) -> Delta:
        seen = self._mirror.snapshot()
        self._at = (seen.epoch, seen.revision)  # what was queued meanwhile is in it
        return Delta(seen.epoch, seen.revision, 0, seen.variables())
