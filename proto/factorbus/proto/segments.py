"""Memory that processes of one host share: anonymous files that the asker makes and others write answers into.

The asker makes a file without a name (memfd), writes a nonce at its beginning and says by which process and descriptor
it is found; a process that finds a file there with that nonce is on the same host, under the same user,
whatever containers and mounts say.  The file is sealed so that it cannot become shorter, so who has mapped it cannot
be ended by it; and it goes with its last user, so that nothing is left behind, however a process ends.

A file serves one question at a time, and another one only if nobody can write to it for the one before any more.  One
who was frozen meanwhile and wakes writes what stands there already: an answer is a pure function of its question.
"""

import contextlib
import fcntl
import mmap
import os
import secrets
import stat
from pathlib import Path

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.features import Segment

PAGE = 4096
# What one question may have made: beyond, it would be a way to use up a machine's memory.
MOST_BYTES = 4 << 30
_NONCE = 32


class Memory:
    """A file for answers, one at a time.  `close` it, or use it in `with`; arrays from it live on."""

    def __init__(self, size: int) -> None:
        """Make one of `size` bytes.  Raises OSError: this system has no such files, or that is too much."""
        if not hasattr(os, "memfd_create"):
            raise OSError("this system has no memfd")
        if size > MOST_BYTES:
            raise OSError(f"{size} bytes are more than {MOST_BYTES}")
        self.size = size
        self._mapped: mmap.mmap | None = None
        self._descriptor = os.memfd_create("factorbus", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.truncate(self._descriptor, size)
            fcntl.fcntl(self._descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
            self.renew()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Memory":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def renew(self) -> None:
        """Another nonce, for another question: who comes late with the one before finds nothing."""
        self._nonce = secrets.token_hex(_NONCE // 2)
        os.pwrite(self._descriptor, self._nonce.encode(), 0)

    def segment(self, offset: int) -> Segment:
        """What to send along."""
        return Segment(os.getpid(), self._descriptor, self._nonce, self.size, offset)

    def array(self, offset: int, shape: tuple[int, ...]) -> F64:
        """The numbers from byte `offset` on; the array keeps the memory, also after `close`."""
        if self._mapped is None:  # kept: finding all its pages again takes as long as reading them
            self._mapped = mmap.mmap(self._descriptor, self.size)
        return np.ndarray(shape, np.float64, self._mapped, offset)

    def close(self) -> None:
        """No more questions; who has mapped it keeps it."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor, self._mapped = -1, None


def try_array(segment: Segment, need: int, start: int, shape: tuple[int, int]) -> F64 | None:
    """Numbers of `segment` to write to, from byte `start` after its offset on; None if it is not on this host.

    need: bytes that it has to have from its offset on.  The array keeps the memory.
    """
    if segment.offset < PAGE or segment.offset % 8 or segment.offset + need > segment.size:
        return None
    with contextlib.suppress(OSError, ValueError, OverflowError):
        descriptor = _open(segment)
        try:
            return _array(descriptor, segment.offset + start, shape) if descriptor >= 0 else None
        finally:
            if descriptor >= 0:
                os.close(descriptor)
    return None


def _open(segment: Segment) -> int:
    """A descriptor of the file, or −1 if what is there is not it.  Raises OSError: nothing there, or not for us."""
    path = Path(f"/proc/{segment.process}/fd/{segment.descriptor}")
    if not stat.S_ISREG(path.stat().st_mode):
        return -1
    descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        sealed = fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK  # any other file has no seals
        same = os.fstat(descriptor).st_size == segment.size
        if sealed and same and os.pread(descriptor, _NONCE, 0) == segment.nonce.encode():
            return descriptor
    except OSError:
        pass
    os.close(descriptor)
    return -1


def _array(descriptor: int, at: int, shape: tuple[int, int]) -> F64:
    """The part of the file that holds the array, mapped with all its pages at once: one by one takes twice as long."""
    skip = at % mmap.ALLOCATIONGRANULARITY
    size = skip + 8 * shape[0] * shape[1]
    mapped = mmap.mmap(descriptor, size, mmap.MAP_SHARED | mmap.MAP_POPULATE, offset=at - skip)
    return np.ndarray(shape, np.float64, mapped, skip)
