"""A connection to a journal's database, once nothing tells that it is not as it was left."""

import os
import sqlite3
from pathlib import Path

from factorbus.journal.log_frames import lost_from
from factorbus.journal.own_connections import OwnConnection, alone_to_connect
from factorbus.journal.problems import JournalDamaged, JournalUnreadable, JournalVersion

# 2: the answer to what was accepted was not kept whole; 3: its header had no seal; 4: a checkpoint counted only for the
# build of the solver that wrote it; 5: checkpoints were called snapshots, in the database and in names of files
FORM = 6
FORM_WITH_BUDGETS = 7  # the same, and some of its records have a budget, which are in a table of their own
APPLICATION = 0x46427573  # "FBus"
_LOG_BYTES = 64 << 20  # what a log that was longer is cut to, once it is in the database
# Ways to open it for reading.  The last: where no file can be made beside it, which the log of a database needs.
_AS_IT_IS = "ro&immutable=1"
_WAYS_TO_READ = ("ro", _AS_IT_IS)
_SYNCHRONOUS = {"none": "OFF", "group": "FULL", "commit": "FULL"}
# What the disk does to a database, not what is in it.
_OF_THE_DISK = (
    sqlite3.SQLITE_PERM, sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PROTOCOL, sqlite3.SQLITE_AUTH,
)  # fmt: skip


def connected(path: Path, durability: str, read_only: bool) -> tuple[sqlite3.Connection, bool]:
    """A connection, and whether it can write.  Raises JournalDamaged, JournalVersion, JournalUnreadable."""
    with alone_to_connect(path) as alone:
        if alone:
            _check_log(path)
        return _connected(path, durability, read_only)


def _connected(path: Path, durability: str, read_only: bool) -> tuple[sqlite3.Connection, bool]:
    why = ""
    for way in _WAYS_TO_READ if read_only else ("rw", *_WAYS_TO_READ):
        if way == _AS_IT_IS and _has_log(path):
            continue
        try:
            connection = connection_to(path, way, durability)
            try:
                return connection, way == "rw" and _is_writable(path, connection)
            except BaseException:
                connection.close()
                raise
        except (sqlite3.DatabaseError, ValueError) as error:
            if isinstance(problem := what_reading_failed_with(path, error), JournalDamaged):
                raise problem from None
            why = why or str(error)
    raise JournalUnreadable(path, why)


def connection_to(path: Path, mode: str, durability: str) -> sqlite3.Connection:
    """A connection in one of SQLite's modes, or `rwc` for a database that is still empty.  Raises what SQLite does."""
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True, isolation_level=None, check_same_thread=False, timeout=10.0, factory=OwnConnection,
    ).known_as(path)  # fmt: skip
    try:
        if mode in ("rw", "rwc"):
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute(f"PRAGMA synchronous = {_SYNCHRONOUS[durability]}")
            connection.execute(f"PRAGMA journal_size_limit = {_LOG_BYTES}")
        if mode != "rwc":
            _check_form(path, connection)
    except BaseException:
        connection.close()
        raise
    return connection


def what_reading_failed_with(path: Path, error: Exception) -> JournalDamaged | JournalUnreadable:
    """Is it the journal that is wrong, or what it is on?"""
    if (getattr(error, "sqlite_errorcode", 0) & 0xFF) in _OF_THE_DISK:
        return JournalUnreadable(path, str(error))
    return JournalDamaged(path, str(error))


def _check_log(path: Path) -> None:
    """Before SQLite sees it, which would take what is left for all.  Raises JournalDamaged, JournalUnreadable.

    Only where this process has no connection to it, see `own_connections`; then it was looked at before that.
    """
    try:
        lost = lost_from(path)
    except OSError as error:
        raise JournalUnreadable(path, str(error)) from None
    if not lost:
        return
    try:
        connection = connection_to(path, _AS_IT_IS, "none")
        try:
            named = dict(connection.execute("SELECT name, value FROM header"))
        finally:
            connection.close()
    except (sqlite3.DatabaseError, ValueError) as error:
        raise JournalDamaged(path, f"{lost}; {error}") from None
    if named.get("durability") != "none":  # which promises nothing, and begins a new epoch
        raise JournalDamaged(path, lost)


def _has_log(path: Path) -> bool:
    """Is there something that is not in the database yet?"""
    try:
        return path.with_name(f"{path.name}-wal").stat().st_size > 0
    except OSError:
        return False


def _check_form(path: Path, connection: sqlite3.Connection) -> None:
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (form,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise JournalDamaged(path, "it is a database of something else")
    if form not in (FORM, FORM_WITH_BUDGETS):
        raise JournalVersion(path, form, FORM_WITH_BUDGETS)


def _is_writable(path: Path, connection: sqlite3.Connection) -> bool:
    # SQLite opens for reading what cannot be opened for writing, and says nothing until something is written.
    if not os.access(path, os.W_OK) or not os.access(path.parent, os.W_OK):
        return False
    try:
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("ROLLBACK")
    except sqlite3.OperationalError:
        return False
    return True
