"""A whole map as one file: its journal, and the newest checkpoint in the same database, in pieces.

Made of a journal that is closed or at work, on this machine; read into a folder of journals under any name.
"""

import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from factorbus.journal.checkpoints import file_of
from factorbus.journal.connecting import APPLICATION
from factorbus.journal.folders import IMPORTING, is_map, make_beside, maps_in, own_place_of, sync_folder
from factorbus.journal.problems import BadFile, JournalDamaged, JournalVersion, MapThere, NoJournal, NotWritten
from factorbus.journal.store import NAME, Store, open_store, what_reading_failed_with
from factorbus.ownership import private_file

_PIECE = 32 << 20
# How a database of SQLite begins, and where it has the number of the application that it belongs to.
_MAGIC, _APPLICATION_AT, _HEADER_BYTES = b"SQLite format 3\0", 68, 100
_TABLE = "CREATE TABLE piece (record INTEGER NOT NULL, number INTEGER NOT NULL, bytes BLOB NOT NULL)"


def export_map(folder: Path, file: Path) -> int:
    """The map in `folder`, as it is now, into `file`, all of it or nothing; gives the revision that it is at there.

    Raises NoJournal, JournalDamaged, JournalVersion, JournalUnreadable, NotWritten.
    """
    _refuse_in_journal(file)
    beside = own_place_of(file, ".", ".part")
    store = _open_one_of(folder)
    try:
        beside.unlink(missing_ok=True)
        store.copy_to(beside)
    except OSError as error:
        raise NotWritten(file, str(error)) from None
    finally:
        store.close()
    try:
        with _opened(beside) as database:
            database.execute(_TABLE)
            (revision,) = database.execute("SELECT COALESCE(MAX(revision), 0) FROM record").fetchone()
            _put_newest(database, folder)
        beside.rename(file)
        sync_folder(file.absolute().parent)
        return revision
    except (sqlite3.Error, OSError) as error:
        beside.unlink(missing_ok=True)
        raise NotWritten(file, str(error)) from None


def _refuse_in_journal(file: Path) -> None:
    """Raises NotWritten for a file in the folder of a map's journal, which a service may be writing."""
    if (file.absolute().parent / NAME).exists():
        raise NotWritten(file, f"the journal of a map, {NAME}, is in its folder")


def import_map(file: Path, folder: Path) -> None:
    """The map in `file` into `folder`, which must not be there yet; all of it or nothing.

    Raises BadFile, MapThere, JournalVersion, JournalUnreadable, NotWritten.
    """
    if folder.exists():
        raise MapThere(folder)
    _check_exported(file)
    beside = own_place_of(folder, IMPORTING)
    try:
        make_beside(beside)
        with file.open("rb") as source, open(beside / NAME, "xb", opener=private_file) as target:
            shutil.copyfileobj(source, target)
        open_store(beside, read_only=True).close()
        _unpack(beside, folder.name)
        _check(beside)
        sync_folder(beside)
        beside.rename(folder)
        sync_folder(folder.parent)
    except JournalVersion as version:
        raise JournalVersion(file, int(version.detail["seen"]), int(version.detail["wanted"])) from None
    except JournalDamaged as damaged:
        raise BadFile(file, f"is damaged: {damaged.detail['what']}") from None
    except sqlite3.DatabaseError as error:
        if isinstance(what_reading_failed_with(file, error), JournalDamaged):
            raise BadFile(file, f"is damaged: {error}") from None
        raise NotWritten(folder, str(error)) from None
    except OSError as error:
        if folder.exists():  # another process was faster
            raise MapThere(folder) from None
        raise NotWritten(folder, str(error)) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _open_one_of(folder: Path) -> Store:
    """The map in `folder`; where there is none, those beside it are named.  Raises NoJournal, JournalDamaged, ..."""
    try:
        return open_store(folder, read_only=True)
    except NoJournal:
        if not folder.parent.is_dir():
            raise NoJournal(folder.parent) from None
        if is_map(folder, NAME):
            raise JournalDamaged(folder, f"{NAME} is missing beside what was written with it") from None
        raise NoJournal(folder, tuple(maps_in(folder.parent, NAME))) from None


def _check_exported(file: Path) -> None:
    """Raises BadFile for what cannot be read, and for what is no database or one of something else."""
    try:
        with file.open("rb") as source:
            begins = source.read(_HEADER_BYTES)
    except OSError as error:
        raise BadFile(file, f"cannot be read: {error.strerror}") from None
    application = int.from_bytes(begins[_APPLICATION_AT : _APPLICATION_AT + 4], "big")
    if not begins.startswith(_MAGIC) or application != APPLICATION:
        raise BadFile(file, "is no exported map")
    if (log := file.resolve().with_name(f"{file.resolve().name}-wal")).exists():
        raise BadFile(file, f"is a journal that somebody may be writing, a part of which is in {log.name}")


def _unpack(folder: Path, name: str) -> None:
    """Checkpoints that are in the database become files beside it, which is that of map `name`."""
    with _opened(folder / NAME) as database:
        for record, content in _pieces(database):
            with open(file_of(folder, record), "ab", opener=private_file) as checkpoint:
                checkpoint.write(content)
        database.execute("DROP TABLE IF EXISTS piece")
        database.execute("UPDATE header SET value = ? WHERE name = 'map'", (name,))


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


def _put_newest(database: sqlite3.Connection, folder: Path) -> None:
    """The newest checkpoint that the copy knows of and that is still there; of the others it has no row either.

    A service at work may have written another one since, and have removed these.
    """
    rows = database.execute("SELECT record FROM checkpoint ORDER BY record DESC").fetchall()
    taken = next((record for (record,) in rows if _put(database, record, file_of(folder, record))), None)
    database.execute("DELETE FROM checkpoint WHERE record IS NOT ?", (taken,))


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
