"""The values of one kind of variable: rows found by key, arrays that grow by doubling.  Pure."""

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.stamps import NO_STAMP


class Table:
    """keys (n,), values (n, size), time stamps (n,) in the order in which the keys came."""

    def __init__(self, size: int) -> None:
        self.count = 0
        self._keys = np.empty(16, np.int64)
        self._values = np.empty((16, size))
        self._stamps = np.full(16, NO_STAMP)
        self._rows: dict[int, int] = {}
        self._order: I64 | None = None

    def put(self, keys: I64, values: F64, stamps: I64 | None = None) -> None:
        """Set the values (m, size) and stamps (m,) of `keys` (m,), new ones included; stamps None: they stay."""
        if len(keys) == 0:
            return
        known = self._run(keys)
        if known:
            first = self._rows[int(keys[0])]
            self._values[first : first + known] = values[:known]
            if stamps is not None:
                self._stamps[first : first + known] = stamps[:known]
        if known < len(keys):
            rows = self._rows_of(keys[known:])  # first: it may replace the array by a larger one
            self._values[rows] = values[known:]
            if stamps is not None:
                self._stamps[rows] = stamps[known:]

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
            self._keys = np.concatenate([self._keys, np.empty_like(self._keys)])
            self._values = np.concatenate([self._values, np.empty_like(self._values)])
            self._stamps = np.concatenate([self._stamps, np.full_like(self._stamps, NO_STAMP)])
        self._keys[row] = key
        self._rows[key] = row
        self._order = None
        self.count += 1
        return row
