"""A whole map as one file: its journal, and the newest checkpoint in the same database, in pieces.

Made of a journal that is closed or at work, on this machine; read into a folder of journals under any name.
"""

import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from factorbus.journal.checkpoints import file_of
from factorbus.journal.folders import IMPORTING, make_beside, sync_folder
from factorbus.journal.problems import JournalDamaged, JournalFailed, MapThere, NoJournal
from factorbus.journal.store import NAME, open_store, what_reading_failed_with
from factorbus.ownership import private_file

_PIECE = 32 << 20
_TABLE = "CREATE TABLE piece (record INTEGER NOT NULL, number INTEGER NOT NULL, bytes BLOB NOT NULL)"


def export_map(folder: Path, file: Path) -> int:
    """The map in `folder`, as it is now, into `file`, all of it or nothing; gives the revision that it is at there.

    Raises NoJournal, JournalDamaged, JournalVersion, JournalFailed.
    """
    beside = file.with_name(f".{file.name}.part")
    beside.unlink(missing_ok=True)
    store = open_store(folder, read_only=True)
    try:
        store.copy_to(beside)
        saved = store.checkpoints()
    finally:
        store.close()
    try:
        with _opened(beside) as database:
            database.execute(_TABLE)
            (revision,) = database.execute("SELECT COALESCE(MAX(revision), 0) FROM record").fetchone()
            for each in saved:
                if _put(database, each.record, file_of(folder, each.record)):
                    break
        beside.rename(file)
        sync_folder(file.absolute().parent)
        return revision
    except (sqlite3.Error, OSError) as error:
        beside.unlink(missing_ok=True)
        raise JournalFailed(file, str(error)) from None


def import_map(file: Path, folder: Path) -> None:
    """The map in `file` into `folder`, which must not be there yet; all of it or nothing.

    Raises NoJournal, MapThere, JournalDamaged, JournalVersion, JournalFailed.
    """
    if not file.is_file():
        raise NoJournal(file)
    if folder.exists():
        raise MapThere(folder)
    beside = folder.with_name(f"{IMPORTING}{folder.name}")
    shutil.rmtree(beside, ignore_errors=True)
    try:
        make_beside(beside)
        with file.open("rb") as source, open(beside / NAME, "xb", opener=private_file) as target:
            shutil.copyfileobj(source, target)
        open_store(beside, read_only=True).close()
        with _opened(beside / NAME) as database:
            for record, content in _pieces(database):
                with open(file_of(beside, record), "ab", opener=private_file) as checkpoint:
                    checkpoint.write(content)
            database.execute("DROP TABLE IF EXISTS piece")
            database.execute("UPDATE header SET value = ? WHERE name = 'map'", (folder.name,))
        _check(beside)
        sync_folder(beside)
        beside.rename(folder)
        sync_folder(folder.parent)
    except sqlite3.DatabaseError as error:
        problem = what_reading_failed_with(file, error)
        raise (problem if isinstance(problem, JournalDamaged) else JournalFailed(folder, str(error))) from None
    except OSError as error:
        raise JournalFailed(folder, str(error)) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _opened(path: Path) -> "_Database":
    return _Database(path)


class _Database:
    """A database in a `with`: one transaction, safe on disk when it ends well, closed in any case."""

    def __init__(self, path: Path) -> None:
        self._connection = sqlite3.connect(path, isolation_level=None)

    def __enter__(self) -> sqlite3.Connection:
        self._connection.execute("PRAGMA journal_mode = DELETE")
        self._connection.execute("PRAGMA synchronous = FULL")
        self._connection.execute("BEGIN IMMEDIATE")
        return self._connection

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if self._connection.in_transaction:
                self._connection.execute("COMMIT" if kind is None else "ROLLBACK")
        finally:
            self._connection.close()


def _put(database: sqlite3.Connection, record: int, path: Path) -> bool:
    """Whether the checkpoint is there and is now in the database, too."""
    try:
        with path.open("rb") as file:
            number = 0
            while content := file.read(_PIECE):
                database.execute("INSERT INTO piece VALUES (?, ?, ?)", (record, number, content))
                number += 1
    except FileNotFoundError:
        return False
    return True


def _pieces(database: sqlite3.Connection) -> Iterator[tuple[int, bytes]]:
    if database.execute("SELECT name FROM sqlite_master WHERE name = 'piece'").fetchone():
        yield from database.execute("SELECT record, bytes FROM piece ORDER BY record, number")


def _check(folder: Path) -> None:
    store = open_store(folder, read_only=True)
    try:
        for wrong in store.check():
            raise JournalDamaged(store.path, wrong)
    finally:
        store.close()
