"""Which variables are of which kind, fixed or free: lists that follow a graph as it grows and forgets."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from factorbus.solver.graph.groups import Group
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

_NO_KEYS: I64 = np.empty(0, np.int64)
_NO_VALUES: F64 = np.empty(0)
_KIND, _COLUMN = at.V_KIND, at.V_COLUMN
_new = tuple.__new__
_FEW = 8  # up to this number, loops in NumPy cost more than in Python


class Span:
    """The variables with one label, which is 2 · kind, and 1 more for fixed ones: their indices, ascending.

    together: there are no others between the first and the last of them.  first, behind: that index, and the one
    behind the last.  start: where the value of the first begins.  kind, size, fixed: of all of them.
    """

    __slots__ = (
        "_apart", "_held", "_keys", "_keys_seen", "_known", "_rows", "_stamped", "_values", "_values_seen",
        "behind", "count", "first", "fixed", "kind", "label", "size", "start", "together",
    )  # fmt: skip

    def __init__(self, label: int, first: int, start: int) -> None:
        kind, self.label = VARIABLE_KIND_OF_CODE[label // 2], label
        self.kind, self.size, self.fixed = kind.name, kind.size, bool(label % 2)
        self.first, self.behind, self.start, self.count, self.together = first, first, start, 0, True
        self._rows: I64 = np.empty(0, np.int64)  # not while together
        self._keys, self._keys_seen = _NO_KEYS, _NO_KEYS
        self._values, self._values_seen = _NO_VALUES, _NO_VALUES
        self._held: Group | None = None  # of fixed ones, whose values stay
        self._apart, self._known = (
            _NO_KEYS,
            0,
        )  # keys of rows that are apart, and of how many rows they are known
        self._stamped = False  # whether any of them is known to have a time stamp

    def __getstate__(self) -> tuple[None, dict[str, Any]]:
        """For copies: their arenas are others."""
        own = {name: getattr(self, name) for name in self.__slots__}
        return None, own | {"_keys_seen": _NO_KEYS, "_values_seen": _NO_VALUES, "_held": None}

    def group(self, keys: I64, values: F64, stamps: I64 | None) -> Group:
        """Their keys and a copy of their values, while they are together: then no others are between them.

        stamps: of all variables; None: none has one.  What never changes, keys, stamps and the values of fixed
        variables, may have been given before, and is read-only.
        """
        if self._keys_seen is not keys or self._values_seen is not values:
            self._look_at(keys, values)
        if self._held:
            return self._held
        count = self.count
        # By no call that Python would have to bind the fields for: a robot asks for this after every step.
        own = None if stamps is None else self._stamps(stamps)
        group = _new(Group, (self.kind, self._keys[:count], self._values[:count].copy(), self.fixed, own))
        if self.fixed:
            group.values.flags.writeable = False
            self._held = group
        return group

    def _stamps(self, stamps: I64) -> I64 | None:
        """Their time stamps; None: none of them has one."""
        own = stamps[self.first : self.behind]
        self._stamped = self._stamped or bool((own != at.NO_STAMP).any())
        if not self._stamped:
            return None
        own.flags.writeable = False
        return own

    def keys_apart(self, keys: I64) -> I64:
        """Their keys where they are not together, read-only."""
        if self._known < self.count:
            more = keys[self._rows[self._known : self.count]]
            self._apart = _behind_each_other(self._apart, self._apart[: self._known], more)
            self._known = self.count
        view = self._apart[: self.count]
        view.flags.writeable = False
        return view

    def _look_at(self, keys: I64, values: F64) -> None:
        """Remember these arenas from the first of them on: to shape them takes as long as to copy a hundred values."""
        self._keys, self._keys_seen, self._held = keys[self.first :], keys, None
        self._keys.flags.writeable = False
        whole = (values.size - self.start) // self.size * self.size
        self._values, self._values_seen = values[self.start : self.start + whole].reshape(-1, self.size), values

    def rows(self) -> I64:
        """The indices."""
        return np.arange(self.first, self.behind) if self.together else self._rows[: self.count]

    def extend(self, found: I64) -> None:
        """More of them, ascending, behind all others; one at least."""
        self._held = None
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
            self._held, self._stamped = None, False
            left = self.rows()
            self.count = int(np.searchsorted(left, variables))
            if self._known > self.count:  # what is behind them may have been given to somebody
                self._apart, self._known = self._apart[: self.count].copy(), self.count
            self.behind = int(left[self.count - 1]) + 1 if self.count else self.first


class Rows:
    """Spans by label."""

    def __init__(self) -> None:
        self._spans: dict[int, Span] = {}
        self._seen = 0

    def forget(self, variables: int) -> bool:
        """The graph has no more than `variables` now.  Gives whether it was followed further, and keys given of it."""
        if variables >= self._seen:
            return False
        self._seen = variables
        for span in self._spans.values():
            span.forget(variables)
        self._spans = {label: span for label, span in self._spans.items() if span.count}
        return True

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
                label = 2 * row[_KIND] + (row[_COLUMN] < 0)
                span = self._spans.get(label) or self._span(label, row, v)
                if span.together and v == span.behind and not span.fixed:  # `extend`, in a robot's usual step
                    span.behind = v + 1
                    span.count += 1
                else:
                    span.extend(np.array([v]))
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
