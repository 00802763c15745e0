"""Which blocks Λ and R of a graph have: the order is the solver's, elimination is done on sets of names."""

from collections.abc import Iterable

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.proto.messages import Batch
from factorbus.solver.sparse.ordering import order
from factorbus.viz import Pattern, loops_of


def pattern_of(graph: Batch) -> Pattern:
    """The pattern of a graph with its first free pose, if nothing is fixed, held; the last pose is eliminated last.

    Variables that are fixed have no column.
    """
    dims, pairs = _blocks(graph)
    n = len(dims)
    diagonal = np.arange(n)
    rows = np.concatenate([diagonal, pairs[:, 0]])
    cols = np.concatenate([diagonal, pairs[:, 1]])
    group = np.zeros(n, np.int64)
    group[_last_pose(graph, n)] = 1
    perm = order(dims, rows, cols, group)
    place = np.empty(n, np.int64)
    place[perm] = diagonal
    eliminated = np.sort(place[pairs], axis=1)
    fill, nnz_r = _eliminate(dims[perm], eliminated)
    return Pattern(
        n,
        order=perm,
        inserted=pairs,
        eliminated=eliminated,
        fill=fill,
        nnz_lambda=_triangle(dims) + int((dims[pairs[:, 0]] * dims[pairs[:, 1]]).sum()),
        nnz_r=nnz_r,
        nnz_unordered=_eliminate(dims, pairs)[1],
    )


def last_loop(graph: Batch, pattern: Pattern) -> I64:
    """The columns, as they are eliminated, of the free ends of the loop closure that came last; none where there is
    none."""
    loops = loops_of(graph)
    if not len(loops):
        return np.empty(0, np.int64)
    keys = np.sort(np.concatenate([keys for _, keys in _free(graph)]))
    ends = loops[np.argmax(loops.max(axis=1))]
    return np.flatnonzero(np.isin(keys[pattern.order], ends))


def _blocks(graph: Batch) -> tuple[I64, I64]:
    """Tangent sizes (n,) of the free variables in the order of their keys, and the blocks (m, 2) above the diagonal."""
    free = _free(graph)
    dims = np.concatenate([np.full(len(keys), VARIABLE_KINDS[kind].dim) for kind, keys in free])
    keys = np.concatenate([keys for _, keys in free])
    order_in = np.argsort(keys, kind="stable")  # keys grow as a robot drives
    place = {key: index for index, key in enumerate(keys[order_in].tolist())}
    found = {
        (min(a, b), max(a, b))
        for group in graph.factors
        if group.keys.shape[1] == 2
        for a, b in ((place.get(i, -1), place.get(j, -1)) for i, j in group.keys.tolist())
        if a >= 0 and b >= 0
    }
    return dims[order_in], np.array(sorted(found), np.int64).reshape(-1, 2)


def _free(graph: Batch) -> list[tuple[str, I64]]:
    """(kind, keys) of what is estimated."""
    groups = [(group.kind, group.keys) for group in graph.variables if not group.fixed]
    if any(group.fixed for group in graph.variables) or not groups:
        return groups
    kind, keys = groups[0]
    return [(kind, keys[1:]), *groups[1:]]


def _last_pose(graph: Batch, n: int) -> int:
    """The column of the pose with the largest key, among n."""
    free = _free(graph)
    poses = [int(keys.max()) for kind, keys in free if kind.startswith("se") and len(keys)]
    everything = np.sort(np.concatenate([keys for _, keys in free]))
    return int(np.searchsorted(everything, max(poses))) if poses else n - 1


def _eliminate(dims: I64, pairs: I64) -> tuple[I64, int]:
    """Blocks (k, 2) that elimination in this order adds, and the scalars of R.

    The row of R of a column is what Λ has right of it, and what the rows have whose first block it is.
    """
    rows: list[set[int]] = [set() for _ in dims]
    for i, j in pairs.tolist():
        rows[i].add(j)
    there = [frozenset(row) for row in rows]
    for row in rows:
        if row:
            parent = min(row)
            rows[parent] |= row
            rows[parent].discard(parent)
    fill = [(i, j) for i, row in enumerate(rows) for j in sorted(row - there[i])]
    scalars = sum(int(dims[i]) * sum(int(dims[j]) for j in row) for i, row in enumerate(rows))
    return np.array(fill, np.int64).reshape(-1, 2), _triangle(dims) + scalars


def _triangle(dims: Iterable[int] | I64) -> int:
    return sum(int(d) * (int(d) + 1) // 2 for d in dims)
