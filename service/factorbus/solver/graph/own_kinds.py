"""Kinds that clients wrote themselves: which of them a map has, and have their residuals values?  MATH §3.11."""

from collections.abc import Iterable

import numpy as np

from factorbus.solver import errors
from factorbus.solver.formulas.own_code import is_made
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factors import FACTOR_KINDS
from factorbus.solver.graph.groups import BatchLike
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.own_residuals import find_without_residual

MOST_OWN = 256  # kinds of a map
# Numbers of the results of their nodes, which take 0.5 to 1.3 ms each to compile: of those that are new in one insert,
# and of all of a map, which a restart compiles.
MOST_NEW_RESULTS, MOST_RESULTS_OF_MAP = 2048, 8192
# Of memory that a process has for such a number once it is compiled, most of it LLVM's; measured, 5 to 18 kB.
_BYTES_OF_RESULT = 12_000
_RESULTS = "numbers in the results of own kinds"
_FEWER = "remove the factors of a kind, or write as z what differs between kinds"


def take_own_kinds(graph: FactorGraph, batch: BatchLike) -> None:
    """The own kinds of a batch are the map's.

    Raises KindTaken: one of them is called as another of the map; TooLarge: the map would have too many.
    """
    if not (new := _new_kinds(graph, batch)):
        return
    held = {_called(name): name for name in graph.own}
    if any(_called(name) in held for name in new):
        held = {_called(name): name for name in _in_use(graph)}
    for name in new:
        before = held.setdefault(_called(name), name)
        if before != name:
            raise errors.KindTaken(_called(name), before, name)
    kept = tuple(name for name in graph.own if held.get(_called(name)) == name)
    with_new = [*kept, *new]
    if len(with_new) > MOST_OWN or _results(with_new) > MOST_RESULTS_OF_MAP:
        with_new = [*_in_use(graph), *new]  # those whose factors are gone, or never came, make room
    if len(with_new) > MOST_OWN:
        raise errors.TooLarge("the map with this", len(with_new), MOST_OWN, "own kinds", _FEWER)
    if (results := _results(with_new)) > MOST_RESULTS_OF_MAP:
        raise errors.TooLarge("the map with this", results, MOST_RESULTS_OF_MAP, _RESULTS, _FEWER)
    if graph.own_before is None:
        graph.own_before = int(graph.counts[at.FACTORS]), graph.own
    graph.own = tuple(with_new)


def check_new_kinds(graph: FactorGraph, batch: BatchLike) -> None:
    """Raises TooLarge: to compile what own kinds `batch` brings that the map does not have takes too long."""
    if (results := _results(_new_kinds(graph, batch))) > MOST_NEW_RESULTS:
        mend = "send new kinds in several inserts, or ask for fewer at a time"
        raise errors.TooLarge("this insert or question", results, MOST_NEW_RESULTS, f"{_RESULTS} that are new", mend)


def bytes_to_compile(kinds: Iterable[str]) -> int:
    """What the memory of the process may grow by as own kinds of these are compiled that it does not have."""
    names = {FACTOR_KINDS[kind].name for kind in kinds if "(" in kind}
    return _BYTES_OF_RESULT * _results(name for name in names if not is_made(name))


def check_residuals(graph: FactorGraph, first: int) -> None:
    """Of the own kinds from row `first` on.  Raises NotFinite for one that has no residual at the values there are."""
    row = int(find_without_residual(first, graph.array_table))
    if row >= 0:
        raise errors.NotFinite(
            f"the residual of {graph.describe(row)}, or its derivative, at the values it begins with"
        )


def _new_kinds(graph: FactorGraph, batch: BatchLike) -> list[str]:
    names = {FACTOR_KINDS[group.kind].name: None for group in batch.factors if "(" in group.kind and len(group.keys)}
    return [name for name in names if name not in graph.own]


def _results(names: Iterable[str]) -> int:
    return sum(own.result_size for name in names if (own := FACTOR_KINDS[name].own))


def _called(name: str) -> str:
    return name.partition("(")[0]


def _in_use(graph: FactorGraph) -> list[str]:
    """The own kinds that the map has factors of."""
    rows = np.flatnonzero(graph.fac[: graph.counts[at.FACTORS], at.F_KIND] == at.OWN)
    return [kind.name for kind, _ in graph.kinds_of(rows)]
