"""Places of poses and points, a linear problem once the rotations are known.  MATH §12.3."""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.starts.normal import Normal, summed
from factorbus.solver.starts.relations import Relations
from factorbus.solver.starts.rotation_matrices import angles_of, residuals_of

# The information of a prior at its place, as a share of a node's own, where nothing else determines it.
_PRIOR_SHARE = 1e-6
_LEAST = 1e-300


def solve_positions(relations: Relations, R: F64, t: F64, known: np.ndarray, rank: I64 | None = None) -> F64:
    """Places (N, d) of all nodes, of least χ² with these rotations (N, d, d).

    known (N,): those that stay where they are in t (N, d); so do those that no relation names.  rank (N,): the order
    in which nodes are eliminated; None: any.
    """
    used = relations.where(~(known[relations.a] & known[relations.b]))
    free = np.zeros(known.size, bool)
    free[used.a] = free[used.b] = True
    free &= ~known
    count, d = int(np.count_nonzero(free)), t.shape[1]
    if not count:
        return t
    number = np.where(free, np.cumsum(free) - 1, -1)
    i, j = number[used.a], number[used.b]
    both = (i >= 0) & (j >= 0)
    normal = Normal(count, d, i[both], j[both], None if rank is None else rank[free])
    turn, seen = R[used.a], used.t[:, :, None]
    W = turn @ used.t_information @ turn.transpose(0, 2, 1)
    v = (turn @ seen - R[used.b] @ used.lever[:, :, None])[:, :, 0]
    coupled = _coupled(used, R)
    diagonal = summed(i, W, count) + summed(j, W, count)
    force = (W @ (v + t[used.a] * (i < 0)[:, None] - t[used.b] * (j < 0)[:, None])[:, :, None])[:, :, 0] - coupled
    right = summed(j, force, count) - summed(i, force, count)
    if not normal.factorize(diagonal, -W[both]):
        least = _PRIOR_SHARE * np.trace(diagonal, axis1=1, axis2=2)
        least = np.maximum(least, 1e-9 * float(least.max()) + _LEAST)
        if not normal.factorize(diagonal + least[:, None, None] * np.eye(d), -W[both]):
            return t
        right += least[:, None] * t[free]
    made = t.copy()
    made[free] = normal.solve(right)
    return made


def distances(relations: Relations, R: F64, t: F64) -> F64:
    """rᵀ Ω r of each relation, without what couples rotation and translation: what a loss goes by."""
    turn = R[relations.a]
    v = (turn @ relations.t[:, :, None] - R[relations.b] @ relations.lever[:, :, None])[:, :, 0]
    off = (turn.transpose(0, 2, 1) @ (t[relations.b] - t[relations.a] - v)[:, :, None])[:, :, 0]
    angle = angles_of((turn @ relations.R).transpose(0, 2, 1) @ R[relations.b])
    return np.einsum("mi,mij,mj->m", off, relations.t_information, off) + relations.turn * angle**2


def _coupled(used: Relations, R: F64) -> F64:
    """What the residuals of the rotations, which are what they are, push translations with."""
    with_it = np.flatnonzero((used.couple != 0.0).any(axis=(1, 2)))
    coupled = np.zeros(used.t.shape)
    if with_it.size:
        a, b, Z = R[used.a[with_it]], R[used.b[with_it]], used.R[with_it]
        r = residuals_of((a @ Z).transpose(0, 2, 1) @ b)
        coupled[with_it] = (a @ used.couple[with_it] @ r[:, :, None])[:, :, 0]
    return coupled
