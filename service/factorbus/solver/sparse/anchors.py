"""Is every variable determined by something?  Checked before a factorization would fail, or survive by luck.  MATH §7.

Variables that earlier steps took in are determined.  A new one is when it is fixed, has a prior, is joined to a
determined pose by a between factor, seen from a determined pose, or fixed by several factors on what is determined.
Those that this finds are determined; the others ("suspects") may still be, which only the numbers can tell:
`find_loose` asks the factor of Λ.
"""

from collections.abc import Callable

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph, Mark
from factorbus.solver.graph.factor_rows import rows_of_factors
from factorbus.solver.graph.linearized import linearized_factor
from factorbus.solver.kernels.graph.initialize import join, reach
from factorbus.solver.kernels.graph.observability import mark_determined
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import ABSOLUTE, OF_FAMILY
from factorbus.solver.sparse.blocks import HessianBlocks

# A variance this many times what the variable's own factors alone would leave is no longer a number.
LOOSE = 1e12
# Scalars of variables that are looked at together without the rest.
_TOGETHER = 1000
# The share of its diagonal that the least known direction of a linear factor has to keep, for it to determine.
_ROOM = 1e-8
_NONE = np.empty(0, np.int64)


def find_undetermined(graph: FactorGraph, since: Mark) -> I64:
    """The free variables after `since` that neither a chain of factors nor several on determined ones determine."""
    first, last = since[at.VARIABLES], int(graph.counts[at.VARIABLES])
    if first == last:
        return _NONE
    determined = (graph.var[first:last, at.V_COLUMN] < 0).astype(np.int64)
    factors = since[at.FACTORS], int(graph.counts[at.FACTORS])
    arenas = graph.var, graph.fac, graph.values, graph.payload
    while reach(False, first, *factors, graph.array_table, determined) >= 0:
        if not mark_determined(first, *factors, *arenas, determined) and not _mark_together(graph, since, determined):
            break
    else:
        return _NONE
    return first + np.flatnonzero(determined == 0)


def _mark_together(graph: FactorGraph, since: Mark, determined: I64) -> bool:
    """Set to 1 in `determined` what one linear factor, or one of an own kind, determines with several variables
    together, as a marginal of the map's anchor does, or an inertial one; gives whether there is any."""
    first, found = since[at.VARIABLES], False
    fac = graph.fac[since[at.FACTORS] : graph.counts[at.FACTORS]]
    for row in (since[at.FACTORS] + np.flatnonzero(OF_FAMILY[fac[:, at.F_KIND]])).tolist():
        loose = [v for v in graph.ends_of(row) if v >= first and not determined[v - first]]
        scalars = int(graph.dims[graph.var[loose, at.V_COLUMN]].sum())
        if len(loose) > 1 and graph.kind_of(row).dim >= scalars:
            linear = linearized_factor(graph, row)
            J = np.hstack([linear.jacobian_of(v) for v in loose])
            information = J.T @ linear.W @ J
            D = np.sqrt(information.diagonal())
            if (D > 0.0).all() and np.linalg.eigvalsh(information / D / D[:, None])[0] > _ROOM:
                determined[np.array(loose) - first], found = 1, True
    return found


def find_unanchored(graph: FactorGraph, since: Mark) -> int:
    """A variable after `since` that no factors join, however indirectly, to one that is fixed or has a prior; or −1.

    A linear factor, or one of an own kind, may say where its variables are in the map: the numbers tell.
    """
    first, last = since[at.VARIABLES], int(graph.counts[at.VARIABLES])
    factors = since[at.FACTORS], int(graph.counts[at.FACTORS])
    anchored = (graph.var[first:last, at.V_COLUMN] < 0).astype(np.int64)
    fac = graph.fac[factors[0] : factors[1]]
    linear = rows_of_factors(fac, np.flatnonzero(np.isin(fac[:, at.F_KIND], (at.LINEAR, at.OWN))))
    told = (fac[:, at.F_J] < 0) | ABSOLUTE[fac[:, at.F_KIND]]
    anchors = np.concatenate([fac[told, at.F_I], fac[linear, at.F_I], fac[linear, at.F_J]])
    anchored[anchors[anchors >= first] - first] = 1
    return int(join(first, last, *factors, graph.fac, anchored, np.empty(last - first + 1, np.int64)))


def find_loose(graph: FactorGraph, blocks: HessianBlocks, suspects: I64, solve: Callable[[F64], F64]) -> int:
    """The suspect that Λ leaves free to move, or −1.

    `solve` gives Λ⁻¹ b.  With D = diag Λ and signs s on the suspects, y = D½ Λ⁻¹ D½ s is of the size of the inverse of
    the smallest eigenvalue of the normalized matrix, along the direction that is free.
    """
    scalars = int(graph.counts[at.SCALARS])
    rows = graph.var[suspects]
    probe, scale = np.zeros(scalars), np.zeros(scalars)
    signs = np.random.default_rng(1).choice((-1.0, 1.0), scalars)
    for row in rows:
        dim = int(graph.dims[row[at.V_COLUMN]])
        start, diagonal = int(row[at.V_SCALAR]), int(row[at.V_DIAGONAL])
        scale[start : start + dim] = np.sqrt(blocks.data[diagonal : diagonal + dim * dim : dim + 1])
    np.multiply(scale, signs, out=probe)
    answer = np.abs(scale * solve(probe))
    loosest = int(np.argmax(np.where(np.isfinite(answer), answer, np.inf)))
    if answer[loosest] <= LOOSE:
        return -1
    return int(suspects[np.searchsorted(rows[:, at.V_SCALAR], loosest, side="right") - 1])


def find_loose_by_themselves(graph: FactorGraph, blocks: HessianBlocks, suspects: I64) -> tuple[int, I64]:
    """The suspect that is free to move where nothing else moves, or −1; and the suspects of which this does not tell.

    All other variables are held without them, so Λ is positive definite where its part of the suspects is: an
    eigenvalue of that part, normalized, is no more than 1 / `LOOSE`.  Told where no more than `_TOGETHER` scalars hang
    together.
    """
    place = np.full(int(graph.counts[at.COLUMNS]), -1)
    columns = graph.var[suspects, at.V_COLUMN]
    place[columns] = np.arange(suspects.size)
    among = np.flatnonzero((place[blocks.rows] >= 0) & (place[blocks.cols] >= 0))
    row, col, offset = place[blocks.rows[among]], place[blocks.cols[among]], blocks.offsets[among]
    group = _groups(suspects.size, row, col)
    dims, untold = graph.dims[columns], []
    for g in range(int(group.max(initial=-1)) + 1):
        members = np.flatnonzero(group == g)
        size = int(dims[members].sum())
        if size > _TOGETHER:
            untold.append(suspects[members])
            continue
        start = np.zeros(suspects.size, np.int64)
        start[members] = np.cumsum(dims[members]) - dims[members]
        Lambda = np.zeros((size, size))
        for k in np.flatnonzero(group[row] == g).tolist():
            a, b, da, db = start[row[k]], start[col[k]], dims[row[k]], dims[col[k]]
            block = blocks.data[offset[k] : offset[k] + da * db].reshape(da, db)
            Lambda[a : a + da, b : b + db], Lambda[b : b + db, a : a + da] = block, block.T
        D = np.sqrt(np.maximum(Lambda.diagonal(), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(Lambda / D / D[:, None])
        if values[0] <= 1.0 / LOOSE:
            loosest = int(np.argmax(np.abs(vectors[:, 0])))
            return int(suspects[members[np.searchsorted(start[members], loosest, side="right") - 1]]), _NONE
    return -1, np.concatenate([_NONE, *untold])


def _groups(count: int, row: I64, col: I64) -> I64:
    """The number of the group that each of `count` variables is in, which pairs row, col join."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    _, group = connected_components(coo_array((np.ones(row.size), (row, col)), shape=(count, count)), directed=False)
    return np.asarray(group, np.int64)
