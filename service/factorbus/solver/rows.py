"""Which variables are of which kind, fixed or free: lists that follow a graph as it grows and forgets."""

from collections.abc import Iterable

import numpy as np

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import I64
from factorbus.solver.variables import VARIABLE_KIND_OF_CODE

_FEW = 8  # for so many loops in NumPy cost more than in Python


class Span:
    """The variables with one label, which is 2 · kind, and 1 more for fixed ones: their indices, ascending.

    together: there are no others between the first and the last of them.  first, behind: that index, and the one
    behind the last.  start: where the value of the first begins.  kind, size, fixed: of all of them.
    """

    __slots__ = ("_rows", "behind", "count", "first", "fixed", "kind", "label", "size", "start", "together")

    def __init__(self, label: int, first: int, start: int) -> None:
        kind, self.label = VARIABLE_KIND_OF_CODE[label // 2], label
        self.kind, self.size, self.fixed = kind.name, kind.size, bool(label % 2)
        self.first, self.behind, self.start, self.count, self.together = first, first, start, 0, True
        self._rows: I64 = np.empty(0, np.int64)  # not while together

    def rows(self) -> I64:
        """The indices."""
        return np.arange(self.first, self.behind) if self.together else self._rows[: self.count]

    def append(self, v: int) -> None:
        """One more, behind all others."""
        if self.together and v == self.behind:
            self.behind = v + 1
            self.count += 1
        else:
            self.extend(np.array([v]))

    def extend(self, found: I64) -> None:
        """More of them, ascending, behind all others; one at least."""
        last = int(found[-1]) + 1
        if self.together and last - self.behind == found.size:
            self.count += found.size
        else:
            rows = self.rows()
            self._rows = _behind_each_other(self._rows, rows, found)
            self.count, self.together = rows.size + found.size, False
        self.behind = last

    def forget(self, variables: int) -> None:
        """Only those below `variables` are left."""
        if variables < self.behind:
            left = self.rows()
            self.count = int(np.searchsorted(left, variables))
            self.behind = int(left[self.count - 1]) + 1 if self.count else self.first


class Rows:
    """Spans by label."""

    def __init__(self) -> None:
        self._spans: dict[int, Span] = {}
        self._seen = 0

    def forget(self, variables: int) -> None:
        """The graph has no more than `variables` now."""
        if variables < self._seen:
            self._seen = variables
            for span in self._spans.values():
                span.forget(variables)
            self._spans = {label: span for label, span in self._spans.items() if span.count}

    def follow(self, var: I64, variables: int) -> Iterable[Span]:
        """All that the graph has, which is `variables` rows of `var`; labels ascend."""
        if variables - self._seen > _FEW:
            new = var[self._seen : variables]
            labels = 2 * new[:, at.V_KIND] + (new[:, at.V_COLUMN] < 0)
            for label in np.flatnonzero(np.bincount(labels)).tolist():
                found = np.flatnonzero(labels == label) + self._seen
                self._span(label, var[found[0]].tolist(), int(found[0])).extend(found)
        else:
            for v in range(self._seen, variables):
                row = var[v].tolist()
                self._span(2 * row[at.V_KIND] + (row[at.V_COLUMN] < 0), row, v).append(v)
        self._seen = variables
        return self._spans.values()

    def _span(self, label: int, row: list[int], v: int) -> Span:
        """That of a label; v: a variable that has it, and its row of `var`, for when there is none yet."""
        if label not in self._spans:
            self._spans[label] = Span(label, v, row[at.V_AT])
            self._spans = dict(sorted(self._spans.items()))
        return self._spans[label]


def _behind_each_other(array: I64, rows: I64, found: I64) -> I64:
    """`rows`, which may be the beginning of `array`, and `found`: there if it has room, else in a larger one."""
    count = rows.size + found.size
    if count > array.size:
        array = np.empty(2 * count, np.int64)
        array[: rows.size] = rows
    array[rows.size : count] = found
    return array
