"""What holds a variable, and what a factor does: the numbers behind an estimate.  MATH §10.5."""

import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorbus.solver import errors
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.graph import observations
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import losses_of, rows_of_factors, with_losses
from factorbus.solver.graph.factors import LOSS_OF_CODE
from factorbus.solver.graph.linearized import Linearized, linearized_factor
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2

_NOTHING = 1e-9
_STEPS = (tl.N_LINEARIZED, tl.N_MOVED, tl.N_SEEN)


@dataclass(frozen=True, slots=True)
class FactorExplanation:
    """One factor at the estimate.

    residual (d,): r   weighted (d,): Lᵀ r with Ω = L Lᵀ, in standard deviations   chi2: s = rᵀ Ω r; all as without loss
    loss: its name, or ""   weight: w = ρ'(s) of it, 1 without one   rho: ρ(s), what it counts in χ²; s without a loss
    inactive: why an observation has no pixel, and so no r (0) and no weight (0), and s is 900; else ""
    leverage: tr(w Ω H Σ Hᵀ), of d: how much of what it measures is known from it rather than from the others
    without: by how much χ² would fall without it (10.8); None: nothing else measures what it does
    """

    factor: int
    kind: str
    keys: tuple[int, ...]
    residual: F64
    weighted: F64
    chi2: float
    dims: int
    leverage: float
    without: float | None
    loss: str
    weight: float
    rho: float
    inactive: str

    def as_dict(self) -> dict[str, Any]:
        """The same as plain types."""
        plain = {name: getattr(self, name) for name in self.__slots__}
        return plain | {"keys": list(self.keys), "residual": self.residual.tolist(), "weighted": self.weighted.tolist()}


@dataclass(frozen=True, slots=True)
class VariableExplanation:
    """One variable.

    sigmas (d,): standard deviations in its tangent space; zero where it is fixed   covariance (d, d)
    pivot: the smallest of its pivots of R, 1/σ of it given all that is eliminated later; conditioning: that squared
    over the diagonal of Λ there, 1: no other variable takes anything from it, near 0: almost nothing holds it
    linearized_step, changed_step, seen_step: the steps that moved its linearization point last, changed its estimate,
    brought a factor of it; −1: none, or the solver's mode keeps no such record
    stamp: its time stamp; None: it has none
    """

    key: int
    kind: str
    fixed: bool
    value: F64
    sigmas: F64
    covariance: F64
    pivot: float
    conditioning: float
    linearized_step: int
    changed_step: int
    seen_step: int
    factors: list[FactorExplanation] = field(default_factory=list)
    stamp: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """The same as plain types."""
        plain = {name: getattr(self, name) for name in self.__slots__}
        arrays = {name: plain[name].tolist() for name in ("value", "sigmas", "covariance")}
        if self.stamp is None:
            del plain["stamp"]
        return plain | arrays | {"factors": [each.as_dict() for each in self.factors]}


def why_factor(blocks: CovarianceBlocks, factor: int) -> FactorExplanation:
    """Of the factor with this id.  Raises UnknownFactor."""
    graph = blocks.factored.graph
    row = int(graph.rows_of(np.array([factor]))[0])
    if row < 0:
        raise errors.UnknownFactor(factor, graph.next_id)
    return _why_row(blocks, row)


def why_variable(blocks: CovarianceBlocks, variable: int, keeps_steps: bool) -> VariableExplanation:
    """Of the variable with this index.  keeps_steps: the record is that of the map's own tree."""
    f = blocks.factored
    graph, node = f.graph, f.tree.node[variable]
    row = graph.var[variable]
    kind = VARIABLE_KIND_OF_CODE[int(row[at.V_KIND])]
    fixed = bool(row[at.V_COLUMN] < 0)
    covariance = blocks.of(np.array([variable]))[0, : kind.dim, : kind.dim]
    rows = graph.rows_on(variable).tolist()
    factors = [_why_row(blocks, each) for each in rows]
    pivot, conditioning = (0.0, 1.0) if fixed else _pivot(blocks, variable, rows)
    linearized_step, changed, seen = (int(node[c]) if keeps_steps else -1 for c in _STEPS)
    value = graph.values[row[at.V_AT] : row[at.V_AT] + kind.size].copy()
    sigmas = np.sqrt(np.diag(covariance))
    stamps = graph.stamps_of(np.array([variable]))
    return VariableExplanation(
        int(graph.keys[variable]), kind.name, fixed, value, sigmas, covariance, pivot, conditioning, linearized_step,
        changed, seen, factors, None if stamps is None else int(stamps[0]),
    )  # fmt: skip


def _why_row(blocks: CovarianceBlocks, row: int) -> FactorExplanation:
    linear = linearized_factor(blocks.factored.graph, row)
    return _explained(blocks, row, linear, linear.J @ blocks.joint(linear.ends) @ linear.J.T)


def _pivot(blocks: CovarianceBlocks, variable: int, factors: list[int]) -> tuple[float, float]:
    """The smallest pivot of a free variable, and the smallest share of Λ's diagonal that is left in one, (10.9)."""
    f = blocks.factored
    tree = f.tree
    row = tree.clique[tree.node[variable, tl.N_CLIQUE]]
    before = tree.lists[row[tl.C_LIST] : row[tl.C_LIST] + tree.node[variable, tl.N_PLACE]]
    first, d = int(f.dims[before].sum()), int(f.dims[variable])
    pivots = np.array([tree.numbers[row[tl.C_ROWS] + i * row[tl.C_LD] + i] for i in range(first, first + d)])
    diagonal = np.zeros(d)
    for factor in factors:
        linear = linearized_factor(f.graph, factor)
        H = linear.jacobian_of(variable)
        diagonal += np.einsum("ai,ab,bi->i", H, linear.W, H)
    return float(pivots.min()), float((pivots**2 / diagonal).min())


def _explained(blocks: CovarianceBlocks, index: int, linear: Linearized, T: F64) -> FactorExplanation:
    """linear, T: with r and H times √w, as the solver has them."""
    graph = blocks.factored.graph
    row, factor = graph.fac[index], int(graph.ids_of(np.array([index]))[0])
    kind = graph.kind_of(index)
    d = kind.dim
    softened, W = linear.r, linear.W
    keys = tuple(int(graph.keys[v]) for v in linear.ends)
    r, s = _plain(graph, index)
    rho, inactive = _chi2(graph, index), observations.why_inactive(graph, index)
    L = np.linalg.cholesky(W)
    # I − Lᵀ T L has the share of each direction that the others know; where that is nothing, all is this factor's.
    M, whitened = L.T @ T @ L, L.T @ softened
    without = None
    if np.linalg.eigvalsh(np.eye(d) - M)[0] > _NOTHING:
        without = rho + float(whitened @ np.linalg.solve(np.eye(d) - M, M @ whitened))
    return FactorExplanation(
        factor, kind.name, keys, r, L.T @ r, s, d, float(np.trace(W @ T)), without,
        LOSS_OF_CODE.get(int(losses_of(row)), ""), 0.0 if inactive else _weight(r, softened), rho,
        inactive,
    )  # fmt: skip


def _plain(graph: FactorGraph, row: int) -> tuple[F64, float]:
    """(r, rᵀ Ω r) of the factor in `row`, whatever its loss."""
    plain = copy.copy(graph)
    plain.fac = graph.fac[: row + int(rows_of_factors(graph.fac, np.array([row])).size)].copy()
    plain.fac[row, at.F_FLAGS] = with_losses(plain.fac[row, at.F_FLAGS], at.NO_LOSS)
    return linearized_factor(plain, row).r, _chi2(plain, row)


def _chi2(graph: FactorGraph, row: int) -> float:
    return float(sum_chi2(row, row + 1, graph.var, graph.fac, graph.values, graph.payload))


def _weight(r: F64, softened: F64) -> float:
    """w, of r times √w and r."""
    largest = int(np.abs(r).argmax())
    return float((softened[largest] / r[largest]) ** 2) if r[largest] else 1.0
