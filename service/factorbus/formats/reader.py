"""Read a graph file: sniff the dialect, convert record by record, put variables and factors together."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorbus.formats.assemble import EdgeColumns, VertexColumns, assembled, numbered_apart
from factorbus.formats.errors import FormatError, refuse_first
from factorbus.formats.graph import GraphFile
from factorbus.formats.lines import Bucket, read_buckets
from factorbus.formats.numbers import read_numbers
from factorbus.formats.records import DIALECTS, Dialect, Edge, Vertex
from factorbus.formats.rotations import isam_edges3, normalised_poses
from factorbus.formats.sniff import sniffed
from factorbus.formats.weights import checked_information, packed_upper, squared
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS

_IDENTITY_ROOT = b" ".join(b"1" if i == j else b"0" for i in range(6) for j in range(i, 6))


def read(path: str | os.PathLike[str], dialect: str | None = None) -> GraphFile:
    """The graph in `path`: g2o, TORO or iSAM text, plain or gzipped.

    dialect: "g2o", "toro" or "isam"; without it the names of the records decide, and the ending where they do not.
    Keys are symbol("x", id) for poses and symbol("l", id) for points.  Quaternions are normalised; angles stay as
    they are.  Raises FormatError, which names the file and the line.
    """
    with np.errstate(all="ignore"):  # what overflows is not finite or not positive definite, and refused as such
        return _read(Path(path), dialect)


def _read(path: Path, dialect: str | None) -> GraphFile:
    file = str(path)
    buckets = read_buckets(path)
    chosen = sniffed(path, buckets) if dialect is None else _named(file, dialect)
    _refuse_foreign(file, chosen, buckets)
    offsets = _identity_offsets(file, buckets)
    vertices = [
        _vertices(file, name, chosen.vertices[name], buckets[name]) for name in buckets if name in chosen.vertices
    ]
    edges = [_edges(file, name, chosen.edges[name], buckets[name], offsets) for name in buckets if name in chosen.edges]
    fixes = _fixes(file, buckets["FIX"]) if "FIX" in buckets else None
    apart = chosen.one_numbering and numbered_apart(vertices)
    batch, lines = assembled(file, chosen.one_numbering and not apart, vertices, edges, fixes)
    notes = [f"{len(buckets[name].rests)} {note}" for name, note in chosen.unspoken.items() if name in buckets]
    if apart:
        notes.append("poses and points are numbered separately")
    return GraphFile(file, chosen.name, batch, lines, tuple(notes))


def _named(file: str, dialect: str) -> Dialect:
    if dialect not in DIALECTS:
        raise FormatError(file, None, f"dialect {dialect!r}", f"one of {', '.join(DIALECTS)}")
    return DIALECTS[dialect]


def _refuse_foreign(file: str, dialect: Dialect, buckets: Mapping[str, Bucket]) -> None:
    """Raise FormatError for the first line whose record the dialect does not have."""
    foreign = [name for name in buckets if name not in dialect.names and name not in dialect.unspoken]
    if foreign:
        name = min(foreign, key=lambda name: buckets[name].numbers[0])
        line = buckets[name].numbers[0]
        if name in dialect.refused:
            raise FormatError(file, line, f"record {name}", f"a record that can be read here ({dialect.refused[name]})")
        shown = name if len(name) <= 40 else name[:37] + "..."
        raise FormatError(
            file, line, f"unknown record {shown!r}", f"a {dialect.name} record: {', '.join(dialect.names)}"
        )


@dataclass(frozen=True, slots=True)
class _Offsets:
    """Parameters of the file: the ids there are, and those that are the identity."""

    known: frozenset[int]
    identity: frozenset[int]


def _identity_offsets(file: str, buckets: Mapping[str, Bucket]) -> _Offsets:
    name = "PARAMS_SE3OFFSET"
    if name not in buckets:
        return _Offsets(frozenset(), frozenset())
    ids, poses = read_numbers(file, name, buckets[name], 1, 8, "id x y z qx qy qz qw")
    poses = normalised_poses(file, name, np.array(buckets[name].numbers), poses)
    at_origin = (poses[:, :6] == 0).all(axis=1)
    moved = frozenset(ids[~at_origin, 0].tolist())
    return _Offsets(frozenset(ids[:, 0].tolist()), frozenset(ids[:, 0].tolist()) - moved)


def _vertices(file: str, name: str, record: Vertex, bucket: Bucket) -> VertexColumns:
    ids, values = read_numbers(file, name, bucket, record.ids, record.width, record.fields)
    lines = np.array(bucket.numbers, np.int64)
    if record.kind == "se3":
        values = normalised_poses(file, name, lines, values)
    return VertexColumns(record.kind, lines, ids[:, 0], np.ascontiguousarray(values))


def _edges(file: str, name: str, record: Edge, bucket: Bucket, offsets: _Offsets) -> EdgeColumns:
    """One record of edges, in our terms and checked."""
    if record.weight == "euler_root":
        bucket = _with_roots(bucket, record)
    ids, numbers = read_numbers(file, name, bucket, record.ids + record.offset, record.width, record.fields)
    lines = np.array(bucket.numbers, np.int64)
    if record.offset:
        _refuse_offsets(file, name, lines, ids[:, -1], offsets)
        ids = ids[:, :-1]
    if record.ids == 2 and record.kind.startswith("between"):
        loops = ids[:, 0] == ids[:, 1]
        refuse_first(file, lines, loops, lambda row: f"{name} from {ids[row, 0]} to itself", "two different vertices")
    measured, weights = numbers[:, : record.measured], numbers[:, record.measured :]
    ids, measured, information = _converted(file, name, record, lines, ids, measured, weights)
    if FACTOR_KINDS[record.kind].size == 7:
        measured = normalised_poses(file, name, lines, measured)
    if record.kind == "bearing_range_se2":
        refuse_first(
            file, lines, measured[:, 1] <= 0, lambda row: f"{name} with range {measured[row, 1]:g}", "a range above 0"
        )
    information = checked_information(file, name, lines, information, FACTOR_KINDS[record.kind].dim)
    return EdgeColumns(
        record.kind, lines, np.ascontiguousarray(ids), np.ascontiguousarray(measured), np.ascontiguousarray(information)
    )


def _converted(
    file: str, name: str, record: Edge, lines: I64, ids: I64, measured: F64, weights: F64
) -> tuple[I64, F64, F64]:
    """(ids, measured, information) in our terms."""
    dim = FACTOR_KINDS[record.kind].dim
    if record.weight == "euler_root":
        ids, measured, information = isam_edges3(ids, measured, weights)
        return ids, measured, information
    if record.weight == "root":
        return ids, measured, squared(weights, dim)
    if record.weight == "sigmas":
        bad = ~(weights > 0).all(axis=1)
        refuse_first(
            file, lines, bad, lambda row: f"{name} with standard deviations {weights[row].tolist()}", "all above 0"
        )
        return ids, measured, packed_upper(np.eye(dim) * (weights**-2.0)[:, None, :])
    return ids, measured, weights[:, record.order] if record.order else weights


def _with_roots(bucket: Bucket, record: Edge) -> Bucket:
    """The bucket with the identity added to the lines that end after the measurement, as iSAM reads them."""
    short = record.ids + record.measured
    rests = [rest + b" " + _IDENTITY_ROOT if len(rest.split()) == short else rest for rest in bucket.rests]
    return Bucket(rests, bucket.numbers)


def _refuse_offsets(file: str, name: str, lines: I64, parameters: I64, offsets: _Offsets) -> None:
    unknown = ~np.isin(parameters, list(offsets.known))
    refuse_first(
        file,
        lines,
        unknown,
        lambda row: f"{name} with parameter {parameters[row]}, which no line declares",
        f"a line PARAMS_SE3OFFSET {parameters[int(np.argmax(unknown))] if unknown.any() else 0} 0 0 0 0 0 0 1",
    )
    refuse_first(
        file,
        lines,
        ~np.isin(parameters, list(offsets.identity)),
        lambda row: f"{name} from a sensor beside the pose (PARAMS_SE3OFFSET {parameters[row]} is not the identity)",
        "measurements in the frame of the pose itself",
    )


def _fixes(file: str, bucket: Bucket) -> tuple[I64, I64]:
    """(ids, lines) of FIX lines; one line may name several vertices."""
    words = [
        (word, line) for rest, line in zip(bucket.rests, bucket.numbers, strict=True) for word in rest.split() or [b""]
    ]
    flat = Bucket([word for word, _ in words], [line for _, line in words])
    ids, _ = read_numbers(file, "FIX", flat, 1, 1, "the id of a vertex")
    return ids[:, 0], np.array(flat.numbers, np.int64)
