"""Which landmark each of a robot's observations is of: compatible one by one, and all together.  MATH §10.4."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import admitted, evaluate_candidates, linearized
from factorbus.solver.covariance.gates import threshold
from factorbus.solver.covariance.kernels.compatible import search
from factorbus.solver.errors import KindMismatch, TooLarge, printed
from factorbus.solver.graph.factors import FACTOR_KINDS
from factorbus.solver.graph.groups import FactorGroup
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

_BUDGET = 200_000  # pairs tried: some seconds at the very worst
_MOST_PAIRS = 2000  # compatible ones: their joint covariance has that many rows, times two or three


@dataclass(frozen=True, slots=True)
class Association:
    """What was found.

    landmark (n,): the variable that each observation is of in the best joint hypothesis, −1: none of those there are
    distance: its joint d², dims: of how many numbers   complete: the search was not cut short
    observations, landmarks, distances (pairs,): all that are compatible one by one, by observation, the nearest first
    """

    landmark: I64
    distance: float
    dims: int
    complete: bool
    observations: I64
    landmarks: I64
    distances: F64


def associate(
    blocks: CovarianceBlocks, kind: str, pose: int, measured: F64, information: F64, landmarks: I64, probability: float,
    weigh: Callable[[I64, int], None] = lambda *_: None,
) -> Association:  # fmt: skip
    """Observations (rows of `measured` and `information`, as of a factor of `kind`) from variable `pose`.

    landmarks: variables to choose from.  weigh: called before the joint covariance is computed, with its
    variables and how many numbers are measured; it may raise.
    Raises KindMismatch, TooLarge, and what `admit` raises for bad rows.
    """
    graph, n, L = blocks.factored.graph, len(measured), landmarks.size
    _check(blocks, kind, pose, landmarks)
    keys = np.column_stack([np.full(n * L, graph.keys[pose]), np.tile(graph.keys[landmarks], n)])
    every = FactorGroup(kind, keys, np.repeat(measured, L, axis=0), np.repeat(information, L, axis=0))
    dim = FACTOR_KINDS[kind].dim
    found = evaluate_candidates(blocks, [every] if n * L else [])
    distance = found.distance.reshape(n, L)
    near = distance <= threshold(np.array([dim]), probability)[0]
    observations, columns = np.nonzero(near)
    order = np.lexsort((distance[observations, columns], observations))
    observations, columns = observations[order], columns[order]
    if observations.size > _MOST_PAIRS:
        raise TooLarge(
            "the question", int(observations.size), _MOST_PAIRS, "compatible pairs of observation and landmark"
        )
    weigh(np.unique(np.append(landmarks[columns], pose)), dim * observations.size)
    chosen = observations * L + columns
    pairs = FactorGroup(kind, every.keys[chosen], every.measured[chosen], every.information[chosen])
    # The search takes (observations)² numbers: those of no landmark that there is are none of it.
    some, first = np.unique(observations, return_index=True)
    begin = np.append(first, observations.size)
    best, joint, complete = _search(blocks, pairs, begin, columns, probability)
    landmark = np.full(n, -1)
    landmark[some[best >= 0]] = landmarks[columns[best[best >= 0]]]
    dims = dim * int((best >= 0).sum())
    return Association(
        landmark, joint, dims, complete, observations, landmarks[columns], distance[observations, columns]
    )


def _search(
    blocks: CovarianceBlocks, pairs: FactorGroup, begin: I64, landmark: I64, probability: float
) -> tuple[I64, float, bool]:
    """(pair of each observation, joint d², whether it is surely the best); arguments as in `search`."""
    n, dim = begin.size - 1, FACTOR_KINDS[pairs.kind].dim
    S, r = _joint_innovations(blocks, pairs, dim)
    gates = np.concatenate([[0.0], threshold(dim * np.arange(1, n + 1), probability)])
    best = np.empty(n, np.int64)
    complete = search(begin, landmark, S, r, gates, _BUDGET, best) <= _BUDGET
    found = best[best >= 0]
    rows, innovation = (found[:, None] * dim + np.arange(dim)).reshape(-1), r[found].reshape(-1)
    joint = float(innovation @ np.linalg.solve(S[np.ix_(rows, rows)], innovation)) if rows.size else 0.0
    return best, joint, complete


def _joint_innovations(blocks: CovarianceBlocks, pairs: FactorGroup, dim: int) -> tuple[F64, F64]:
    """Covariance and values of all pairs' innovations together: S = H Σ Hᵀ + diag Ω⁻¹."""
    graph = blocks.factored.graph
    mark, k = graph.mark(), len(pairs.keys)
    if not k:
        return np.zeros((0, 0)), np.zeros((0, dim))
    with admitted(graph, [pairs]):
        linear = linearized(graph, mark[at.FACTORS], mark[at.FACTORS] + k)
    variables = np.unique(linear.ends)
    dims = blocks.factored.dims[variables]
    starts = dict(zip(variables.tolist(), (np.cumsum(dims) - dims).tolist(), strict=True))
    H = np.zeros((k * dim, int(dims.sum())))
    for q in range(k):
        for end, J in ((0, linear.A), (1, linear.B)):
            start, width = starts[int(linear.ends[q, end])], int(linear.sizes[q, 1 + end])
            H[q * dim : (q + 1) * dim, start : start + width] = J[q, :dim, :width]
    S = H @ blocks.joint(variables) @ H.T
    for q in range(k):
        rows = slice(q * dim, (q + 1) * dim)
        S[rows, rows] += np.linalg.inv(linear.W[q, :dim, :dim])
    return S, np.ascontiguousarray(linear.r[:, :dim])


def _check(blocks: CovarianceBlocks, kind: str, pose: int, landmarks: I64) -> None:
    graph, wanted = blocks.factored.graph, FACTOR_KINDS[kind].connects
    for variable, end in ((pose, wanted[0]), *((int(v), wanted[1]) for v in landmarks)):
        if graph.var[variable, at.V_KIND] != end.code:
            seen = VARIABLE_KIND_OF_CODE[int(graph.var[variable, at.V_KIND])].name
            key = int(graph.keys[variable])
            raise KindMismatch(key, f"{kind} to {printed(key)}", seen, end.name)
