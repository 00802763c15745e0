"""What SQLite finds wrong with a journal's database, in one sentence."""

from collections.abc import Iterable

from factorbus.wording import counted


def list_faults(said: Iterable[tuple[str]]) -> str:
    """Of the rows of `PRAGMA integrity_check` the first fault in its words, and how many more; empty: there is none."""
    lines = [line for (row,) in said for line in row.splitlines()]
    faults = [line for line in lines if line != "ok" and not line.startswith("***")]
    if not faults:
        return ""
    more = f", and {counted(len(faults) - 1, 'fault')} more" if len(faults) > 1 else ""
    return f"the pages of its database are not what was written (SQLite: {faults[0]}{more})"
