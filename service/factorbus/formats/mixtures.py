"""Edges that may be of two kinds at once, as Vertigo writes them: the better component of a mixture.

EDGE_SE2_MAXMIX has the measurement with Ω, or a null hypothesis with the same measurement and w Ω.  Vertigo takes
whichever is more likely at the values it is at, and so do we at those of the file: the null hypothesis where

    d/2 ln w − w m  >  −m,      m = rᵀ Ω r, d its dimension

An edge of poses without a value is taken as measured.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factorbus.formats.assemble import EdgeColumns, VertexColumns
from factorbus.formats.edges import Lead
from factorbus.formats.errors import refuse_first
from factorbus.formats.left_out import LeftOut
from factorbus.formats.rotations import compose_poses, inverse_poses
from factorbus.formats.weights import unpacked_symmetric
from factorbus.proto.arrays import F64
from factorbus.proto.kinds import FACTOR_KINDS


def best_components(file: str, mixed: Lead, vertices: Sequence[VertexColumns], left: LeftOut) -> EdgeColumns:
    """The edges of `mixed`, each as its more likely component.  Raises FormatError: a weight below 0, or strict."""
    columns, weight = mixed.columns, mixed.weight
    if left.strict:
        left.leave(mixed.name, columns.lines, "of whose components one is read")
    refuse_first(
        file, columns.lines, weight < 0, lambda row: f"{mixed.name} with the weight {weight[row]:g}", "one of 0 or more"
    )
    dim = FACTOR_KINDS[columns.kind].dim
    values = {
        number: value
        for vertex in vertices
        if vertex.kind == FACTOR_KINDS[columns.kind].connects[0]
        for number, value in zip(vertex.ids.tolist(), vertex.values, strict=True)
    }
    known = np.array([all(end in values for end in ends) for ends in columns.ids.tolist()], bool)
    is_null = np.zeros(len(known), bool)
    if known.any():
        poses = [np.array([values[end] for end in columns.ids[known, column].tolist()]) for column in (0, 1)]
        r = _residuals(poses[0], poses[1], columns.measured[known])
        m = np.einsum("ni,nij,nj->n", r, unpacked_symmetric(columns.information[known], dim), r)
        w = weight[known]
        is_null[known] = np.where(w > 0, 0.5 * dim * np.log(np.maximum(w, 5e-324)) - w * m > -m, False)
    left.say(
        f"{len(known)} {mixed.name} read as the likelier component at the file's values: "
        f"{len(known) - int(is_null.sum())} as measured, {int(is_null.sum())} as the null hypothesis"
    )
    return replace(columns, information=columns.information * np.where(is_null, weight, 1.0)[:, None])


def _residuals(first: F64, second: F64, measured: F64) -> F64:
    """z⁻¹ (xᵢ⁻¹ xⱼ) as residuals have it: (n, 3) with the angle wrapped, or (n, 6)."""
    error = compose_poses(inverse_poses(measured), compose_poses(inverse_poses(first), second))
    if error.shape[1] == 3:
        return np.concatenate([error[:, :2], np.remainder(error[:, 2:] + np.pi, 2 * np.pi) - np.pi], axis=1)
    return np.concatenate([error[:, :3], np.where(error[:, 6:] < 0, -error[:, 3:6], error[:, 3:6])], axis=1)
