"""The optimum of a whole graph, found in this process: for `solve`, `plot map --solve`, and what is held against it."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import BatchEvents, BatchResult, BatchSearch, solve_batch
from factorbus.solver.changes.repair import find_loops, repair
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import Addition
from factorbus.solver.starts.search import NoEvents

# Before false factors are looked for: roughly where the graph lies will do.
_ROUGHLY = BatchSearch(max_iterations=60, polish=False)


@dataclass(frozen=True, slots=True)
class FalseFactors:
    """What graduated non-convexity has left out.

    suspects: how many were looked at.  rows: (kind, keys, rᵀΩr) of each that is false.
    """

    suspects: int
    rows: tuple[tuple[str, tuple[int, ...], float], ...]


def optimum_of(
    graph: Batch, search: BatchSearch | None = None, events: BatchEvents | None = None
) -> tuple[BatchResult, Batch]:
    """What came of the search, and the same graph at its end.  Raises SolverError."""
    result = solve_batch(graph.variables, graph.factors, search or BatchSearch(), events or NoEvents())
    return result, Batch(as_messages(result.values), graph.factors)


def as_messages(groups: Iterable[Any]) -> tuple[Variables, ...]:
    """The solver's groups of variables as those of the wire."""
    return tuple(Variables(group.kind, group.keys, group.values, group.fixed, group.stamps) for group in groups)


def with_loss_on_loops(graph: Batch, loss: str, scale: float) -> tuple[Batch, int]:
    """The same graph with a robust loss on every factor that closes a loop and has none; and how many these are.

    Raises SolverError.
    """
    robust, factors = np.zeros(graph.factor_count, bool), []
    robust[_closing(_admitted(graph))] = True
    at = changed = 0
    for group in graph.factors:
        chosen, at = robust[at : at + len(group.keys)], at + len(group.keys)
        if group.loss or not chosen.any():
            factors.append(group)
            continue
        changed += int(np.count_nonzero(chosen))
        if not chosen.all():
            factors.append(_some(group, ~chosen))
        factors.append(_some(group, chosen)._replace(loss=loss, scale=np.full(np.count_nonzero(chosen), scale)))
    return Batch(graph.variables, tuple(factors)), changed


def without_false(
    graph: Batch, probability: float, memory_limit_bytes: int | None = None, events: BatchEvents | None = None
) -> tuple[Batch, FalseFactors]:
    """The graph without the false ones among the factors that close loops, at where the others lead.

    memory_limit_bytes, events: of the search before, for where the graph roughly lies.  Raises SolverError.
    """
    _, near = optimum_of(graph, replace(_ROUGHLY, memory_limit_bytes=memory_limit_bytes), events)
    found = repair(_admitted(near), probability=probability)
    false, factors, at = np.zeros(graph.factor_count, bool), [], 0
    false[found.false] = True
    distance, rows = dict(zip(found.false.tolist(), found.distance.tolist(), strict=True)), []
    for group in graph.factors:
        left_out = false[at : at + len(group.keys)]
        which = np.flatnonzero(left_out).tolist()
        rows += [(group.kind, tuple(group.keys[row].tolist()), distance[at + row]) for row in which]
        factors.append(_some(group, ~left_out) if left_out.any() else group)
        at += len(group.keys)
    left = tuple(group for group in factors if len(group.keys))
    return Batch(as_messages(found.groups), left), FalseFactors(found.suspects, tuple(rows))


class WorkerCores:
    """Worker threads for the eliminations of a graph, as many as there are cores for, once it is known to be large."""

    _FROM_BYTES = 64 << 20  # below, a panel that is worth waking somebody is rare

    def __init__(self, cores: int | None) -> None:
        from factorbus.service.process.worker_threads import WorkerThreads, core_count

        self.cores = min(cores or core_count(), core_count())
        self._threads = WorkerThreads(self.cores, self._FROM_BYTES)

    def start(self, memory_bytes: int) -> None:
        """Start them if that much memory is worth it."""
        if self.cores > 1 and memory_bytes >= self._FROM_BYTES:
            from factorbus.solver import warm

            warm()
            self._threads.tick(lambda: memory_bytes)

    def __enter__(self) -> "WorkerCores":
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.close()


def _admitted(graph: Batch) -> FactorGraph:
    admitted = FactorGraph()
    admit(admitted, Addition(tuple(graph.variables), tuple(graph.factors)))
    return admitted


def _closing(graph: FactorGraph) -> Any:
    """Ids of the factors that close loops: their places in the order of the groups."""
    return graph.ids_of(find_loops(graph))


def _some(group: Factors, chosen: Any) -> Factors:
    scale = None if group.scale is None else group.scale[chosen]
    rows = {"keys": group.keys[chosen], "measured": group.measured[chosen], "information": group.information[chosen]}
    return group._replace(**rows, scale=scale)
