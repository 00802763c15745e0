"""Asking repeatedly at a bounded load: one question at a time, and pauses by how long the answers take."""

import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

T = TypeVar("T")

# The share of the time that a service spends on answering is at most one in this number.
_SPARE = 10
_LEAST_PAUSE_S = 0.5


class RateLimited(Generic[T]):
    """The last answer to a question that is put again when it is out of date.  For one thread.

    ask: puts the question and returns at once.  notify: called, on any thread, when an answer has come.
    """

    def __init__(self, ask: Callable[[], Future[T]], first: T, notify: Callable[[], None] = lambda: None) -> None:
        self._ask, self._notify = ask, notify
        self._asked: Future[T] | None = None
        self._asked_at, self._next_at = 0.0, 0.0
        self.answer = first

    def put(self, answer: T) -> None:
        """What somebody has waited for; what is still under way is older, and let go."""
        self.answer, self._asked = answer, None

    def refresh(self, out_of_date: Callable[[T], bool]) -> T:
        """Take the answer that came, ask for a newer one if this is out of date and it is time; never waits."""
        now = time.monotonic()
        if self._asked is not None and self._asked.done():
            asked, self._asked = self._asked, None
            self._next_at = now + max(_LEAST_PAUSE_S, _SPARE * (now - self._asked_at))
            if asked.exception() is None:  # otherwise the old one stays, and it is asked again
                self.answer = asked.result()
        if self._asked is None and now >= self._next_at and out_of_date(self.answer):
            self._asked, self._asked_at = self._ask(), now
            self._asked.add_done_callback(lambda _: self._notify())
        return self.answer
