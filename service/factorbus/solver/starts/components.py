"""Poses that relative poses join, and how such a component lies in the map if none of them says it.  MATH §12.5."""

import numpy as np

from factorbus.solver.kernels.graph.initialize import join
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.starts.relations import Directions, Relations
from factorbus.solver.starts.rotation_matrices import nearest_rotations
from factorbus.solver.starts.translations import solve_positions

# What the rotations that are there count for beside what is measured: where that leaves a direction open.
_PRESENT = 1e-12


def components_of(relations: Relations, held: np.ndarray) -> I64:
    """(N,): 0 for the nodes that relations join to a held one, else the number of another of them, the same for all."""
    fac = np.zeros((len(relations), at.F_WIDTH), np.int64)
    fac[:, at.F_I], fac[:, at.F_J] = relations.a, relations.b
    root = np.empty(held.size + 1, np.int64)
    join(0, held.size, 0, len(fac), fac, held.astype(np.int64), root)
    while True:
        further = root[root]
        if (further == root).all():
            return root[1:]
        root = further


def docked(
    members: np.ndarray, relations: Relations, directions: Directions, R: F64, t: F64, known: np.ndarray, now: F64
) -> F64 | None:
    """The rotation (d, d) that brings a component to where it lies in the map.

    members (N,): its poses, whose R are relative to each other only.  known (N,): nodes whose place t is that in the
    map.  now (N, d, d): present rotations.  None: nothing says it.
    """
    inside = relations.where(members[relations.a] | (members[relations.b] & (relations.a == 0)))
    own = inside.where(inside.a != 0)
    points = np.zeros(members.size, bool)
    points[own.b] = True
    points &= ~members
    first = int(np.flatnonzero(members)[0])
    local = t.copy()
    local[first] = 0.0
    stays = ~(members | points)
    stays[first] = True
    local = solve_positions(own, R, local, stays)
    there, here, weight = _pairs(inside, points & known, members, R, t, local)
    M = np.zeros(R.shape[1:])
    if weight.size > 1:
        share = weight / weight.sum()
        M += ((there - share @ there) * weight[:, None]).T @ (here - share @ here)
    of = members[directions.b]
    seen = (R[directions.b[of]] @ directions.seen[of][:, :, None])[:, :, 0]
    M += (directions.there[of] * directions.weight[of][:, None]).T @ seen
    if not np.linalg.norm(M) > 0.0:
        return None
    present = (now[members] @ R[members].transpose(0, 2, 1)).sum(axis=0)
    return nearest_rotations((M / np.linalg.norm(M) + _PRESENT * present / members.sum())[None])[0]


def _pairs(
    inside: Relations, points: np.ndarray, members: np.ndarray, R: F64, t: F64, local: F64
) -> tuple[F64, F64, F64]:
    """Places in the map, the same in the component, and what each pair weighs: antennas, and points that are known."""
    fixes = inside.where((inside.a == 0) & members[inside.b] & (inside.turn == 0.0))
    antenna = local[fixes.b] + (R[fixes.b] @ fixes.lever[:, :, None])[:, :, 0]
    seen = np.flatnonzero(points)
    weight = np.trace(fixes.t_information, axis1=1, axis2=2)
    each = np.full(seen.size, float(np.median(weight)) if weight.size else 1.0)
    there = np.concatenate([fixes.t, t[seen]])
    return there, np.concatenate([antenna, local[seen]]), np.concatenate([weight, each])
