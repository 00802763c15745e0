"""Variables taken out of a graph for good: what their factors say of the others is kept as linear factors.  MATH §11.3.

Variables that hang together go together.  Those that they share a factor with are their border, and what they say of
it is a linear factor there, linearised at the estimate: of one pose, of two poses of a kind, or a prior of one point.
Of more poses it is one in pieces (`joints`).  Refused are a border of more than joints.MOST poses, one of poses of both
kinds, and one of more than a point: there are no linear factors of points.
"""

from collections.abc import Sequence

import numpy as np

from factorbus.solver import errors
from factorbus.solver.graph import Graph
from factorbus.solver.groups import FactorGroup
from factorbus.solver.joints import MOST, find_joints, split
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import F64, I64
from factorbus.solver.quadratic import Quadratic, kind_of, quadratic
from factorbus.solver.variables import SE2, SE3

# Below this share of the largest eigenvalue a direction of the border is not known at all.
_NOTHING = 1e-13
_POSES = (SE2.code, SE3.code)


def marginals(graph: Graph, gone: I64, kept: np.ndarray) -> tuple[list[FactorGroup], list[int]]:
    """(the linear factors that take the place of those on the variables `gone`, the rows of all that these replace).

    kept (m,): the factors that are there.  Raises TooConnected, Underconstrained.
    """
    made: list[FactorGroup] = []
    used: list[int] = []
    for part, rows in _pieces(graph, gone, kept):
        used += rows
        whole = quadratic(graph, rows, part)
        border = whole.variables[len(part) :]
        if border:
            made += _as_factors(graph, part or gone[:1].tolist(), border, *_reduced(graph, whole, len(part)))
    return made, used


def _pieces(graph: Graph, gone: I64, kept: np.ndarray) -> list[tuple[list[int], list[int]]]:
    """(free variables, factors) of each piece of `gone` that hangs together; what is fixed joins nothing.

    What is known of many poses together goes whole where one of them goes.
    """
    going = set(gone.tolist())
    free = {v for v in going if graph.var[v, at.V_COLUMN] >= 0}
    above = {v: v for v in free}

    def root(v: int) -> int:
        while above[v] != v:
            above[v] = above[above[v]]
            v = above[v]
        return v

    ends = graph.fac[: kept.size, at.F_I : at.F_J + 1]
    groups = [(joint.poses, joint.rows) for joint in find_joints(graph, kept) if not going.isdisjoint(joint.poses)]
    joined = {f for _, rows in groups for f in rows}
    on = np.flatnonzero(kept & np.isin(ends, gone).any(axis=1)).tolist()
    groups += [([v for v in ends[f].tolist() if v >= 0], [f]) for f in on if f not in joined]
    for of, _ in groups:
        inside = [v for v in of if v in free]
        for v in inside[1:]:
            above[root(v)] = root(inside[0])
    variables: dict[int, list[int]] = {}
    factors: dict[int, list[int]] = {}
    for v in sorted(free):
        variables.setdefault(root(v), []).append(v)
    for of, rows in groups:
        inside = [v for v in of if v in free]
        head = root(inside[0]) if inside else max(set(of) - going, default=-1)
        factors.setdefault(head, []).extend(rows)
    heads = sorted({*variables, *factors})
    return [(variables.get(head, []), sorted(factors.get(head, []))) for head in heads]


def _reduced(graph: Graph, whole: Quadratic, count: int) -> tuple[F64, F64]:
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
    kinds = [kind_of(graph, v) for v in border]
    codes = {kind.code for kind in kinds}
    if len(border) == 1 and kinds[0].code in (at.POINT2, at.POINT3):
        return _point(graph, border[0], information, eta)
    if len(border) > MOST or len(codes) > 1 or not codes <= set(_POSES):
        keys = [int(graph.keys[v]) for v in border]
        raise errors.TooConnected(int(graph.keys[part[0]]), len(part), keys)
    dim, kind = kinds[0].dim, kinds[0].name
    y = [_value(graph, v) for v in border]
    if len(border) > 2:
        return split(kind, graph.keys[border], y, information, eta)
    R, d = _root(information, eta)
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
    return [FactorGroup(f"prior_{kind_of(graph, v).name}", graph.keys[v : v + 1][None], z[None], upper[None])]


def _value(graph: Graph, v: int) -> F64:
    start = int(graph.var[v, at.V_AT])
    return graph.values[start : start + kind_of(graph, v).size].copy()
