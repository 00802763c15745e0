"""Carries questions and inserts to the service, and carries them again until they are answered.

While there has been nothing but silence, it looks whether the services that are there speak another version of the
protocol, and then gives up at once; not once somebody has answered: that service may be on its way back.

The first try goes out on the caller's thread, for latency; later ones on the courier's own thread, because a
callback of the bus must not call the bus.
"""

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

from factorbus.client.link import Link
from factorbus.client.promise import Promise
from factorbus.client.replies import Again, Reply, Silence, judge
from factorbus.client.versions import LOOK_S, other_protocol
from factorbus.proto.problems import ClosedHere, Problem, Refused, Unavailable
from factorbus.wording import counted

# An unanswered try is repeated after this long: a step may take longer, but then repeating costs little.
TRY_S = 5.0
# Silence so often in a row, 0.3 s, is worth a look for services of other versions; then again after this long.
_SILENT, _LOOK_AGAIN_S = 3, 2.0


class Errand:
    """One question or insert on its way: its future, and when it went and came back (time.perf_counter seconds).

    timeout_s: give up with Unavailable after so long; None: keep trying until the courier is closed.
    passing: which refusals will not last, so that it is sent again (besides busy and shutting_down).
    then: called with (errand, answer or Problem) right before those who wait for the future are woken.
    """

    def __init__(
        self,
        what: str,
        key: str,
        payload: bytes,
        decode: Callable[[bytes], Any],
        timeout_s: float | None = None,
        passing: Callable[[Refused], bool] | None = None,
        then: Callable[["Errand", Any], None] | None = None,
    ) -> None:
        self.what, self.key, self.payload, self.decode = what, key, payload, decode
        self.passing, self.then = passing, then
        self.deadline = None if timeout_s is None else time.monotonic() + timeout_s
        self.future: Promise[Any] = Promise()
        self.attempt = 0
        self.because = "the first try is out"
        self.sent_at = self.answered_at = 0.0


class Courier:
    """All errands of one bus."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._due: list[tuple[float, int, Errand]] = []
        self._order = itertools.count()
        self._open: set[Errand] = set()
        self._lock = threading.RLock()  # entered itself, and not by its condition: see `promise.py`
        self._changed = threading.Condition(self._lock)
        self._closed = False
        self._heard = False  # somebody has answered here, if only with a problem
        self._look_at = 0.0
        self._thread = threading.Thread(target=self._run, name="factorbus-courier", daemon=True)
        self._thread.start()

    def carry(self, errand: Errand) -> Errand:
        """Send `errand`; its future gets `decode(answer)`, or a Problem."""
        with self._lock:
            self._open.add(errand)
            closed = self._closed
        errand.sent_at = time.perf_counter()
        if closed:
            self._finish(errand, ClosedHere(errand.what, connection=True))
        else:
            self._try(errand)
        return errand

    def hurry(self, prefix: str) -> None:
        """Try everything now whose key begins with `prefix`: somebody is there again.

        Also what is on its way: what reached them before they were ready may well be answered by nobody.
        """
        with self._lock:
            now = time.monotonic()
            self._due = [each for each in self._due if not each[2].key.startswith(prefix)]
            again = sorted((e for e in self._open if e.key.startswith(prefix)), key=lambda e: e.sent_at)
            self._due += [(now, next(self._order), errand) for errand in again]
            heapq.heapify(self._due)
            self._changed.notify()

    def abandon(self, errand: Errand, problem: Problem) -> None:
        """Stop carrying `errand`; its future gets `problem` unless it is already answered."""
        self._finish(errand, problem)

    def close(self) -> None:
        """Stop.  What is still unanswered fails with Unavailable."""
        with self._lock:
            self._closed = True
            left = list(self._open)
            self._changed.notify()
        self._thread.join()
        for errand in left:
            self._finish(errand, Unavailable(errand.what, self._waited(errand), "the connection was closed first"))

    def _try(self, errand: Errand) -> None:
        errand.attempt = attempt = errand.attempt + 1
        timeout_s = TRY_S
        if errand.deadline is not None:
            timeout_s = min(TRY_S, max(errand.deadline - time.monotonic(), 0.001))
        self._link.ask(errand.key, errand.payload, timeout_s, lambda reply: self._take(errand, attempt, reply))

    def _take(self, errand: Errand, attempt: int, reply: Reply) -> None:
        """On zenoh's thread: only decode, hand over, or put back."""
        self._heard = self._heard or not isinstance(reply, Silence)
        verdict = judge(reply, attempt, errand.passing)
        if isinstance(verdict, bytes):
            try:
                self._finish(errand, errand.decode(verdict))
            except Problem as unreadable:
                self._finish(errand, unreadable)
        elif isinstance(verdict, Again):
            if attempt == errand.attempt:  # else a later try is on its way
                self._put_back(errand, verdict)
        else:
            self._finish(errand, verdict)

    def _put_back(self, errand: Errand, again: Again) -> None:
        sent = f"{counted(len(errand.payload), 'byte')} sent, {counted(errand.attempt, 'try', 'tries')}"
        errand.because = f"{again.because} on {errand.key} ({sent})"
        at = time.monotonic() + again.pause_s
        if errand.deadline is not None and at >= errand.deadline:
            self._finish(errand, Unavailable(errand.what, self._waited(errand), errand.because))
            return
        with self._lock:
            if errand in self._open:
                heapq.heappush(self._due, (at, next(self._order), errand))
                self._changed.notify()

    def _finish(self, errand: Errand, result: Any) -> None:
        with self._lock:
            if errand not in self._open:
                return
            self._open.remove(errand)
        errand.answered_at = time.perf_counter()
        if errand.then is not None:
            errand.then(errand, result)
        if isinstance(result, BaseException):
            errand.future.set_exception(result)
        else:
            errand.future.set_result(result)

    def _waited(self, errand: Errand) -> float:
        return round(time.perf_counter() - errand.sent_at, 3)

    def _run(self) -> None:
        while (errand := self._next()) is not None:
            if not errand.future.done():
                self._try(errand)
                if errand.attempt >= _SILENT:
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
            for errand in left:
                self._finish(errand, other)

    def _next(self) -> Errand | None:
        with self._lock:
            while not self._closed:
                if not self._due:
                    self._changed.wait()
                elif (left := self._due[0][0] - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    return heapq.heappop(self._due)[2]
        return None
