"""From the lines of one record of edges to factors in our terms."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from factorbus.formats.assemble import EdgeColumns
from factorbus.formats.errors import refuse_first
from factorbus.formats.left_out import LeftOut
from factorbus.formats.lines import Bucket
from factorbus.formats.numbers import read_numbers
from factorbus.formats.offsets import Offsets, has_lever, is_moved, seen_from_pose
from factorbus.formats.records import SWITCH_PRIOR, Edge
from factorbus.formats.rotations import isam_edges3, normalized_poses
from factorbus.formats.weights import checked_information, packed_upper, squared
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS

_IDENTITY_ROOT = b" ".join(b"1" if i == j else b"0" for i in range(6) for j in range(i, 6))


@dataclass(slots=True)
class Reading:
    """What edges need to know of the rest of the file, and what they have asked for.

    named: the numbers of the offsets in space that edges name.
    """

    file: str
    offsets: Offsets
    switches: Mapping[int, float]
    left: LeftOut
    named: set[int]


@dataclass(frozen=True, slots=True)
class Lead:
    """Edges with a number before the measurement: of a switch (its loss is set already) or of a mixture."""

    name: str
    columns: EdgeColumns
    weight: F64


def read_switches(file: str, buckets: Mapping[str, Bucket]) -> dict[int, float]:
    """The information with which each switch is held on.  Raises FormatError."""
    if SWITCH_PRIOR not in buckets:
        return {}
    bucket = buckets[SWITCH_PRIOR]
    ids, numbers = read_numbers(file, SWITCH_PRIOR, bucket, 1, 3, "id of a switch, its value, information")
    lines = np.array(bucket.numbers, np.int64)
    bad = ~(numbers[:, 1] > 0)
    refuse_first(
        file, lines, bad, lambda row: f"{SWITCH_PRIOR} with information {numbers[row, 1]:g}", "information above 0"
    )
    return dict(zip(ids[:, 0].tolist(), numbers[:, 1].tolist(), strict=True))


def read_edges(name: str, record: Edge, bucket: Bucket, reading: Reading) -> list[EdgeColumns | Lead]:
    """One record of edges, in our terms and checked.  Raises FormatError."""
    bucket = _prepared(name, record, bucket, reading.left)
    if not record.optional:
        return [_columns(name, record, bucket, reading)]
    short = [len(rest.split()) == record.width - record.parameters for rest in bucket.rests]
    parts = [
        (replace(record, parameters=0, optional=False), _chosen(bucket, short, True)),
        (record, _chosen(bucket, short, False)),
    ]
    return [_columns(name, form, part, reading) for form, part in parts if part.rests]


def _prepared(name: str, record: Edge, bucket: Bucket, left: LeftOut) -> Bucket:
    """The lines with as many fields as the record has, where what is too much or missing has a meaning."""
    if record.weight == "euler_root":
        return _with_roots(bucket, record)
    if record.extra and any(long := [len(rest.split()) == record.width + 1 for rest in bucket.rests]):
        left.say(f"{sum(long)} {name} with a number behind the information, as RTAB-Map has it: not looked at")
        cut = [rest.rsplit(None, 1)[0] if is_long else rest for rest, is_long in zip(bucket.rests, long, strict=True)]
        return Bucket(cut, bucket.numbers)
    return bucket


def _chosen(bucket: Bucket, short: list[bool], wanted: bool) -> Bucket:
    rows = [row for row, is_short in enumerate(short) if is_short == wanted]
    return Bucket([bucket.rests[row] for row in rows], [bucket.numbers[row] for row in rows])


def _columns(name: str, record: Edge, bucket: Bucket, reading: Reading) -> EdgeColumns | Lead:
    file, kind = reading.file, FACTOR_KINDS[record.kind]
    heads = record.ids + record.parameters + (record.lead == "switch")
    ids, numbers = read_numbers(file, name, bucket, heads, record.width, record.fields)
    lines = np.array(bucket.numbers, np.int64)
    ends, heads_left = ids[:, : record.ids], ids[:, record.ids :]
    if record.ids == 2 and kind.connects[0] == kind.connects[1]:
        loops = ends[:, 0] == ends[:, 1]
        refuse_first(file, lines, loops, lambda row: f"{name} from {ends[row, 0]} to itself", "two different vertices")
    lead, numbers = (numbers[:, 0], numbers[:, 1:]) if record.lead == "mixture" else (None, numbers)
    measured, weights = numbers[:, : record.measured], numbers[:, record.measured :]
    ends, measured, information = _converted(file, name, record, lines, ends, measured, weights)
    if measured.shape[1] == 7:
        measured = normalized_poses(file, name, lines, measured)
    if record.kind == "bearing_range_se2":
        refuse_first(
            file, lines, measured[:, 1] <= 0, lambda row: f"{name} with range {measured[row, 1]:g}", "a range above 0"
        )
    information = checked_information(file, name, lines, information, kind.dim)
    measured, information = _on_the_pose(name, record, lines, heads_left, measured, information, reading)
    ends, measured = np.ascontiguousarray(ends), np.ascontiguousarray(measured)
    columns = EdgeColumns(record.kind, lines, ends, measured, np.ascontiguousarray(information))
    if record.lead == "switch":
        scale = np.sqrt([reading.switches.get(number, 1.0) for number in heads_left[:, -1].tolist()])
        reading.left.say(f"{len(lines)} {name} read with the loss dcs, each as wide as its switch is held on")
        return replace(columns, loss="dcs", scale=scale)
    return columns if lead is None else Lead(name, columns, lead)


def _on_the_pose(
    name: str, record: Edge, lines: I64, heads: I64, measured: F64, information: F64, reading: Reading
) -> tuple[F64, F64]:
    """(measured, information) in the frame of the pose, not of a sensor beside it."""
    kind = FACTOR_KINDS[record.kind]
    missing = kind.size - measured.shape[1]  # a position, whose antenna is on the pose
    measured = np.pad(measured, ((0, 0), (0, missing))) if missing else measured
    if not record.parameters:
        return measured, information
    space = kind.connects[0]
    numbers = [heads[:, column] for column in range(record.parameters)]
    places = [reading.offsets.of(reading.file, name, space, lines, column) for column in numbers]
    if space == "se3" and record.applied:
        reading.named.update(*(column.tolist() for column in numbers))
    if not record.applied:
        beside = int(is_moved(places).sum())
        if beside:
            reading.left.say(f"{beside} {name}: their offset is not applied, as g2o does not apply it in this record")
        return measured, information
    if has_lever(record.kind, places):
        reading.left.say(f"{name}: of a sensor beside the pose, its weight is carried over to first order in the error")
    moved, weights = seen_from_pose(record.kind, places, measured, information)
    return moved, checked_information(reading.file, name, lines, weights, kind.dim)


def _converted(
    file: str, name: str, record: Edge, lines: I64, ids: I64, measured: F64, weights: F64
) -> tuple[I64, F64, F64]:
    """(ids, measured, information) in our terms."""
    dim = FACTOR_KINDS[record.kind].dim
    if record.weight == "euler_root":
        return isam_edges3(ids, measured, weights)
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
