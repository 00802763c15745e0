"""Questions that wait for the solver, and which of them it gets at a time.  Pure.

A question is answered between two steps in one of two ways.  Most take a copy there, and are answered from it on
another thread; one copy serves all of them, so they go together however many there are.  Those about a few variables
are answered on the spot, from R where it lies, and inserts wait for each.  So in one InsertBatch they come to a bounded
number of variables together, and the others stay for the next one, which takes the inserts that came in meanwhile.
"""

from collections import deque
from collections.abc import Iterator, Sequence

from factorbus.service.core.events import Read
from factorbus.service.questions.uncertainty import NEAR, near_variables


class Reads:
    """Those that wait, oldest first."""

    def __init__(self) -> None:
        self._waiting: deque[Read] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[Read]:
        return iter(self._waiting)

    def append(self, read: Read) -> None:
        """One more waits."""
        self._waiting.append(read)

    def clear(self) -> None:
        """None waits any more."""
        self._waiting.clear()

    def take(self) -> tuple[Read, ...]:
        """What the next InsertBatch answers: all that take copies, of the others the oldest, up to `NEAR` variables.

        What puts records of another journal into this one comes first, and alone.
        """
        if (graft := next((read for read in self._waiting if is_graft((read,))), None)) is not None:
            self._waiting.remove(graft)
            return (graft,)
        taken: list[Read] = []
        stay: deque[Read] = deque()
        variables, is_full = 0, False
        for read in self._waiting:
            here = near_variables(read.question.ask)
            is_full = is_full or variables + here > NEAR
            if here and is_full:
                stay.append(read)
            else:
                variables += here
                taken.append(read)
        self._waiting = stay
        return tuple(taken)


def is_graft(reads: Sequence[Read]) -> bool:
    """Is it one that puts records of another journal into the map's own?"""
    return len(reads) == 1 and reads[0].question.name == "graft"
