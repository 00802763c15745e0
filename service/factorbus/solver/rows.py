"""Which variables are of which kind, fixed or free: lists that follow a graph as it grows and forgets."""

from collections.abc import Iterator

import numpy as np

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import I64

_FEW = 8  # for so many loops in NumPy cost more than in Python


class Rows:
    """Indices of variables, ascending, by label: 2 · kind, and 1 more for fixed ones."""

    def __init__(self) -> None:
        self._rows: dict[int, I64] = {}
        self._counts: dict[int, int] = {}
        self._seen = 0

    def forget(self, variables: int) -> None:
        """The graph has no more than `variables` now."""
        if variables < self._seen:
            self._seen = variables
            for label, rows in self._rows.items():
                self._counts[label] = int(np.searchsorted(rows[: self._counts[label]], variables))

    def follow(self, var: I64, variables: int) -> Iterator[tuple[int, I64]]:
        """(label, indices) of all that the graph has, which is `variables` rows of `var`; labels ascend."""
        if variables - self._seen > _FEW:
            new = var[self._seen : variables]
            labels = 2 * new[:, at.V_KIND] + (new[:, at.V_COLUMN] < 0)
            for label in set(labels.tolist()):
                self._append(label, np.flatnonzero(labels == label) + self._seen)
        else:
            for v in range(self._seen, variables):
                row = var[v].tolist()
                self._append(2 * row[at.V_KIND] + (row[at.V_COLUMN] < 0), np.array([v]))
        self._seen = variables
        for label in sorted(self._rows):
            if count := self._counts[label]:
                yield label, self._rows[label][:count]

    def _append(self, label: int, found: I64) -> None:
        count = self._counts.get(label, 0)
        rows = self._rows.get(label, np.empty(0, np.int64))
        if count + found.size > rows.size:
            rows = np.concatenate([rows[:count], found, np.empty(count + found.size, np.int64)])
        else:
            rows[count : count + found.size] = found
        self._rows[label], self._counts[label] = rows, count + found.size
