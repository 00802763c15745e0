"""Graphs as front ends publish them, brought into one form: nodes with stamps, edges with a measurement.

    pose_graph_tools_msgs/PoseGraph   Kimera and its kind.  A node is (robot, key) and has a stamp.
    rtabmap_msgs/MapGraph             RTAB-Map.  A node is a number, without a stamp: the newest is that of the header.
    rtabmap_msgs/Link                 An edge alone, between nodes that a MapGraph has named.

Both give the second node in the frame of the first, with a covariance or an information of six axes: x y z and the
rotation about them, in the frame of the second node.  GTSAM, whose matrices Kimera-RPGO copies, has rotation first.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.ros2.certainty import UNKNOWN
from factorbus.ros2.geometry import Transform
from factorbus.ros2.message_parts import stamp_ns_of, transform_of
from factorbus.ros2.messages import LINK, MAP_GRAPH, POSE_GRAPH
from factorbus.ros2.problems import BadRosEdge, BadRosMessage

CLOSURE, ODOMETRY_EDGE, REJECTED = "closure", "odometry", "rejected"
_POSE_GRAPH_TYPES = {
    0: ODOMETRY_EDGE, 1: CLOSURE, 2: "LANDMARK", 3: REJECTED, 4: "MESH", 5: "POSE_MESH", 6: "MESH_POSE"
}  # fmt: skip
_LINK_TYPES = {
    0: ODOMETRY_EDGE, 1: CLOSURE, 2: CLOSURE, 3: CLOSURE, 4: CLOSURE, 5: "VirtualClosure", 6: ODOMETRY_EDGE,
    7: "PosePrior", 8: "Landmark", 9: "Gravity",
}  # fmt: skip
_ROTATION_FIRST = [3, 4, 5, 0, 1, 2]
# Of an information, smallest eigenvalue by largest: below it is singular, and has no covariance.
_SINGULAR = 1e-14


class GraphNode(NamedTuple):
    """Whose graph it is of ("kimera", "rtabmap"), the robot's number in it, and the node's."""

    source: str
    robot: int
    number: int

    def __str__(self) -> str:
        return f"node {self.number}" if self.source == "rtabmap" else f"node {self.number} of robot {self.robot}"


@dataclass(frozen=True, slots=True)
class GraphEdge:
    """second in the frame of first; covariance (6, 6): as it came, local at the second.

    kind: CLOSURE, ODOMETRY_EDGE, REJECTED or what else it is called where it comes from.
    """

    first: GraphNode
    second: GraphNode
    kind: str
    T: Transform
    covariance: F64


@dataclass(slots=True)
class HeardGraph:
    """One message.  stamps: of its nodes, ns.  named: all its nodes.  bad: what of it cannot be used."""

    stamps: dict[GraphNode, int] = field(default_factory=dict)
    named: set[GraphNode] = field(default_factory=set)
    edges: list[GraphEdge] = field(default_factory=list)
    bad: list[BadRosMessage] = field(default_factory=list)


def heard_graph(topic: str, type_name: str, message: Any, rotation_first: bool) -> HeardGraph:
    """Of a message of one of the three types.  Raises BadRosMessage: nothing of it can be used."""
    if type_name == POSE_GRAPH:
        return _pose_graph(topic, message, rotation_first)
    if type_name == MAP_GRAPH:
        return _map_graph(topic, message)
    if type_name != LINK:
        raise ValueError(f"{type_name} is no graph; wanted {POSE_GRAPH}, {MAP_GRAPH} or {LINK}")
    made = HeardGraph()
    _read_edges(topic, made, [message], _link)
    return made


def _pose_graph(topic: str, message: Any, rotation_first: bool) -> HeardGraph:
    made = HeardGraph()
    for each in message.nodes:
        node = GraphNode("kimera", _robot(each, "robot_id"), int(each.key))
        made.named.add(node)
        try:
            made.stamps[node] = stamp_ns_of(topic, each.header.stamp)
        except BadRosMessage as bad:
            made.bad.append(BadRosEdge(topic, str(node), str(bad.detail["seen"]), str(bad.detail["wanted"])))
    _read_edges(topic, made, message.edges, lambda topic, each: _pose_graph_edge(topic, each, rotation_first))
    return made


def _map_graph(topic: str, message: Any) -> HeardGraph:
    made = HeardGraph()
    numbers = [int(number) for number in _either(message, "poses_id", "posesId")]
    made.named = {GraphNode("rtabmap", 0, number) for number in numbers if number > 0}  # below 0 are landmarks
    if made.named:
        made.stamps[max(made.named)] = stamp_ns_of(topic, message.header.stamp)
    _read_edges(topic, made, message.links, _link)
    return made


def _read_edges(topic: str, made: HeardGraph, edges: Any, read: Callable[[str, Any], GraphEdge]) -> None:
    for each in edges:
        try:
            made.edges.append(read(topic, each))
        except BadRosMessage as bad:
            made.bad.append(bad)


def _pose_graph_edge(topic: str, each: Any, rotation_first: bool) -> GraphEdge:
    first = GraphNode("kimera", _robot(each, "robot_from"), int(each.key_from))
    second = GraphNode("kimera", _robot(each, "robot_to"), int(each.key_to))
    kind = _POSE_GRAPH_TYPES.get(int(each.type), f"type {each.type}")
    covariance = np.asarray(each.covariance, np.float64).reshape(6, 6)
    if rotation_first:
        covariance = covariance[np.ix_(_ROTATION_FIRST, _ROTATION_FIRST)]
    return GraphEdge(first, second, kind, _edge_transform(topic, first, second, each.pose), covariance)


def _link(topic: str, each: Any) -> GraphEdge:
    first = GraphNode("rtabmap", 0, int(_either(each, "from_id", "fromId")))
    second = GraphNode("rtabmap", 0, int(_either(each, "to_id", "toId")))
    kind = _LINK_TYPES.get(int(each.type), f"type {each.type}")
    T = _edge_transform(topic, first, second, each.transform)
    if kind != CLOSURE:
        return GraphEdge(first, second, kind, T, np.zeros((6, 6)))
    return GraphEdge(first, second, kind, T, _covariance_of(topic, first, second, each.information))


def _edge_transform(topic: str, first: GraphNode, second: GraphNode, pose: Any) -> Transform:
    try:
        return transform_of(topic, pose)
    except BadRosMessage as bad:
        raise bad_edge(topic, first, second, bad) from None


def _covariance_of(topic: str, first: GraphNode, second: GraphNode, numbers: F64) -> F64:
    """The inverse of an information.  An axis of zeros is unknown; all zeros, which say nothing, stay zeros.

    Raises BadRosEdge.
    """
    information = np.asarray(numbers, np.float64).reshape(6, 6)
    edge = edge_text(first, second)
    if not np.isfinite(information).all():
        raise BadRosEdge(topic, edge, "an information that is not finite", "finite numbers")
    axes = np.flatnonzero(information.any(axis=0) | information.any(axis=1))
    if not axes.size:
        return information
    scale = float(np.abs(information).max())
    part = information[np.ix_(axes, axes)] / scale
    values, vectors = np.linalg.eigh(0.5 * (part + part.T))
    if not (values[0] > _SINGULAR * values[-1] > 0.0 and np.allclose(part, part.T, atol=1e-6)):
        raise BadRosEdge(topic, edge, "an information that is not positive definite", "a symmetric one that is")
    covariance = np.diag(np.full(6, UNKNOWN))
    with np.errstate(over="ignore"):  # what is too large is found where the covariance is checked
        covariance[np.ix_(axes, axes)] = (vectors / values) @ vectors.T / scale
    return covariance


def edge_text(first: GraphNode, second: GraphNode) -> str:
    """In words."""
    return f"the edge from {first} to {second}"


def bad_edge(topic: str, first: GraphNode, second: GraphNode, bad: BadRosMessage) -> BadRosEdge:
    """What is wrong with a part of an edge, said of the edge."""
    return BadRosEdge(topic, edge_text(first, second), str(bad.detail["seen"]), str(bad.detail["wanted"]))


def _robot(message: Any, name: str) -> int:
    """Whose it is; the first generation of the message, of ROS 1, has one robot alone, and no field for it."""
    return int(getattr(message, name, 0))


def _either(message: Any, name: str, former: str) -> Any:
    """A field that had another name in ROS 1."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, former)
