"""Which factor has which id.

A factor's id is the number of factors that the map took in before it, and stays with it when others are removed: the
ids of the first rows are listed, those of the rows behind them follow each other without gaps.  A closure that is put
back has the last row, and the id it had.
"""

from typing import NamedTuple

import numpy as np

from factorbus.solver.graph.arenas import Arenas, roomy
from factorbus.solver.graph.factor_rows import is_first
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at


class Ids(NamedTuple):
    """Which factor has which id, as a graph keeps it."""

    listed: I64
    shift: int
    unlisted: tuple[I64, int] | None


class FactorIds(Arenas):
    """The ids of the factors in the rows of `fac`, of which as many are in use as `counts` says."""

    fac: I64
    counts: I64

    def __init__(self) -> None:
        self.ids: I64 = np.empty(0, np.int64)  # of the first rows of `fac`
        self.id_shift = 0  # of a later row: its id less its number
        self._id_room: I64 = np.empty(0, np.int64)  # where ids are listed that grow with every insert
        self._unlisted: tuple[I64, int] | None = None  # both as they were before the factors in use had several rows

    @property
    def next_id(self) -> int:
        """The id that the next factor gets."""
        return int(self.counts[at.FACTORS]) + self.id_shift

    def name_rows(self, first: int, first_id: int) -> None:
        """Give their ids to the rows from `first` on, which came last; the first of them gets `first_id`.

        For a graph of which a factor has several rows: then all ids are listed, since those rows have the same.
        """
        rows = int(self.counts[at.FACTORS])
        ids = first_id - 1 + np.cumsum(is_first(self.fac[first:rows]))
        if self._unlisted is None and self.ids.size < first:
            self._unlisted = self.ids, self.id_shift
        if self.ids.base is not self._id_room or self.ids.size != first or rows > self._id_room.size:
            before = self.ids_of(np.arange(first))
            self._id_room = np.empty(roomy(rows, first), np.int64)
            self._id_room[:first] = before
        self._id_room[first:rows] = ids
        self.name_factors(self._id_room[:rows], int(ids[-1]) + 1 if ids.size else first_id)

    def forget_ids(self) -> None:
        """Of rows that are gone, which came last."""
        rows = int(self.counts[at.FACTORS])
        if self._unlisted is not None and not self.counts[at.MEMBERS]:
            (self.ids, self.id_shift), self._unlisted = self._unlisted, None
        if self.ids.size > rows:
            self.name_factors(self.ids[:rows], int(self.ids[rows]))

    def name_factors(self, ids: I64, following: int) -> None:
        """The factors that are there have these ids; the next one gets `following`."""
        self.ids, self.id_shift = ids, following - ids.size

    def rename_last(self, ids: I64, following: int) -> None:
        """The factors in the last rows have these ids; the next one gets `following`."""
        first = int(self.counts[at.FACTORS]) - ids.size
        self.name_factors(np.concatenate([self.ids_of(np.arange(first)), ids]), following)
        self._unlisted = None

    def drop_ids(self, gone: I64) -> None:
        """Of these rows, which are about to go, in increasing order; those of the others and the next one stay."""
        last = max(self.ids.size, int(gone[-1]) + 1)
        self.ids, self.id_shift = np.delete(self.ids_of(np.arange(last)), gone), self.id_shift + gone.size
        self._unlisted = None

    def kept_ids(self) -> Ids:
        """All that says which factor has which id, for `put_ids`."""
        return Ids(self.ids, self.id_shift, self._unlisted)

    def put_ids(self, ids: Ids) -> None:
        """As it was at `kept_ids`: of the factors that were there then."""
        self.ids, self.id_shift, self._unlisted = ids

    def ids_of(self, rows: I64) -> I64:
        """The ids of the factors in these rows of `fac`."""
        named = self.ids.size
        if not named:
            return rows + self.id_shift
        return np.where(rows < named, self.ids[np.minimum(rows, named - 1)], rows + self.id_shift)

    def rows_of(self, ids: I64) -> I64:
        """The rows of the factors with these ids; −1 where there is none."""
        named, count = self.ids.size, int(self.counts[at.FACTORS])
        later = ids - self.id_shift
        found = np.where((later >= named) & (later < count), later, -1)
        if named:
            order = np.argsort(self.ids, kind="stable")
            place = order[np.minimum(np.searchsorted(self.ids, ids, sorter=order), named - 1)]
            found = np.where(self.ids[place] == ids, place, found)
        return found
