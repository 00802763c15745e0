"""The lines of the source files, in each of their forms, with every measured number left as it is written."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from factorbus.datasets.errors import BadSource
from factorbus.datasets.weights import from_covariance, from_root
from factorbus.wording import counted

# A vertex of a graph: ("x", id) for a pose, ("l", id) for a landmark; some sources number the two separately.
Vertex = tuple[str, int]

Words = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class VertexLine:
    """A line that holds an initial estimate; record: its name in g2o."""

    record: str
    vertex: Vertex
    values: Words


@dataclass(frozen=True, slots=True)
class EdgeLine:
    """A measurement from one vertex to another; information: upper triangle row by row, in measurement order."""

    record: str
    start: Vertex
    end: Vertex
    measured: Words
    information: Words


@dataclass(frozen=True, slots=True)
class _Record:
    """How a line is read.  widths: numbers of (ids, values or measurement, weights)."""

    g2o: str
    widths: tuple[int, int, int]
    ends: str = "xx"
    information: Callable[[Words], Words] = lambda weights: weights


def read_lines(form: str, file: str, content: bytes) -> Iterator[VertexLine | EdgeLine]:
    """The vertices and edges of a source file of `form`, in its order.  Raises BadSource."""
    records, dropped = FORMS[form]
    for number, raw in enumerate(content.split(b"\n"), 1):
        try:
            name, *words = raw.decode("ascii").split() or ["#"]
        except UnicodeDecodeError:
            raise BadSource(file, number, "a byte that is not ASCII", "a text file") from None
        if name.startswith("#") or name in dropped or (number == 1 and name in _HEADINGS):
            continue
        if name not in records:
            raise BadSource(file, number, f"unknown record {name[:40]!r}", f"one of {', '.join(records)}")
        yield _line(file, number, name, records[name], words)


def _line(file: str, number: int, name: str, record: _Record, words: list[str]) -> VertexLine | EdgeLine:
    ids, values, weights = record.widths
    if len(words) != sum(record.widths):
        raise BadSource(file, number, f"{name} with {counted(len(words), 'field')}", f"{sum(record.widths)}")
    if not all(word.isdigit() for word in words[:ids]) or not all(map(_finite, words[ids:])):
        raise BadSource(file, number, f"{name} with a field that is no number", "ids, then finite numbers")
    ends = [(kind, int(word)) for kind, word in zip(record.ends, words[:ids], strict=False)]
    numbers = tuple(words[ids : ids + values])
    if ids == 1:
        return VertexLine(record.g2o, ends[0], numbers)
    if ends[0] == ends[1]:
        raise BadSource(file, number, f"{name} from {words[0]} to itself", "two vertices")
    try:
        information = record.information(tuple(words[len(words) - weights :]))
    except ValueError as error:
        raise BadSource(file, number, f"{name} with {error}", "a weight of the file's form") from None
    return EdgeLine(record.g2o, ends[0], ends[1], numbers, information)


def _finite(word: str) -> bool:
    try:
        return math.isfinite(float(word)) and "_" not in word
    except ValueError:
        return False


def _toro_order(weights: Words) -> Words:
    """TORO and HOG-Man write xx xy yy tt xt yt."""
    xx, xy, yy, tt, xt, yt = weights
    return xx, xy, xt, yy, yt, tt


def _isam(information: Callable[[Words], Words]) -> dict[str, _Record]:
    pose = _Record("EDGE_SE2", (2, 3, 6), "xx", information)
    return {"ODOMETRY": pose, "EDGE2": pose, "LANDMARK": _Record("EDGE_SE2_XY", (2, 2, 3), "xl", information)}


_TORO_VERTEX = _Record("VERTEX_SE2", (1, 3, 0))
_TORO_EDGE = _Record("EDGE_SE2", (2, 3, 6), "xx", _toro_order)

# form -> (records, names of lines that are left out).  EQUIV says that two poses are the same place: no measurement.
FORMS: dict[str, tuple[dict[str, _Record], tuple[str, ...]]] = {
    "isam": (_isam(from_root), ()),
    "isam_covariance": (_isam(from_covariance), ()),
    "toro": (
        {"VERTEX2": _TORO_VERTEX, "VERTEX": _TORO_VERTEX, "EDGE2": _TORO_EDGE, "EDGE": _TORO_EDGE},
        ("EQUIV",),
    ),
    "g2o": (
        {
            "VERTEX_SE2": _Record("VERTEX_SE2", (1, 3, 0)),
            "VERTEX_SE3:QUAT": _Record("VERTEX_SE3:QUAT", (1, 7, 0)),
            "EDGE_SE2": _Record("EDGE_SE2", (2, 3, 6)),
            "EDGE_SE2_XY": _Record("EDGE_SE2_XY", (2, 2, 3), "xl"),
            "EDGE_SE3:QUAT": _Record("EDGE_SE3:QUAT", (2, 7, 21)),
        },
        ("FIX",),
    ),
}

# The first words of the files of the Freiburg exercises, one for vertices and one for edges.
_HEADINGS = ("vertex", "Edge", "edge")
