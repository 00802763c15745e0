"""Which factors of a batch close a loop: a relative pose between two variables that others join already.

Relative poses between keys that follow each other, x6 and x7, are odometry, and are trusted; so are those that the
client says are.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from factorbus.solver.closures.ledger import POSES_BETWEEN
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import arities_of, is_first
from factorbus.solver.graph.groups import BatchLike, FactorGroup, FactorsLike
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

_GROUND = object()
_new = tuple.__new__  # as in `ahead`
_FEW_ROWS = 16  # a group with no more is copied whole: it is kept for as long as a closure in it


class RowOfFactors(NamedTuple):
    """One factor of a group, as a group: its columns are cut out when they are asked for, which they seldom are."""

    group: FactorGroup
    row: int

    @property
    def kind(self) -> str:
        """As of a group."""
        return self.group.kind

    @property
    def keys(self) -> I64:
        """(1, arity)."""
        return self.group.keys[self.row : self.row + 1]

    @property
    def measured(self) -> F64:
        """(1, size)."""
        return self.group.measured[self.row : self.row + 1]

    @property
    def information(self) -> F64:
        """(1, triangle)."""
        return self.group.information[self.row : self.row + 1]

    @property
    def loss(self) -> str:
        """As of a group."""
        return self.group.loss

    @property
    def scale(self) -> F64 | None:
        """(1,) or None."""
        return None if self.group.scale is None else self.group.scale[self.row : self.row + 1]


class SplitFactors(NamedTuple):
    """The factors of a batch, how many there are, and those of them that close loops, one each.

    places: theirs among all factors of the batch, ascending.  kind: of all that close loops; "": they are of several.
    """

    factors: Sequence[FactorsLike]
    count: int
    closing: list[FactorsLike]
    places: list[int]
    kind: str

    @property
    def closing_at(self) -> I64:
        """The places as an array."""
        return np.array(self.places, np.int64)

    @property
    def trusted_at(self) -> I64:
        """The places of those that are trusted."""
        return np.delete(np.arange(self.count), self.places)

    @property
    def trusted(self) -> list[FactorsLike]:
        """Those that are trusted, in their order."""
        if not self.closing:
            return list(self.factors)
        trusted, before = list[FactorsLike](), 0
        is_trusted = np.ones(self.count, bool)
        is_trusted[self.places] = False
        for group in self.factors:
            own = is_trusted[before : before + len(group.keys)]
            if own.any():
                trusted.append(group if own.all() else _pick_rows(group, own))
            before += len(group.keys)
        return trusted


NOTHING_CLOSES = SplitFactors((), 0, [], [], "")


def has_candidates(batch: BatchLike) -> bool:
    """Whether any factor of a batch may close a loop, whatever the map has."""
    return any(not _are_trusted(group).all() for group in batch.factors)


class TrustedForest:
    """What hangs together by factors that are trusted.

    Keys that follow each other, as those of odometry do, are a chain: those behind its first hang together with it, and
    are entered only when something else than the next one comes.
    """

    def __init__(self) -> None:
        self._above: dict[object, object] = {}
        self._sizes: dict[object, int] = {}  # of roots; one that is not here has 1
        self._linked: list[tuple[object, object]] = []  # by the last batch
        self._alone: list[object] = []  # what came with it and hung on nothing then
        self._begin_chain(math.inf, -math.inf, None)

    def _begin_chain(self, first: float, last: float, root: object) -> None:
        self._first, self._last, self._root_of_chain, self._grown = first, last, root, 0  # grown: by the last batch

    def split(self, batch: BatchLike) -> SplitFactors:
        """Join what trusted factors of a batch join; gives them, and those that close loops.

        Where none does, as in most batches, `NOTHING_CLOSES`, which does not say what is trusted: all is.
        """
        above, count = self._above, 0
        self._begin()
        for group in batch.variables:
            if group.fixed:
                self._ground(group.keys)
        waiting: list[tuple[FactorsLike, int, int, int, int]] = []  # an alias that is called takes a microsecond
        for group in batch.factors:
            rows = group.keys.tolist()
            if group.kind not in POSES_BETWEEN or getattr(group, "trusted", False):
                self._join_rows(rows)
                count += len(rows)
                continue
            for k, (i, j) in enumerate(rows):
                if i == self._last and j == i + 1 and j not in above:  # as nearly every one is
                    self._last = j
                    self._grown += 1
                elif i - j != -1 and i - j != 1:
                    waiting.append((group, k, count + k, i, j))
                elif not self._join(i, j):
                    self._begin_chain(j, j, self._root(j))
            count += len(rows)
        if not waiting:
            return NOTHING_CLOSES
        closing: list[FactorsLike] = []
        places: list[int] = []
        of = kept = kind = None
        for group, k, place, i, j in waiting:
            # Those of the chain are joined; of others it may be seen at once.
            one = self._root_of_chain if self._first <= i <= self._last else above.get(i)
            other = self._root_of_chain if self._first <= j <= self._last else above.get(j)
            if (one is None or one != other) and self._join(i, j):
                continue
            places.append(place)
            if group is not of:
                of, kept = group, _copied(group) if len(group.keys) <= _FEW_ROWS else None
                kind = group.kind if kind in (None, group.kind) else ""
            closing.append(_new(RowOfFactors, (kept, k)) if kept else _pick_row(group, k))
        return _new(SplitFactors, (batch.factors, count, closing, places, kind or ""))

    def join(self, batch: BatchLike) -> None:
        """Join what all factors of a batch join."""
        self._begin()
        for group in batch.variables:
            if group.fixed:
                self._ground(group.keys)
        for group in batch.factors:
            self._join_rows(group.keys.tolist())

    def forget(self) -> None:
        """As before the last batch, which was refused."""
        self._last -= self._grown
        self._grown = 0
        self._end_chain()
        for under, over in reversed(self._linked):
            self._sizes[over] -= self._sizes.get(under, 1)
            if under in self._sizes:
                self._above[under] = under
            else:
                del self._above[under]
        for key in self._alone:
            del self._above[key], self._sizes[key]
        self._begin()

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
        self._begin()

    def dump(self) -> dict[str, Any]:
        """Which keys hang together: of each the number of its part; ground: that of what is fixed, or −1."""
        self._end_chain()
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
        self._begin()

    def _begin(self) -> None:
        """What is joined from here on is of one batch."""
        self._grown = 0
        if self._linked:
            self._linked.clear()
        if self._alone:
            self._alone.clear()

    def _ground(self, keys: I64) -> None:
        for key in keys.tolist():
            self._join(_GROUND, key)

    def _join_rows(self, rows: Sequence[Sequence[int]]) -> None:
        for one, *others in rows:
            for key in others:
                if one == self._last and key == one + 1 and key not in self._above:
                    self._last = key
                    self._grown += 1
                else:
                    self._join(one, key)

    def _join(self, one: object, other: object) -> bool:
        """Join two, the smaller under the larger; False: they are."""
        self._end_chain()
        first = self._root(one)
        if other not in self._above:  # the next pose, as a rule
            self._above[other] = first
            self._sizes[first] += 1
            self._linked.append((other, first))
            if isinstance(other, int):
                self._begin_chain(other, other, first)
            return True
        second = self._root(other)
        if first == second:
            return False
        if self._sizes[first] < self._sizes[second]:
            first, second = second, first
        self._above[second] = first
        self._sizes[first] += self._sizes[second]
        self._linked.append((second, first))
        return True

    def _end_chain(self) -> None:
        """Enter the keys of the chain."""
        if (first := self._first) < (last := self._last):
            above, root = self._above, self._root_of_chain
            for key in range(int(first) + 1, int(last) + 1):
                above[key] = root
            self._sizes[root] += int(last - first)
            self._linked += [(key, root) for key in range(int(last) - self._grown + 1, int(last) + 1)]
        self._begin_chain(math.inf, -math.inf, None)

    def _root(self, of: object) -> object:
        if of not in self._above:
            self._above[of], self._sizes[of] = of, 1
            self._alone.append(of)
        while (higher := self._above[of]) != of:
            of = higher
        return of


def _pick_row(group: FactorsLike, k: int) -> FactorGroup:
    """One factor of a group."""
    own = slice(k, k + 1)
    scale = None if group.scale is None else group.scale[own].copy()
    picked = group.keys[own].copy(), group.measured[own].copy(), group.information[own].copy()
    return FactorGroup(group.kind, *picked, group.loss, scale)


def _pick_rows(group: FactorsLike, chosen: np.ndarray | I64) -> FactorGroup:
    """Some factors of a group."""
    scale = None if group.scale is None else group.scale[chosen]
    picked = group.keys[chosen], group.measured[chosen], group.information[chosen]
    return FactorGroup(group.kind, *picked, group.loss, scale)


def _copied(group: FactorsLike) -> FactorGroup:
    """With arrays of its own: the sender may use them again, and they may be views of a whole message."""
    scale = None if group.scale is None else group.scale.copy()
    columns = group.keys.copy(), group.measured.copy(), group.information.copy()
    return _new(FactorGroup, (group.kind, *columns, group.loss, scale, None))


def _are_trusted(group: FactorsLike) -> np.ndarray:
    """(m,): whether each is, whatever it joins."""
    if group.kind not in POSES_BETWEEN or getattr(group, "trusted", False):
        return np.ones(len(group.keys), bool)
    return np.abs(group.keys[:, 0] - group.keys[:, 1]) == 1
