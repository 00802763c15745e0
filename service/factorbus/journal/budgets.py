"""What the steps of a record might take, in a journal's database: a table that only a journal has that needs it.

A record that is not in it was made without a budget.  A journal gets the table, and the form that says so, with its
first record that has one; so what was written before is read as it was, and a version that knows no budgets refuses
the journal instead of making other steps of it.
"""

import sqlite3
from collections.abc import Sequence

from factorbus.journal.connecting import FORM_WITH_BUDGETS
from factorbus.journal.records import JournalRecord

_TABLE = "CREATE TABLE IF NOT EXISTS budget (record INTEGER PRIMARY KEY, units REAL NOT NULL)"


def select_records(db: sqlite3.Connection, after: int) -> sqlite3.Cursor:
    """(number, revision, rebuilt, chain, budget) of the records after one, in order."""
    joined = " LEFT JOIN budget ON budget.record = record.number" if _has(db) else ""
    units = "COALESCE(units, 0.0)" if joined else "0.0"
    return db.execute(
        f"SELECT number, revision, rebuilt, chain, {units} FROM record{joined} WHERE number > ? ORDER BY number",
        (after,),
    )


def insert_budgets(db: sqlite3.Connection, records: Sequence[JournalRecord]) -> None:
    """Those of `records`, in the transaction that writes them."""
    rows = [(record.number, record.budget) for record in records if record.budget]
    if rows:
        db.execute(_TABLE)
        db.execute(f"PRAGMA user_version = {FORM_WITH_BUDGETS}")
        db.executemany("INSERT INTO budget VALUES (?, ?)", rows)


def delete_budgets(db: sqlite3.Connection, after: int) -> None:
    """Those of the records after one."""
    if _has(db):
        db.execute("DELETE FROM budget WHERE record > ?", (after,))


def _has(db: sqlite3.Connection) -> bool:
    found = db.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'budget'").fetchone()
    return found is not None
