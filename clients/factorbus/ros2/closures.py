"""Loop closures of a front end's graph, as factors between the keyframes of this map.

A node of the graph has a stamp: there the robot was at T of the last keyframe before it, by odometry, with the
covariance of that way.  An edge from node a to node b, of T_a_b, then joins their keyframes:

    T_ka_kb = T_ka_a T_a_b T_kb_b⁻¹,   with the covariances of all three, each carried to kb.

Graphs are published again and again, whole or in parts: an edge goes into the map once.  One whose node is not known
yet waits for it.  No bus and no clock.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from factorbus.client.draft import Draft
from factorbus.proto.arrays import F64
from factorbus.ros2.certainty import information
from factorbus.ros2.geometry import Transform, carried
from factorbus.ros2.graphs import (
    CLOSURE,
    ODOMETRY_EDGE,
    REJECTED,
    GraphEdge,
    GraphNode,
    HeardGraph,
    bad_edge,
    edge_text,
)
from factorbus.ros2.message_parts import Notes
from factorbus.ros2.problems import BadRosEdge, BadRosMessage
from factorbus.ros2.settings import Settings
from factorbus.ros2.space import SPACES
from factorbus.wording import counted

_WAITING = 1024  # edges that may wait for a node
_NODES, _EDGES = 1 << 18, 1 << 18  # that are remembered
_SAME = 1e-6  # how far a number of an edge may be off when it comes again
_LEFT, _WAITS, _INSERTED, _TOLD = "left out", "waits", "inserted", "told"


@dataclass(frozen=True, slots=True)
class NodePlace:
    """T_keyframe_node, and the covariance of that way (6, 6), local at the node; None: it is the keyframe itself."""

    key: int
    T: Transform
    way: F64 | None


@dataclass(slots=True)
class _SeenEdge:
    edge: GraphEdge
    topic: str
    state: str


class GraphClosures:
    """Which nodes and edges of graphs are known.

    place: where the robot was at a time, by odometry.  Raises BadRosMessage: that is not known, and never will be;
    returns None before its odometry.
    """

    def __init__(self, settings: Settings, place: Callable[[str, int], NodePlace | None], notes: Notes) -> None:
        self._settings, self._place, self._notes = settings, place, notes
        self._space = SPACES[settings.space]
        self.forget()

    def forget(self) -> None:
        """All of it."""
        self._robot = self._settings.robot_id
        self._to_come: dict[GraphNode, tuple[str, int]] = {}
        self._places: dict[GraphNode, NodePlace | None] = {}
        self._seen: dict[tuple[str, GraphNode, GraphNode], _SeenEdge] = {}
        self._waiting: deque[_SeenEdge] = deque()

    def hear(self, topic: str, heard: HeardGraph, draft: Draft) -> None:
        """A graph, whole or in part: what is new of it goes into the draft."""
        self._notes.refused += heard.bad
        for node, stamp_ns in heard.stamps.items():
            self._learn(topic, node, stamp_ns)
        self.advance(draft)
        for edge in heard.edges:
            self._take(topic, edge, draft)
        self._tell_removed(topic, heard)

    def advance(self, draft: Draft) -> None:
        """After odometry: nodes that now have a place, and the edges that waited for them."""
        if not self._to_come:
            return
        placed = False
        for node, (topic, stamp_ns) in list(self._to_come.items()):
            try:
                place = self._place(topic, stamp_ns)
            except BadRosMessage as bad:
                self._notes.remark(topic, f"a node has no place on odometry: wanted {bad.detail['wanted']}")
                place = None
            else:
                if place is None:
                    continue
            del self._to_come[node]
            self._places[node] = place
            placed = True
        if placed and self._waiting:
            waiting, self._waiting = self._waiting, deque()
            for each in waiting:
                self._close(each, draft)

    def rewind(self, present: Callable[[int], bool]) -> None:
        """Nodes whose keyframe is not in the map have no place, and their edges were not inserted."""
        gone = {node for node, at in self._places.items() if at is not None and not present(at.key)}
        if gone:
            self._places = {node: at for node, at in self._places.items() if node not in gone}
            self._seen = {name: each for name, each in self._seen.items() if not gone & set(name[1:])}
            self._waiting = deque(each for each in self._waiting if not gone & {each.edge.first, each.edge.second})

    def open_ends(self) -> Iterator[tuple[str, str]]:
        """(topic, what still waits) for people, where a recording ends."""
        for topic in dict.fromkeys(each.topic for each in self._waiting):
            count = sum(each.topic == topic for each in self._waiting)
            first = next(each.edge for each in self._waiting if each.topic == topic)
            waits = "waits" if count == 1 else "wait"
            found = f"{counted(count, 'closure')} still {waits} for a node; the first is {_named(first)}"
            yield topic, found

    def _learn(self, topic: str, node: GraphNode, stamp_ns: int) -> None:
        if node in self._places or node in self._to_come:
            return
        if self._robot is None and node.source != "rtabmap":
            self._robot = node.robot
            self._notes.remark(topic, f"robot {node.robot} of the graph is this one (--robot-id says otherwise)")
        if node.source != "rtabmap" and node.robot != self._robot:
            return
        if len(self._places) + len(self._to_come) >= _NODES:
            self._notes.remark(topic, f"more than {_NODES} nodes: further ones are not remembered")
            return
        self._to_come[node] = topic, stamp_ns

    def _take(self, topic: str, edge: GraphEdge, draft: Draft) -> None:
        name = _name(edge)
        if (seen := self._seen.get(name)) is not None:
            self._compare(topic, seen, edge)
            return
        if len(self._seen) >= _EDGES:
            self._notes.remark(topic, f"more than {_EDGES} edges: further ones are left out")
            return
        seen = self._seen[name] = _SeenEdge(edge, topic, _LEFT)
        if why := self._why_not(edge):
            self._notes.remark(topic, why)
            return
        seen.state = _WAITS
        self._close(seen, draft)

    def _why_not(self, edge: GraphEdge) -> str:
        """Why an edge is left out; empty: it is a closure between nodes of this robot."""
        if edge.kind == ODOMETRY_EDGE:
            return "its edges of odometry are left out: odometry itself says them"
        if edge.kind == REJECTED:
            return "closures that the front end has rejected are left out"
        if edge.kind != CLOSURE:
            return f"its edges of {edge.kind} are left out: they are no relative pose of the robot"
        others = {node.robot for node in (edge.first, edge.second) if node.source != "rtabmap"} - {self._robot}
        if others and self._robot is not None:
            return f"edges with robots other than {self._robot} are left out: a bridge reads one robot (--robot-id)"
        return ""

    def _close(self, seen: _SeenEdge, draft: Draft) -> None:
        """Into the draft, if both its ends are known."""
        edge, topic = seen.edge, seen.topic
        unknown = [node for node in (edge.first, edge.second) if node not in self._places]
        if unknown:
            if len(self._waiting) >= _WAITING:
                late = self._waiting.popleft()
                late.state = _LEFT
                wanted = f"its nodes before {_WAITING} further closures wait"
                self._notes.refused.append(
                    BadRosEdge(late.topic, _named(late.edge), "a node that did not come", wanted)
                )
            self._waiting.append(seen)
            self._notes.remark(topic, "a closure names a node that is not known yet: it waits for it")
            return
        seen.state = _LEFT
        first, second = self._places[edge.first], self._places[edge.second]
        if first is None or second is None:
            wanted = "nodes from while odometry was heard"
            self._notes.refused.append(BadRosEdge(topic, _named(edge), "a node without a place", wanted))
        elif first.key == second.key:
            self._notes.remark(topic, "closures whose ends are at the same keyframe are left out (--keyframe)")
        else:
            try:
                self._insert(topic, edge, first, second, draft)
            except BadRosMessage as bad:
                self._notes.refused.append(bad_edge(topic, edge.first, edge.second, bad))
            else:
                seen.state = _INSERTED

    def _insert(self, topic: str, edge: GraphEdge, first: NodePlace, second: NodePlace, draft: Draft) -> None:
        space, floors = self._space, self._settings.floors
        known = self._notes.checked(topic, "a closure", edge.covariance.ravel(), space.axes).whole
        back, there = second.T.inverse(), space.fitted(edge.T)
        covariance = carried(space.floored(known, floors.closure_m, floors.closure_rad), back)
        if first.way is not None:
            covariance = covariance + carried(first.way, there @ back)
        if second.way is not None:
            covariance = covariance + carried(second.way, back)
        draft.factor(
            f"between_{space.pose}",
            (first.key, second.key),
            space.row(first.T @ there @ back),
            information=information(space.residual(covariance)),
        )

    def _compare(self, topic: str, seen: _SeenEdge, edge: GraphEdge) -> None:
        """An edge that comes again: what is in the map stays, and where it differs that is said, once for each edge."""
        if seen.state not in (_INSERTED, _WAITS):
            return
        if edge.kind == REJECTED:
            if seen.state == _WAITS:
                self._waiting.remove(seen)
                seen.state = _LEFT
                return
            text = "the front end has rejected a closure that is in the map, where it stays"
        elif edge.first == seen.edge.first and not _alike(edge, seen.edge):
            text = "a closure came again with other numbers; the first ones stay in the map"
        else:
            return
        seen.state = _TOLD if seen.state == _INSERTED else seen.state
        self._notes.remark(topic, text)

    def _tell_removed(self, topic: str, heard: HeardGraph) -> None:
        """GraphClosures in the map whose ends the message names, but which it has no more."""
        if not heard.named:
            return
        there = {_name(edge) for edge in heard.edges}
        for name, seen in self._seen.items():
            if seen.state == _INSERTED and seen.topic == topic and name not in there and heard.named >= set(name[1:]):
                seen.state = _TOLD
                self._notes.remark(topic, "the front end has removed a closure that is in the map, where it stays")


def _name(edge: GraphEdge) -> tuple[str, GraphNode, GraphNode]:
    """Of an edge in either direction; a closure that was rejected is the same edge."""
    kind = CLOSURE if edge.kind == REJECTED else edge.kind
    return kind, min(edge.first, edge.second), max(edge.first, edge.second)


def _named(edge: GraphEdge) -> str:
    return edge_text(edge.first, edge.second)


def _alike(edge: GraphEdge, other: GraphEdge) -> bool:
    pairs = ((edge.T.t, other.T.t), (edge.T.R, other.T.R), (edge.covariance, other.covariance))
    return all(a.tobytes() == b.tobytes() for a, b in pairs) or all(_close_numbers(a, b) for a, b in pairs)


def _close_numbers(a: F64, b: F64) -> bool:
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    with np.errstate(over="ignore"):
        return bool((np.abs(a - b) <= _SAME * np.abs(b).max()).all())
