"""What a map does to keep within its policy: poses that go, and the relative factors that take their place.

    1  which poses are redundant (`redundant`)
    2  groups of these that hang together, each taken out at once (`eliminating`): approximated once, not pose by pose
    3  what that leaves between two variables is added to the factors without a loss between them: however often a
       street is driven, two poses have one factor

No two groups of one plan share a neighbour that goes, so each is taken out of the graph as it is.
"""

from typing import NamedTuple

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import losses_of
from factorbus.solver.graph.groups import FactorGroup
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.lifelong.eliminating import Eliminated, try_eliminate
from factorbus.solver.lifelong.policy import KeepPolicy
from factorbus.solver.lifelong.redundant import Redundant, find_redundant
from factorbus.solver.lifelong.relative_terms import RelativeTerm, factor_of_term, term_of_factors, turned_term

_GROUP, _NEIGHBOURS = 16, 20  # poses that are taken out at once, and what these may hang together with
_LOOKED_AT = 4  # times as many as are to go: the newest, which hang together
_NONE = np.empty(0, np.int64)


class KeepPlan(NamedTuple):
    """keys (n,): of poses that go; factors (m,): ids of those that go; added: what takes their place.

    loss: what is lost with all of them, nats.  left: redundant poses that cannot go or would lose too much, of those
    that were looked at: of all, where nothing goes.
    """

    keys: I64
    factors: I64
    added: list[FactorGroup]
    loss: float
    left: int


def plan_removals(graph: FactorGraph, policy: KeepPolicy, most: int = 64, staying: I64 = _NONE) -> KeepPlan:
    """What goes next, some `most` poses; nothing, where the map has no more than its policy keeps.

    staying: keys of poses that stay.  After it, there may be more.
    """
    found, left = find_redundant(graph, policy, staying), 0
    for first in range(0, found.poses.size, _LOOKED_AT * most):
        poses = found.poses[first : first + _LOOKED_AT * most]
        at_work = _Planning(graph, policy, _around(found, poses, int(graph.counts[at.VARIABLES])))
        for pose in at_work.poses:
            if len(at_work.taken) >= most:
                break
            at_work.take_group(pose)
        left += at_work.left
        if at_work.taken:
            merged, added = _merged(graph, at_work.terms, at_work.on)
            factors = graph.ids_of(np.array(sorted(at_work.rows | merged), np.int64))
            return KeepPlan(graph.keys[np.array(at_work.taken, np.int64)], factors, added, at_work.loss, left)
    return KeepPlan(_NONE, _NONE, [], 0.0, left)


def _around(found: Redundant, poses: I64, variables: int) -> Redundant:
    """Of these poses alone, and of their neighbours: with the factors that any of them has."""
    near = np.zeros(variables, bool)
    near[poses] = True
    near[found.ends[near[found.ends].any(axis=1)]] = True
    rows = near[found.ends].any(axis=1)
    return Redundant(poses, found.rows[rows], found.ends[rows])


class _Planning:
    """One plan at work.  poses: those with the fewest neighbours first.  taken: of these; rows: of their factors.

    terms: what takes their place, by pair of neighbours.
    """

    def __init__(self, graph: FactorGraph, policy: KeepPolicy, found: Redundant) -> None:
        self.taken, self.rows = list[int](), set[int]()
        self.terms: dict[tuple[int, int], list[RelativeTerm]] = {}
        self.loss, self.left = 0.0, 0
        self.on: dict[int, dict[int, list[int]]] = {}  # rows by variable and its neighbour
        self._graph, self._policy = graph, policy
        self._open = set(found.poses.tolist())
        for row, (i, j) in zip(found.rows.tolist(), found.ends.tolist(), strict=True):
            self.on.setdefault(i, {}).setdefault(j, []).append(row)
            self.on.setdefault(j, {}).setdefault(i, []).append(row)
        self.poses: list[int] = sorted(found.poses.tolist(), key=lambda pose: len(self.on.get(pose, ())))

    def take_group(self, pose: int) -> None:
        """The pose, with redundant ones around it; or alone, where they lose too much together; or not at all."""
        if pose not in self._open:
            return
        group, around = self._group(pose)
        done = self._try(group, around)
        if done is None and len(group) > 1:
            group, around = [pose], set(self.on.get(pose, {}))
            done = self._try(group, around)
        if done is None:
            self.left += 1
            self._open.discard(pose)
            return
        self.taken += group
        self._open -= around | set(group)
        self.rows.update(self._rows_of(group))
        self.loss += done.loss
        for term in done.terms:
            self.terms.setdefault((min(term.i, term.j), max(term.i, term.j)), []).append(term)

    def _group(self, pose: int) -> tuple[list[int], set[int]]:
        """Poses that go together, begun with this one, by the fewest neighbours; and these."""
        group, around = [pose], set(self.on.get(pose, {}))
        while len(group) < _GROUP:
            grown = [(v, (around | self.on[v].keys()) - {*group, v}) for v in sorted(around & self._open)]
            v, wider = min(grown, key=lambda each: len(each[1]), default=(-1, around))
            if v < 0 or len(wider) > _NEIGHBOURS:
                break
            group.append(v)
            around = wider
        return group, around

    def _try(self, group: list[int], around: set[int]) -> Eliminated | None:
        if not 0 < len(around) <= _NEIGHBOURS:
            return None
        done = try_eliminate(self._graph, group, self._rows_of(group), self.on)
        return done if done is not None and done.loss <= self._policy.loss * len(group) else None

    def _rows_of(self, group: list[int]) -> list[int]:
        return sorted({row for pose in group for rows in self.on[pose].values() for row in rows})


def _merged(
    graph: FactorGraph, terms: dict[tuple[int, int], list[RelativeTerm]], on: dict[int, dict[int, list[int]]]
) -> tuple[set[int], list[FactorGroup]]:
    """(rows of factors that are in those added, and these by kind)."""
    used, made = set[int](), dict[str, list[tuple[list[int], F64, F64]]]()
    for _, some in sorted(terms.items()):
        i, j = some[0].i, some[0].j
        there = [row for row in on[i].get(j, ()) if losses_of(graph.fac[row]) == at.NO_LOSS]
        alike = [term if term.i == i else turned_term(graph, term) for term in some]
        alike += [term_of_factors(graph, there, i, j)] if there else []
        used.update(there)
        information, gradient = sum(term.information for term in alike), sum(term.gradient for term in alike)
        kind, z, upper = factor_of_term(graph, RelativeTerm(i, j, np.asarray(information), np.asarray(gradient)))
        made.setdefault(kind, []).append((graph.keys[[i, j]].tolist(), z, upper))
    return used, [_group_of(kind, some) for kind, some in sorted(made.items())]


def _group_of(kind: str, some: list[tuple[list[int], F64, F64]]) -> FactorGroup:
    keys, z, upper = zip(*some, strict=True)
    return FactorGroup(kind, np.array(keys, np.int64), np.stack(z), np.stack(upper))
