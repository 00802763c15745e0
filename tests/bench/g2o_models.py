"""What g2o's vertices and edges are for a graph of ours: relative poses and landmarks, or cameras and points.

A camera of g2o's bundle adjustment is map to camera, the inverse of ours; its residual, pixel minus prediction, is ours
with the other sign, and its information is the same.  Points are eliminated first, by its Schur complement.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import g2opy as g2o
import numpy as np

from factorbus.proto.messages import Batch
from factorbus.simulate.noise import conjugate, rotated

from .replays.columns import F64
from .replays.contestants import Failed
from .replays.g2o_batch import EDGES, VERTICES

_RADTAN = 1.0  # the code of lenses with and without such distortion


@dataclass(frozen=True, slots=True)
class G2oModel:
    """size: of its solver's blocks, by g2o's names, of which "SE2" is that of poses and points in the plane, "SE3" that
    of 6 and 3.  vertex: of a kind.  edge: of a kind, what was measured and the vertices.  turned: a row of a kind as
    g2o has it, and back."""

    size: str
    vertex: Callable[[str], Any]
    edge: Callable[[str, F64, list[Any]], Any]
    turned: Callable[[str, F64], F64]


def g2o_model(graph: Batch) -> G2oModel:
    """Raises Failed for a kind that is not here."""
    kinds = {group.kind for group in graph.factors}
    if "point_seen" in kinds:
        _check(kinds, {"point_seen"}, "beside pixels")
        return G2oModel("SE3", _bundle_vertex, _pixel_edge, _bundle_row)
    _check(kinds, set(EDGES), "here")
    only_poses = {group.kind for group in graph.variables} == {"se3"}
    return G2oModel("SE3" if only_poses else "X", lambda kind: VERTICES[kind](), _edge, lambda _, row: row)


def _check(kinds: set[str], known: set[str], where: str) -> None:
    if unknown := sorted(kinds - known):
        raise Failed(f"no edge for {unknown[0]} {where}")


def _edge(kind: str, z: F64, vertices: list[Any]) -> Any:
    edge = EDGES[kind]()
    for n, vertex in enumerate(vertices):
        edge.set_vertex(n, vertex)
    edge.set_measurement_data(z)
    return edge


def _bundle_vertex(kind: str) -> Any:
    if kind == "se3":
        return g2o.VertexSE3Expmap()
    vertex = g2o.VertexPointXYZ()
    vertex.set_marginalized(True)
    return vertex


def _pixel_edge(kind: str, z: F64, vertices: list[Any]) -> Any:
    if z[2] != _RADTAN or z[7:].any():
        raise Failed(f"a lens {z[2:].tolist()}: g2o's edge is one without distortion")
    camera, point = vertices
    edge = g2o.EdgeSE3ProjectXYZ()
    edge.set_vertex(0, point)
    edge.set_vertex(1, camera)
    edge.fx, edge.fy, edge.cx, edge.cy = z[3:7].tolist()
    edge.set_measurement_data(z[:2].copy())
    return edge


def _bundle_row(kind: str, row: F64) -> F64:
    if kind != "se3":
        return row
    back = conjugate(row[None, 3:])
    return np.concatenate([-rotated(back, row[None, :3]), back], axis=1)[0]
