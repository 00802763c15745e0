"""Memory that processes of one host share: a file in /dev/shm that the asker makes and others write answers into.

The asker makes a file for one answer, writes a nonce at its beginning and sends both along; whoever finds a file of
that name with that nonce is on the same host, whatever containers and mounts say.  The asker removes the name when it
has the answer, and never uses the file for another one.  So one who was frozen, and writes when it wakes, writes into
memory that nobody else looks at; and what it writes while others still look is what stands there already, because an
answer is a pure function of its question.

Only the asker maps the file.  Others write to it, which fails with an error where there is no room or where somebody
has cut the file short; a mapping would end their process.  It is faster, too: a page that is written whole need not be
cleared first.
"""

import contextlib
import errno
import mmap
import os
import re
import secrets
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.features import Segment

FOLDER = Path("/dev/shm")
PAGE = 4096
_NAME = re.compile(r"factorbus-[0-9]+-[0-9a-f]{32}")
_NONCE = 32
_OLD_S = 600.0


class Memory:
    """A file for answers, one at a time.  `close` it, or use it in `with`; arrays from it live on."""

    def __init__(self, size: int) -> None:
        """Make one of `size` bytes.  Raises OSError: no /dev/shm here, or no room in it."""
        _sweep()
        room = os.statvfs(FOLDER)
        if room.f_bavail * room.f_frsize < size:
            raise OSError(errno.ENOSPC, f"no room for {size} bytes", str(FOLDER))
        self.size = size
        self._path = FOLDER / f"factorbus-{os.getpid()}-{secrets.token_hex(16)}"
        self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            os.truncate(self._descriptor, size)
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
        return Segment(self._path.name, self._nonce, self.size, offset)

    def array(self, offset: int, shape: tuple[int, ...]) -> F64:
        """The numbers from byte `offset` on; the array keeps the memory, also after `close`."""
        return np.ndarray(shape, np.float64, self.mapped(), offset)

    def mapped(self) -> mmap.mmap:
        """The bytes, as long as somebody holds what this returns or an array made of it."""
        return mmap.mmap(self._descriptor, self.size)

    def close(self) -> None:
        """Remove the name."""
        if self._descriptor >= 0:
            self._path.unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = -1


@contextmanager
def try_opened(segment: Segment, need: int) -> Iterator[int | None]:
    """A descriptor to write to `segment` with, if it is on this host and has `need` bytes from its offset on."""
    descriptor = _try_open(segment, need)
    try:
        yield descriptor
    finally:
        if descriptor is not None:
            os.close(descriptor)


def write(descriptor: int, numbers: F64, at: int) -> None:
    """Write contiguous `numbers` from byte `at` on.  Raises OSError."""
    left = numbers.reshape(-1).data.cast("B")
    while left:
        done = os.pwrite(descriptor, left, at)
        left, at = left[done:], at + done


def _try_open(segment: Segment, need: int) -> int | None:
    name, nonce, size, offset = segment
    if not _NAME.fullmatch(name) or offset < PAGE or offset % 8 or offset + need > size:
        return None
    try:
        descriptor = os.open(FOLDER / name, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    found = os.fstat(descriptor)
    regular = stat.S_ISREG(found.st_mode) and found.st_size == size
    if regular and os.pread(descriptor, _NONCE, 0) == nonce.encode():
        return descriptor
    os.close(descriptor)
    return None


def _sweep() -> None:
    """Remove what processes that were killed have left: an old file of a process that is not there.

    Old, too, because a process in another container may be there and not be seen.
    """
    for path in FOLDER.glob("factorbus-*"):
        if _NAME.fullmatch(path.name) and not Path(f"/proc/{path.name.split('-')[1]}").exists():
            with contextlib.suppress(OSError):  # not ours, or somebody was quicker
                if time.time() - path.stat().st_mtime > _OLD_S:
                    path.unlink()
