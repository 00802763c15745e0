"""Read JRL files: `jrl` has the records."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factorbus.formats.assemble import KIND_WORDS, EdgeColumns, VertexColumns, assembled
from factorbus.formats.bearing_ranges import positions_of_bearings
from factorbus.formats.cbor import is_cbor, parsed_cbor
from factorbus.formats.errors import FormatError, refuse_first
from factorbus.formats.jrl import (
    BEARING_RANGE_3D,
    FACTORS,
    GTSAM_ORDER,
    PRIORS,
    VALUES,
    measured_numbers,
    value_numbers,
)
from factorbus.formats.json_parts import Part, abridged, parsed_json
from factorbus.formats.left_out import LeftOut
from factorbus.formats.outlier_labels import OUTLIERS, POTENTIAL_OUTLIERS, labelled_factors, listed, robots_in
from factorbus.formats.robot_log import FactorLabels, RobotLog, first_mentions
from factorbus.formats.rotations import normalized_poses
from factorbus.formats.weights import checked_information, doubled_rotations, inverted_weights, packed_upper
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.stamps import LEAST_STAMP, MOST_STAMP, NO_STAMP
from factorbus.proto.symbols import MAX_KEY, format_symbol

_SYMMETRIC = 1e-6  # of the largest entry: files have at least six digits


@dataclass(frozen=True, slots=True)
class _Entry:
    """What a robot measured at a time; number: its place among the entries of the robot."""

    robot: str
    number: int
    stamp: int
    measurements: list[Part]


@dataclass(frozen=True, slots=True)
class _Row:
    """A factor: its turn in the file, its keys, what was measured and its covariance (d²,), and where it stands."""

    turn: int
    keys: tuple[int, ...]
    measured: list[float]
    covariance: list[float]
    entry: _Entry
    number: int


@dataclass(frozen=True, slots=True)
class _Value:
    """The value of a variable: its turn in the file, its key and its numbers."""

    turn: int
    key: int
    numbers: list[float]


@dataclass(frozen=True, slots=True)
class _Values:
    """Values by the name of their type, and the time stamps that stand beside them, None for one that has none."""

    rows: dict[str, list[_Value]] = field(default_factory=lambda: defaultdict(list))
    stamps: dict[int, int | None] = field(default_factory=dict)


def is_jrl(content: bytes) -> bool:
    """Whether a file is JSON or CBOR, which no other form is."""
    return content.lstrip()[:1] == b"{" or is_cbor(content)


def read_jrl(file: str, content: bytes, left: LeftOut) -> tuple[Batch, tuple[I64, ...], RobotLog]:
    """(the graph, the turn of each factor for each group of factors, the log that it is of).

    Measurements take turns by the stamps of their entries.  These are the time stamps of the poses that they are the
    first to name, unless all are 0.  Raises FormatError, which names the place in the file.
    """
    document = parsed_cbor(file, content) if is_cbor(content) else parsed_json(file, content)
    places: list[Part] = []  # what takes turn 0, 1, 2 ...
    entries = _entries(document)
    rows = _rows(entries, places, left)
    values, truth = (_values(document, name, places, left) for name in ("initialization", "groundtruth"))
    _refuse_clashes(rows, values, places)
    _refuse_other_truth(values, truth, places)
    with _placed(places):
        edges = [_edges(file, name, of) for name, of in rows.items()]
        vertices, known = ([_vertices(file, *each) for each in of.rows.items()] for of in (values, truth))
        batch, turns = assembled(file, True, False, vertices, edges, None)
    name = document.find("name")
    true = Batch(tuple(Variables(of.kind, of.ids, of.values) for of in known))
    log = RobotLog(
        "" if name is None else name.text(),
        _labels(document, entries, rows, turns, left),
        _stamped(true, entries, rows, {**values.stamps, **truth.stamps}).variables,
    )
    if told := log.told():
        left.say(told)
    if seen := len(rows.get(BEARING_RANGE_3D, [])):
        left.say(f"{seen:,} {BEARING_RANGE_3D} read as positions in the frames of the poses, exact to first order")
    return _stamped(batch, entries, rows, values.stamps), turns, log


def _refuse_other_truth(values: _Values, truth: _Values, places: list[Part]) -> None:
    """The truth of a variable has the type of its value, and all truth is of the plane or all of space."""
    types = {value.key: name for name, of in values.rows.items() for value in of}
    every = [(name, value) for name, of in truth.rows.items() for value in of]
    for name, value in every:
        if (wanted := types.get(value.key, name)) != name:
            raise places[value.turn].refused(f"a {wanted}, as its initialization is", f"the truth is a {name}")
        if name[-1] != every[0][0][-1]:
            raise places[value.turn].refused(f"all of the plane or all of space, as the {every[0][0]} before", name)


def _entries(document: Part) -> list[_Entry]:
    """The entries of all robots by their stamps; those of one stamp in the order of the file.  Raises FormatError."""
    entries = []
    for robot, part in robots_in(document.member("measurements")):
        for number, entry in enumerate(listed(part)):
            stamp = entry.member("stamp").whole(0, MOST_STAMP)
            entries.append(_Entry(robot, number, stamp, listed(entry.find("measurements"))))
    return sorted(entries, key=lambda entry: entry.stamp)


def _rows(entries: list[_Entry], places: list[Part], left: LeftOut) -> dict[str, list[_Row]]:
    """Measurements by the name of their type.  Raises FormatError."""
    rows: dict[str, list[_Row]] = defaultdict(list)
    foreign: dict[str, list[Part]] = defaultdict(list)
    for entry in entries:
        for number, part in enumerate(entry.measurements):
            name = part.member("type").text()
            if name in FACTORS:
                rows[name].append(_row(name, part, entry, number, len(places)))
                places.append(part)
            else:
                foreign[name].append(part)
    for name, parts in foreign.items():
        left.drop(abridged(name), len(parts), f"no JRL measurement that is read; the first is {parts[0].place}")
    return rows


def _row(name: str, part: Part, entry: _Entry, number: int, turn: int) -> _Row:
    dim = FACTOR_KINDS[FACTORS[name]].dim
    keys = tuple(part.member(key).whole(0, MAX_KEY) for key in (("key",) if name in PRIORS else ("key1", "key2")))
    measured = measured_numbers(name, part.member("prior" if name in PRIORS else "measurement"))
    return _Row(turn, keys, measured, part.member("covariance").numbers(dim * dim), entry, number)


def _values(document: Part, what: str, places: list[Part], left: LeftOut) -> _Values:
    """The values of all robots in a member of the document.  Raises FormatError."""
    found = _Values()
    foreign: dict[str, list[Part]] = defaultdict(list)
    seen: dict[int, tuple[str, list[float], Part]] = {}
    for key, part in (each for _, of in robots_in(document.find(what)) for each in _valued(of)):
        name = part.member("type").text()
        if name not in VALUES:
            foreign[name].append(part)
            continue
        numbers = value_numbers(name, part)
        before, its, where = seen.setdefault(key, (name, numbers, part))
        if (before, its) != (name, numbers):
            raise part.refused("one value for a key", f"{format_symbol(key)} again, other than at {where.place}")
        if where is part:
            found.rows[name].append(_Value(len(places), key, numbers))
            places.append(part)
        if "stamp" in part.value:
            stamp = part.find("stamp")
            found.stamps[key] = None if stamp is None else stamp.whole(LEAST_STAMP, MOST_STAMP)
    for name, parts in foreign.items():
        why = f"no JRL value that is read; the first is {parts[0].place}"
        left.drop(f"{what} {abridged(name)}", len(parts), why)
    return found


def _valued(of_robot: Part) -> Iterator[tuple[int, Part]]:
    """(key, value) of a robot, whether they are in an array or by their keys.  Raises FormatError."""
    if not isinstance(of_robot.value, dict):
        yield from ((value.member("key").whole(0, MAX_KEY), value) for value in listed(of_robot))
        return
    for name, value in of_robot.members().items():
        if not (name.isascii() and name.isdigit() and len(name) < 20 and int(name) <= MAX_KEY):
            raise value.refused(f"a whole number from 0 to {MAX_KEY}", f"the key {abridged(name)!r}")
        yield int(name), value


def _refuse_clashes(rows: Mapping[str, list[_Row]], values: _Values, places: list[Part]) -> None:
    """Refuse a key of two kinds of variables.  Raises FormatError."""
    mentions = [
        (row.turn, key, kind)
        for name, of in rows.items()
        for row in of
        for key, kind in zip(row.keys, FACTOR_KINDS[FACTORS[name]].connects, strict=True)
    ]
    mentions += [(value.turn, value.key, VALUES[name]) for name, of in values.rows.items() for value in of]
    kinds: dict[int, tuple[str, int]] = {}
    for turn, key, kind in mentions:
        before, first = kinds.setdefault(key, (kind, turn))
        if before != kind:
            seen = f"{format_symbol(key)} as {KIND_WORDS[kind]}, which is {KIND_WORDS[before]} at {places[first].place}"
            raise places[turn].refused("one kind of variable for a key", seen)


@contextmanager
def _placed(places: list[Part]) -> Iterator[None]:
    """Name the place of what is refused by its turn, in place of a line."""
    try:
        yield
    except FormatError as error:
        if error.line is None:
            raise
        raise places[error.line].refused(error.wanted, error.found) from error


def _vertices(file: str, name: str, values: list[_Value]) -> VertexColumns:
    turns = np.array([value.turn for value in values], np.int64)
    numbers = np.array([value.numbers for value in values])
    if VALUES[name] == "se3":
        numbers = normalized_poses(file, name, turns, numbers)
    return VertexColumns(VALUES[name], turns, np.array([value.key for value in values], np.int64), numbers)


def _edges(file: str, name: str, rows: list[_Row]) -> EdgeColumns:
    """In our terms and checked.  Raises FormatError."""
    about = FACTOR_KINDS[FACTORS[name]]
    turns, keys = np.array([row.turn for row in rows], np.int64), np.array([row.keys for row in rows], np.int64)
    measured = np.array([row.measured for row in rows])
    covariance = np.array([row.covariance for row in rows]).reshape(-1, about.dim, about.dim)
    if keys.shape[1] == 2:
        loops = keys[:, 0] == keys[:, 1]
        refuse_first(
            file,
            turns,
            loops,
            lambda row: f"{name} from {format_symbol(int(keys[row, 0]))} to itself",
            "two variables",
        )
    if "Range" in name:
        bad = measured[:, -1] <= 0
        refuse_first(file, turns, bad, lambda row: f"{name} of {measured[row, -1]:g}", "a distance above 0")
    if about.size == 7:
        measured = normalized_poses(file, name, turns, measured)
    if name == BEARING_RANGE_3D:
        length = np.linalg.norm(measured[:, :3], axis=1)
        refuse_first(file, turns, length == 0, lambda _: f"{name} along no direction", "a direction of some length")
        measured[:, :3] /= length[:, None]
        _checked_covariance(file, name, turns, covariance)
        measured, covariance = positions_of_bearings(measured, covariance)
        covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    information = _information(file, name, turns, covariance)
    return EdgeColumns(about.name, turns, keys, np.ascontiguousarray(measured), information)


def _information(file: str, name: str, turns: I64, covariance: F64) -> F64:
    """Information of whole covariances (n, d, d) in GTSAM's order, packed in ours.  Raises FormatError."""
    about = FACTOR_KINDS[FACTORS[name]]
    if about.half_angles:
        covariance = covariance[:, GTSAM_ORDER][:, :, GTSAM_ORDER]
    packed = _checked_covariance(file, name, turns, covariance)
    information = inverted_weights(packed, about.dim)
    information = doubled_rotations(information) if about.half_angles else information
    return np.ascontiguousarray(checked_information(file, name, turns, information, about.dim))


def _checked_covariance(file: str, name: str, turns: I64, covariance: F64) -> F64:
    """Whole covariances, packed.  Raises FormatError where one is none."""
    apart = np.abs(covariance - np.swapaxes(covariance, 1, 2)).max(axis=(1, 2))
    askew = ~(apart <= _SYMMETRIC * np.abs(covariance).max(axis=(1, 2)))
    wanted = "a symmetric positive definite matrix"
    refuse_first(file, turns, askew, lambda row: f"{name} with a covariance matrix that is not symmetric", wanted)
    return checked_information(file, name, turns, packed_upper(covariance), covariance.shape[1], "a covariance")


def _stamped(
    batch: Batch, entries: list[_Entry], rows: Mapping[str, list[_Row]], beside: Mapping[int, int | None]
) -> Batch:
    """The same with time stamps: those beside the values, and of poses those of the entries that first name them."""
    named: dict[int, list[int]] = defaultdict(list)
    for row in (row for of in rows.values() for row in of):
        named[id(row.entry)] += row.keys
    timed = any(entry.stamp for entry in entries)
    stamps = first_mentions((entry.robot, entry.stamp, named[id(entry)]) for entry in entries) if timed else {}
    groups = []
    for group in batch.variables:
        first = stamps if VARIABLE_KINDS[group.kind].is_pose else {}
        times = [beside.get(key, first.get(key)) for key in group.keys.tolist()]
        column = np.array([NO_STAMP if time is None else time for time in times], np.int64)
        groups.append(group._replace(stamps=column) if (column != NO_STAMP).any() else group)
    return Batch(tuple(groups), batch.factors)


def _labels(
    document: Part,
    entries: list[_Entry],
    rows: Mapping[str, list[_Row]],
    turns: tuple[I64, ...],
    left: LeftOut,
) -> tuple[FactorLabels, ...]:
    """What else is said of the factors.  Raises FormatError."""
    by_turn = {row.turn: row for of in rows.values() for row in of}
    sizes = {(entry.robot, entry.number): len(entry.measurements) for entry in entries}
    potential, outlier = (labelled_factors(document, name, sizes, left) for name in (POTENTIAL_OUTLIERS, OUTLIERS))

    def flags(group: list[_Row], chosen: set[tuple[str, int, int]]) -> NDArray[np.bool]:
        return np.array([(row.entry.robot, row.entry.number, row.number) in chosen for row in group], bool)

    labels = []
    for at in turns:
        group = [by_turn[turn] for turn in at.tolist()]
        stamps = np.array([row.entry.stamp for row in group], np.int64)
        robots = np.array([ord(row.entry.robot) for row in group], np.int64)
        labels.append(FactorLabels(stamps, robots, flags(group, potential), flags(group, outlier)))
    return tuple(labels)
