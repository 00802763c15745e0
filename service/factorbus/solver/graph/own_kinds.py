"""Kinds that clients wrote themselves: which of them a map has, and have their residuals values?  MATH §3.11."""

import numpy as np

from factorbus.solver import errors
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factors import FACTOR_KINDS
from factorbus.solver.graph.groups import BatchLike
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.own_residuals import find_without_residual

MOST_OWN = 256  # kinds of a map


def take_own_kinds(graph: FactorGraph, batch: BatchLike) -> None:
    """The own kinds of a batch are the map's.

    Raises KindTaken: one of them is called as another of the map; TooLarge: the map would have too many.
    """
    names = {FACTOR_KINDS[group.kind].name: None for group in batch.factors if "(" in group.kind and len(group.keys)}
    new = [name for name in names if name not in graph.own]
    if not new:
        return
    held = {_called(name): name for name in graph.own}
    if any(_called(name) in held for name in new):
        held = {_called(name): name for name in _in_use(graph)}
    for name in new:
        before = held.setdefault(_called(name), name)
        if before != name:
            raise errors.KindTaken(_called(name), before, name)
    kept = tuple(name for name in graph.own if held.get(_called(name)) == name)
    if len(kept) + len(new) > MOST_OWN:  # those whose factors are gone, or never came, make room
        kept = tuple(_in_use(graph))
    if len(kept) + len(new) > MOST_OWN:
        raise errors.TooLarge("the map", len(kept) + len(new), MOST_OWN, "own kinds")
    graph.own = (*kept, *new)


def check_residuals(graph: FactorGraph, first: int) -> None:
    """Of the own kinds from row `first` on.  Raises NotFinite for one that has no residual at the values there are."""
    row = int(find_without_residual(first, graph.array_table))
    if row >= 0:
        raise errors.NotFinite(
            f"the residual of {graph.describe(row)}, or its derivative, at the values it begins with"
        )


def _called(name: str) -> str:
    return name.partition("(")[0]


def _in_use(graph: FactorGraph) -> list[str]:
    """The own kinds that the map has factors of."""
    rows = np.flatnonzero(graph.fac[: graph.counts[at.FACTORS], at.F_KIND] == at.OWN)
    return [kind.name for kind, _ in graph.kinds_of(rows)]
