"""Have new factors of own kinds a residual?  MATH §3.11."""

import numpy as np

from factorbus.solver.kernels.jit.compile import I64, kernel
from factorbus.solver.kernels.jit.machine_code import first_of
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expressions import BEHIND, BOTH, evaluate_own
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, residual_size
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.sizes import dim_of


@kernel("int64(int64, int64[::1])")
def find_without_residual(first: int, graph_table: I64) -> int:
    """The first row from `first` on of an own kind whose residual, or a slope of it, is no number; −1: none."""
    graph = graph_at(graph_table)
    var, fac = graph.var, graph.fac
    for f in range(first, graph.counts[at.FACTORS]):
        if fac[f, at.F_KIND] != at.OWN:
            continue
        columns = 0
        for n in range(count_ends(f, fac)):
            columns += dim_of(var[end_of(f, n, fac), at.V_KIND])
        out = np.empty(residual_size(f, fac) * (columns + 1) + BEHIND)
        if evaluate_own(f, var, fac, graph.values, graph.payload, first_of(out, 0)) != BOTH:
            return f
    return -1
