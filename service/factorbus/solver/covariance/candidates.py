"""Factors that a map does not have: how far off they are, and how much information they would add.  MATH §10.3."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from factorbus.solver import errors
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.kernels.innovation import distances_and_gains, predicted_covariances
from factorbus.solver.covariance.square_root import LARGEST
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import are_of_many, is_first
from factorbus.solver.graph.factors import FACTOR_KIND_OF_CODE
from factorbus.solver.graph.groups import FactorsLike
from factorbus.solver.graph.linearized import linearized_factor
from factorbus.solver.graph.own_kinds import check_new_kinds
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.candidates import evaluate_factors

_CHUNK = 512  # factors whose Jacobians stay in the cache between two kernels


@dataclass(frozen=True, slots=True)
class Candidates:
    """Factors k, in the order they were given.

    dims (n,): of the residuals   distance (n,): d²   gain (n,): nats
    predicted (n, d, d): T = H Σ Hᵀ, upper left corners
    """

    dims: I64
    distance: F64
    gain: F64
    predicted: F64


@dataclass(frozen=True, slots=True)
class Linear:
    """Factors linearized at the estimate: r (n, 6), A, B, W (n, 6, 6), sizes (n, 3) of residual and ends."""

    ends: I64
    sizes: I64
    r: F64
    A: F64
    B: F64
    W: F64


@dataclass(frozen=True, slots=True)
class _Batch:
    variables: tuple[()]
    factors: tuple[FactorsLike, ...]


def evaluate_candidates(blocks: CovarianceBlocks, groups: Sequence[FactorsLike]) -> Candidates:
    """What the map expects of `groups`.  Raises what `admission.admit` raises for factors that it would refuse."""
    graph = blocks.factored.graph
    first = int(graph.counts[at.FACTORS])
    with admitted(graph, groups):
        return evaluate_rows(blocks, first, int(graph.counts[at.FACTORS]))


@contextmanager
def admitted(graph: FactorGraph, groups: Sequence[FactorsLike]) -> Iterator[None]:
    """`groups` are the last factors of `graph` for a while.  Raises as `evaluate_candidates`."""
    mark, batch = graph.mark(), _Batch((), tuple(groups))
    check_new_kinds(graph, batch)
    try:
        admit(graph, batch)
        yield
    finally:
        graph.forget(mark)


def evaluate_rows(blocks: CovarianceBlocks, first: int, last: int) -> Candidates:
    """The same for the factors in the rows first .. last−1 of the graph."""
    graph = blocks.factored.graph
    rows = first + np.flatnonzero(is_first(graph.fac[first:last]))
    many = are_of_many(graph.fac[rows])
    if not many.any():
        return _of_pairs(blocks, rows)
    sizes = np.array([graph.kind_of(row).dim for row in rows.tolist()], np.int64)
    found = Candidates(sizes, np.empty(rows.size), np.empty(rows.size), np.zeros((rows.size, *(int(sizes.max()),) * 2)))
    few = np.flatnonzero(~many)
    pairs = _of_pairs(blocks, rows[few])
    found.distance[few], found.gain[few] = pairs.distance, pairs.gain
    found.predicted[few, : pairs.predicted.shape[1], : pairs.predicted.shape[2]] = pairs.predicted
    for k in np.flatnonzero(many).tolist():
        linear, d = linearized_factor(graph, int(rows[k])), int(sizes[k])
        T = linear.J @ blocks.joint(linear.ends) @ linear.J.T
        found.predicted[k, :d, :d] = T
        root = np.linalg.cholesky(linear.W)
        L, y = np.linalg.cholesky(np.eye(d) + root.T @ T @ root), root.T @ linear.r
        found.distance[k], found.gain[k] = float(y @ np.linalg.solve(L @ L.T, y)), float(np.log(L.diagonal()).sum())
    if not np.isfinite(found.distance).all():
        raise errors.NotFinite("the distance of a candidate")
    return found


def _of_pairs(blocks: CovarianceBlocks, rows: I64) -> Candidates:
    """The same of factors of one or two variables."""
    graph, n = blocks.factored.graph, rows.size
    ends = np.ascontiguousarray(graph.fac[rows, at.F_I : at.F_J + 1])
    both = np.flatnonzero(ends[:, 1] >= 0)
    diagonal, places = _diagonal(blocks, ends, _hub(ends[both]))
    if both.size == n:
        cross = blocks.pairs(ends[:, 0], ends[:, 1])
    else:
        cross = np.zeros((n, blocks.width, blocks.width))
        cross[both] = blocks.pairs(ends[both, 0], ends[both, 1])
    sizes = _SIZES[graph.fac[rows, at.F_KIND]]
    dims = sizes[:, 0].copy()
    widest = int(dims.max(initial=1))
    distance, gain, predicted = np.empty(n), np.empty(n), np.empty((n, widest, widest))
    r, A, B, W = _room(min(n, _CHUNK))
    for start in range(0, n, _CHUNK):
        stop = min(start + _CHUNK, n)
        of = slice(start, stop)
        evaluate_factors(rows[of], graph.array_table, graph.values, r, A, B, W)
        predicted_covariances(places[of], sizes[of], A, B, diagonal, cross[of], predicted[of])
        distances_and_gains(sizes[of], r, W, predicted[of], distance[of], gain[of])
    if not np.isfinite(distance).all():
        raise errors.NotFinite("the distance of a candidate")
    return Candidates(dims, distance, gain, predicted)


def _hub(ends: I64) -> int:
    """The variable that is an end of all, at the same side; −1: none is."""
    for side in (0, 1):
        if len(ends) and (ends[:, side] == ends[0, side]).all():
            return int(ends[0, side])
    return -1


def _diagonal(blocks: CovarianceBlocks, ends: I64, hub: int) -> tuple[F64, I64]:
    """Covariances of the variables that occur, and where those of `ends` are among them; −1 stays."""
    if blocks.prefers_all(ends.size):
        return blocks.diagonal(hub), ends
    different, which = np.unique(ends, return_inverse=True)
    known = different >= 0
    diagonal = np.zeros((different.size, blocks.width, blocks.width))
    diagonal[known] = blocks.of(different[known])
    return diagonal, np.where(ends < 0, -1, which.reshape(ends.shape))


def linearized(graph: FactorGraph, first: int, last: int) -> Linear:
    """The factors in the rows first .. last−1, of one or two variables each, at the estimate."""
    r, A, B, W = _room(last - first)
    evaluate_factors(np.arange(first, last), graph.array_table, graph.values, r, A, B, W)
    r = np.ascontiguousarray(r[:, :LARGEST])  # without why an observation is inactive
    fac = graph.fac[first:last]
    ends = np.ascontiguousarray(fac[:, at.F_I : at.F_J + 1])
    return Linear(ends, _SIZES[fac[:, at.F_KIND]], r, A, B, W)


def _room(n: int) -> tuple[F64, F64, F64, F64]:
    """For r, A, B, W of n factors."""
    A, B, W = (np.zeros((n, LARGEST, LARGEST)) for _ in range(3))
    return np.zeros((n, at.R_SIZE)), A, B, W


def _sizes() -> I64:
    sizes = np.zeros((1 + max(FACTOR_KIND_OF_CODE), 3), np.int64)
    for code, kind in FACTOR_KIND_OF_CODE.items():
        sizes[code] = kind.dim, kind.connects[0].dim, kind.connects[1].dim if len(kind.connects) > 1 else 0
    return sizes


_SIZES = _sizes()
