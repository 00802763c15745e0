"""Variables taken out of a graph for good: what their factors say of the others is kept as linear factors.  MATH §11.3.

Variables that hang together go together.  Those that they share a factor with are their border, and what they say of
it is a linear factor there, linearised at the estimate: of one pose, of two poses of a kind, or a prior of one point.
A larger border is refused: it would need a factor of more ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorbus.solver import errors
from factorbus.solver.factors import FACTOR_KIND_OF_CODE
from factorbus.solver.graph import Graph
from factorbus.solver.groups import FactorGroup
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import F64, I64
from factorbus.solver.kernels.linearise import evaluate_one
from factorbus.solver.variables import SE2, SE3, VARIABLE_KIND_OF_CODE, VariableKind

# Below this share of the largest eigenvalue a direction of the border is not known at all.
_NOTHING = 1e-13
_POSES = (SE2.code, SE3.code)


@dataclass(frozen=True, slots=True)
class _Quadratic:
    """χ² of some factors to second order, x ⊟ y around the estimate: δᵀ Λ δ − 2 ηᵀ δ + ..."""

    variables: list[int]
    starts: dict[int, int]
    information: F64
    eta: F64


def marginals(graph: Graph, gone: I64, kept: np.ndarray) -> list[FactorGroup]:
    """The linear factors that take the place of those on the variables `gone`.

    kept (m,): the factors that are there.  Raises TooConnected, Underconstrained.
    """
    made: list[FactorGroup] = []
    for part, rows in _pieces(graph, gone, kept):
        whole = _sum(graph, part, rows)
        border = whole.variables[len(part) :]
        if border:
            made += _as_factors(graph, part or gone[:1].tolist(), border, *_reduced(graph, whole, len(part)))
    return made


def _pieces(graph: Graph, gone: I64, kept: np.ndarray) -> list[tuple[list[int], list[int]]]:
    """(free variables, factors) of each piece of `gone` that hangs together; what is fixed joins nothing."""
    going = set(gone.tolist())
    free = {v for v in going if graph.var[v, at.V_COLUMN] >= 0}
    above = {v: v for v in free}

    def root(v: int) -> int:
        while above[v] != v:
            above[v] = above[above[v]]
            v = above[v]
        return v

    ends = graph.fac[: kept.size, at.F_I : at.F_J + 1]
    on = np.flatnonzero(kept & np.isin(ends, gone).any(axis=1)).tolist()
    for i, j in ends[on].tolist():
        if i in free and j in free:
            above[root(i)] = root(j)
    variables: dict[int, list[int]] = {}
    factors: dict[int, list[int]] = {}
    for v in sorted(free):
        variables.setdefault(root(v), []).append(v)
    for f in on:
        inside = [v for v in ends[f].tolist() if v in free]
        head = root(inside[0]) if inside else max(set(ends[f].tolist()) - going, default=-1)
        factors.setdefault(head, []).append(f)
    return [(variables.get(head, []), factors.get(head, [])) for head in sorted({*variables, *factors})]


def _sum(graph: Graph, part: list[int], rows: list[int]) -> _Quadratic:
    """Λ and η of the factors `rows` over `part` and, behind it, its border."""
    ends = {v for v in graph.fac[rows, at.F_I : at.F_J + 1].ravel().tolist() if v >= 0} - set(part)
    border = sorted(v for v in ends if graph.var[v, at.V_COLUMN] >= 0)
    variables, starts, size = [*part, *border], {}, 0
    for v in variables:
        starts[v], size = size, size + _kind(graph, v).dim
    information, eta = np.zeros((size, size)), np.zeros(size)
    r, J, W = np.zeros(at.R_SIZE), np.zeros((2, 6, 6)), np.zeros((6, 6))
    for f in rows:
        row = graph.fac[f]
        kind = FACTOR_KIND_OF_CODE[int(row[at.F_KIND])]
        evaluate_one(f, graph.var, graph.fac, graph.values, graph.payload, r, J[0], J[1])
        upper = np.triu_indices(kind.dim)
        W[upper] = graph.payload[row[at.F_AT] + kind.size : row[at.F_AT] + kind.size + kind.triangle]
        omega = np.triu(W[: kind.dim, : kind.dim]) + np.triu(W[: kind.dim, : kind.dim], 1).T
        here = [(e, int(row[at.F_I + e])) for e in range(len(kind.connects)) if int(row[at.F_I + e]) in starts]
        H = np.concatenate([J[e, : kind.dim, : _kind(graph, v).dim] for e, v in here], axis=1)
        places = np.concatenate([starts[v] + np.arange(_kind(graph, v).dim) for _, v in here])
        information[np.ix_(places, places)] += H.T @ omega @ H
        eta[places] -= H.T @ omega @ r[: kind.dim]
    return _Quadratic(variables, starts, information, eta)


def _reduced(graph: Graph, whole: _Quadratic, count: int) -> tuple[F64, F64]:
    """Λ and η of the border once the first `count` variables have taken theirs.  (11.4)"""
    if not count:
        return whole.information, whole.eta
    cut = whole.starts[whole.variables[count]]
    inner, cross = whole.information[:cut, :cut], whole.information[:cut, cut:]
    try:
        L = np.linalg.cholesky(inner)
    except np.linalg.LinAlgError:
        key, factors = int(graph.keys[whole.variables[0]]), graph.factors_of(whole.variables[0])
        raise errors.Underconstrained(
            key, factors, "its own factors leave it free; it cannot be marginalised"
        ) from None
    across, along = np.linalg.solve(L, cross), np.linalg.solve(L, whole.eta[:cut])
    return whole.information[cut:, cut:] - across.T @ across, whole.eta[cut:] - across.T @ along


def _as_factors(graph: Graph, part: list[int], border: list[int], information: F64, eta: F64) -> list[FactorGroup]:
    """Linear factors on the border with these Λ and η.  Raises TooConnected."""
    kinds = [_kind(graph, v) for v in border]
    codes = {kind.code for kind in kinds}
    if len(border) == 1 and kinds[0].code in (at.POINT2, at.POINT3):
        return _point(graph, border[0], information, eta)
    if len(border) > 2 or len(codes) > 1 or not codes <= set(_POSES):
        keys = [int(graph.keys[v]) for v in border]
        raise errors.TooConnected(int(graph.keys[part[0]]), len(part), keys)
    R, d = _root(information, eta)
    dim, kind = kinds[0].dim, kinds[0].name
    y = [_value(graph, v) for v in border]
    if len(border) == 1:
        return [_linear(graph, f"linear_{kind}", border, y, [R], -d)]
    made = [_linear(graph, f"linear_pair_{kind}", border, y, [R[:dim, :dim], R[:dim, dim:]], -d[:dim])]
    if np.any(R[dim:, dim:]):
        made.append(_linear(graph, f"linear_{kind}", border[1:], y[1:], [R[dim:, dim:]], -d[dim:]))
    return made


def _root(information: F64, eta: F64) -> tuple[F64, F64]:
    """Upper triangular R and d with RᵀR = Λ and Rᵀd = η; rows of nothing where Λ has no information."""
    values, V = np.linalg.eigh(information)
    known = values > _NOTHING * max(values[-1], 0.0)
    root = np.where(known, np.sqrt(np.maximum(values, 0.0)), 0.0)
    along = np.where(known, (V.T @ eta) / np.where(known, root, 1.0), 0.0)
    Q, R = np.linalg.qr(root[:, None] * V.T)
    return np.triu(R), Q.T @ along


def _linear(graph: Graph, kind: str, ends: Sequence[int], y: list[F64], H: list[F64], b: F64) -> FactorGroup:
    keys = graph.keys[np.array(ends)][None]
    measured = np.concatenate([*y, *(block.ravel() for block in H), b])[None]
    return FactorGroup(kind, keys, measured, np.eye(b.size)[np.triu_indices(b.size)][None])


def _point(graph: Graph, v: int, information: F64, eta: F64) -> list[FactorGroup]:
    """Of a point a linear factor is a prior."""
    if np.linalg.eigvalsh(information)[0] <= _NOTHING * np.abs(information).max():
        raise errors.TooConnected(int(graph.keys[v]), 1, [int(graph.keys[v])])
    z = _value(graph, v) + np.linalg.solve(information, eta)
    upper = 0.5 * (information + information.T)[np.triu_indices(z.size)]
    return [FactorGroup(f"prior_{_kind(graph, v).name}", graph.keys[v : v + 1][None], z[None], upper[None])]


def _value(graph: Graph, v: int) -> F64:
    start = int(graph.var[v, at.V_AT])
    return graph.values[start : start + _kind(graph, v).size].copy()


def _kind(graph: Graph, v: int) -> VariableKind:
    return VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])]
