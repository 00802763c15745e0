"""What some factors say of their variables together, to second order at the estimate: dense, for a few of them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import are_of_many
from factorbus.solver.graph.factors import FactorKind
from factorbus.solver.graph.linearized import Linearized, linearized_factor
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE, VariableKind
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.candidates import evaluate_factors


@dataclass(frozen=True, slots=True)
class Quadratic:
    """χ² of some factors, x ⊟ y around the estimate: δᵀ Λ δ − 2 ηᵀ δ + ..., over free variables in this order.

    starts: where each begins in δ
    """

    variables: list[int]
    starts: dict[int, int]
    information: F64
    eta: F64


def quadratic(graph: FactorGraph, rows: Iterable[int], first: list[int]) -> Quadratic:
    """Of the factors `rows`; the variables `first` come first, behind them the others on these factors, ascending."""
    rows = list(rows)
    ends = {v for row in rows for v in graph.ends_of(row)} - set(first)
    variables, starts, size = [*first, *sorted(v for v in ends if graph.var[v, at.V_COLUMN] >= 0)], {}, 0
    for v in variables:
        starts[v], size = size, size + kind_of(graph, v).dim
    information, eta = np.zeros((size, size)), np.zeros(size)
    picked = np.array(rows, np.int64)
    of_many = are_of_many(graph.fac[picked])
    for row in picked[of_many].tolist():
        _add_many(linearized_factor(graph, row), starts, information, eta)
    for kind, of in graph.kinds_of(picked[~of_many]):
        J, W, r = _evaluated(graph, kind, of)
        there = graph.fac[of, at.F_I : at.F_I + len(kind.connects)]
        place = np.array([[starts.get(v, -1) for v in ends] for ends in there.tolist()])
        for e, end in enumerate(kind.connects):
            WJ = W @ J[e]
            at_e = place[:, e, None] + np.arange(end.dim)
            inside = place[:, e] >= 0
            np.subtract.at(eta, at_e[inside], (WJ.transpose(0, 2, 1) @ r[:, :, None])[inside, :, 0])
            for f, other in enumerate(kind.connects):
                both = inside & (place[:, f] >= 0)
                at_f = place[:, f, None] + np.arange(other.dim)
                added = (J[f].transpose(0, 2, 1) @ WJ)[both]
                np.add.at(information, (at_f[both][:, :, None], at_e[both][:, None, :]), added)
    return Quadratic(variables, starts, information, eta)


def _add_many(factor: Linearized, starts: dict[int, int], information: F64, eta: F64) -> None:
    """Add a factor of any number of variables."""
    place = np.concatenate(
        [
            starts[v] + np.arange(d) if v in starts else np.full(d, -1)
            for v, d in zip(factor.ends.tolist(), factor.dims.tolist(), strict=True)
        ]
    )
    inside, WJ = place >= 0, factor.W @ factor.J
    added = (factor.J.T @ WJ)[np.ix_(inside, inside)]
    information[np.ix_(place[inside], place[inside])] += added
    eta[place[inside]] -= WJ.T[inside] @ factor.r


def _evaluated(graph: FactorGraph, kind: FactorKind, rows: I64) -> tuple[list[F64], F64, F64]:
    """Of factors of one kind the Jacobian of each end (n, dim, d), Ω (n, dim, dim) and r (n, dim)."""
    n = rows.size
    r, A, B, W = np.zeros((n, at.R_SIZE)), *(np.zeros((n, 6, 6)) for _ in range(3))
    evaluate_factors(rows, graph.array_table, graph.values, r, A, B, W)
    d = kind.dim
    blocks = [J[:, :d, : end.dim] for J, end in zip((A, B), kind.connects, strict=False)]
    return blocks, W[:, :d, :d], r[:, :d]


def kind_of(graph: FactorGraph, v: int) -> VariableKind:
    """The kind of the variable with this index."""
    return VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])]
