"""Which factors of a batch close a loop: a relative pose between two variables that others join already.

Relative poses between keys that follow each other, x6 and x7, are odometry, and are trusted.
"""

import numpy as np

from factorbus.solver.closures.ledger import POSES_BETWEEN, pick_rows
from factorbus.solver.graph.groups import BatchLike, FactorGroup, FactorsLike

_GROUND = object()


class TrustedForest:
    """What hangs together by factors that are trusted."""

    def __init__(self) -> None:
        self._above: dict[object, object] = {}
        self._sizes: dict[object, int] = {}
        self._linked: list[tuple[object, object]] = []  # by the last batch

    def split(self, batch: BatchLike) -> tuple[list[FactorsLike], list[FactorGroup]]:
        """The factors that are trusted, and those that close loops, one each, in their order."""
        self._linked.clear()
        for group in batch.variables:
            if group.fixed:
                for key in group.keys.tolist():
                    self._join(_GROUND, key)
        trusted, left = list[FactorsLike](), list[FactorsLike]()
        for group in batch.factors:
            is_trusted = np.ones(len(group.keys), bool)
            if group.kind in POSES_BETWEEN:
                is_trusted = np.abs(group.keys[:, 0] - group.keys[:, 1]) == 1
            for row in group.keys[is_trusted].tolist():
                for key in row[1:]:
                    self._join(row[0], key)
            if is_trusted.all():
                trusted.append(group)
                continue
            if is_trusted.any():
                trusted.append(pick_rows(group, is_trusted))
            left.append(pick_rows(group, ~is_trusted))
        closing: list[FactorGroup] = []
        for group in left:
            joins = np.array([self._join(i, j) for i, j in group.keys.tolist()], bool)
            if joins.any():
                trusted.append(pick_rows(group, joins))
            closing += [pick_rows(group, np.array([k])) for k in np.flatnonzero(~joins).tolist()]
        return trusted, closing

    def forget(self) -> None:
        """As before the last batch, which was refused."""
        for under, over in reversed(self._linked):
            self._above[under] = under
            self._sizes[over] -= self._sizes[under]
        self._linked.clear()

    def _join(self, one: object, other: object) -> bool:
        """Join two, the smaller under the larger; False: they are."""
        first, second = self._root(one), self._root(other)
        if first == second:
            return False
        if self._sizes[first] < self._sizes[second]:
            first, second = second, first
        self._above[second] = first
        self._sizes[first] += self._sizes[second]
        self._linked.append((second, first))
        return True

    def _root(self, of: object) -> object:
        if of not in self._above:
            self._above[of], self._sizes[of] = of, 1
        while (higher := self._above[of]) != of:
            of = higher
        return of
