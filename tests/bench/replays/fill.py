"""Fill-in of R by the ordering of the final system: by blocks or by elements, with and without the constraint.

The constraint is the paper's (§5.2): the last pose is eliminated last, the landmarks seen from it right before it.
What "recently observed" means is a choice: from the last pose alone, or from the last few.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csc_matrix, tril

from factorbus.solver.sparse.cholmod import require_cholmod
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import analyze

from .columns import ENDS, I64, Columns

F32 = NDArray[np.float32]

RECENT = 10  # poses, for the wider reading of "recently observed"
_TANGENT = {"se2": 3, "se3": 6, "point2": 2, "point3": 3}


def orderings(columns: Columns, pixels: int = 0) -> tuple[dict[str, Any], dict[str, F32]]:
    """Numbers by name, and pictures (pixels, pixels) of the patterns, as the share of nonzeros of each cell.

    nnz: nonzeros of R for
        blocks, blocks_constrained       our minimum degree on the block graph
        blocks_recent                    the same, constraint with the landmarks seen from the last RECENT poses
        elements, elements_constrained   the same on the graph of scalars
        cholmod_amd                      CHOLMOD's AMD on the scalars, R counted by CHOLMOD
    stored_by_blocks: nonzeros of `blocks` when diagonal blocks are kept full.
    """
    dims, rows, cols, column = block_pattern(columns)
    group, wide = (constraint_groups(columns, column, len(dims), recent) for recent in (1, RECENT))
    scalar_rows, scalar_cols, owner = scalar_pattern(dims, rows, cols)
    ones = np.ones(len(owner), np.int64)
    pattern = _symmetric(scalar_rows, scalar_cols, len(owner))
    perms: dict[str, I64] = {}
    for name, constraint in (("blocks", None), ("blocks_constrained", group)):
        perms[name] = _scalars_of(order(dims, rows, cols, constraint), dims)
        perms[f"{name.replace('blocks', 'elements')}"] = order(
            ones, scalar_rows, scalar_cols, None if constraint is None else group[owner]
        )
    perms["blocks_recent"] = _scalars_of(order(dims, rows, cols, wide), dims)
    nnz = {name: _nnz(dims, rows, cols, perm, owner, name) for name, perm in perms.items()}
    factors = {name: _cholmod_pattern(pattern, perm) for name, perm in perms.items()}
    for name, factor in factors.items():
        if factor.nnz != nnz[name]:
            raise RuntimeError(f"{name}: R has {nnz[name]} nonzeros by our analysis and {factor.nnz} by CHOLMOD's")
    amd = require_cholmod().analyze(pattern, mode="simplicial", ordering_method="amd")
    amd.cholesky_inplace(pattern)
    nnz["cholmod_amd"] = int(amd.L().nnz)
    numbers = {
        "scalars": len(owner),
        "variables": len(dims),
        "recent_landmarks": [int((groups == 1).sum()) for groups in (group, wide)],
        "nnz_lambda": int((pattern.nnz + len(owner)) // 2),
        "nnz": nnz,
        "stored_by_blocks": int(nnz["blocks"] + (dims * (dims - 1) // 2).sum()),
        "against_cholmod": nnz["blocks"] / nnz["cholmod_amd"],
        "price_of_constraint": nnz["blocks_constrained"] / nnz["blocks"] - 1,
        "price_of_recent": nnz["blocks_recent"] / nnz["blocks"] - 1,
    }
    pictures = {}
    if pixels:
        pictures["lambda"] = picture(pattern, pixels)
        pictures |= {name: picture(factor.T, pixels) for name, factor in factors.items()}
    return numbers, pictures


def block_pattern(columns: Columns) -> tuple[I64, I64, I64, dict[str, I64]]:
    """(dims, rows, cols, column) of Λ: free variables in order of arrival, each pair of blocks once, rows <= cols.

    column: per kind, the block column of each row of the graph's variables; -1 where it is fixed.
    """
    column, dims = _block_columns(columns)
    pairs = [np.repeat(np.arange(len(dims))[:, None], 2, axis=1)]
    for f in columns.factors:
        a, b = ENDS[f.kind]
        ends = np.stack((column[a][f.first], column[b][f.second]), axis=1)
        pairs.append(np.sort(ends[(ends >= 0).all(axis=1)], axis=1))
    rows, cols = np.unique(np.concatenate(pairs), axis=0).T.copy()
    return dims, rows, cols, column


def constraint_groups(columns: Columns, column: dict[str, I64], count: int, recent: int) -> I64:
    """Groups (count,) of the ordering: 2 the last pose, 1 landmarks seen from the last `recent` poses, 0 the rest."""
    group = np.zeros(count, np.int64)
    poses = max((kind for kind in columns.keys if kind.startswith("se")), key=lambda kind: len(columns.keys[kind]))
    last = columns.arrival[poses][-recent:]
    for f in columns.factors:
        a, b = ENDS[f.kind]
        if b.startswith("point") and a == poses:
            seen = column[b][f.second[np.isin(f.first, last)]]
            group[seen[seen >= 0]] = 1
    group[column[poses][last[-1]]] = 2
    return group


def scalar_pattern(dims: I64, rows: I64, cols: I64) -> tuple[I64, I64, I64]:
    """(rows, cols, owner): the upper triangle of Λ by scalars, and the variable of each scalar."""
    start = np.concatenate(([0], np.cumsum(dims)))
    shapes, parts = np.stack((dims[rows], dims[cols]), axis=1), []
    for height, width in np.unique(shapes, axis=0).tolist():
        mine = np.flatnonzero((shapes == (height, width)).all(axis=1))
        r = start[rows[mine]][:, None, None] + np.arange(height)[None, :, None] + np.zeros((1, 1, width), np.int64)
        c = start[cols[mine]][:, None, None] + np.arange(width)[None, None, :] + np.zeros((1, height, 1), np.int64)
        parts.append(np.stack((r.ravel(), c.ravel()), axis=1))
    both = np.concatenate(parts)
    both = both[both[:, 0] <= both[:, 1]]
    return both[:, 0].copy(), both[:, 1].copy(), np.repeat(np.arange(len(dims)), dims)


def picture(matrix: Any, pixels: int) -> F32:
    """The share of nonzeros in each cell of a grid over the matrix."""
    entries = coo_array(matrix)
    n = entries.shape[0]
    side = min(pixels, n)
    counts, edges, _ = np.histogram2d(entries.row, entries.col, bins=side, range=((0, n), (0, n)))
    lengths, _ = np.histogram(np.arange(n), bins=edges)  # cells differ by a row where n is no multiple
    return (counts / np.outer(lengths, lengths)).astype(np.float32)


def _block_columns(columns: Columns) -> tuple[dict[str, I64], I64]:
    """Per kind the block column of each row, -1 when fixed; and the sizes.  Poses and points mixed as they arrive."""
    stamps, kinds, rows = [], [], []
    for code, (kind, arrival) in enumerate(columns.arrival.items()):
        free = ~np.isin(arrival, columns.fixed.get(kind, np.empty(0, np.int64)))
        when = np.searchsorted(columns.until[kind], np.arange(len(arrival)), side="right") - 1
        stamps.append(when[free])
        kinds.append(np.full(int(free.sum()), code))
        rows.append(arrival[free])
    stamp, kind_of, row_of = (np.concatenate(part) for part in (stamps, kinds, rows))
    in_turn = np.lexsort((np.arange(len(stamp)), kind_of, stamp))
    names = list(columns.arrival)
    column = {kind: np.full(len(keys), -1, np.int64) for kind, keys in columns.keys.items()}
    dims = np.array([_TANGENT[names[code]] for code in kind_of[in_turn]], np.int64)
    for code, kind in enumerate(names):
        at = np.flatnonzero(kind_of[in_turn] == code)
        column[kind][row_of[in_turn][at]] = at
    return column, dims


def _scalars_of(perm: I64, dims: I64) -> I64:
    """An order of blocks as an order of scalars."""
    start = np.concatenate(([0], np.cumsum(dims)[:-1]))
    ends = np.cumsum(dims[perm])
    return np.repeat(start[perm] - (ends - dims[perm]), dims[perm]) + np.arange(int(ends[-1]))


def _nnz(dims: I64, rows: I64, cols: I64, perm: I64, owner: I64, name: str) -> int:
    """Nonzeros of R by our own analysis."""
    if name.startswith("blocks"):
        first = np.concatenate(([0], np.cumsum(dims)[:-1]))
        blocks = owner[perm]
        return analyze(dims, rows, cols, blocks[np.isin(perm, first)]).nnz_r
    scalar_rows, scalar_cols, _ = scalar_pattern(dims, rows, cols)
    return analyze(np.ones(len(owner), np.int64), scalar_rows, scalar_cols, perm).nnz_r


def _symmetric(rows: I64, cols: I64, n: int) -> csc_matrix:
    """A positive definite matrix with the pattern of Λ; its numbers mean nothing."""
    upper = coo_array((np.where(rows == cols, 0.0, -1.0), (rows, cols)), shape=(n, n))
    full = csc_array(upper + upper.T)
    degree = np.asarray(abs(full).sum(axis=1)).ravel()
    diagonal = coo_array((degree + 1.0, (np.arange(n), np.arange(n))), shape=(n, n))
    return csc_matrix(full + diagonal)


def _cholmod_pattern(pattern: csc_matrix, perm: I64) -> csc_array:
    """L of the permuted pattern, by CHOLMOD."""
    lower = csc_matrix(tril(pattern[perm][:, perm]))
    lower.sort_indices()
    factor = require_cholmod().analyze(lower, mode="simplicial", ordering_method="natural")
    factor.cholesky_inplace(lower)
    return csc_array(factor.L())
