"""Variables taken out of a graph for good: what their factors say of the others is kept as linear factors.  MATH §11.3.

Variables that hang together go together.  Those that they share a factor with are their separator, and what they say of
it is one linear factor there, linearized at the estimate; or a prior, of a single point that it determines.  Refused is
a separator of more than MOST_JOINED free variables.

Fixed poses are in it too, where there is room: so what hung on one through a pose that goes still hangs on it, in its
frame, and stays right where it is freed, or moved with the part that it holds.  What is said of several among each
other is a constant, and is not kept: where one is freed later the rest is less certain than it would be.
"""

import numpy as np

from factorbus.proto.kinds import MOST_JOINED, linear_kind
from factorbus.solver import errors
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import is_first, of_whole_factors
from factorbus.solver.graph.groups import FactorGroup
from factorbus.solver.graph.linearized import JACOBIAN_ROUNDING
from factorbus.solver.graph.whitened import Whitened, kind_of, whitened
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import POSE


def marginals(graph: FactorGraph, gone: I64, kept: np.ndarray) -> tuple[list[FactorGroup], list[int]]:
    """(the linear factors that take the place of those on the variables `gone`, the rows of all that these replace).

    kept (m,): the factors that are there.  Raises TooConnected, Underconstrained.
    """
    made: list[FactorGroup] = []
    used: list[int] = []
    for part, rows in _components(graph, gone, kept):
        used += rows
        fixed = _separator_of(graph, part or gone[:1].tolist(), rows, gone)
        whole = whitened(graph, rows, part, fixed)
        separator = whole.variables[len(part) :]
        if separator:
            made += _as_factors(graph, separator, len(fixed), *reduced(graph, whole, len(part), len(fixed)))
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


def _separator_of(graph: FactorGraph, part: list[int], rows: list[int], gone: I64) -> set[int]:
    """The fixed poses in the separator, before anything is computed of it; none where there are too many.

    Raises TooConnected.
    """
    ends = np.setdiff1d([v for row in rows for v in graph.ends_of(row)], gone).astype(np.int64)
    free = graph.var[ends, at.V_COLUMN] >= 0
    separator, poses = ends[free], [v for v in ends[~free].tolist() if POSE[graph.var[v, at.V_KIND]]]
    if separator.size > MOST_JOINED:
        raise errors.TooConnected(int(graph.keys[part[0]]), len(part), graph.keys[separator].tolist(), MOST_JOINED)
    return set(poses) if separator.size and separator.size + len(poses) <= MOST_JOINED else set()


def reduced(graph: FactorGraph, whole: Whitened, count: int, held: int = 0) -> tuple[F64, F64]:
    """R, upper triangular, and d: |R δ − d|² is what is left on the separator, but for a constant, with the best δ of
    the first `count` variables.  (11.4), by Householder transformations, as Λ has lost what R has not.

    The last `held` variables are fixed: where they are is part of the constant.
    """
    J, n = whole.J, whole.J.shape[1]
    free = whole.starts[whole.variables[-held]] if held else n
    cut = n if count == len(whole.variables) else whole.starts[whole.variables[count]]
    stacked = np.zeros((max(len(J), n), n + 1))
    stacked[: len(J), :n], stacked[: len(J), n] = J, -whole.r
    # The largest first: a transformation that begins with a small row would round what it takes from the others.
    largest = np.abs(stacked[:, :free]).max(1, initial=0.0)
    R = np.asarray(np.linalg.qr(stacked[np.argsort(-largest, kind="stable")], mode="r"))
    length = np.sqrt((J * J).sum(0))
    # A scalar of which no more is left beside what goes is not known at all.
    if (np.abs(R.diagonal()[:cut]) <= JACOBIAN_ROUNDING * length[:cut]).any():
        key, factors = int(graph.keys[whole.variables[0]]), graph.factors_of(whole.variables[0])
        raise errors.Underconstrained(key, factors, "its own factors leave it free; it cannot be marginalized")
    left = R[cut:free, cut:]
    # Of a scalar that is known only with what goes, nothing is left but rounding.
    left[:, :-1][:, np.sqrt((left[:, :-1] ** 2).sum(0)) <= JACOBIAN_ROUNDING * length[cut:]] = 0.0
    return left[:, :-1], left[:, -1]


def _as_factors(graph: FactorGraph, separator: list[int], held: int, R: F64, d: F64) -> list[FactorGroup]:
    """A factor on the separator, of which the last `held` are fixed, with |R δ − d|²; none where it says nothing."""
    kinds, keys = [kind_of(graph, v).name for v in separator], graph.keys[separator]
    y = [_value(graph, v) for v in separator]
    R, d = _of_full_rank(R, d, sum(kind_of(graph, v).dim for v in separator[: len(separator) - held]))
    if not len(R):
        return []
    if len(separator) == 1 and kinds[0] in ("point2", "point3") and len(R) == len(y[0]):
        # Of a point that is determined a linear factor is a prior.
        z = y[0] + np.linalg.solve(R, d)
        return [FactorGroup(f"prior_{kinds[0]}", keys[:, None], z[None], (R.T @ R)[np.triu_indices(z.size)][None])]
    dims = np.cumsum([kind_of(graph, v).dim for v in separator])
    H = [block.reshape(-1) for block in np.split(R, dims[:-1], axis=1)]
    of, upper = linear_kind(len(R), tuple(kinds)), np.eye(len(R))[np.triu_indices(len(R))]
    return [FactorGroup(of.name, keys[None], np.concatenate([*y, *H, -d])[None], upper[None])]


def _of_full_rank(R: F64, d: F64, free: int) -> tuple[F64, F64]:
    """R (rank, n), upper triangular, and d that say the same, without directions of which nothing is known.

    free: columns of what is not fixed; they alone decide.
    """
    # Without units: what is known of an angle and of a place differ by as much as their scales.
    R, of_fixed = R[:, :free], R[:, free:]
    D = np.sqrt((R * R).sum(0))
    U, values, V = np.linalg.svd(R / np.where(D > 0.0, D, 1.0), full_matrices=False)
    known = values > JACOBIAN_ROUNDING * values.max(initial=0.0)
    Q, R = np.linalg.qr(values[known, None] * V[known] * D)
    to_known = Q.T @ U[:, known].T
    return np.hstack([np.triu(R), to_known @ of_fixed]), to_known @ d


def _value(graph: FactorGraph, v: int) -> F64:
    start = int(graph.var[v, at.V_AT])
    return graph.values[start : start + kind_of(graph, v).size].copy()
