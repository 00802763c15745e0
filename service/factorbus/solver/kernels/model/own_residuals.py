"""Have new factors of own kinds a residual?  MATH §3.11."""

from factorbus.solver.kernels.jit.compile import I64, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.many import evaluate_plain
from factorbus.solver.kernels.model.records import graph_at


@kernel("int64(int64, int64[::1])")
def find_without_residual(first: int, graph_table: I64) -> int:
    """The first row from `first` on of an own kind whose residual, or a slope of it, is no number; −1: none."""
    graph = graph_at(graph_table)
    for f in range(first, graph.counts[at.FACTORS]):
        if graph.fac[f, at.F_KIND] == at.OWN:
            more, _ = evaluate_plain(f, graph.var, graph.fac, graph.values, graph.payload)
            if more > 0.0:
                return f
    return -1
