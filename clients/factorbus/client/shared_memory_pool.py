"""Shared memory for large answers, used again when nobody looks at it and nobody can write to it any more.

Fresh pages cost more than what is written on them (86 ms against 12 for 104 MB, measured), so a filter that grows again
and again is better off with the memory of the answer before.
"""

import threading
import weakref
from typing import NamedTuple

from factorbus.proto.arrays import F64
from factorbus.proto.features import Segment
from factorbus.proto.segments import Memory

_KEPT_BYTES = 1 << 30
_LARGEST_SPARE = 4  # times what is needed


class SharedAllocation(NamedTuple):
    """Memory for one answer: what to send along, and the matrix (rows, columns) that it is for."""

    memory: Memory
    segment: Segment
    matrix: F64


class SharedMemoryPool:
    """The shared memory of one front end.  Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._spare: list[Memory] = []
        self._closed = False

    def try_allocate(self, start: int, shape: tuple[int, int], first_row: int) -> SharedAllocation | None:
        """Memory for a matrix of `shape` from byte `start` on, of which rows from `first_row` on will be written.

        None where there is no room, or no shared memory.
        """
        need = start + 8 * shape[0] * shape[1]
        try:
            memory = self._take(need) or Memory(need)
        except OSError:
            return None
        matrix = memory.array(start, shape)
        return SharedAllocation(memory, memory.segment(start + 8 * first_row * shape[1]), matrix)

    def settle(self, allocation: SharedAllocation, clean: bool) -> None:
        """The answer is there (or will not be used).  clean: nobody will write to the memory any more.

        It is used again once the matrix, and everything made of it, is gone.
        """
        if not clean or self._closed:
            allocation.memory.close()
        else:
            # Whatever is made of an array (slices, views of it in other libraries) keeps that array.
            weakref.finalize(allocation.matrix, self._give_back, allocation.memory).atexit = False

    def close(self) -> None:
        """Let go of what is spare; what is looked at lives on."""
        with self._lock:
            self._closed = True
            spare, self._spare = self._spare, []
        for memory in spare:
            memory.close()

    def _take(self, need: int) -> Memory | None:
        with self._lock:
            for memory in self._spare:
                if need <= memory.size <= _LARGEST_SPARE * need:
                    self._spare.remove(memory)
                    memory.renew()
                    return memory
        return None

    def _give_back(self, memory: Memory) -> None:
        with self._lock:
            keep = not self._closed
            if keep:
                self._spare.append(memory)
            gone = [] if keep else [memory]
            while sum(each.size for each in self._spare) > _KEPT_BYTES:
                gone.append(self._spare.pop(0))
        for each in gone:
            each.close()
