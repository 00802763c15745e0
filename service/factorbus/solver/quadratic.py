"""What some factors say of their variables together, to second order at the estimate: dense, for a few of them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from factorbus.solver.factors import FACTOR_KIND_OF_CODE
from factorbus.solver.graph import Graph
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import F64
from factorbus.solver.kernels.linearise import evaluate_one
from factorbus.solver.variables import VARIABLE_KIND_OF_CODE, VariableKind


@dataclass(frozen=True, slots=True)
class Quadratic:
    """χ² of some factors, x ⊟ y around the estimate: δᵀ Λ δ − 2 ηᵀ δ + ..., over free variables in this order.

    starts: where each begins in δ   plus: the diagonal that Λ would have without factors of negative weight
    """

    variables: list[int]
    starts: dict[int, int]
    information: F64
    eta: F64
    plus: F64


def quadratic(graph: Graph, rows: Iterable[int], first: list[int]) -> Quadratic:
    """Of the factors `rows`; the variables `first` come first, behind them the others on these factors, ascending."""
    rows = list(rows)
    ends = {v for v in graph.fac[rows, at.F_I : at.F_J + 1].ravel().tolist() if v >= 0} - set(first)
    variables, starts, size = [*first, *sorted(v for v in ends if graph.var[v, at.V_COLUMN] >= 0)], {}, 0
    for v in variables:
        starts[v], size = size, size + kind_of(graph, v).dim
    information, eta, plus = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    r, J, W = np.zeros(at.R_SIZE), np.zeros((2, 6, 6)), np.zeros((6, 6))
    for f in rows:
        row = graph.fac[f]
        kind = FACTOR_KIND_OF_CODE[int(row[at.F_KIND])]
        evaluate_one(f, graph.var, graph.fac, graph.values, graph.payload, r, J[0], J[1])
        upper = np.triu_indices(kind.dim)
        W[upper] = graph.payload[row[at.F_AT] + kind.size : row[at.F_AT] + kind.size + kind.triangle]
        omega = np.triu(W[: kind.dim, : kind.dim]) + np.triu(W[: kind.dim, : kind.dim], 1).T
        here = [(e, int(row[at.F_I + e])) for e in range(len(kind.connects)) if int(row[at.F_I + e]) in starts]
        if not here:
            continue
        H = np.concatenate([J[e, : kind.dim, : kind_of(graph, v).dim] for e, v in here], axis=1)
        places = np.concatenate([starts[v] + np.arange(kind_of(graph, v).dim) for _, v in here])
        added = H.T @ omega @ H
        information[np.ix_(places, places)] += added
        eta[places] -= H.T @ omega @ r[: kind.dim]
        plus[places] += np.maximum(added.diagonal(), 0.0)
    return Quadratic(variables, starts, information, eta, plus)


def kind_of(graph: Graph, v: int) -> VariableKind:
    """The kind of the variable with this index."""
    return VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])]
