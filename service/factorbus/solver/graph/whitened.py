"""What some factors say of their variables together, to second order at the estimate: dense, for a few of them."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import are_of_many
from factorbus.solver.graph.linearized import linearized_factor
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE, VariableKind
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.candidates import evaluate_factors


@dataclass(frozen=True, slots=True)
class Whitened:
    """χ² of some factors is |J δ + r|², x ⊟ y around the estimate, over variables in this order.

    starts: where each begins in δ   J (m, n), r (m,): times Ω^½, and √w of a loss
    """

    variables: list[int]
    starts: dict[int, int]
    J: F64
    r: F64

    @property
    def information(self) -> F64:
        """Λ (n, n)."""
        return self.J.T @ self.J

    @property
    def eta(self) -> F64:
        """η (n,)."""
        return -self.J.T @ self.r


def whitened(graph: FactorGraph, rows: Iterable[int], first: list[int], fixed: Collection[int] = ()) -> Whitened:
    """Of the factors `rows`; the variables `first` come first, behind them the others on these factors that are free,
    ascending, and last those of them that are in `fixed`."""
    rows = list(rows)
    ends = {v for row in rows for v in graph.ends_of(row)} - set(first)
    free = {v for v in ends if graph.var[v, at.V_COLUMN] >= 0}
    variables = [*first, *sorted(free), *sorted((ends - free).intersection(fixed))]
    starts, size = {}, 0
    for v in variables:
        starts[v], size = size, size + kind_of(graph, v).dim
    picked = np.array(rows, np.int64)
    J, r = [np.zeros((0, size))], [np.zeros(0)]
    of_many = are_of_many(graph.fac[picked])
    for row in picked[of_many].tolist():
        factor = linearized_factor(graph, row)
        S, whole = np.linalg.cholesky(factor.W).T, np.zeros((len(factor.r), size))
        for v in factor.ends.tolist():
            if v in starts:
                whole[:, starts[v] : starts[v] + kind_of(graph, v).dim] = factor.jacobian_of(v)
        J.append(S @ whole)
        r.append(S @ factor.r)
    for kind, of in graph.kinds_of(picked[~of_many]):
        n, d = of.size, kind.dim
        r_of, A, B, W = np.zeros((n, at.R_SIZE)), *(np.zeros((n, 6, 6)) for _ in range(3))
        evaluate_factors(of, graph.array_table, graph.values, r_of, A, B, W)
        S, whole = np.linalg.cholesky(W[:, :d, :d]).transpose(0, 2, 1), np.zeros((n, d, size))
        for of_end, block, end in zip(graph.fac[of, at.F_I : at.F_J + 1].T, (A, B), kind.connects, strict=False):
            place = np.array([starts.get(v, -1) for v in of_end.tolist()])
            there = np.flatnonzero(place >= 0)
            at_end = place[there, None] + np.arange(end.dim)
            whole[there[:, None, None], np.arange(d)[:, None], at_end[:, None, :]] = block[there, :d, : end.dim]
        J.append((S @ whole).reshape(n * d, size))
        r.append((S @ r_of[:, :d, None]).reshape(n * d))
    return Whitened(variables, starts, np.vstack(J), np.concatenate(r))


def kind_of(graph: FactorGraph, v: int) -> VariableKind:
    """The kind of the variable with this index."""
    return VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])]
