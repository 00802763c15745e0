"""Which factors of a batch close a loop: a relative pose between two variables that others join already.

Relative poses between keys that follow each other, x6 and x7, are odometry, and are trusted; so are those that the
client says are.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from factorbus.solver.closures.ledger import POSES_BETWEEN, pick_rows
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import arities_of, is_first
from factorbus.solver.graph.groups import BatchLike, FactorGroup, FactorsLike
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at

_GROUND = object()


class SplitFactors(NamedTuple):
    """The factors of a batch that are trusted, in their order, and those that close loops, one each.

    trusted_at, closing_at: their places among all factors of the batch.
    """

    trusted: list[FactorsLike]
    trusted_at: I64
    closing: list[FactorGroup]
    closing_at: I64


def has_candidates(batch: BatchLike) -> bool:
    """Whether any factor of a batch may close a loop, whatever the map has."""
    return any(not _are_trusted(group).all() for group in batch.factors)


class TrustedForest:
    """What hangs together by factors that are trusted."""

    def __init__(self) -> None:
        self._above: dict[object, object] = {}
        self._sizes: dict[object, int] = {}
        self._linked: list[tuple[object, object]] = []  # by the last batch

    def split(self, batch: BatchLike) -> SplitFactors:
        """Join what trusted factors of a batch join; gives them, and those that close loops."""
        self._begin(batch)
        are_trusted = [_are_trusted(group) for group in batch.factors]
        for group, trusted in zip(batch.factors, are_trusted, strict=True):
            self._join_rows(group.keys[trusted])
        made, before = SplitFactors([], np.empty(0, np.int64), [], np.empty(0, np.int64)), 0
        at_trusted, at_closing = list[int](), list[int]()
        for group, trusted in zip(batch.factors, are_trusted, strict=True):
            for k in np.flatnonzero(~trusted).tolist():
                i, j = group.keys[k].tolist()
                trusted[k] = self._join(i, j)
            made.closing.extend(pick_rows(group, np.array([k])) for k in np.flatnonzero(~trusted).tolist())
            if trusted.any():
                made.trusted.append(group if trusted.all() else pick_rows(group, trusted))
            at_trusted += (before + np.flatnonzero(trusted)).tolist()
            at_closing += (before + np.flatnonzero(~trusted)).tolist()
            before += len(group.keys)
        return made._replace(trusted_at=np.array(at_trusted, np.int64), closing_at=np.array(at_closing, np.int64))

    def join(self, batch: BatchLike) -> None:
        """Join what all factors of a batch join."""
        self._begin(batch)
        for group in batch.factors:
            self._join_rows(group.keys)

    def forget(self) -> None:
        """As before the last batch, which was refused."""
        for under, over in reversed(self._linked):
            self._above[under] = under
            self._sizes[over] -= self._sizes[under]
        self._linked.clear()

    def renew(self, graph: FactorGraph) -> None:
        """What hangs together by all factors of a graph, from which some may have gone."""
        self.__init__()
        keys = graph.keys[: graph.counts[at.VARIABLES]].tolist()
        for v in np.flatnonzero(graph.var[: len(keys), at.V_COLUMN] < 0).tolist():
            self._join(_GROUND, keys[v])
        fac = graph.fac[: graph.counts[at.FACTORS]]
        rows = np.flatnonzero(is_first(fac))
        several = arities_of(fac[rows]) > 2
        for i, j in fac[rows[~several], at.F_I : at.F_J + 1].tolist():
            if j >= 0:
                self._join(keys[i], keys[j])
        for row in rows[several].tolist():
            first, *others = graph.ends_of(row)
            for v in others:
                self._join(keys[first], keys[v])
        self._linked.clear()

    def dump(self) -> dict[str, Any]:
        """Which keys hang together: of each the number of its part; ground: that of what is fixed, or −1."""
        roots: dict[object, int] = {}
        keys = [key for key in self._above if key is not _GROUND]
        parts = [roots.setdefault(self._root(key), len(roots)) for key in keys]
        ground = roots.get(self._root(_GROUND), -1) if _GROUND in self._above else -1
        return {"keys": np.array(keys, np.int64), "parts": np.array(parts, np.int64), "ground": ground}

    def load(self, state: Mapping[str, Any]) -> None:
        """Be what one was that gave `state`.  Raises KeyError."""
        self.__init__()
        heads: dict[int, object] = {} if state["ground"] < 0 else {int(state["ground"]): _GROUND}
        for key, part in zip(np.asarray(state["keys"]).tolist(), np.asarray(state["parts"]).tolist(), strict=True):
            self._join(heads.setdefault(part, key), key)
        self._linked.clear()

    def _begin(self, batch: BatchLike) -> None:
        self._linked.clear()
        for group in batch.variables:
            if group.fixed:
                for key in group.keys.tolist():
                    self._join(_GROUND, key)

    def _join_rows(self, keys: I64) -> None:
        for row in keys.tolist():
            for key in row[1:]:
                self._join(row[0], key)

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


def _are_trusted(group: FactorsLike) -> np.ndarray:
    """(m,): whether each is, whatever it joins."""
    if group.kind not in POSES_BETWEEN or getattr(group, "trusted", False):
        return np.ones(len(group.keys), bool)
    return np.abs(group.keys[:, 0] - group.keys[:, 1]) == 1
