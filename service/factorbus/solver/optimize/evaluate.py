"""χ² of a graph at values that somebody else found."""

from collections.abc import Sequence

import numpy as np

from factorbus.solver.errors import UnknownVariable
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import Addition, FactorsLike, VariablesLike
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2


def chi2_at(
    variables: Sequence[VariablesLike], factors: Sequence[FactorsLike], values: Sequence[VariablesLike]
) -> float:
    """Σ ρ(rᵀ Ω r) over `factors`, with the variables of `values` where those say.  MATH (4.1)

    variables: of the graph, with values.  values: of some of them; the others, and fixed ones, stay where they are.
    Raises the errors of `admission.admit`, and UnknownVariable for a key in `values` that the graph does not have.
    """
    graph = FactorGraph()
    admit(graph, Addition(tuple(variables), tuple(factors)))
    for group in values:
        for key, row in zip(group.keys.tolist(), np.asarray(group.values), strict=True):
            if (v := graph.find(key)) < 0:
                raise UnknownVariable(key, "evaluating χ²")
            if graph.var[v, at.V_COLUMN] >= 0:
                start = graph.var[v, at.V_AT]
                graph.values[start : start + row.size] = row
    chi2 = sum_chi2(0, int(graph.counts[at.FACTORS]), graph.var, graph.fac, graph.values, graph.payload)
    return max(float(chi2), 0.0)
