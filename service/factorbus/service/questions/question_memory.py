"""What a question may take, judged before anything is allocated for it: its answer's bytes, and memory meanwhile."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from factorbus.proto.limits import ANSWER_LIMITS
from factorbus.proto.problems import TooLarge
from factorbus.service.process.memory import MemoryLimit

# Of an answer there are for a moment: the numbers, their bytes, the message, and what Zenoh sends.
COPIES = 4
# What is that small is not worth counting.
_LITTLE = 1 << 20


class Taken:
    """Memory that one question has been given; `take` more as it becomes known what it needs."""

    def __init__(self, memory: MemoryLimit | None) -> None:
        self._memory, self.bytes = memory, 0

    def take(self, size: int) -> None:
        """Reserve bytes until the question is answered.  Raises OutOfMemory."""
        if self._memory is not None and size > _LITTLE:
            self._memory.reserve(size)
            self.bytes += size


@dataclass(frozen=True, slots=True)
class Room:
    """Of one service.  memory: None: not bounded.  answer_bytes: no client could receive what is larger."""

    memory: MemoryLimit | None = None
    answer_bytes: int = ANSWER_LIMITS.max_bytes

    @contextmanager
    def taken(self) -> Iterator[Taken]:
        """While inside, what is taken counts for all questions."""
        taken = Taken(self.memory)
        try:
            yield taken
        finally:
            if self.memory is not None:
                self.memory.give_back(taken.bytes)

    def check(self, size: int) -> None:
        """Is there memory for `size` bytes that are allocated at once?  Raises OutOfMemory."""
        with self.taken() as taken:
            taken.take(size)

    def fits(self, what: str, size: int) -> None:
        """Could a client receive an answer of `size` bytes?  Raises TooLarge."""
        if size > self.answer_bytes:
            raise TooLarge(what, size, self.answer_bytes, "bytes", "ask for less at a time, or raise the limit")
