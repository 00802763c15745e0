"""Carries questions and inserts to the service, and carries them again until they are answered.

While there has been nothing but silence, it looks whether the services that are there speak another version of the
protocol, and then gives up at once; not once somebody has answered: that service may be on its way back.

The first try goes out on the caller's thread, for latency; later ones on the sender's own thread, because a
callback of the bus must not call the bus.
"""

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

from factorbus.client.interruptible_future import InterruptibleFuture
from factorbus.client.link import Link
from factorbus.client.replies import NOBODY, Again, Reply, Silence, interpret_reply, why_silent
from factorbus.client.versions import LOOK_S, other_protocol
from factorbus.proto.problems import ClosedHere, Problem, Refused, Unavailable
from factorbus.wording import counted

# An unanswered try is repeated after this long: a step may take longer, but then repeating costs little.
TRY_S = 5.0
# Silence so often in a row, 0.3 s, is worth a look for services of other versions; then again after this long.
_SILENT, _LOOK_AGAIN_S = 3, 2.0


class Request:
    """One question or insert on its way: its future, and when it went and came back (time.perf_counter seconds).

    timeout_s: give up with Unavailable after so long; None: keep trying until the sender is closed.
    passing: which refusals will not last, so that it is sent again (besides busy and shutting_down).
    then: called with (request, answer or Problem) right before those who wait for the future are woken.
    """

    def __init__(
        self,
        what: str,
        key: str,
        payload: bytes,
        decode: Callable[[bytes], Any],
        timeout_s: float | None = None,
        passing: Callable[[Refused], bool] | None = None,
        then: Callable[["Request", Any], None] | None = None,
    ) -> None:
        self.what, self.key, self.payload, self.decode = what, key, payload, decode
        self.passing, self.then = passing, then
        self.deadline = None if timeout_s is None else time.monotonic() + timeout_s
        self.future: InterruptibleFuture[Any] = InterruptibleFuture()
        self.attempt = 0
        self.because = "the first try is out"
        self.sent_at = self.answered_at = 0.0


class RequestSender:
    """All requests of one bus."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._due: list[tuple[float, int, Request]] = []
        self._order = itertools.count()
        self._open: set[Request] = set()
        self._lock = threading.RLock()  # entered itself, and not by its condition: see `interruptible_future.py`
        self._changed = threading.Condition(self._lock)
        self._closed = False
        self._heard = False  # somebody has answered here, if only with a problem
        self._look_at = 0.0
        self._thread = threading.Thread(target=self._run, name="factorbus-request-sender", daemon=True)
        self._thread.start()

    def carry(self, request: Request) -> Request:
        """Send `request`; its future gets `decode(answer)`, or a Problem."""
        with self._lock:
            self._open.add(request)
            closed = self._closed
        request.sent_at = time.perf_counter()
        if closed:
            self._finish(request, ClosedHere(request.what, connection=True))
        else:
            self._try(request)
        return request

    def hurry(self, prefix: str) -> None:
        """Try everything now whose key begins with `prefix`: somebody is there again.

        Also what is on its way: what reached them before they were ready may well be answered by nobody.
        """
        with self._lock:
            now = time.monotonic()
            self._due = [each for each in self._due if not each[2].key.startswith(prefix)]
            again = sorted((e for e in self._open if e.key.startswith(prefix)), key=lambda e: e.sent_at)
            self._due += [(now, next(self._order), request) for request in again]
            heapq.heapify(self._due)
            self._changed.notify()

    def abandon(self, request: Request, problem: Problem) -> None:
        """Stop carrying `request`; its future gets `problem` unless it is already answered."""
        self._finish(request, problem)

    def close(self) -> None:
        """Stop.  What is still unanswered fails with Unavailable."""
        with self._lock:
            self._closed = True
            left = list(self._open)
            self._changed.notify()
        self._thread.join()
        for request in left:
            self._finish(request, Unavailable(request.what, self._waited(request), "the connection was closed first"))

    def _try(self, request: Request) -> None:
        request.attempt = attempt = request.attempt + 1
        timeout_s = TRY_S
        if request.deadline is not None:
            timeout_s = min(TRY_S, max(request.deadline - time.monotonic(), 0.001))
        self._link.ask(request.key, request.payload, timeout_s, lambda reply: self._take(request, attempt, reply))

    def _take(self, request: Request, attempt: int, reply: Reply) -> None:
        """On zenoh's thread: only decode, hand over, or put back."""
        self._heard = self._heard or not isinstance(reply, Silence)
        verdict = interpret_reply(reply, attempt, request.passing)
        if isinstance(verdict, bytes):
            try:
                self._finish(request, request.decode(verdict))
            except Problem as unreadable:
                self._finish(request, unreadable)
        elif isinstance(verdict, Again):
            if attempt == request.attempt:  # else a later try is on its way
                self._put_back(request, verdict)
        else:
            self._finish(request, verdict)

    def _put_back(self, request: Request, again: Again) -> None:
        sent = f"{counted(len(request.payload), 'byte')} sent, {counted(request.attempt, 'try', 'tries')}"
        request.because = f"{again.because} on {request.key} ({sent})"
        if again.because == NOBODY:
            request.because += f": {why_silent(request.key)}"
        at = time.monotonic() + again.pause_s
        if request.deadline is not None and at >= request.deadline:
            self._finish(request, Unavailable(request.what, self._waited(request), request.because))
            return
        with self._lock:
            if request in self._open:
                heapq.heappush(self._due, (at, next(self._order), request))
                self._changed.notify()

    def _finish(self, request: Request, result: Any) -> None:
        with self._lock:
            if request not in self._open:
                return
            self._open.remove(request)
        request.answered_at = time.perf_counter()
        if request.then is not None:
            request.then(request, result)
        if isinstance(result, BaseException):
            request.future.set_exception(result)
        else:
            request.future.set_result(result)

    def _waited(self, request: Request) -> float:
        return round(time.perf_counter() - request.sent_at, 3)

    def _run(self) -> None:
        while (request := self._next()) is not None:
            if not request.future.done():
                self._try(request)
                if request.attempt >= _SILENT:
                    self._look_for_other_versions()

    def _look_for_other_versions(self) -> None:
        if not self._heard and (now := time.monotonic()) >= self._look_at:
            self._look_at = now + _LOOK_AGAIN_S
            self._link.ask_versions(LOOK_S, self._looked)

    def _looked(self, versions: set[str]) -> None:
        """On zenoh's thread."""
        if not self._heard and (other := other_protocol(versions)) is not None:
            with self._lock:
                left = list(self._open)
            for request in left:
                self._finish(request, other)

    def _next(self) -> Request | None:
        with self._lock:
            while not self._closed:
                if not self._due:
                    self._changed.wait()
                elif (left := self._due[0][0] - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    return heapq.heappop(self._due)[2]
        return None
