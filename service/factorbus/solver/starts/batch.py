"""A whole graph at once, from the best of several starts: what an incremental estimate is held against.  MATH §12."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from factorbus.solver.errors import NotFinite
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import Addition, FactorsLike, Group, VariablesLike
from factorbus.solver.kernels.graph.initialize import reach
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.starts.averaged import averaged
from factorbus.solver.starts.descent import NOTHING, ODOMETRY, ROTATIONS, STARTS, VALUES, Descent, Descents, are_close

__all__ = ["STARTS", "BatchResult", "solve_batch"]


@dataclass(frozen=True, slots=True)
class BatchResult:
    """The optimum: χ² there, the iterations it took, the values of all variables, whether it converged.

    start: what led there, one of `STARTS`: the values given, composed odometry, or averaged rotations.
    """

    chi2: float
    iterations: int
    values: list[Group]
    converged: bool
    start: str


def solve_batch(variables: Sequence[VariablesLike], factors: Sequence[FactorsLike]) -> BatchResult:
    """The lowest χ² that Gauss-Newton (Levenberg-Marquardt where needed) finds from three starts.

    These are the values given, those that the factors compose from the first to the last, and those that averaged
    rotations lead to.  Variables without values are composed.  Raises SolverError.
    """
    graph = FactorGraph()
    admit(graph, Addition(tuple(variables), tuple(factors)))
    given = any(group.values is not None and not group.fixed and len(group.keys) for group in variables)
    descents = Descents(graph)
    best = descents.run(_begun(descents, given))
    graph.values = best.values
    return BatchResult(best.chi2, best.iterations, graph.variables(), best.converged, best.start)


def _begun(descents: Descents, given: bool) -> list[Descent]:
    """All starts that have a χ², the lowest first.  Raises NotFinite if none has."""
    graph = descents.graph
    found = [(VALUES, graph.values)] if given else []
    found.append((ODOMETRY, _composed(graph)))
    found += [(ROTATIONS, values) for values in averaged(graph)]
    begun, failed = [], None
    for start, values in found:
        try:
            begun.append(descents.begin(start, values))
        except NotFinite as problem:
            failed = failed or problem
    if failed is not None and not begun:
        raise failed
    begun.sort(key=lambda each: (each.chi2 if each.chi2 > NOTHING else 0.0, STARTS.index(each.start)))
    return [each for n, each in enumerate(begun) if not any(_is_beside(each, lower) for lower in begun[:n])]


def _is_beside(descent: Descent, lower: Descent) -> bool:
    """Whether a start adds nothing to one that begins lower: it begins in the same place, or is of the same sort."""
    return descent.start == lower.start or are_close(descent.values, lower.values)


def _composed(graph: FactorGraph) -> F64:
    """Each variable from the first factor that reaches it; what none reaches stays where it is."""
    composed = copy(graph)
    composed.values = graph.values.copy()
    reached = (graph.var[: graph.counts[at.VARIABLES], at.V_COLUMN] < 0).astype(np.int64)
    reach(True, 0, 0, int(graph.counts[at.FACTORS]), composed.array_table, reached)
    return composed.values
