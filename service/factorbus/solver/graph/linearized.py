"""One factor linearized at the estimate, whatever it connects: dense, for questions about it.  MATH §3, §10.3."""

from dataclasses import dataclass

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import are_of_many
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.candidates import evaluate_factors, evaluate_many

# Of the largest numbers of Jacobians, what may be rounding in the others: of a map that lies some thousand kilometres
# from its origin they are 10⁻⁹ off, and Λ in doubles has no more.
JACOBIAN_ROUNDING = 1e-8


@dataclass(frozen=True, slots=True)
class Linearized:
    """r (dim,), J (dim, Σ d) with the Jacobians of its variables side by side, Ω as W (dim, dim).

    ends: its variables   dims: the scalars of each.  With a loss r and J are times √w.
    """

    ends: I64
    dims: I64
    r: F64
    J: F64
    W: F64

    def jacobian_of(self, variable: int) -> F64:
        """(dim, d): of one of its variables."""
        n = int(np.flatnonzero(self.ends == variable)[0])
        first = int(self.dims[:n].sum())
        return self.J[:, first : first + int(self.dims[n])]


def linearized_factor(graph: FactorGraph, row: int) -> Linearized:
    """The factor that begins at this row of `fac`."""
    dim, ends = graph.kind_of(row).dim, np.array(graph.ends_of(row), np.int64)
    dims = np.array([VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])].dim for v in ends], np.int64)
    if are_of_many(graph.fac[row : row + 1])[0]:
        found = Linearized(ends, dims, np.empty(dim), np.empty((dim, int(dims.sum()))), np.empty((dim, dim)))
        evaluate_many(row, graph.array_table, graph.values, found.r, found.J, found.W)
        return found
    r, A, B, W = np.zeros((1, at.R_SIZE)), *(np.zeros((1, 6, 6)) for _ in range(3))
    evaluate_factors(np.array([row]), graph.array_table, graph.values, r, A, B, W)
    J = np.hstack([of[0, :dim, :d] for of, d in zip((A, B), dims.tolist(), strict=False)])
    return Linearized(ends, dims, r[0, :dim].copy(), J, W[0, :dim, :dim].copy())
