"""Who wants to be called with every delta of a mirror."""

import logging
import threading
from collections.abc import Callable, Iterable

from factorbus.client.arguments import seen
from factorbus.proto.messages import Delta
from factorbus.proto.problems import BadOption

log = logging.getLogger("factorbus.client")


class DeltaCallbacks:
    """Added and taken off by any thread, called by one."""

    def __init__(self, map_name: str) -> None:
        self._map, self._lock = map_name, threading.Lock()
        self._callbacks: list[Callable[[Delta], None]] = []

    def add(self, callback: Callable[[Delta], None]) -> Callable[[], None]:
        """Have `callback` called from now on; returns what takes it off again.  Raises BadOption."""
        if not callable(callback):
            raise BadOption("callback", seen(callback), "a function of a delta")
        with self._lock:
            self._callbacks = [*self._callbacks, callback]
        return lambda: self._forget(callback)

    def tell(self, news: Iterable[Delta]) -> None:
        """Call all with each.  One that raises is logged."""
        for delta in news:
            for callback in self._callbacks:
                try:
                    callback(delta)
                except Exception:
                    log.exception("map %s: on_delta callback failed at revision %d", self._map, delta.revision)

    def _forget(self, callback: Callable[[Delta], None]) -> None:
        with self._lock:
            self._callbacks = [each for each in self._callbacks if each is not callback]
