"""A future that a thread can be interrupted at, by Ctrl-C say, without harm to the others.

Python's own waits at a `threading.Condition`, whose `with` is Python code: a signal's handler may run, and raise, when
the lock is taken and the block not yet entered.  The lock is then never released, and Zenoh's thread that brings the
answer waits for it for ever.  The `with` of a lock itself cannot be interrupted between the two.
"""

import threading
from concurrent.futures import Future
from typing import Any, TypeVar

T = TypeVar("T")


class InterruptibleFuture(Future[T]):
    """A future that is running from the start, so that an asyncio wrapper cannot cancel what is on its way."""

    def __init__(self) -> None:
        super().__init__()
        self.set_running_or_notify_cancel()
        self._missing = threading.Lock()
        self._missing.acquire()
        self._kept, self._value, self._error = False, None, None

    def set_result(self, result: Any) -> None:
        """Wake those who wait with `result`."""
        self._value, self._kept = result, True
        super().set_result(result)
        self._missing.release()

    def set_exception(self, exception: BaseException | None) -> None:
        """Wake those who wait with `exception`."""
        self._error, self._kept = exception, True
        super().set_exception(exception)
        self._missing.release()

    def done(self) -> bool:
        """There is a result, or an exception."""
        return self._kept

    def result(self, timeout: float | None = None) -> T:
        """Wait for it.  Raises TimeoutError after `timeout` seconds, and what was set as exception."""
        if (error := self.exception(timeout)) is not None:
            raise error
        return self._value  # type: ignore[return-value]

    def exception(self, timeout: float | None = None) -> BaseException | None:
        """Wait for it: what was set as exception, or None.  Raises TimeoutError after `timeout` seconds."""
        if not self._kept:
            if not self._missing.acquire(timeout=-1 if timeout is None else max(timeout, 0.0)):
                raise TimeoutError
            self._missing.release()  # for the next who waits
        return self._error
