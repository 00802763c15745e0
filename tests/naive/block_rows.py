"""R in block rows, and Λ and η in blocks, as whole matrices."""

import numpy as np
from naive.solver_parts import graph_in, system_in
from scipy.sparse import coo_array

from factorbus.solver.kernels.inc_l import block_rows as br
from factorbus.solver.kernels.model import layout as at


def dense_r(rows, sparse: bool = False):
    """(R, the scalar of the insertion order that is eliminated k-th, d); the structure is checked on the way."""
    n = int(rows.counts[br.SCALARS])
    order, entries, where = np.empty(n, np.int64), [], ([], [])
    for k, rec in enumerate(rows.rec[: rows.counts[br.POSITIONS]]):
        held = rows.index[rec[br.LIST] : rec[br.LIST] + rec[br.COUNT]]
        assert held[0] == k
        assert (np.diff(held) > 0).all()
        if len(held) > 1:
            parent = rows.rec[held[1]]
            assert set(held[1:]) <= set(rows.index[parent[br.LIST] : parent[br.LIST] + parent[br.COUNT]])
        lines = rec[br.SCALAR] + np.arange(rec[br.DIM])
        order[lines] = rec[br.START] + np.arange(rec[br.DIM])
        columns = np.concatenate([rows.rec[j, br.SCALAR] + np.arange(rows.rec[j, br.DIM]) for j in held])
        assert len(columns) == rec[br.WIDTH] <= rec[br.LD]
        for i, line in enumerate(lines):
            first = rec[br.ROW] + i * rec[br.LD]
            numbers = rows.numbers[first : first + rec[br.WIDTH]]
            assert (numbers[:i] == 0.0).all()
            entries.append(numbers)
            where[0].append(np.full(len(columns), line))
            where[1].append(columns)
    index = tuple(np.concatenate(part or [np.empty(0, np.int64)]) for part in where)
    R = coo_array((np.concatenate(entries or [np.empty(0)]), index), shape=(n, n)).tocsc()
    return (R if sparse else R.toarray()), order, rows.d[:n].copy()


def dense_lambda(solver, sparse: bool = False):
    """(Λ, η) as the solver holds them, in insertion order."""
    graph, blocks = graph_in(solver), system_in(solver).blocks
    dims = graph.dims[: graph.counts[at.COLUMNS]]
    starts = np.concatenate([[0], np.cumsum(dims)])
    entries, rows, cols = [np.empty(0)], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for i, j, offset in zip(blocks.rows, blocks.cols, blocks.offsets, strict=True):
        block = blocks.data[offset : offset + dims[i] * dims[j]]
        r, c = np.divmod(np.arange(block.size), dims[j])
        for a, b in ((r + starts[i], c + starts[j]), (c + starts[j], r + starts[i]))[: 1 if i == j else 2]:
            entries.append(block)
            rows.append(a)
            cols.append(b)
    n = int(starts[-1])
    index = (np.concatenate(rows), np.concatenate(cols))
    matrix = coo_array((np.concatenate(entries), index), shape=(n, n)).tocsc()
    return (matrix if sparse else matrix.toarray()), blocks.eta[:n].copy()
