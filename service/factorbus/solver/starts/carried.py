"""What sees without measuring a place: points and features that go along with the pose that saw them first.

MATH §12.3."""

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.starts.relations import PoseSpace, Relations
from factorbus.solver.starts.rotation_matrices import turned_rays

# What such a tie counts for beside rays to the same point.
_WEAK = 1e-4


def tied(graph: FactorGraph, space: PoseSpace, relations: Relations, R: F64, t: F64) -> Relations:
    """`relations`, and for each point whose place no factor measures: as the pose that saw it first sees it now.

    R (N, d, d), t (N, d): as they are.
    """
    count, d = int(graph.counts[at.VARIABLES]), space.dim
    kinds = graph.var[:count, at.V_KIND]
    free = np.concatenate([[False], (kinds == space.point) & (graph.var[:count, at.V_COLUMN] >= 0)])
    if not free.any():
        return relations
    whole = np.linalg.eigvalsh(relations.t_information)[:, 0] > 1e-9 * np.trace(
        relations.t_information, axis1=1, axis2=2
    )
    measured = np.zeros(count + 1, bool)
    measured[relations.b[whole & (relations.turn == 0.0)]] = True
    points, poses, rows = _first_seen(graph, free & ~measured, np.concatenate([[False], kinds == space.pose]))
    if not points.size:
        return relations
    m, strength = points.size, np.trace(relations.t_information, axis1=1, axis2=2)
    strongest = np.zeros(count + 1)
    np.maximum.at(strongest, relations.b, strength)
    usual = float(np.median(strength)) if strength.size else 1.0
    weight = np.where(strongest[points] > 0.0, _WEAK * strongest[points], usual)
    seen = (R[poses].transpose(0, 2, 1) @ (t[points] - t[poses])[:, :, None])[:, :, 0]
    nothing = np.zeros((m, d, d))
    ties = Relations(
        poses, points, nothing, seen, np.zeros(m), weight[:, None, None] * np.eye(d),
        np.zeros((m, *relations.couple.shape[1:])), np.zeros((m, d)), rows, np.zeros(m, np.int64), np.ones(m),
    )  # fmt: skip
    return relations.joined(ties)


def carry(graph: FactorGraph, space: PoseSpace, before: tuple[F64, F64], after: tuple[F64, F64], values: F64) -> None:
    """Features of inverse depth go along with the pose that saw them first.

    before, after: rotations (N, d, d) and places (N, d) of all nodes as they are, and as they are in `values`.
    """
    if space.dim == 2:
        return
    count = int(graph.counts[at.VARIABLES])
    kinds = graph.var[:count, at.V_KIND]
    free = np.concatenate([[False], (kinds == at.IDP) & (graph.var[:count, at.V_COLUMN] >= 0)])
    features, poses, _ = _first_seen(graph, free, np.concatenate([[False], kinds == space.pose]))
    if not features.size:
        return
    start = graph.var[features - 1, at.V_AT]
    at_now = graph.values[start[:, None] + np.arange(3)]
    (R, t), (to_R, to_t) = before, after
    turn = to_R[poses] @ R[poses].transpose(0, 2, 1)
    values[start[:, None] + np.arange(3)] = to_t[poses] + (turn @ (at_now - t[poses])[:, :, None])[:, :, 0]
    angles = graph.values[start[:, None] + 3 + np.arange(2)]
    values[start[:, None] + 3 + np.arange(2)] = turned_rays(angles, turn)


def _first_seen(graph: FactorGraph, wanted: np.ndarray, pose: np.ndarray) -> tuple[I64, I64, I64]:
    """(nodes that are wanted, the first pose that a factor joins each to, the row of that factor)."""
    fac = graph.fac[: graph.counts[at.FACTORS]]
    i, j = fac[:, at.F_I] + 1, fac[:, at.F_J] + 1
    rows = np.flatnonzero((fac[:, at.F_J] >= 0) & pose[i] & wanted[j])
    nodes, first = np.unique(j[rows], return_index=True)
    return nodes, i[rows[first]], rows[first]
