"""The memory of this process: how much it has, how much it may have, and whether there is room for more.

The kernel's own answer to too much memory is to kill the process.  So from a limit below that on, what would make maps
grow is refused, and a refusal says why; questions, jobs and dropping maps go on.
"""

import os
import threading

from factorbus.proto.problems import Problem
from factorbus.service.process.control_groups import limit_files

# Of what the machine or the container has; the rest is for steps under way, answers, and other processes.
_SHARE = 0.8
# What an insert comes to in memory, by its bytes on the wire: as a message, in the graph, in Λ and in R.  Measured:
# 6 to 9 for poses along a trajectory, with arrays that double as they grow; loops fill R further.
_GROWTH = 10
# Questions may have this share of the limit also where maps have come up to it.
_QUESTIONS = 1 / 4
_PAGE = os.sysconf("SC_PAGE_SIZE")


class OutOfMemory(Problem):
    """The service has as much memory as it may have."""

    code = "out_of_memory"

    def __init__(self, resident: int, limit: int, more: int = 0) -> None:
        """more: what is known to be needed."""
        needed = f", {more >> 20} MiB more are needed" if more else ""
        super().__init__(
            f"the service has {resident >> 20} MiB of memory{needed} and its limit is {limit >> 20} MiB, "
            "so maps cannot grow; drop or move a map, or give it more with limits.memory_bytes",
            size=resident + more,
            limit=limit,
        )


class NoRoom(OutOfMemory):
    """A question whose answer would take more memory than there is for questions."""

    def __init__(self, resident: int, limit: int, more: int) -> None:
        super().__init__(resident, limit, more)
        self.args = (
            f"to answer this question takes {_megabytes(more)} MiB of memory; the service has {resident >> 20} MiB and "
            f"its limit is {limit >> 20} MiB: ask for less at a time, or give it more with limits.memory_bytes",
        )


class MemoryLimit:
    """Of this process.  limit: bytes; 0: four fifths of what the container or the machine has."""

    def __init__(self, limit: int) -> None:
        self.limit = limit or int(_SHARE * available())
        self._file = os.open("/proc/self/statm", os.O_RDONLY)
        self.resident = self._measure()
        self._promised = 0  # bytes taken in since that was measured
        self._reserved, self._lending = 0, threading.Lock()  # bytes that questions being answered may come to

    def look(self) -> None:
        """Measure anew; a few microseconds."""
        self._promised = 0
        self.resident = self._measure()

    def no_room(self, size: int, beside: int = 0) -> OutOfMemory | None:
        """Why an insert of `size` bytes cannot be taken, for which `beside` bytes are needed that it does not show by
        its size; None: it can.
        """
        more = _GROWTH * size + beside
        self._promised += more
        if self.resident + self._promised <= self.limit:
            return None
        self.look()
        if self.resident + more <= self.limit:
            return None
        return OutOfMemory(self.resident, self.limit)

    def room(self) -> int:
        """Bytes that there are before the limit."""
        self.look()
        return max(self.limit - self.resident, 0)

    def reserve(self, size: int) -> None:
        """Bytes for a question, until `give_back`; all of them together have what is left, or a quarter of the limit.

        Raises OutOfMemory: then nothing is reserved.
        """
        with self._lending:
            more = self._reserved + size
            if more > _QUESTIONS * self.limit and self.resident + more > self.limit:
                self.look()
                if self.resident + more > self.limit:
                    raise NoRoom(self.resident, self.limit, size)
            self._reserved = more

    def give_back(self, size: int) -> None:
        """They are free again."""
        with self._lending:
            self._reserved -= size

    def close(self) -> None:
        """No more measuring."""
        os.close(self._file)

    def _measure(self) -> int:
        return int(os.pread(self._file, 128, 0).split()[1]) * _PAGE


def _megabytes(size: int) -> int:
    """At least 1."""
    return max(size >> 20, 1)


def available() -> int:
    """Bytes that this process may have before the kernel ends it: of its control groups, or of the machine."""
    limits = [os.sysconf("SC_PHYS_PAGES") * _PAGE]
    for path in limit_files("memory", "memory.limit_in_bytes", "memory.max"):
        try:
            limits.append(int(path.read_text()))
        except (OSError, ValueError):  # not there, or "max"
            continue
    return min(limits)
