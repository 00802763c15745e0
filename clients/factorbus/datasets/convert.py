"""From a source file to the one form of all data sets: g2o text, numbered by and ordered in time."""

from collections.abc import Iterable, Sequence

from factorbus.datasets.errors import BadSource
from factorbus.datasets.records import FORMS, EdgeLine, Vertex, VertexLine, read_lines

__all__ = ["FORMS", "convert"]


def convert(form: str, files: Sequence[tuple[str, bytes]]) -> bytes:
    """The g2o text of the (name, content) `files` of one source.  Raises BadSource.

    Measured numbers are kept digit by digit.  Vertex lines come first.  Edges stand with the later of the poses
    they join, the odometry edge first and the others in the order of the source; vertices are numbered 0, 1, ... as
    they first appear in the edges.
    """
    lines = [line for name, content in files for line in read_lines(form, name, content)]
    edges = _in_time_order([line for line in lines if isinstance(line, EdgeLine)])
    if not edges:
        raise BadSource(files[0][0], None, "no edge at all", "a pose graph")
    numbers = _numbered(edges)
    vertices = [line for line in lines if isinstance(line, VertexLine)]
    if foreign := [line.vertex[1] for line in vertices if line.vertex not in numbers]:
        raise BadSource(files[0][0], None, f"vertex {foreign[0]} without an edge", "a connected graph")
    vertices.sort(key=lambda line: numbers[line.vertex])
    text = [" ".join((v.record, str(numbers[v.vertex]), *v.values)) for v in vertices]
    text += [
        " ".join((e.record, str(numbers[e.start]), str(numbers[e.end]), *e.measured, *e.information)) for e in edges
    ]
    return "\n".join([*text, ""]).encode()


def _in_time_order(edges: Iterable[EdgeLine]) -> list[EdgeLine]:
    """Stable: edges of one pose keep the order of the source, but for the odometry edge."""
    by_pose: dict[int, list[EdgeLine]] = {}
    for edge in edges:
        by_pose.setdefault(max(_poses(edge)), []).append(edge)
    ordered: list[EdgeLine] = []
    poses = sorted(by_pose)
    for previous, pose in zip([min(poses, default=0) - 1, *poses], poses, strict=False):
        own = by_pose[pose]
        # Pose 0 is the later one of no edge, so that it is not among `poses`: 0 comes before 1 all the same.
        first = next((k for k, edge in enumerate(own) if _poses(edge) == {previous, pose}), None)
        if first is not None:
            own.insert(0, own.pop(first))
        ordered += own
    return ordered


def _poses(edge: EdgeLine) -> set[int]:
    return {number for kind, number in (edge.start, edge.end) if kind == "x"}


def _numbered(edges: Iterable[EdgeLine]) -> dict[Vertex, int]:
    """Numbers in the order of first appearance; of two new vertices the lower one is earlier."""
    numbers: dict[Vertex, int] = {}
    for edge in edges:
        ends = (edge.start, edge.end) if edge.end[0] == "l" else sorted((edge.start, edge.end))
        for vertex in ends:
            numbers.setdefault(vertex, len(numbers))
    return numbers
