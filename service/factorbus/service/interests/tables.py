"""The estimate of a map as its interests see it: the latest values, and when each came.  Pure.

Rows are in the order in which variables were inserted, so the newest are last.  A row stays where it is until the whole
estimate comes anew.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Delta, Variables
from factorbus.proto.table import Table


class KindRows:
    """The variables of one kind, and at which count of `InterestTables.clock` each one's value came."""

    def __init__(self, size: int) -> None:
        self.table = Table(size)
        self._came = np.zeros(16, np.int64)

    @property
    def came(self) -> I64:
        """(n,)"""
        return self._came[: self.table.count]

    def put(self, group: Variables, clock: int) -> None:
        """The values of `group` came."""
        if group.values is None:
            return
        put = self.table.put(np.asarray(group.keys), group.values, group.stamps)
        if (count := self.table.count) > len(self._came):
            self._came = np.concatenate([self._came, np.zeros(max(count, 2 * len(self._came)), np.int64)])
        for rows in put:
            self._came[rows] = clock

    def note(self, rows: I64, came: I64) -> None:
        """The values of `rows` are those that came earlier."""
        self._came[rows] = came


class Moved(NamedTuple):
    """Where the rows of one kind went when the whole estimate came anew.

    origin (n,): the row that each had before, −1 of a new one.  keys: of all rows before.
    """

    origin: I64
    keys: I64


class InterestTables:
    """One estimate.  live: nothing is missing that is known to have happened."""

    def __init__(self) -> None:
        self.epoch = self.revision = self.clock = 0
        self.live = False
        self.converged: bool | None = None
        self.converging: bool | None = None
        self.kinds: dict[str, KindRows] = {}

    def count(self) -> int:
        """Variables."""
        return sum(rows.table.count for rows in self.kinds.values())

    def try_apply(self, delta: Delta) -> Mapping[str, Moved] | None:
        """Go on to the revision of `delta`, if it follows; what is older is skipped.

        Returns where rows went, if that changed; `live` is false afterwards where something is missing.
        """
        if delta.epoch == self.epoch and delta.revision <= self.revision:
            return None
        if delta.epoch == self.epoch and delta.previous == 0 and self.revision:
            moved = self.replace(delta.epoch, delta.revision, delta.variables)
        elif delta.epoch == self.epoch and delta.previous == self.revision:
            moved = None
            self.clock += 1
            self._put(delta.variables)
        else:
            self.live = False
            return None
        self.revision = delta.revision
        converged, converging = delta.report.get("converged"), delta.report.get("converging")
        self.converged = converged if isinstance(converged, bool) else None
        self.converging = converging if isinstance(converging, bool) else None
        return moved

    def replace(self, epoch: int, revision: int, groups: Iterable[Variables]) -> Mapping[str, Moved]:
        """The whole estimate came.  What has the same bits as before has not changed."""
        before, self.kinds = self.kinds, {}
        self.clock += 1
        self._put(groups)
        moved = {}
        for kind in {*before, *self.kinds}:
            old, new = before.get(kind), self.kinds.get(kind)
            old_keys, old_values, _ = old.table.rows() if old else (_NO_KEYS, None, None)
            new_keys, new_values, _ = new.table.rows() if new else (_NO_KEYS, None, None)
            origin = _rows_in(old_keys, new_keys)
            if old and new and old_values is not None and new_values is not None:
                both = np.flatnonzero(origin >= 0)
                same = both[_same_bits(old_values[origin[both]], new_values[both])]
                new.note(same, old.came[origin[same]])
            moved[kind] = Moved(origin, old_keys.copy())
        self.epoch, self.revision, self.live = epoch, revision, True
        self.converged = self.converging = None
        return moved

    def learn(self, row: Mapping[str, Any]) -> None:
        """What the map says of its revision: a copy does not say whether it has converged."""
        if (row["epoch"], row["revision"]) == (self.epoch, self.revision) and self.converged is None:
            self.converged, self.converging = row["converged"], row["converging"]

    def _put(self, groups: Iterable[Variables]) -> None:
        for group in groups:
            if group.values is None or not len(group.keys):
                continue
            rows = self.kinds.get(group.kind)
            if rows is None:
                rows = self.kinds[group.kind] = KindRows(group.values.shape[1])
            rows.put(group, self.clock)


_NO_KEYS = np.empty(0, np.int64)


def _rows_in(keys: I64, wanted: I64) -> I64:
    """Where each of `wanted` is in `keys`, −1 where it is not."""
    if not len(keys):
        return np.full(len(wanted), -1)
    order = np.argsort(keys, kind="stable")
    at = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
    rows = order[at]
    return np.where(keys[rows] == wanted, rows, -1)


def _same_bits(a: F64, b: F64) -> np.ndarray:
    return (np.ascontiguousarray(a).view(np.int64) == np.ascontiguousarray(b).view(np.int64)).all(axis=1)
