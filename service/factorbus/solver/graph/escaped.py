"""Which of the variables that a step moved are beyond their bounds.  MATH §2.5."""

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import LEAST_SCALE, find_escaped, find_first_outside

# Where the scale of a `sim3` is among its numbers.
SCALE_OF_SIM3 = 7


def find_beyond(changed: I64, graph: FactorGraph) -> int:
    """The first of the variables `changed` with a number too large or none at all, or a scale too small; or −1.

    A scale is multiplied by exp(δ), so a step that overshoots leaves it at 1e-200, which no later step finds its way
    back from: its residual is measured in units of it.
    """
    escaped = int(find_escaped(changed, graph.array_table))
    if escaped >= 0:
        return escaped
    rows = graph.var[changed]
    scaled = np.flatnonzero(rows[:, at.V_KIND] == at.SIM3)
    if scaled.size:
        small = scaled[graph.values[rows[scaled, at.V_AT] + SCALE_OF_SIM3] < LEAST_SCALE]
        if small.size:
            return int(changed[small[0]])
    return -1


def are_all_within(graph: FactorGraph, values: F64) -> bool:
    """Whether all variables of `graph` would be within their bounds with these values."""
    count = int(graph.counts[at.VARIABLES])
    if find_first_outside(0, count, graph.var, values) >= 0:
        return False
    scaled = graph.var[:count]
    scaled = scaled[scaled[:, at.V_KIND] == at.SIM3]
    return not scaled.size or bool((values[scaled[:, at.V_AT] + SCALE_OF_SIM3] >= LEAST_SCALE).all())
