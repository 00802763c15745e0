"""Rotations averaged together with places, where what has been seen again says more than odometry.  MATH §12.4.

    min Σ w ‖Rᵢ Z − Rⱼ‖² + Σ h ‖tⱼ − tᵢ − Rᵢ z‖²   over matrices and places; of these only the rotations are kept

Both are linear in the two.  Row r of the matrices and coordinate r of the places are apart from the others: unknowns of
d + 1 numbers, the same normal equations for each r.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.starts.normal import Normal, summed
from factorbus.solver.starts.relations import Directions, Relations
from factorbus.solver.starts.rotation_matrices import nearest_rotations
from factorbus.solver.starts.rotations import direction_terms


def rotations_with_places(
    relations: Relations,
    directions: Directions,
    known: np.ndarray,
    pose: np.ndarray,
    R: F64,
    t: F64,
    rank: I64 | None = None,
) -> F64 | None:
    """Rotations (N, d, d) of all nodes; None: nothing holds some of them.

    known, pose (N,): nodes that stay at R (N, d, d) and t (N, d); those that have a rotation.
    rank (N,): the order in which nodes are eliminated; None: any.
    """
    used = relations.where(~(known[relations.a] & known[relations.b]))
    free = np.zeros(known.size, bool)
    free[used.a] = free[used.b] = True
    free &= ~known
    count, d = int(np.count_nonzero(free)), R.shape[1]
    number = np.where(free, np.cumsum(free) - 1, -1)
    i, j = number[used.a], number[used.b]
    both = (i >= 0) & (j >= 0)
    directions = directions.where(number[directions.b] >= 0)
    A, B = _ends(used)
    (At, Bt), W = (A.transpose(0, 2, 1), B.transpose(0, 2, 1)), _weights(used, d)[:, :, None]
    WA, WB = W * A, W * B
    across, there = direction_terms(directions, number, count)
    diagonal = summed(i, At @ WA, count) + summed(j, Bt @ WB, count)
    diagonal[:, :d, :d] += across
    diagonal[np.flatnonzero(~pose[free]), :d, :d] = np.eye(d)  # a point has no rotation
    normal = Normal(count, d + 1, i[both], j[both], None if rank is None else rank[free])
    if not normal.factorize(diagonal, -(At @ WB)[both]):
        return None
    here = np.concatenate([R, t[:, :, None]], axis=2)  # (N, d, d + 1): row r is what is known of row r
    known_a = np.where((i < 0)[:, None, None], here[used.a], 0.0) @ At
    known_b = np.where((j < 0)[:, None, None], here[used.b], 0.0) @ Bt
    right = summed(i, known_b @ WA, count) + summed(j, known_a @ WB, count)
    right[:, :, :d] += there
    rows = np.stack([normal.solve(right[:, row]) for row in range(d)], axis=1)
    made = R.copy()
    made[free & pose] = nearest_rotations(rows[pose[free], :, :d])
    return made


def _ends(used: Relations) -> tuple[F64, F64]:
    """A, B (m, d + 1, d + 1): the residual of a relation is B y_b − A y_a, with y = (row of R, coordinate of t)."""
    m, d = used.t.shape
    A, B = np.zeros((m, d + 1, d + 1)), np.zeros((m, d + 1, d + 1))
    A[:, :d, :d], A[:, d, :d], A[:, d, d] = used.R.transpose(0, 2, 1), used.t, 1.0
    B[:, :d, :d], B[:, d, :d], B[:, d, d] = np.eye(d), used.lever, 1.0
    return A, B


def _weights(used: Relations, d: int) -> F64:
    """(m, d + 1): what the rows of the residuals count."""
    t_information = np.trace(used.t_information, axis1=1, axis2=2) / d
    return np.concatenate([np.repeat(used.turn[:, None], d, axis=1), t_information[:, None]], axis=1)
