"""Entries of a journal that no client sent: the map's own, under names that no client on the bus can have."""

from collections.abc import Iterable
from typing import Any

JUDGE = "closures.judge"  # verdicts on loop closures
KEEPER = "keep.policy"  # inserts that take out poses which the map has enough of
OWN_CLIENTS = (JUDGE, KEEPER)


def count_inserts(entries: Iterable[Any]) -> int:
    """How many of the entries of a record are inserts of clients; the others are the map's own."""
    return sum(entry.client not in OWN_CLIENTS for entry in entries)
