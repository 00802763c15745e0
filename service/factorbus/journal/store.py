"""A journal's database: what is in its tables, and how it is written.

Written by one process, and read by others at the same time (WAL); one transaction takes in all records that wait.
"""

import json
import shutil
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from itertools import pairwise
from pathlib import Path
from typing import Any

from factorbus.journal import chain
from factorbus.journal.budgets import delete_budgets, insert_budgets, select_records
from factorbus.journal.connecting import APPLICATION, FORM, connected, connection_to, what_reading_failed_with
from factorbus.journal.digest import digest_of
from factorbus.journal.faults import list_faults
from factorbus.journal.folders import UNFINISHED, check_own, make_beside, sync_folder
from factorbus.journal.problems import JournalDamaged, JournalFailed, JournalUnreadable, NoJournal, NotWritten
from factorbus.journal.records import Checkpoint, Entry, Epoch, Header, JournalRecord, Last, Maker, Sender
from factorbus.ownership import private_file
from factorbus.proto.own_clients import JUDGE, KEEPER

NAME = "journal.db"
_SCHEMA = """
CREATE TABLE header (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE epoch (number INTEGER PRIMARY KEY, epoch INTEGER NOT NULL, record INTEGER NOT NULL, because TEXT NOT NULL);
-- rebuilt: 0, or 1 where the solver failed meanwhile and was replaced, or 2 for a step without an insert
CREATE TABLE record (
    number INTEGER PRIMARY KEY, revision INTEGER NOT NULL, rebuilt INTEGER NOT NULL, chain BLOB NOT NULL
);
CREATE TABLE entry (
    number INTEGER PRIMARY KEY, record INTEGER NOT NULL, client TEXT NOT NULL, sequence INTEGER NOT NULL,
    digest INTEGER NOT NULL, outcome INTEGER NOT NULL, revision INTEGER NOT NULL, first_factor INTEGER NOT NULL,
    together INTEGER NOT NULL, answer BLOB NOT NULL, message BLOB NOT NULL
);
CREATE INDEX entry_of_client ON entry (client);
CREATE TABLE checkpoint (
    record INTEGER PRIMARY KEY, format INTEGER NOT NULL, build TEXT NOT NULL, differs TEXT NOT NULL,
    bytes INTEGER NOT NULL
);
CREATE TABLE maker (record INTEGER PRIMARY KEY, build TEXT NOT NULL);
"""
_REBUILT, _FURTHER = 1, 2
_ENTRY = "client, sequence, digest, outcome, revision, first_factor, together, answer"


class Store:
    """One map's database, open.  One thread at a time."""

    def __init__(self, path: Path, connection: sqlite3.Connection, writable: bool) -> None:
        self.path, self.writable = path, writable
        self._db = connection

    def header(self) -> Header:
        """What the journal says of itself.  Raises JournalDamaged."""
        with self._reading():
            named, epochs = self._header(), self._epochs()
            if named.get("seal") != _sealed(named, epochs):
                raise JournalDamaged(self.path, "its header is not what was written")
            return Header(
                named["map"], named["mode"], json.loads(named["options"]), tuple(epochs), named["durability"],
                named["clean"] == "1",
            )  # fmt: skip

    def last(self) -> Last:
        """Where it ends.  Raises JournalDamaged."""
        with self._reading():
            row = self._db.execute("SELECT number, revision, chain FROM record ORDER BY number DESC LIMIT 1").fetchone()
        return Last(*row) if row else Last(0, 0, chain.START)

    def last_at(self, record: int) -> Last:
        """Where it was after `record`.  Raises JournalDamaged."""
        with self._reading():
            row = self._db.execute("SELECT number, revision, chain FROM record WHERE number = ?", (record,)).fetchone()
        if row is None:
            raise JournalDamaged(self.path, f"record {record}, which a checkpoint was made after, is missing")
        return Last(*row)

    def records(self, after: int = 0) -> Iterator[JournalRecord]:
        """What was applied after record `after`, in order.  Raises JournalDamaged."""
        with self._reading():
            entries = self._db.execute(
                f"SELECT record, {_ENTRY}, message FROM entry WHERE record > ? ORDER BY number", (after,)
            )
            row = entries.fetchone()
            for number, revision, kind, digest, budget in select_records(self._db, after):
                if number != after + 1:
                    raise JournalDamaged(self.path, f"record {after + 1} is missing")
                after, taken = number, []
                while row is not None and row[0] == number:
                    taken.append(self._checked(Entry(*row[1:])))
                    row = entries.fetchone()
                if row is not None and row[0] < number:
                    raise JournalDamaged(self.path, f"an insert of record {row[0]} is out of order")
                rebuilt, further = kind == _REBUILT, kind == _FURTHER
                yield JournalRecord(number, revision, rebuilt, digest, tuple(taken), further, budget)
            if row is not None:
                raise JournalDamaged(self.path, f"an insert belongs to record {row[0]}, which is missing")

    def makers(self) -> list[Maker]:
        """The builds that made its records, in their order; one that made none is left out.  Raises JournalDamaged."""
        with self._reading():
            rows = self._db.execute(
                "SELECT * FROM maker WHERE record <= (SELECT MAX(number) FROM record) ORDER BY record"
            ).fetchall()
            return [Maker(record, json.loads(build)) for record, build in rows]

    def senders(self, first_record: int, clients: int, entries: int) -> list[Sender]:
        """The `clients` heard last, each with up to `entries` of its last inserts.

        Of the present epoch, which began with `first_record`.  The client heard longest ago comes first.
        """
        with self._reading():
            names = self._db.execute(
                "SELECT client, MAX(number) AS heard FROM entry WHERE record >= ? GROUP BY client "
                "ORDER BY heard DESC LIMIT ?", (first_record, clients),
            ).fetchall()  # fmt: skip
            return [self._sender(name, first_record, entries) for name, _ in reversed(names)]

    def counts(self) -> dict[str, int]:
        """Records, inserts, clients and bytes of all messages."""
        with self._reading():
            (records,) = self._db.execute("SELECT COUNT(*) FROM record").fetchone()
            row = self._db.execute(
                "SELECT SUM(client NOT IN (:judge, :keeper)), "
                "COUNT(DISTINCT NULLIF(NULLIF(client, :judge), :keeper)), SUM(LENGTH(message)) FROM entry",
                {"judge": JUDGE, "keeper": KEEPER},
            ).fetchone()
        return {"records": records, "inserts": row[0] or 0, "clients": row[1], "message_bytes": row[2] or 0}

    def checkpoints(self) -> list[Checkpoint]:
        """The checkpoints that were written, newest first."""
        with self._reading():
            rows = self._db.execute("SELECT * FROM checkpoint ORDER BY record DESC").fetchall()
            return [Checkpoint(record, form, json.loads(build), *more) for record, form, build, *more in rows]

    def append(self, records: Sequence[JournalRecord]) -> None:
        """Write `records` down: when this returns they are as safe as the durability says.  Raises JournalFailed."""
        with self._writing():
            self._insert_records(records)

    def add_checkpoint(self, saved: Checkpoint, keep: int, back_to: int = 0) -> list[int]:
        """Note a checkpoint, and forget all but the last `keep` and the last up to record `back_to`: gives the records
        of those that are forgotten.  Raises JournalFailed."""
        held = "SELECT COALESCE(MAX(record), 0) FROM checkpoint WHERE record <= ?"
        with self._writing():
            self._insert_checkpoint(saved)
            old = self._db.execute(
                f"SELECT record FROM checkpoint WHERE record <> ({held}) ORDER BY record DESC LIMIT -1 OFFSET ?",
                (back_to, keep),
            ).fetchall()
            self._db.executemany("DELETE FROM checkpoint WHERE record = ?", old)
        return [record for (record,) in old]

    def begin(self, durability: str, epoch: Epoch | None = None, maker: Maker | None = None) -> None:
        """Somebody is at work with it from now on, in a new epoch if there is one.

        maker: who makes the next record, if it is not who made the last one.  Raises JournalFailed.
        """
        with self._writing():
            self._set({"clean": "0", "durability": durability})
            self._db.execute("DELETE FROM maker WHERE record > (SELECT COALESCE(MAX(number), 0) FROM record)")
            if maker is not None:
                self._db.execute("INSERT INTO maker VALUES (?, ?)", (maker.record, text_of_build(maker.build)))
            if epoch is not None:
                self._add_epoch(epoch)
                self._seal()

    def end(self) -> None:
        """It is left in order: nothing that was answered is missing.  Raises JournalFailed."""
        with self._writing():
            self._set({"clean": "1"})

    def become(self, name: str, record: int, epoch: Epoch, saved: Checkpoint | None) -> None:
        """A copy of another map's is the journal of map `name`: with nothing after `record`, in an epoch of its own.

        saved: the one checkpoint that it has.  Raises JournalFailed.
        """
        with self._writing():
            self._db.execute("DELETE FROM entry WHERE record > ?", (record,))
            self._db.execute("DELETE FROM record WHERE number > ?", (record,))
            delete_budgets(self._db, record)
            self._db.execute("DELETE FROM epoch WHERE record > ?", (epoch.record,))
            self._db.execute("DELETE FROM maker WHERE record > ?", (record,))
            self._add_epoch(epoch)
            self._db.execute("DELETE FROM checkpoint")
            if saved is not None:
                self._insert_checkpoint(saved)
            self._set({"map": name, "clean": "1"})
            self._seal()

    def probe(self) -> None:
        """Can something be written again, and some room be had?  Raises JournalFailed."""
        with self._writing():
            self._db.execute("INSERT OR REPLACE INTO header VALUES ('probe', ?)", ("." * (256 << 10),))
        with self._writing():
            self._db.execute("DELETE FROM header WHERE name = 'probe'")

    def check_form(self) -> None:
        """That tables and index are what SQLite made, not yet what is in them.  Raises JournalDamaged."""
        with self._reading():
            faults = list_faults(self._db.execute("PRAGMA integrity_check(1)"))
        if faults:
            raise JournalDamaged(self.path, faults)

    def check(self) -> Iterator[str]:
        """Everything that is wrong with it: by SQLite's own check, by inserts' bytes, by clients' numbers."""
        try:
            if faults := list_faults(self._db.execute("PRAGMA integrity_check(20)")):
                yield faults
            yield from self._check_sequences()
            revision = 0
            for record in self.records():
                if record.revision < revision:
                    yield f"record {record.number} goes back from revision {revision} to {record.revision}"
                revision = record.revision
            self.header()
        except JournalDamaged as damaged:
            yield str(damaged.detail["what"])
        except (sqlite3.DatabaseError, ValueError, TypeError) as error:
            yield str(error)

    def copy_to(self, path: Path) -> None:
        """A copy in one file, consistent also while somebody writes.  Raises NotWritten."""
        try:
            open(path, "xb", opener=private_file).close()  # into an empty file it writes as into none
            self._db.execute("VACUUM INTO ?", (str(path),))
        except (OSError, sqlite3.Error) as error:
            raise NotWritten(path, str(error)) from None

    def close(self) -> None:
        """Close it; what is in the log is moved to the database first, where that is possible."""
        try:
            self._db.close()
        except sqlite3.Error as error:
            raise JournalFailed(self.path, str(error)) from None

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """One transaction."""
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
        except sqlite3.Error as error:
            raise JournalFailed(self.path, str(error)) from None

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as error:
            raise what_reading_failed_with(self.path, error) from None
        except (ValueError, TypeError, OverflowError, LookupError) as error:
            raise JournalDamaged(self.path, f"a row of it is missing or cannot be read ({error})") from None

    def _set(self, values: dict[str, str]) -> None:
        self._db.executemany("INSERT OR REPLACE INTO header VALUES (?, ?)", list(values.items()))

    def _header(self) -> dict[str, str]:
        return dict(self._db.execute("SELECT name, value FROM header"))

    def _epochs(self) -> list[Epoch]:
        return [Epoch(*row) for row in self._db.execute("SELECT epoch, record, because FROM epoch ORDER BY number")]

    def _seal(self) -> None:
        self._set({"seal": _sealed(self._header(), self._epochs())})

    def _add_epoch(self, epoch: Epoch) -> None:
        self._db.execute(
            "INSERT INTO epoch (epoch, record, because) VALUES (?, ?, ?)", (epoch.epoch, epoch.record, epoch.because)
        )

    def _insert_records(self, records: Sequence[JournalRecord]) -> None:
        rows = [(record.number, record.revision, _kind(record), record.chain) for record in records]
        self._db.executemany("INSERT INTO record VALUES (?, ?, ?, ?)", rows)
        insert_budgets(self._db, records)
        self._db.executemany(
            f"INSERT INTO entry (record, {_ENTRY}, message) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [(record.number, *entry) for record in records for entry in record.entries],
        )

    def _insert_checkpoint(self, saved: Checkpoint) -> None:
        row = saved.record, saved.format, text_of_build(saved.build), saved.differs, saved.bytes
        self._db.execute("INSERT OR REPLACE INTO checkpoint VALUES (?, ?, ?, ?, ?)", row)

    def _checked(self, entry: Entry) -> Entry:
        if digest_of(entry) != entry.digest:
            raise JournalDamaged(self.path, f"insert {entry.sequence} of client {entry.client} is not what was written")
        return entry

    def _sender(self, name: str, first_record: int, most: int) -> Sender:
        rows = self._db.execute(
            f"SELECT {_ENTRY}, message FROM entry WHERE client = ? AND record >= ? ORDER BY number DESC LIMIT ?",
            (name, first_record, most),
        )
        entries: list[Entry] = []
        for row in rows:
            entry = self._checked(Entry(*row))
            if entries and entry.sequence != entries[-1].sequence - 1:
                break  # a name that was forgotten and used again began at 1
            entries.append(entry)
        if not entries:
            raise JournalDamaged(self.path, f"client {name}, who is in its index, has no insert")
        return Sender(name, entries[0].sequence + 1, tuple(reversed(entries)))

    def _check_sequences(self) -> Iterator[str]:
        """Each client's numbers are 1, 2, 3, ... in every epoch; the keeper's are revisions, and rise."""
        begins = [record for (record,) in self._db.execute("SELECT record FROM epoch ORDER BY number")]
        for first, end in pairwise([*begins, 1 << 62]):
            rows = self._db.execute(
                "SELECT client, sequence, sequence - LAG(sequence, 1, 0) OVER (PARTITION BY client ORDER BY number) "
                "FROM entry WHERE record >= ? AND record < ?", (first, end),
            )  # fmt: skip
            for client, sequence, by in rows:
                if by != 1 and sequence != 1 and not (client == KEEPER and by > 0):
                    yield f"client {client} has number {sequence} after {sequence - by}"


def create(folder: Path, name: str, mode: str, options: dict[str, Any], epoch: int, durability: str) -> Store:
    """A new journal in `folder`, which is made: it is there whole or not at all.  Raises JournalFailed."""
    beside = folder.with_name(f"{UNFINISHED}{folder.name}")
    try:
        shutil.rmtree(beside, ignore_errors=True)
        make_beside(beside)
        _fill(beside / NAME, name, mode, options, epoch, durability)
        sync_folder(beside)
        beside.rename(folder)
        sync_folder(folder.parent)
        return open_store(folder, durability)
    except (OSError, sqlite3.Error) as error:
        shutil.rmtree(beside, ignore_errors=True)
        raise JournalFailed(folder / NAME, str(error)) from None


def open_store(folder: Path, durability: str = "commit", read_only: bool = False) -> Store:
    """The journal in `folder`.  One that cannot be written is opened for reading: `writable` says so.

    Raises NoJournal, UnsafeJournal, JournalDamaged, JournalVersion, JournalUnreadable.
    """
    path = folder / NAME
    try:
        there = path.is_file()
    except PermissionError as error:
        raise JournalUnreadable(path, error.strerror or str(error)) from None
    if not there:
        raise NoJournal(path)
    if path.is_symlink():
        path = path.resolve()  # beside which the log is
    if not read_only:
        check_own(folder)
    return Store(path, *connected(path, durability, read_only))


def _sealed(named: Mapping[str, str], epochs: Sequence[Epoch]) -> str:
    """A digest of what makes a map's steps, and of its lives."""
    rows = [[each.epoch, each.record, each.because] for each in epochs]
    content = json.dumps([named.get("mode"), named.get("options"), rows])
    return blake2b(content.encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()


def _kind(record: JournalRecord) -> int:
    """As the table has it, in the column `rebuilt`."""
    return _FURTHER if record.further else _REBUILT * record.rebuilt


def text_of_build(build: Mapping[str, str]) -> str:
    """As the tables have it."""
    return json.dumps(dict(build), ensure_ascii=False)


def _fill(path: Path, name: str, mode: str, options: dict[str, Any], epoch: int, durability: str) -> None:
    open(path, "xb", opener=private_file).close()  # SQLite gives its log the same rights
    store = Store(path, connection_to(path, "rwc", durability), True)
    try:
        with store._writing():
            for statement in _SCHEMA.split(";"):
                store._db.execute(statement)
            store._db.execute("INSERT INTO epoch (epoch, record, because) VALUES (?, 1, 'created')", (epoch,))
            store._set(
                {"map": name, "mode": mode, "options": json.dumps(options), "durability": durability, "clean": "0"}
            )
            store._seal()
            store._db.execute(f"PRAGMA application_id = {APPLICATION}")
            store._db.execute(f"PRAGMA user_version = {FORM}")
    finally:
        store.close()
