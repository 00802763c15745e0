"""Sequence numbers and what is still unanswered of one client on one map.  Pure: no bus, no clock, no lock.

Inserts are numbered 1, 2, 3, ...; the same number always goes with the same insert, however often it is sent, so
the service takes each exactly once.  At most `size` are unanswered at a time.

A refusal tells in `detail.next` whether its number is used up: where `next` is not above it, the service has taken
nothing from `next` on.  Then no further insert is sent until all are answered, and numbering goes on from there.
"""

from typing import Generic, TypeVar

from factorbus.proto.problems import Problem
from factorbus.wording import counted

T = TypeVar("T")


class Window(Generic[T]):
    """The inserts in flight; T is whatever stands for one."""

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ValueError(f"window of {counted(size, 'insert')}; wanted at least 1")
        self.size = size
        self.last = 0
        self._unanswered: dict[int, T] = {}
        self._refused: list[tuple[T, Problem]] = []
        self._back_to = 0  # the number that the service wants of those that it refused without taking them; 0: none

    @property
    def full(self) -> bool:
        """No further insert may be sent now."""
        return len(self._unanswered) >= self.size or bool(self._back_to)

    @property
    def idle(self) -> bool:
        """Everything sent is answered."""
        return not self._unanswered

    @property
    def unanswered(self) -> list[T]:
        """What is in flight, oldest first."""
        return list(self._unanswered.values())

    @property
    def next(self) -> int:
        """The sequence number of the next insert."""
        return self.last + 1

    def waits_for(self, sequence: int, wanted: int) -> bool:
        """Whether the service, which wants `wanted` before `sequence`, will get it: it is still being sent."""
        return wanted < sequence and wanted in self._unanswered

    def sent(self, item: T) -> None:
        """`item` is on its way as number `next`."""
        self.last += 1
        self._unanswered[self.last] = item

    def answered(self, sequence: int, refusal: Problem | None) -> None:
        """`sequence` has its answer."""
        item = self._unanswered.pop(sequence, None)
        if refusal is not None and item is not None:
            self._refused.append((item, refusal))
            following = refusal.detail.get("next")
            if type(following) is int and 1 <= following <= sequence:
                self._back_to = min(following, self._back_to or following)
        if self._back_to and not self._unanswered:
            self.last, self._back_to = self._back_to - 1, 0

    def take_refused(self) -> list[tuple[T, Problem]]:
        """What was refused since the last call, and why, oldest answer first."""
        refused, self._refused = self._refused, []
        return refused
