"""A whole graph at once, from the best of several starts: what an incremental estimate is held against.  MATH §12."""

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from factorbus.solver.errors import BadOption, NotFinite, TooLarge
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import Addition, FactorsLike, Group, VariablesLike
from factorbus.solver.kernels.graph.initialize import reach
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.starts.averaged import averaged
from factorbus.solver.starts.descent import NOTHING, Descent, Descents
from factorbus.solver.starts.search import (
    BEST,
    ODOMETRY,
    ROTATIONS,
    STARTS,
    VALUES,
    BatchEvents,
    BatchSearch,
    NoEvents,
)

__all__ = ["STARTS", "BatchResult", "solve_batch"]

_USUAL, _NOBODY = BatchSearch(), NoEvents()


@dataclass(frozen=True, slots=True)
class BatchResult:
    """The optimum: χ² there, the iterations it took, the values of all variables, whether it converged.

    start: what led there, one of `STARTS`: the values given, composed odometry, or averaged rotations.
    starts: χ² of each that there was.  left: what another Gauss-Newton step would take off χ², as predicted last;
    infinite where that is not known.
    """

    chi2: float
    iterations: int
    values: list[Group]
    converged: bool
    start: str
    starts: Mapping[str, float]
    left: float


def solve_batch(
    variables: Sequence[VariablesLike],
    factors: Sequence[FactorsLike],
    search: BatchSearch = _USUAL,
    events: BatchEvents = _NOBODY,
) -> BatchResult:
    """The lowest χ² that Gauss-Newton (Levenberg-Marquardt where needed) finds from three starts, or from one of them.

    These are the values given, those that the factors compose from the first to the last, and those that averaged
    rotations lead to.  Variables without values are composed.  Raises SolverError.
    """
    if search.start not in (BEST, *STARTS):
        raise BadOption("start", repr(search.start), f"one of {', '.join((BEST, *STARTS))}")
    graph = FactorGraph()
    admit(graph, Addition(tuple(variables), tuple(factors)))
    given = any(group.values is not None and not group.fixed and len(group.keys) for group in variables)
    descents = Descents(graph, search, events)
    _check_memory(descents.memory_bytes(), search, events)
    begun = _begun(descents, given, search.start)
    starts = {each.start: each.chi2 for each in reversed(begun)}
    starts = dict(sorted(starts.items(), key=lambda each: each[1]))
    events.on_starts(starts)
    best = descents.run(begun)
    graph.values = best.values
    return BatchResult(best.chi2, best.iterations, graph.variables(), best.converged, best.start, starts, best.left)


def _check_memory(need: int, search: BatchSearch, events: BatchEvents) -> None:
    """Raises TooLarge."""
    events.on_memory(need)
    if search.memory_limit_bytes is not None and need > search.memory_limit_bytes:
        raise TooLarge(
            "the optimization of this graph",
            need,
            search.memory_limit_bytes,
            "bytes of memory",
            "solve it on a machine with more, or a part of it at a time",
        )


def _begun(descents: Descents, given: bool, wanted: str) -> list[Descent]:
    """All starts that are wanted and have a χ², the lowest first.  Raises NotFinite, or BadOption, if none has."""
    begun: list[Descent] = []
    failed: NotFinite | None = None
    for start, values in _values_of_starts(descents, given, wanted):
        try:
            begun.append(descents.begin(start, values))
        except NotFinite as problem:
            failed = failed or problem
    if not begun:
        raise failed or BadOption(
            "start", repr(wanted), "odometry or the values given: nothing here holds the rotations of all poses"
        )
    begun.sort(key=lambda each: (_rounded(each.chi2), STARTS.index(each.start)))
    return [each for n, each in enumerate(begun) if not any(_is_beside(descents, each, lower) for lower in begun[:n])]


def _values_of_starts(descents: Descents, given: bool, wanted: str) -> Iterator[tuple[str, F64]]:
    graph = descents.graph
    if wanted == VALUES or (wanted == BEST and given):
        yield VALUES, graph.values
    if wanted in (BEST, ODOMETRY):
        yield ODOMETRY, _composed(graph)
    if wanted in (BEST, ROTATIONS):
        yield from ((ROTATIONS, values) for values in averaged(graph, descents.order()))


def _rounded(chi2: float) -> float:
    """χ² without the digits in which the same place differs by the order of its sums."""
    return float(f"{chi2:.9g}") if chi2 > NOTHING else 0.0


def _is_beside(descents: Descents, descent: Descent, lower: Descent) -> bool:
    """Whether a start adds nothing to one that begins lower: it begins in the same place, or is of the same sort."""
    return descent.start == lower.start or descents.are_close(descent.values, lower.values)


def _composed(graph: FactorGraph) -> F64:
    """Each variable from the first factor that reaches it; what none reaches stays where it is."""
    composed = copy(graph)
    composed.values = graph.values.copy()
    reached = (graph.var[: graph.counts[at.VARIABLES], at.V_COLUMN] < 0).astype(np.int64)
    reach(True, 0, 0, int(graph.counts[at.FACTORS]), composed.array_table, reached)
    return composed.values
