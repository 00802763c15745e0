"""A journal that follows another one: what comes after a record is replaced, in one transaction.

A replica writes down its upstream's records in their place, and its own behind them.  What it knows of the upstream is
in the header: up to which of its own records that has them, and the chain that the upstream has told for it.
"""

import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from factorbus.journal.budgets import delete_budgets
from factorbus.journal.records import JournalRecord, Last, Maker
from factorbus.journal.store import Store, text_of_build

_UPSTREAM = "upstream"


class UpstreamPlace(NamedTuple):
    """Up to `record` the upstream has what this journal has; `chain` is what the upstream has told of that."""

    record: int
    chain: bytes


def rewrite(
    store: Store, last: Last, records: Sequence[JournalRecord], place: UpstreamPlace | None, build: Mapping[str, str]
) -> list[int]:
    """After `last` there are `records` and nothing else.  Gives the records of checkpoints that are forgotten.

    place: known of the upstream, if there is one.  build: made the records.  Raises JournalFailed.
    """
    after, database = last.record, store._db
    with store._writing():
        gone = database.execute("SELECT record FROM checkpoint WHERE record > ?", (after,)).fetchall()
        database.execute("DELETE FROM checkpoint WHERE record > ?", (after,))
        database.execute("DELETE FROM entry WHERE record > ?", (after,))
        database.execute("DELETE FROM record WHERE number > ?", (after,))
        delete_budgets(database, after)
        database.execute("DELETE FROM maker WHERE record > ?", (after,))
        store._insert_records(records)
        _add_maker(store, Maker(after + 1, build))
        if place is not None:
            store._set({_UPSTREAM: _place_text(place)})
    return [record for (record,) in gone]


def note_upstream(store: Store, place: UpstreamPlace | None) -> None:
    """Write down how far the upstream has come, if there is one.  Raises JournalFailed."""
    if place is None:
        return
    with store._writing():
        store._set({_UPSTREAM: _place_text(place)})


def upstream_of(store: Store) -> UpstreamPlace:
    """What is written down of it; of a journal that never had one, nothing.  Raises JournalDamaged."""
    with store._reading():
        text = store._header().get(_UPSTREAM)
        if text is None:
            return UpstreamPlace(0, bytes(16))
        record, chain = json.loads(text)
        return UpstreamPlace(int(record), bytes.fromhex(chain))


def _place_text(place: UpstreamPlace) -> str:
    return json.dumps([place.record, place.chain.hex()])


def _add_maker(store: Store, maker: Maker) -> None:
    makers = store._db.execute("SELECT build FROM maker ORDER BY record DESC LIMIT 1").fetchone()
    if makers is None or makers[0] != text_of_build(maker.build):
        store._db.execute("INSERT OR REPLACE INTO maker VALUES (?, ?)", (maker.record, text_of_build(maker.build)))
