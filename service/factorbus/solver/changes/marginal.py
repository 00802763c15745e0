"""Variables taken out of a graph for good: what their factors say of the others is kept as linear factors.  MATH §11.3.

Variables that hang together go together.  Those that they share a factor with are their separator, and what they say of
it is one linear factor there, linearized at the estimate; or a prior, of a single point that it determines.  Refused is
a separator of more than MOST_JOINED variables.
"""

import numpy as np

from factorbus.proto.kinds import MOST_JOINED, linear_kind
from factorbus.solver import errors
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import is_first, of_whole_factors
from factorbus.solver.graph.groups import FactorGroup
from factorbus.solver.graph.quadratic import Quadratic, kind_of, quadratic
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

# Below this share of the largest eigenvalue a direction of the separator is not known at all; nor is a scalar of which
# no more than this share is left of what was known of it.
_NOTHING = 1e-13


def marginals(graph: FactorGraph, gone: I64, kept: np.ndarray) -> tuple[list[FactorGroup], list[int]]:
    """(the linear factors that take the place of those on the variables `gone`, the rows of all that these replace).

    kept (m,): the factors that are there.  Raises TooConnected, Underconstrained.
    """
    made: list[FactorGroup] = []
    used: list[int] = []
    for part, rows in _components(graph, gone, kept):
        used += rows
        _check_separator(graph, part or gone[:1].tolist(), rows, gone)
        whole = quadratic(graph, rows, part)
        separator = whole.variables[len(part) :]
        if separator:
            made += _as_factors(graph, separator, *reduced(graph, whole, len(part)))
    return made, used


def _components(graph: FactorGraph, gone: I64, kept: np.ndarray) -> list[tuple[list[int], list[int]]]:
    """(free variables, factors) of each part of `gone` that hangs together; what is fixed joins nothing."""
    going = set(gone.tolist())
    free = {v for v in going if graph.var[v, at.V_COLUMN] >= 0}
    above = {v: v for v in free}

    def root(v: int) -> int:
        while above[v] != v:
            above[v] = above[above[v]]
            v = above[v]
        return v

    fac = graph.fac[: kept.size]
    on = of_whole_factors(fac, kept & np.isin(fac[:, at.F_I : at.F_J + 1], gone).any(axis=1)) & is_first(fac)
    factors_there = [(graph.ends_of(f), f) for f in np.flatnonzero(on).tolist()]
    for of, _ in factors_there:
        inside = [v for v in of if v in free]
        for v in inside[1:]:
            above[root(v)] = root(inside[0])
    variables: dict[int, list[int]] = {}
    factors: dict[int, list[int]] = {}
    for v in sorted(free):
        variables.setdefault(root(v), []).append(v)
    for of, f in factors_there:
        inside = [v for v in of if v in free]
        head = root(inside[0]) if inside else max(set(of) - going, default=-1)
        factors.setdefault(head, []).append(f)
    heads = sorted({*variables, *factors})
    return [(variables.get(head, []), sorted(factors.get(head, []))) for head in heads]


def _check_separator(graph: FactorGraph, part: list[int], rows: list[int], gone: I64) -> None:
    """Before anything is computed of it.  Raises TooConnected."""
    ends = np.setdiff1d([v for row in rows for v in graph.ends_of(row)], gone).astype(np.int64)
    separator = ends[graph.var[ends, at.V_COLUMN] >= 0]
    if separator.size > MOST_JOINED:
        raise errors.TooConnected(int(graph.keys[part[0]]), len(part), graph.keys[separator].tolist(), MOST_JOINED)


def reduced(graph: FactorGraph, whole: Quadratic, count: int) -> tuple[F64, F64]:
    """Λ and η of the separator once the first `count` variables have taken theirs.  (11.4)"""
    if not count:
        return whole.information, whole.eta
    cut = whole.starts[whole.variables[count]]
    inner, cross = whole.information[:cut, :cut], whole.information[:cut, cut:]
    try:
        L = np.linalg.cholesky(inner)
    except np.linalg.LinAlgError:
        key, factors = int(graph.keys[whole.variables[0]]), graph.factors_of(whole.variables[0])
        raise errors.Underconstrained(
            key, factors, "its own factors leave it free; it cannot be marginalized"
        ) from None
    across, along = np.linalg.solve(L, cross), np.linalg.solve(L, whole.eta[:cut])
    information, eta = whole.information[cut:, cut:] - across.T @ across, whole.eta[cut:] - across.T @ along
    # Of a scalar that is known only with what goes, nothing is left but rounding.
    nothing = information.diagonal() <= _NOTHING * whole.information.diagonal()[cut:]
    information[nothing], information[:, nothing], eta[nothing] = 0.0, 0.0, 0.0
    return information, eta


def _as_factors(graph: FactorGraph, separator: list[int], information: F64, eta: F64) -> list[FactorGroup]:
    """A factor on the separator with these Λ and η; none where they say nothing."""
    kinds, keys = [kind_of(graph, v).name for v in separator], graph.keys[separator]
    y = [_value(graph, v) for v in separator]
    if len(separator) == 1 and kinds[0] in ("point2", "point3") and _is_determined(information):
        return [_prior(kinds[0], keys, y[0], information, eta)]
    R, d = _root(information, eta)
    if not len(R):
        return []
    dims = np.cumsum([kind_of(graph, v).dim for v in separator])
    H = [block.reshape(-1) for block in np.split(R, dims[:-1], axis=1)]
    of, upper = linear_kind(len(R), tuple(kinds)), np.eye(len(R))[np.triu_indices(len(R))]
    return [FactorGroup(of.name, keys[None], np.concatenate([*y, *H, -d])[None], upper[None])]


def _is_determined(information: F64) -> bool:
    return bool(np.linalg.eigvalsh(information)[0] > _NOTHING * np.abs(information).max())


def _prior(kind: str, keys: I64, y: F64, information: F64, eta: F64) -> FactorGroup:
    """Of a point that is determined a linear factor is a prior."""
    z = y + np.linalg.solve(information, eta)
    upper = 0.5 * (information + information.T)[np.triu_indices(z.size)]
    return FactorGroup(f"prior_{kind}", keys[:, None], z[None], upper[None])


def _root(information: F64, eta: F64) -> tuple[F64, F64]:
    """R (rank, n), upper triangular, and d with RᵀR = Λ and Rᵀd = η."""
    # Without units: what is known of an angle and of a place differ by as much as their scales.
    D = np.sqrt(np.maximum(information.diagonal(), 0.0))
    inverse = np.where(D > 0.0, 1.0 / np.where(D > 0.0, D, 1.0), 0.0)
    S = information * inverse * inverse[:, None]
    values, V = np.linalg.eigh(0.5 * (S + S.T))
    known = values > _NOTHING * max(values[-1], 0.0)
    root = np.sqrt(values[known])
    along = (V[:, known].T @ (inverse * eta)) / root
    Q, R = np.linalg.qr(root[:, None] * V[:, known].T * D)
    return np.triu(R), Q.T @ along


def _value(graph: FactorGraph, v: int) -> F64:
    start = int(graph.var[v, at.V_AT])
    return graph.values[start : start + kind_of(graph, v).size].copy()
