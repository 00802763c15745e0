"""What SQLite finds wrong with a journal's database, in one sentence."""

import sqlite3

from factorbus.wording import counted


def faults_of(connection: sqlite3.Connection, most: int) -> str:
    """What SQLite finds wrong with the database, of up to `most` faults the first in its words; empty: nothing."""
    rows = [line for (said,) in connection.execute(f"PRAGMA integrity_check({most})") for line in said.splitlines()]
    faults = [line for line in rows if line != "ok" and not line.startswith("***")]
    if not faults:
        return ""
    more = f", and {counted(len(faults) - 1, 'fault')} more" if len(faults) > 1 else ""
    return f"the pages of its database are not what was written (SQLite: {faults[0]}{more})"
