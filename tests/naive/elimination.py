"""The elimination of a block system as on paper: sets of neighbours and dense matrices."""

import numpy as np
from naive.block_systems import F64, I64, BlockSystem


def neighbours(system: BlockSystem) -> list[set[int]]:
    """The graph of Λ."""
    graph: list[set[int]] = [set() for _ in system.dims]
    for i, j in zip(system.rows.tolist(), system.cols.tolist(), strict=True):
        if i != j:
            graph[i].add(j)
            graph[j].add(i)
    return graph


def row_lengths(system: BlockSystem, order: I64) -> I64:
    """Nonzeros of each scalar row of R, rows in elimination order: eliminating v joins its neighbours."""
    graph, lengths = neighbours(system), []
    for v in order.tolist():
        dim, separator = int(system.dims[v]), sum(int(system.dims[w]) for w in graph[v])
        lengths += [separator + dim - i for i in range(dim)]
        for w in graph[v]:
            graph[w] |= graph[v]
            graph[w] -= {v, w}
    return np.array(lengths, np.int64)


def minimum_degree_nonzeros(system: BlockSystem) -> int:
    """Nonzeros of R when the variable with the least exact degree goes first."""
    graph, left, total = neighbours(system), set(range(len(system.dims))), 0
    while left:
        weights = {v: sum(int(system.dims[w]) for w in graph[v]) for v in left}
        v = min(left, key=lambda v: (weights[v], v))
        dim = int(system.dims[v])
        total += dim * (dim + 1) // 2 + dim * weights[v]
        for w in graph[v]:
            graph[w] |= graph[v]
            graph[w] -= {v, w}
        left.remove(v)
    return total


def partial_cholesky(front: F64, pivots: int) -> tuple[F64, F64]:
    """Rows of R (pivots, n), zero below the diagonal, and the Schur complement of a symmetric front (n, n)."""
    A, B, C = front[:pivots, :pivots], front[:pivots, pivots:], front[pivots:, pivots:]
    R = np.linalg.cholesky(A).T
    S = np.linalg.solve(R.T, B)
    return np.hstack((R, S)), C - S.T @ S
