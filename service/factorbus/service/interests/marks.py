"""What of a map's variables the followers of one interest have, and what is to be sent to them.  Pure.

Of each variable, by the row it has in `InterestTables`:

    inside   it is in the interest
    stale    it is, and its value is to be sent
    held     followers have it; outside, that is to be told
    since    the number of the last message when it began to wait: who waits longest has a share of every message
    sent     the number of the message in which it, or that it has left, was sent last
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.interest import InterestFilter
from factorbus.proto.messages import Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.variable_kinds import VARIABLE_KINDS
from factorbus.service.interests.tables import InterestTables, Moved

# Bytes of a message: of a group of variables beside its rows, of one key.
GROUP_BYTES, KEY_BYTES = 80, 8
# Of a message that cannot hold all, what goes to those that wait longest.
_OLDEST_SHARE = 0.25
# Keys of variables that have left and are no more, kept for those who missed that.
_MOST_REMOVED = 65_536

Rows = dict[str, I64]  # of variables, by kind, ascending
_Costed = tuple[str, I64, I64, I64]


class KindMarks:
    """Of the variables of one kind."""

    def __init__(self, count: int = 0) -> None:
        self.count = count
        self.inside, self.stale, self.held = (np.zeros(count, bool) for _ in range(3))
        self.since, self.sent = np.zeros(count, np.int64), np.zeros(count, np.int64)

    def grow(self, count: int) -> None:
        """There are `count` rows now."""
        self.count = count
        if (more := count - len(self.inside)) > 0:
            more = max(more, len(self.inside))
            for name in _COLUMNS:
                column = getattr(self, name)
                setattr(self, name, np.concatenate([column, np.zeros(more, column.dtype)]))

    def moved(self, origin: I64) -> "KindMarks":
        """The same for rows that had other numbers before, −1 of new ones."""
        marks, known = KindMarks(len(origin)), np.flatnonzero(origin >= 0)
        for name in _COLUMNS:
            getattr(marks, name)[known] = getattr(self, name)[origin[known]]
        return marks


_COLUMNS = ("inside", "stale", "held", "since", "sent")


class Removed(NamedTuple):
    """Keys that were told to be gone in message `number` or before, and whose variables are no more."""

    number: int
    kind: str
    keys: I64


class InterestMarks:
    """Of all variables of a map, for one interest."""

    def __init__(self, chosen: InterestFilter) -> None:
        self._filter = chosen
        self._kinds: dict[str, KindMarks] = {}
        self._seen = -1  # up to where `InterestTables.clock` has been looked at
        self._leaving: Rows = {}  # keys whose variables are no more, which followers have
        self._removed: list[Removed] = []
        self._waiting: int | None = None  # counted, and nothing has changed since
        self.repairs_from = 0  # who has a message of this number or later can be told what was missed

    def has_seen(self, tables: InterestTables) -> bool:
        """Whether nothing came since the last look."""
        return self._seen == tables.clock

    def look(self, tables: InterestTables, number: int) -> None:
        """See what changed.  number: of the last message."""
        if self.has_seen(tables):
            return
        self._waiting = None
        for kind, rows in tables.kinds.items():
            marks = self._kinds.setdefault(kind, KindMarks())
            marks.grow(rows.table.count)
            changed = np.flatnonzero(rows.came > self._seen)
            if not changed.size:
                continue
            keys, values, _ = rows.table.rows()
            mask = self._filter.mask(kind, keys[changed], values[changed])
            inside, outside = changed[mask], changed[~mask]
            marks.since[inside[~marks.stale[inside]]] = number
            marks.inside[inside] = marks.stale[inside] = True
            marks.inside[outside] = marks.stale[outside] = False
        self._seen = tables.clock

    def moved(self, moved: Mapping[str, Moved], number: int) -> None:
        """The whole estimate came anew; `look` is to follow."""
        self._waiting = None
        for kind, (origin, keys) in moved.items():
            marks = self._kinds.get(kind, KindMarks())
            marks.grow(len(keys))
            stay = np.zeros(len(keys), bool)
            stay[origin[origin >= 0]] = True
            if (gone := keys[marks.held[: len(keys)] & ~stay]).size:
                self._leaving[kind] = np.union1d(self._leaving.get(kind, gone), gone)
            told = keys[(marks.sent[: len(keys)] > 0) & ~marks.held[: len(keys)] & ~stay]
            self._note_removed(number, kind, told)
            self._kinds.pop(kind, None)
            if len(origin):
                self._kinds[kind] = marks.moved(origin)

    def forget(self) -> None:
        """Nobody has anything."""
        self._kinds, self._leaving, self._removed = {}, {}, []
        self._seen, self.repairs_from, self._waiting = -1, 0, None

    def waiting(self) -> int:
        """How many are to be sent: values, and that they have left."""
        if self._waiting is None:
            values = sum(int(np.count_nonzero(marks.stale[: marks.count])) for marks in self._kinds.values())
            left = sum(len(rows) for rows in self._left().values())
            self._waiting = values + left + sum(map(len, self._leaving.values()))
        return self._waiting

    def stale(self) -> Rows:
        """Those whose value is to be sent."""
        return {kind: np.flatnonzero(marks.stale[: marks.count]) for kind, marks in self._kinds.items()}

    def inside(self) -> Rows:
        """Those in the interest."""
        return {kind: np.flatnonzero(marks.inside[: marks.count]) for kind, marks in self._kinds.items()}

    def missed(self, number: int) -> Rows:
        """Those in the interest whose value was sent after message `number`."""
        return {
            kind: np.flatnonzero((marks.sent[: marks.count] > number) & marks.inside[: marks.count])
            for kind, marks in self._kinds.items()
        }

    def missed_gone(self, number: int, tables: InterestTables) -> tuple[Variables, ...]:
        """The variables that left in messages after `number`."""
        gone: dict[str, list[I64]] = {}
        for kind, marks in self._kinds.items():
            n = marks.count
            rows = np.flatnonzero((marks.sent[:n] > number) & ~marks.held[:n] & ~marks.inside[:n])
            if rows.size:
                gone.setdefault(kind, []).append(tables.kinds[kind].table.rows()[0][rows])
        for each in self._removed:
            if each.number > number:
                gone.setdefault(each.kind, []).append(np.setdiff1d(each.keys, self._held_keys(each.kind, tables)))
        groups = ((kind, np.unique(np.concatenate(keys))) for kind, keys in gone.items())
        return tuple(Variables(kind, keys) for kind, keys in groups if keys.size)

    def choose(self, rows: Rows, tables: InterestTables, budget: int) -> Rows:
        """Of `rows` those that fit into `budget` bytes: poses before others, newest first, and some of the oldest."""
        columns = list(_costed(rows, tables, self._kinds))
        if not columns:
            return {}
        if sum(int(cost.sum()) + GROUP_BYTES for _, _, cost, _ in columns) <= budget:
            return {kind: chosen for kind, chosen, _, _ in columns}
        columns = _kinds_with_room(columns, budget)
        kinds = [kind for kind, *_ in columns]
        of_kind = np.repeat(np.arange(len(kinds)), [len(each) for _, each, _, _ in columns])
        row, cost, since = (np.concatenate(column) for column in list(zip(*columns, strict=True))[1:])
        budget -= GROUP_BYTES * len(kinds)
        is_pose = np.array([_is_pose(kind) for kind in kinds])
        newest = np.lexsort((-row, ~is_pose[of_kind]))
        taken = newest[np.cumsum(cost[newest]) <= (1.0 - _OLDEST_SHARE) * budget]
        left = np.ones(len(row), bool)
        left[taken] = False
        oldest = np.flatnonzero(left)
        oldest = oldest[np.lexsort((row[oldest], since[oldest]))]
        more = oldest[np.cumsum(cost[oldest]) <= budget - int(cost[taken].sum())]
        chosen = np.concatenate([taken, more])
        return {kind: np.sort(row[chosen[of_kind[chosen] == n]]) for n, kind in enumerate(kinds)}

    def take_gone(self, tables: InterestTables, number: int, most: int) -> tuple[Variables, ...]:
        """At most `most` of those that have left, which message `number` tells."""
        self._waiting = None
        groups: dict[str, list[I64]] = {}
        for kind in list(self._leaving):
            left = np.setdiff1d(self._leaving[kind], self._held_keys(kind, tables))  # what came back has been told
            keys, self._leaving[kind] = left[:most], left[most:]
            most -= len(keys)
            self._note_removed(number, kind, keys)
            groups.setdefault(kind, []).append(keys)
        self._leaving = {kind: keys for kind, keys in self._leaving.items() if keys.size}
        for kind, rows in self._left().items():
            rows, marks = rows[:most], self._kinds[kind]
            most -= len(rows)
            marks.held[rows], marks.sent[rows] = False, number
            groups.setdefault(kind, []).append(tables.kinds[kind].table.rows()[0][rows])
        told = ((kind, np.unique(np.concatenate(keys))) for kind, keys in groups.items())
        return tuple(Variables(kind, keys) for kind, keys in told if keys.size)

    def sent(self, rows: Rows, number: int) -> None:
        """Message `number` has the values of `rows`."""
        self._waiting = None
        for kind, chosen in rows.items():
            marks = self._kinds[kind]
            marks.stale[chosen], marks.held[chosen], marks.sent[chosen] = False, True, number

    def given(self, rows: Rows, wanted: Rows, number: int) -> None:
        """One follower got the values of `rows`, and is to get those of `wanted` that are not among them."""
        self._waiting = None
        for kind, needed in wanted.items():
            marks, got = self._kinds[kind], rows.get(kind, _NONE)
            marks.held[got] = True
            owed = np.setdiff1d(needed, got, assume_unique=True)
            marks.since[owed[~marks.stale[owed]]] = number
            marks.stale[owed] = True

    def _left(self) -> Rows:
        """Those that followers have and that are in the interest no more."""
        return {
            kind: np.flatnonzero(marks.held[: marks.count] & ~marks.inside[: marks.count])
            for kind, marks in self._kinds.items()
        }

    def _held_keys(self, kind: str, tables: InterestTables) -> I64:
        marks, rows = self._kinds.get(kind), tables.kinds.get(kind)
        return _NONE if marks is None or rows is None else rows.table.rows()[0][marks.held[: rows.table.count]]

    def _note_removed(self, number: int, kind: str, keys: I64) -> None:
        if keys.size:
            self._removed.append(Removed(number, kind, keys))
        while sum(len(each.keys) for each in self._removed) > _MOST_REMOVED:
            self.repairs_from = max(self.repairs_from, self._removed.pop(0).number)


_NONE = np.empty(0, np.int64)


def _costed(rows: Rows, tables: InterestTables, kinds: Mapping[str, KindMarks]) -> Iterator[_Costed]:
    """(kind, rows, bytes of each, since when each waits) of the kinds that have any."""
    for kind, chosen in rows.items():
        if chosen.size:
            _, values, stamps = tables.kinds[kind].table.rows()
            numbers = 1 + values.shape[1] + bool((stamps[chosen] != NO_STAMP).any())
            yield kind, chosen, np.full(chosen.size, 8 * numbers), kinds[kind].since[chosen]


def _kinds_with_room(columns: list[_Costed], budget: int) -> list[_Costed]:
    """Those kinds that a message of `budget` bytes has room for: the one that waits longest, then poses."""
    oldest = min(columns, key=lambda column: column[3].min())
    columns = sorted(columns, key=lambda column: (column is not oldest, not _is_pose(column[0])))
    return columns[: max(budget // (3 * GROUP_BYTES), 1)]


def _is_pose(kind: str) -> bool:
    return kind in VARIABLE_KINDS and VARIABLE_KINDS[kind].is_pose


def values_of(rows: Rows, tables: InterestTables) -> tuple[Variables, ...]:
    """The present values of `rows`."""
    groups = []
    for kind, chosen in rows.items():
        if chosen.size:
            keys, values, stamps = tables.kinds[kind].table.rows()
            told = stamps[chosen] if (stamps[chosen] != NO_STAMP).any() else None
            groups.append(Variables(kind, keys[chosen], values[chosen], stamps=told))
    return tuple(groups)
