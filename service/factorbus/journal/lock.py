"""Who owns a folder of journals: a lock that ends with the process that has it, however that ends."""

import contextlib
import fcntl
import os
import threading
from collections.abc import Callable
from pathlib import Path

from factorbus.journal.folders import check_own, make_own
from factorbus.journal.problems import JournalInUse

NAME = "owner.lock"
_LOOK_S = 0.05


class Owned:
    """A folder that this process owns until `release`."""

    def __init__(self, folder: Path, descriptor: int) -> None:
        self.folder = folder
        self._descriptor = descriptor

    def say(self, text: str) -> None:
        """Tell others who owns it; on a disk that takes nothing they have to do without."""
        try:
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, text.encode(), 0)
        except OSError:
            return

    def release(self) -> None:
        """Let others have it."""
        os.close(self._descriptor)


def own(
    folder: Path, wait: threading.Event | None = None, waiting: Callable[[str], None] | None = None
) -> Owned | None:
    """Own `folder`, which is made if it is not there.

    wait: stand by until the present owner is gone, or this is set (then None); `waiting` is called with who that is.
    Raises JournalInUse when it has an owner and nobody wants to wait; UnsafeJournal: others can write to it; OSError.
    """
    descriptor = _open(folder)
    try:
        if _try(descriptor):
            return Owned(folder, descriptor)
        owner = os.pread(descriptor, 400, 0).decode(errors="replace").strip()
        if wait is None:
            raise JournalInUse(folder, owner)
        if waiting is not None:
            waiting(owner)
        # There is no event for "a lock is free" that a stop could end too; looking costs a microsecond.
        while not wait.wait(_LOOK_S):
            if _try(descriptor):
                return Owned(folder, descriptor)
    except BaseException:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


def _open(folder: Path) -> int:
    """What can open the file can take the lock and keep the service from starting: so only this user may."""
    try:
        make_own(folder)
        descriptor = os.open(folder / NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        with contextlib.suppress(PermissionError):  # root's, or a volume that has no owners
            os.fchmod(descriptor, 0o600)
        return descriptor
    except OSError:
        if not (folder / NAME).exists():
            raise
        check_own(folder)
        # A disk that is read-only has owners, too.
        return os.open(folder / NAME, os.O_RDONLY | os.O_CLOEXEC)


def _try(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
