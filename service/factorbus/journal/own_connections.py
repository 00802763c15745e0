"""Which databases this process has connections to.

SQLite tells others by locks of the kernel that it has a database and the index of its log open.  A process loses all
its locks on a file when it closes it, even where it had opened that to read it, beside SQLite.  SQLite in another
process then takes the index for one that was left, and cuts it off while the service writes.  So a file of a database
that this process has a connection to is not to be opened in any other way.
https://www.sqlite.org/howtocorrupt.html, 2.2
"""

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from weakref import WeakSet

_File = tuple[int, int]  # device and inode


class OwnConnection(sqlite3.Connection):
    """One that is known from when it is made until it is closed, or nobody has it any more."""

    def known_as(self, database: Path) -> "OwnConnection":
        """Itself: it is one to `database`."""
        with _changing:
            _open.setdefault(_file_of(database), WeakSet()).add(self)
        return self

    def close(self) -> None:
        """As that of SQLite."""
        super().close()
        with _changing:
            for file in [file for file, connections in _open.items() if self in connections]:
                _open[file].discard(self)
                if not _open[file]:
                    del _open[file]


_open: dict[_File, "WeakSet[OwnConnection]"] = {}
_connecting: dict[_File, threading.RLock] = {}
_changing = threading.RLock()


@contextmanager
def alone_to_connect(database: Path) -> Iterator[bool]:
    """Whether there is no connection to it; no other thread makes one meanwhile."""
    file = _file_of(database)
    with _changing:
        lock = _connecting.setdefault(file, threading.RLock())
    with lock:
        with _changing:
            alone = not _open.get(file)
        yield alone


def _file_of(database: Path) -> _File:
    try:
        found = database.stat()
    except OSError:
        return 0, 0
    return found.st_dev, found.st_ino
