"""R in block rows, and Λ in blocks, as sparse matrices, made without a loop: fast enough to look after every step."""

import numpy as np
from naive.solver_parts import graph_in, system_in
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from factorbus.solver.kernels.inc_l import block_rows as br
from factorbus.solver.kernels.model import layout as at

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


def sparse_r(rows) -> tuple[csr_array, I64, F64]:
    """(R, the scalar of the insertion order that is eliminated k-th, d), as `block_rows.dense_r` gives them; the
    structure is checked on the way."""
    rec = rows.rec[: rows.counts[br.POSITIONS]]
    dim, scalar, n = rec[:, br.DIM], rec[:, br.SCALAR], int(rows.counts[br.SCALARS])
    row, held = _lists(rec, rows.index)
    assert_is_a_tree(rec, row, held)
    order = np.empty(n, np.int64)
    order[_ranges(scalar, dim)] = _ranges(rec[:, br.START], dim)
    # One scalar line of R after the other: columns of its block row, and where they are in `numbers`.
    columns, width = _ranges(scalar[held], dim[held]), np.bincount(row, weights=dim[held]).astype(np.int64)
    assert (width == rec[:, br.WIDTH]).all()
    assert (width <= rec[:, br.LD]).all()
    owner = np.repeat(np.arange(len(rec)), dim)
    line = np.arange(len(owner)) - np.repeat(np.cumsum(dim) - dim, dim)
    where = _ranges(rec[owner, br.ROW] + line * rec[owner, br.LD], width[owner])
    first = np.cumsum(width) - width
    across = columns[_ranges(first[owner], width[owner])]
    down = np.repeat(scalar[owner] + line, width[owner])
    numbers = rows.numbers[where]
    assert (numbers[across < down] == 0.0).all()
    keep = across >= down
    R = csr_array(coo_array((numbers[keep], (down[keep], across[keep])), shape=(n, n)))
    return R, order, rows.d[:n].copy()


def sparse_lambda(solver) -> tuple[csr_array, F64]:
    """(Λ, η) as the solver holds them, in insertion order."""
    graph, blocks = graph_in(solver), system_in(solver).blocks
    dims = graph.dims[: graph.counts[at.COLUMNS]]
    starts = np.concatenate(([0], np.cumsum(dims)))
    rows, cols, offsets = blocks.rows, blocks.cols, blocks.offsets
    parts: list[tuple[F64, I64, I64]] = []
    shapes = np.stack((dims[rows], dims[cols]), axis=1)
    for height, width in np.unique(shapes, axis=0).tolist():
        mine = np.flatnonzero((shapes == (height, width)).all(axis=1))
        i, j = np.divmod(np.arange(height * width), width)
        r, c = starts[rows[mine], None] + i, starts[cols[mine], None] + j
        numbers = blocks.data[offsets[mine, None] + np.arange(height * width)]
        parts.append((numbers.ravel(), r.ravel(), c.ravel()))
        turned = (rows[mine] != cols[mine])[:, None] & np.ones(height * width, bool)
        parts.append((numbers[turned], c[turned], r[turned]))
    numbers, r, c = (np.concatenate(column) for column in zip(*parts, strict=True))
    n = int(starts[-1])
    return csr_array(coo_array((numbers, (r, c)), shape=(n, n))), blocks.eta[:n].copy()


def assert_is_a_tree(rec: I64, row: I64, held: I64) -> None:
    """Every list is ascending and begins with its own position, and what is behind its parent is in the parent's."""
    count = rec[:, br.COUNT]
    first = np.cumsum(count) - count
    assert (held[first] == np.arange(len(rec))).all()
    same = row[1:] == row[:-1]
    assert (held[1:][same] > held[:-1][same]).all()
    parent = np.where(count > 1, held[np.minimum(first + 1, len(held) - 1)], -1)
    behind = np.ones(len(held), bool)
    behind[first] = False
    keys = row * len(rec) + held  # ascending
    wanted = parent[row[behind]] * len(rec) + held[behind]
    assert (keys[np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)] == wanted).all()


def _lists(rec: I64, index: I64) -> tuple[I64, I64]:
    """(row, position) of every block of R, row by row."""
    count = rec[:, br.COUNT]
    return np.repeat(np.arange(len(rec)), count), index[_ranges(rec[:, br.LIST], count)]


def _ranges(start: I64, length: I64) -> I64:
    """start[0], start[0] + 1, ... (length[0] of them), start[1], ..."""
    ends = np.cumsum(length)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) + np.repeat(start - (ends - length), length)
