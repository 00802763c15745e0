"""Read PyFactorGraph's text files: `pyfg` has the records."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorbus.formats.assemble import EdgeColumns, VertexColumns, assembled
from factorbus.formats.errors import FormatError, refuse_first
from factorbus.formats.left_out import LeftOut, shown
from factorbus.formats.lines import Bucket
from factorbus.formats.numbers import read_numbers
from factorbus.formats.pyfg import FACTORS, PYFG, RANGE, RANGES, RECORDS, VERTICES, Record
from factorbus.formats.rotations import normalized_poses
from factorbus.formats.seconds import is_time, nanoseconds
from factorbus.formats.weights import checked_information, doubled_rotations, inverted_weights
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch
from factorbus.proto.problems import BadSymbol
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import format_symbol, parse_symbol
from factorbus.wording import counted

_NAME = re.compile(rb"[A-Za-z]\d+")


@dataclass(frozen=True, slots=True)
class _Lines:
    """The lines of one record: lines (n,), keys (n, names), stamps (n,) in nanoseconds, numbers (n, numbers)."""

    name: str
    lines: I64
    keys: I64
    stamps: I64
    numbers: F64

    def where(self, chosen: np.ndarray) -> "_Lines":
        """Some of them."""
        return _Lines(self.name, self.lines[chosen], self.keys[chosen], self.stamps[chosen], self.numbers[chosen])


def is_pyfg(path: Path, buckets: Mapping[str, Bucket]) -> bool:
    """Whether a file of these records is one: by its ending, or names of variables where g2o has numbers."""
    if path.name.lower().removesuffix(".gz").endswith(f".{PYFG}"):
        return True
    return any(_has_name(RECORDS[name], buckets[name].rests[0]) for name in buckets if name in RECORDS)


def _has_name(record: Record, rest: bytes) -> bool:
    words = rest.split(None, 2)
    if record.timed:
        return len(words) > 1 and is_time(words[0].decode("ascii", "replace")) and bool(_NAME.fullmatch(words[1]))
    return bool(words) and bool(_NAME.fullmatch(words[0]))


def read_pyfg(file: str, buckets: Mapping[str, Bucket], left: LeftOut) -> tuple[Batch, tuple[I64, ...]]:
    """(the graph, the line of each factor for each group of factors).

    Keys are the names as symbols: A12 is symbol("A", 12).  Poses have time stamps, unless all times are 0.  Raises
    FormatError, which names the file and the line.
    """
    found = {name: _lines(file, name, RECORDS[name], bucket) for name, bucket in buckets.items() if name in RECORDS}
    if not found:
        raise FormatError(file, None, "no pyfg record", "lines such as VERTEX_SE2 0.0 A0 0 0 0")
    for name in buckets:
        if name not in RECORDS:
            short = name if len(name) <= 40 else name[:37] + "..."
            left.leave(short, buckets[name].numbers, "no pyfg record that is read")
    vertices = [_vertices(file, VERTICES[name].kind, of) for name, of in found.items() if name in VERTICES]
    _say_undeclared(found, left)
    edges = [_edges(file, FACTORS[name].kind, of) for name, of in found.items() if name in FACTORS and name != RANGE]
    if RANGE in found:
        edges += [_edges(file, kind, part) for kind, part in _ranges(file, found[RANGE], vertices, edges, left)]
    batch, lines = assembled(file, True, False, vertices, edges, None)
    return _stamped(file, batch, found, left), lines


def _say_undeclared(found: Mapping[str, _Lines], left: LeftOut) -> None:
    """A misspelt name is one more variable.  A file without any vertices has its poses by odometry."""
    declared = [of.keys for name, of in found.items() if name in VERTICES]
    named = [of.keys.ravel() for name, of in found.items() if name in FACTORS and name != RANGE]
    if declared and named:
        known = np.concatenate([keys.ravel() for keys in declared])
        names = [format_symbol(key) for key in np.setdiff1d(np.concatenate(named), known).tolist()]
        if names:
            left.say(f"{counted(len(names), 'name')} without a vertex line, each a variable: {shown(names)}")


def _lines(file: str, name: str, record: Record, bucket: Bucket) -> _Lines:
    keys, stamps, rests = [], [], []
    for rest, line in zip(bucket.rests, bucket.numbers, strict=True):
        words = rest.split()
        if len(words) != record.width:
            raise FormatError(
                file, line, f"{name} with {counted(len(words), 'field')}", f"{record.width}: {record.fields}"
            )
        time = words[0].decode("utf-8", "backslashreplace") if record.timed else "0"
        stamps.append(nanoseconds(file, line, time))
        keys.append([_key(file, name, line, word) for word in words[record.timed : record.timed + record.names]])
        rests.append(b" ".join(words[record.timed + record.names :]))
    _, numbers = read_numbers(file, name, Bucket(rests, bucket.numbers), 0, record.numbers, record.fields)
    return _Lines(name, np.array(bucket.numbers, np.int64), np.array(keys, np.int64), np.array(stamps), numbers)


def _key(file: str, name: str, line: int, word: bytes) -> int:
    text = word.decode("utf-8", "backslashreplace")
    try:
        return parse_symbol(text)
    except BadSymbol as error:
        shown = text if len(text) <= 40 else text[:37] + "..."
        raise FormatError(file, line, f"{name} of {shown!r}", "a letter and a number, such as A12") from error


def _vertices(file: str, kind: str, of: _Lines) -> VertexColumns:
    values = normalized_poses(file, of.name, of.lines, of.numbers) if kind == "se3" else of.numbers
    return VertexColumns(kind, of.lines, of.keys[:, 0], np.ascontiguousarray(values))


def _edges(file: str, kind: str, of: _Lines) -> EdgeColumns:
    """In our terms and checked.  Raises FormatError."""
    about = FACTOR_KINDS[kind]
    measured, covariance = of.numbers[:, : about.size], of.numbers[:, about.size :]
    if len(about.connects) == 2:
        loops = of.keys[:, 0] == of.keys[:, 1]
        refuse_first(file, of.lines, loops, lambda row: f"{of.name} from {_shown(of, row)} to itself", "two variables")
    if kind in RANGES.values():
        bad = measured[:, 0] <= 0
        refuse_first(file, of.lines, bad, lambda row: f"{of.name} of {measured[row, 0]:g}", "a distance above 0")
    if about.size == 7:
        measured = normalized_poses(file, of.name, of.lines, measured)
    checked_information(file, of.name, of.lines, covariance, about.dim, "a covariance")
    information = inverted_weights(covariance, about.dim)
    information = doubled_rotations(information) if about.half_angles else information
    checked_information(file, of.name, of.lines, information, about.dim)
    return EdgeColumns(kind, of.lines, of.keys, np.ascontiguousarray(measured), np.ascontiguousarray(information))


def _shown(of: _Lines, row: int) -> str:
    return format_symbol(int(of.keys[row, 0]))


def _ranges(
    file: str, of: _Lines, vertices: list[VertexColumns], edges: list[EdgeColumns], left: LeftOut
) -> Iterator[tuple[str, _Lines]]:
    """Ranges by the kind of factor that their ends make them, the pose first.  Raises FormatError."""
    kinds: dict[int, str] = {}
    for edge in edges:
        for column, end in enumerate(FACTOR_KINDS[edge.kind].connects):
            kinds |= dict.fromkeys(edge.ids[:, column].tolist(), end)
    for vertex in vertices:
        kinds |= dict.fromkeys(vertex.ids.tolist(), vertex.kind)
    unknown = np.array([not all(key in kinds for key in pair) for pair in of.keys.tolist()], bool)

    def lost(row: int) -> str:
        missing = next(key for key in of.keys[row].tolist() if key not in kinds)
        return f"{RANGE} of {format_symbol(missing)}, of which no other line tells what it is"

    refuse_first(file, of.lines, unknown, lost, "a vertex line for it")
    ends = [(kinds[one], kinds[other]) for one, other in of.keys.tolist()]
    back = np.array([pair not in RANGES and pair[::-1] in RANGES for pair in ends], bool)
    of = _Lines(of.name, of.lines, np.where(back[:, None], of.keys[:, ::-1], of.keys), of.stamps, of.numbers)
    names = np.array([RANGES.get(pair) or RANGES.get(pair[::-1], "") for pair in ends])
    of_points = np.array([all(end.startswith("point") for end in pair) for pair in ends], bool)
    refuse_first(
        file,
        of.lines,
        (names == "") & ~of_points,
        lambda row: f"{RANGE} between {' and '.join(ends[row])}",
        "two variables in the plane, or two in space",
    )
    left.leave(RANGE, of.lines[of_points], "a distance between two points, which no factor has")
    for kind in RANGES.values():
        if (chosen := names == kind).any():
            yield kind, of.where(chosen)


def _stamped(file: str, batch: Batch, found: Mapping[str, _Lines], left: LeftOut) -> Batch:
    """The same with the time stamps of the poses.  Raises FormatError for a pose of two times."""
    stamps: dict[int, int] = {}
    for of in (found[name] for name in found if name in VERTICES and VERTICES[name].timed):
        for key, stamp, line in zip(of.keys[:, 0].tolist(), of.stamps.tolist(), of.lines.tolist(), strict=True):
            if stamps.setdefault(key, stamp) != stamp:
                raise FormatError(file, line, f"{format_symbol(key)} again, at another time", "one time for a pose")
    for name in (name for name in found if name in FACTORS):
        of = found[name]
        own = [
            line
            for line, pair, stamp in zip(of.lines.tolist(), of.keys.tolist(), of.stamps.tolist(), strict=True)
            if stamp and stamp not in (stamps.get(key) for key in pair)
        ]
        left.leave(f"{name} times", own, "a factor has no time other than that of its poses")
    if not any(stamps.values()):
        return batch
    groups = []
    for group in batch.variables:
        times = np.array([stamps.get(key, NO_STAMP) for key in group.keys.tolist()], np.int64)
        groups.append(group._replace(stamps=times) if (times != NO_STAMP).any() else group)
    return Batch(tuple(groups), batch.factors)
