"""How uncertain two variables are relative to each other.  MATH §10.3.

Relative to a pose are: another pose, x_ij = xᵢ⁻¹ xⱼ, whose covariance is in its own tangent space (local increments,
translation first); and a point, u = Rᵢᵀ(lⱼ − tᵢ), in metres along the axes of the pose.
"""

from dataclasses import dataclass

import numpy as np

from factorbus.proto import kinds as wire
from factorbus.solver import errors
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import evaluate_candidates
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factors import FACTOR_KINDS
from factorbus.solver.graph.groups import FactorGroup
from factorbus.solver.graph.variables import SE2, VARIABLE_KIND_OF_CODE, VARIABLE_KINDS
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

SIM3 = "sim3"
# What measures the second variable in the frame of the first.
_MEASURED_BY = {
    ("se2", "se2"): "between_se2",
    ("se3", "se3"): "between_se3",
    ("se2", "point2"): "landmark_se2",
    ("se3", "point3"): "landmark_se3",
    ("so3", "so3"): "between_so3",
    ("sim3", "sim3"): "between_sim3",
    ("sim3", "point3"): "landmark_sim3",
}


@dataclass(frozen=True, slots=True)
class Relative:
    """Pairs `rows` of those asked for: values (k, size), covariance (k, d, d) of the second relative to the first."""

    kind: str
    rows: I64
    values: F64
    covariance: F64


def relative(blocks: CovarianceBlocks, first: I64, second: I64) -> list[Relative]:
    """The pairs first[k], second[k] of variables, by kind of the second.  Raises KindMismatch, SelfLoop."""
    graph = blocks.factored.graph
    codes = np.column_stack([graph.var[first, at.V_KIND], graph.var[second, at.V_KIND]]).reshape(-1, 2)
    groups = []
    for pair in np.unique(codes, axis=0).tolist():
        rows = np.flatnonzero((codes == pair).all(axis=1))
        here, there = (VARIABLE_KIND_OF_CODE[code].name for code in pair)
        if (here, there) not in _MEASURED_BY:
            key = int(graph.keys[second[rows[0]]])
            frame = errors.printed(int(graph.keys[first[rows[0]]]))
            raise errors.KindMismatch(
                key, f"relative to {frame}, a {here}", there, "pose or a point of the same space, relative to a pose"
            )
        groups.append(_of_kind(blocks, here, there, rows, first[rows], second[rows]))
    return groups


def _of_kind(blocks: CovarianceBlocks, here: str, there: str, rows: I64, first: I64, second: I64) -> Relative:
    graph, kind = blocks.factored.graph, FACTOR_KINDS[_MEASURED_BY[here, there]]
    values = _seen_from(here, there, _values(graph, here, first), _values(graph, there, second))
    # A factor that measures what is the case has the residual zero, and H of (10.5) is that of the relative value.
    unit = np.tile(np.eye(kind.dim)[np.triu_indices(kind.dim)], (rows.size, 1))
    keys = np.column_stack([graph.keys[first], graph.keys[second]])
    covariance = evaluate_candidates(blocks, [FactorGroup(kind.name, keys, values, unit)]).predicted
    covariance = covariance[:, : kind.dim, : kind.dim].copy()
    # The rotation part of a residual in space is half an angle.
    halves = wire.FACTOR_KINDS[kind.name].half_angle_rows
    covariance[:, halves] *= 2.0
    covariance[:, :, halves] *= 2.0
    return Relative(there, rows, values, covariance)


def _values(graph: FactorGraph, kind: str, variables: I64) -> F64:
    return graph.values[graph.var[variables, at.V_AT, None] + np.arange(VARIABLE_KINDS[kind].size)]


def _seen_from(here: str, there: str, x: F64, y: F64) -> F64:
    """y in the frame of the poses x."""
    if here == SE2.name:
        c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
        dx, dy = (y[:, :2] - x[:, :2]).T
        u = np.column_stack([c * dx + s * dy, c * dy - s * dx])
        if there != SE2.name:
            return u
        turn = (y[:, 2] - x[:, 2] + np.pi) % (2 * np.pi) - np.pi
        return np.column_stack([u, turn])
    at_q, other_q = (wire.VARIABLE_KINDS[kind].quaternion_at for kind in (here, there))
    v, w = -x[:, at_q : at_q + 3], x[:, at_q + 3 : at_q + 4]
    parts = []
    if at_q > 0:
        d = y[:, :3] - x[:, :3]
        u = d + 2.0 * np.cross(v, np.cross(v, d) + w * d)
        parts.append(u / x[:, 7:] if here == SIM3 else u)
    if other_q >= 0:
        b, s = y[:, other_q : other_q + 3], y[:, other_q + 3 : other_q + 4]
        q = np.hstack([w * b + s * v + np.cross(v, b), w * s - np.sum(v * b, 1, keepdims=True)])
        parts.append(q / np.linalg.norm(q, axis=1, keepdims=True))
    if there == SIM3:
        parts.append(y[:, 7:] / x[:, 7:])
    return np.hstack(parts)
