"""Rotation averaging: the chordal relaxation.  MATH §12.2.

    min Σ w ‖Rᵢ Z − Rⱼ‖²   over matrices, not rotations; then each goes to the nearest rotation

The rows of the matrices are apart from each other, with the same normal equations.  In the plane a matrix is a complex
number, and the second row follows from the first.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.starts.normal import Normal, summed
from factorbus.solver.starts.relations import Directions, Relations
from factorbus.solver.starts.rotation_matrices import nearest_rotations


def averaged_rotations(
    relations: Relations, directions: Directions, known: np.ndarray, R: F64, rank: I64 | None = None
) -> F64 | None:
    """Rotations (N, d, d) of all nodes; None: nothing holds some of them.

    known (N,): those that stay what they are in R (N, d, d).  Every node that is not known is one of a relation with a
    `turn`; relations without are not looked at.  rank (N,): the order in which nodes are eliminated; None: any.
    """
    used = relations.where((relations.turn > 0.0) & ~(known[relations.a] & known[relations.b]))
    number, (count, d) = np.where(known, -1, np.cumsum(~known) - 1), (int(np.count_nonzero(~known)), R.shape[1])
    if not count:
        return R
    directions = directions.where(number[directions.b] >= 0)
    i, j, w = number[used.a], number[used.b], used.turn
    both = (i >= 0) & (j >= 0)
    across, there = direction_terms(directions, number, count)
    diagonal = (summed(i, w, count) + summed(j, w, count))[:, None, None] * np.eye(d) + across
    normal = Normal(count, d, i[both], j[both], None if rank is None else rank[~known])
    if not normal.factorize(diagonal, (-w[:, None, None] * used.R)[both]):
        return None
    right = _right(used, i, j, R, count) + there
    rows = [normal.solve(right[:, row]) for row in range(1 if d == 2 else d)]
    if d == 2:  # (c, −s), and so (s, c)
        rows.append(np.stack([-rows[0][:, 1], rows[0][:, 0]], axis=1))
    made = R.copy()
    made[~known] = nearest_rotations(np.stack(rows, axis=1))
    return made


def direction_terms(directions: Directions, number: I64, count: int) -> tuple[F64, F64]:
    """Σ w s sᵀ and Σ w g sᵀ (n, d, d), by the unknown: R s = g is s · r = g for each row r."""
    w, s, g = directions.weight[:, None, None], directions.seen[:, None, :], directions.there[:, :, None]
    into = number[directions.b]
    return summed(into, w * s.transpose(0, 2, 1) * s, count), summed(into, w * g * s, count)


def _right(used: Relations, i: I64, j: I64, R: F64, count: int) -> F64:
    """(n, d, d): what relations to known nodes put on the right; row r of it belongs to row r of the matrices."""
    wide = used.turn[:, None, None]
    to_b = summed(np.where(i < 0, j, -1), wide * (R[used.a] @ used.R), count)
    return to_b + summed(np.where(j < 0, i, -1), wide * (R[used.b] @ used.R.transpose(0, 2, 1)), count)
