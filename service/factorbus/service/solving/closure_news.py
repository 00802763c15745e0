"""The event of closures whose state is another, and of those that a map has no more."""

from collections.abc import Iterable, Sequence, Set

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.closures import GONE, POSE_GONE, REMOVED
from factorbus.proto.messages import Change
from factorbus.service.core.events import MovedClosure
from factorbus.solver.closures.ledger import Closure, ClosureLedger
from factorbus.solver.graph.factor_graph import FactorGraph


def moved_closures(changed: Iterable[Closure]) -> tuple[MovedClosure, ...]:
    """That their state is what it is."""
    return tuple(MovedClosure(c.factor_id, c.state, c.reason) for c in changed)


def forget_gone(
    ledger: ClosureLedger, graph: FactorGraph, removed: Set[int], changes: Sequence[Change]
) -> tuple[MovedClosure, ...]:
    """After changes that may have taken closures along: the ledger is without them; gives those that went.

    removed: of those that were out, which were named.
    """
    # 1. Those that are no more: what was in is no factor of the graph, of what was out a pose is not there.
    here = [c for c in ledger.closures if c.factor_id not in removed]
    rows = graph.rows_of(np.array([c.factor_id for c in here], np.int64)).tolist()
    lost = {c.factor_id for c, row in zip(here, rows, strict=True) if not _stands(c, row, graph)}
    # 2. In the order they came, with the reason.
    named = removed | set(_ids_named(changes).tolist())
    gone = [c.factor_id for c in ledger.closures if c.factor_id in removed or c.factor_id in lost]
    ledger.forget(gone, graph)
    return tuple(MovedClosure(factor, GONE, REMOVED if factor in named else POSE_GONE) for factor in gone)


def _stands(closure: Closure, row: int, graph: FactorGraph) -> bool:
    """Whether a closure is still one: in the map, or out and between poses that are there."""
    return row >= 0 if closure.is_in else all(graph.find(key) >= 0 for key in closure.keys)


def _ids_named(changes: Sequence[Change]) -> I64:
    """The factors that are to go."""
    named = [c.factors for c in changes if c.change == "remove_factors" and c.factors is not None]
    return np.concatenate([np.empty(0, np.int64), *named])
