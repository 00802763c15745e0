"""The values of one kind of variable: rows found by key, arrays that grow by doubling.  Pure."""

from typing import Any

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.stamps import NO_STAMP


class Table:
    """keys (n,), values (n, size), time stamps (n,) in the order in which the keys came."""

    def __init__(self, size: int) -> None:
        self.count = 0
        self._keys: I64 = np.empty(16, np.int64)
        self._values: F64 = np.empty((16, size))
        self._stamps: I64 = np.full(16, NO_STAMP)
        self._rows: dict[int, int] = {}
        self._order: I64 | None = None

    def put(self, keys: I64, values: F64, stamps: I64 | None = None) -> list[Any]:
        """Set the values (m, size) and stamps (m,) of `keys` (m,), new ones included; stamps None: they stay.

        Returns which rows were set, as indices of arrays.
        """
        put: list[Any] = []
        if len(keys) == 0:
            return put
        known = self._run(keys)
        if known:
            first = self._rows[int(keys[0])]
            run = slice(first, first + known)
            put.append(run)
            self._values[run] = values[:known]
            if stamps is not None:
                self._stamps[run] = stamps[:known]
        if known < len(keys):
            rows = self._rows_of(keys[known:])  # first: it may replace the array by a larger one
            put.append(rows)
            self._values[rows] = values[known:]
            if stamps is not None:
                self._stamps[rows] = stamps[known:]
        return put

    def remove(self, keys: I64) -> None:
        """Let go of `keys`, those that are here; the rows of the others close up."""
        gone = [row for key in keys.tolist() if (row := self._rows.get(key)) is not None]
        if not gone:
            return
        stay = np.ones(self.count, bool)
        stay[gone] = False
        keys, values, stamps = self.rows()
        self._keys, self._values, self._stamps = keys[stay], values[stay], stamps[stay]
        self.count = len(self._keys)
        self._rows = {key: row for row, key in enumerate(self._keys.tolist())}
        self._order = None

    def rows(self) -> tuple[I64, F64, I64]:
        """(keys, values, stamps) in the order in which the keys came: views, until the next change."""
        return self._keys[: self.count], self._values[: self.count], self._stamps[: self.count]

    def get(self, key: int) -> F64 | None:
        """A copy of the row of `key`, if there is one."""
        row = self._rows.get(key)
        return None if row is None else self._values[row].copy()

    def stamp(self, key: int) -> int | None:
        """The time stamp of `key`, if it is there and has one."""
        row = self._rows.get(key)
        stamp = NO_STAMP if row is None else int(self._stamps[row])
        return None if stamp == NO_STAMP else stamp

    def columns(self) -> tuple[I64, F64]:
        """(keys, values), copies, in the order of the keys: the same for all who hold the same estimate."""
        order = self._sorted()
        return self._keys[order], self._values[order]

    def stamps(self) -> I64:
        """The time stamps in the same order, a copy; NO_STAMP of what has none."""
        return self._stamps[self._sorted()]

    def _sorted(self) -> I64:
        if self._order is None:
            self._order = np.argsort(self._keys[: self.count], kind="stable")
        return self._order

    def _run(self, keys: I64) -> int:
        """How many of `keys` stand here one after the other, in that order, from the row of the first one on.

        A delta lists variables in the order of their insertion, as this table does, so this is the usual case.
        """
        first = self._rows.get(int(keys[0]))
        if first is None:
            return 0
        here = self._keys[first : min(first + len(keys), self.count)]
        same = here == keys[: len(here)]
        return len(here) if same.all() else int(same.argmin())

    def _rows_of(self, keys: I64) -> I64:
        rows = np.empty(len(keys), np.int64)
        for i, key in enumerate(keys.tolist()):
            row = self._rows.get(key)
            if row is None:
                row = self._append(key)
            rows[i] = row
        return rows

    def _append(self, key: int) -> int:
        row = self.count
        if row == len(self._keys):
            more = max(row, 16)
            self._keys = np.concatenate([self._keys, np.empty(more, np.int64)])
            self._values = np.concatenate([self._values, np.empty((more, self._values.shape[1]))])
            self._stamps = np.concatenate([self._stamps, np.full(more, NO_STAMP)])
        self._keys[row] = key
        self._rows[key] = row
        self._order = None
        self.count += 1
        return row
