"""The end of a journal, which upstream does not have yet: from memory while it is short, else from the disk."""

from collections import deque
from collections.abc import Sequence
from itertools import islice, takewhile

from factorbus.journal.records import JournalRecord
from factorbus.journal.store import open_store
from factorbus.proto.own_clients import count_inserts
from factorbus.service.journal.keeping import Keeper

_MOST_RECORDS, _MOST_BYTES = 4096, 4 << 20


class JournalTail:
    """Of one map.  For one thread; `wrote` may come late, after a record was read from the disk."""

    def __init__(self, keeper: Keeper) -> None:
        self._keeper = keeper
        self._records: deque[JournalRecord] = deque()
        self._bytes = 0

    def wrote(self, records: Sequence[JournalRecord]) -> None:
        """These came to the end of the journal."""
        for record in records:
            if self._records and record.number != self._records[-1].number + 1:
                continue  # it is here already, or there was no room for the one before
            if len(self._records) < _MOST_RECORDS and self._bytes < _MOST_BYTES:
                self._add(record)

    def forget(self) -> None:
        """The journal was rewritten."""
        self._records.clear()
        self._bytes = 0

    def after(self, record: int) -> list[JournalRecord]:
        """What comes after `record`, or the first of it: as many as fit."""
        while self._records and self._records[0].number <= record:
            self._bytes -= _size(self._records.popleft())
        if not self._records or self._records[0].number != record + 1:
            self.forget()
            self._read(record)
        return list(self._records)

    def inserts(self, after: int, until: int) -> int:
        """How many of clients are behind record `after`, up to `until`.  Raises JournalDamaged, JournalUnreadable."""
        store = open_store(self._keeper.folder, read_only=True)
        try:
            records = takewhile(lambda record: record.number <= until, store.records(after))
            return sum(count_inserts(record.entries) for record in records)
        finally:
            store.close()

    def _read(self, record: int) -> None:
        store = open_store(self._keeper.folder, read_only=True)
        try:
            for each in islice(store.records(record), _MOST_RECORDS):
                self._add(each)
                if self._bytes >= _MOST_BYTES:
                    break
        finally:
            store.close()

    def _add(self, record: JournalRecord) -> None:
        self._records.append(record)
        self._bytes += _size(record)


def _size(record: JournalRecord) -> int:
    return sum(len(entry.message) + len(entry.answer) for entry in record.entries)
