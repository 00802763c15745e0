"""Write a graph as a JRL file: `jrl` has the records.

Values, measurements, keys and times are written so that reading gives the same bits.  Of an information matrix the
file has the inverse, so its last digits may differ.
"""

import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from factorbus.formats.bearing_ranges import bearings_of_positions
from factorbus.formats.cbor import as_cbor
from factorbus.formats.errors import FormatError
from factorbus.formats.jrl import BEARING_RANGE_3D, FACTORS, GTSAM_ORDER, JRL, VALUES, as_measured, as_value
from factorbus.formats.left_out import FileNotes, LeftOut
from factorbus.formats.outlier_labels import OUTLIERS, POTENTIAL_OUTLIERS
from factorbus.formats.robot_log import RobotLog, first_mentions
from factorbus.formats.weights import doubled_rotations, inverted_weights, unpacked_symmetric
from factorbus.formats.whole_file import write_whole
from factorbus.formats.writable import Form, Written, writable
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol_parts

_VALUE_NAMES = {kind: name for name, kind in VALUES.items()}
_FACTOR_NAMES = {kind: name for name, kind in FACTORS.items()}
_FORM = Form(
    "JRL (.jrl, .jrl.cbor)",
    frozenset(_VALUE_NAMES),
    {kind: FACTOR_KINDS[kind].size for kind in _FACTOR_NAMES},
    frozenset(_VALUE_NAMES),
    fixes=False,
    covariances=True,
)
_NOBODY = "a"  # the robot of keys without a letter
CBOR = ".cbor"  # the ending of a file that is coded so


@dataclass(frozen=True, slots=True)
class _Measurement:
    """What a robot measured at a time; turn: orders what has no time.  Whether it may be, and is, an outlier."""

    robot: str
    stamp: int
    turn: int
    keys: list[int]
    record: dict[str, Any]
    potential: bool = False
    outlier: bool = False


def write_jrl(
    path: str | os.PathLike[str], batch: Batch, strict: bool = False, log: RobotLog | None = None
) -> FileNotes:
    """Write `batch` to a path, as `as_jrl` makes it, in CBOR for .cbor; returns its notes.  Raises FormatError."""
    left = LeftOut(JRL, strict)
    document = _document(batch, log, Path(path).stem.removesuffix(f".{JRL}"), left)
    if Path(path).suffix == CBOR:
        write_whole(path, as_cbor(document))
    else:
        write_whole(path, _text(document), encoding="ascii")
    return left.told()


def recoded(text: str) -> bytes:
    """JRL text in CBOR, as a .cbor has it."""
    return as_cbor(json.loads(text))


def as_jrl(batch: Batch, strict: bool = False, log: RobotLog | None = None, name: str = "factorbus") -> Written:
    """`batch` as JRL text: the entries of each robot by their time, the values that there are, and what `log` has.

    log: of the same groups of factors; without its labels a factor was measured by the robot of the last of its poses,
    at its time, and without it `name` is that of the data set.  Without time stamps all are 0, and an entry has what a
    pose came with.  What JRL has no record for is left out and said: losses (the factor stays, without), which
    variables are fixed, factors and variables of other kinds.  With `strict` it is refused instead.  Raises
    FormatError, before anything is written.
    """
    left = LeftOut(JRL, strict)
    text = _text(_document(batch, log, name, left))
    return Written(text, left.told())


def _document(batch: Batch, log: RobotLog | None, name: str, left: LeftOut) -> dict[str, Any]:
    """What the file says.  Raises FormatError."""
    _refuse_negative(batch)
    kept = writable(batch, _FORM, left)
    _say_bearings(kept, left)
    robots = _robots(kept)
    measurements = sorted(_measurements(kept, robots, log), key=lambda one: (one.stamp, one.turn))
    beside = _beside(kept.variables, measurements, left)
    entries = _entries(measurements)
    letters = sorted({*robots.values(), *entries})
    document: dict[str, Any] = {"name": log.name if log else name, "robots": [ord(letter) for letter in letters]}
    document["measurements"] = {letter: [_entry(one) for one in entries.get(letter, [])] for letter in letters}
    beside_them = {
        "initialization": _values(kept.variables, letters, robots, beside),
        "groundtruth": _values(log.ground_truth if log else (), letters, robots, {}),
        POTENTIAL_OUTLIERS: {a: _places(entries.get(a, []), lambda one: one.potential) for a in letters},
        OUTLIERS: {a: _places(entries.get(a, []), lambda one: one.outlier) for a in letters},
    }
    return document | {title: of for title, of in beside_them.items() if any(of.values())}


def _say_bearings(batch: Batch, left: LeftOut) -> None:
    """What of points in space is written as directions and distances.  Raises FormatError."""
    seen = np.concatenate([np.empty((0, 3)), *(of.measured for of in batch.factors if of.kind == "landmark_se3")])
    nowhere = int((~seen.any(axis=1)).sum())
    left.drop("landmark_se3", nowhere, "a point that is where its pose is has no direction")
    if len(seen) > nowhere:
        left.say(f"{len(seen) - nowhere:,} landmark_se3 written as {BEARING_RANGE_3D}, exact to first order")


def _refuse_negative(batch: Batch) -> None:
    keys = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables)])
    if (keys < 0).any():
        raise FormatError(JRL, None, f"the key {keys.min()}", "keys from 0")


def _robots(batch: Batch) -> dict[int, str]:
    """The robot of each variable: the letter of a pose; of a point, the robot that first saw it."""
    keys = [key for group in batch.variables if VARIABLE_KINDS[group.kind].is_pose for key in group.keys.tolist()]
    robots = {key: _letter(key) for key in keys}
    anybody = robots[keys[0]] if keys else _NOBODY
    for group in batch.factors:
        if FACTOR_KINDS[group.kind].sees_landmark:
            for pose, point in group.keys.tolist():
                robots.setdefault(point, robots[pose])
    return {key: anybody for group in batch.variables for key in group.keys.tolist()} | robots


def _letter(key: int) -> str:
    return symbol_parts(key)[0] or _NOBODY


def _measurements(batch: Batch, robots: Mapping[int, str], log: RobotLog | None) -> Iterator[_Measurement]:
    poses = [group for group in batch.variables if VARIABLE_KINDS[group.kind].is_pose]
    times = {key: time for group in poses for key, time in _times(group) if time is not None and time >= 0}
    order = sorted((key for group in poses for key in group.keys.tolist()), key=lambda key: (times.get(key, 0), key))
    turn = {key: at for at, key in enumerate(order)}
    for number, group in enumerate(batch.factors):
        labels = log.labels[number] if log and log.labels else None
        for row, (keys, record) in enumerate(zip(group.keys.tolist(), _records(group), strict=True)):
            if record is None:
                continue
            last = max(keys, key=lambda key: turn.get(key, -1))
            robot, stamp = robots[last], times.get(last, 0)
            potential = outlier = False
            if labels is not None:
                robot, stamp = chr(labels.robots[row]), int(labels.stamps[row])
                potential, outlier = bool(labels.potential[row]), bool(labels.outlier[row])
            yield _Measurement(robot, stamp, 0 if stamp else turn.get(last, 0), keys, record, potential, outlier)


def _times(group: Variables) -> Iterator[tuple[int, int | None]]:
    """The key and the time stamp of each variable."""
    stamps = [NO_STAMP] * len(group.keys) if group.stamps is None else group.stamps.tolist()
    for key, stamp in zip(group.keys.tolist(), stamps, strict=True):
        yield key, None if stamp == NO_STAMP else stamp


def _records(group: Factors) -> Iterator[dict[str, Any] | None]:
    """Measurements as JSON has them; None: there is no record for it."""
    name, kind = _FACTOR_NAMES[group.kind], FACTOR_KINDS[group.kind]
    packed = inverted_weights(group.information, kind.dim)
    covariance = unpacked_symmetric(doubled_rotations(packed) if kind.half_angles else packed, kind.dim)
    if kind.half_angles:
        covariance = covariance[:, GTSAM_ORDER][:, :, GTSAM_ORDER]
    measured = group.measured
    if name == BEARING_RANGE_3D:
        with np.errstate(invalid="ignore"):  # of points that are where their pose is
            measured, covariance = bearings_of_positions(measured, covariance)
    flat = covariance.reshape(-1, kind.dim**2).tolist()
    for keys, numbers, row in zip(group.keys.tolist(), measured.tolist(), flat, strict=True):
        if name == BEARING_RANGE_3D and numbers[-1] == 0.0:
            yield None
        elif len(keys) == 1:
            yield {"type": name, "key": keys[0], "prior": as_measured(name, numbers), "covariance": row}
        else:
            ends = {"key1": keys[0], "key2": keys[1]}
            yield {"type": name, **ends, "measurement": as_measured(name, numbers), "covariance": row}


def _beside(groups: Iterable[Variables], measurements: list[_Measurement], left: LeftOut) -> dict[int, int | None]:
    """Time stamps that the entries do not tell, to stand beside the values, None for a variable that has none."""
    timed = any(one.stamp for one in measurements)
    told = first_mentions((one.robot, one.stamp, one.keys) for one in measurements) if timed else {}
    beside, untold = {}, 0
    for group in groups:
        for key, stamp in _times(group):
            if stamp != (told.get(key) if VARIABLE_KINDS[group.kind].is_pose else None):
                beside[key] = stamp
                untold += group.values is None
    left.drop("time stamps", untold, "that of a variable without a value is that of its first measurement")
    return beside


def _entries(measurements: list[_Measurement]) -> dict[str, list[list[_Measurement]]]:
    """Of each robot what was measured together."""
    entries: dict[str, dict[tuple[int, int], list[_Measurement]]] = defaultdict(dict)
    for one in measurements:
        entries[one.robot].setdefault((one.stamp, one.turn), []).append(one)
    return {robot: list(of.values()) for robot, of in entries.items()}


def _entry(entry: list[_Measurement]) -> dict[str, Any]:
    return {"stamp": entry[0].stamp, "measurements": [one.record for one in entry]}


def _values(
    groups: Iterable[Variables], letters: list[str], robots: Mapping[int, str], beside: Mapping[int, int | None]
) -> dict[str, list[dict[str, Any]]]:
    values: dict[str, list[dict[str, Any]]] = {letter: [] for letter in letters}
    for group in groups:
        table = [] if group.values is None else group.values.tolist()
        for key, numbers in zip(group.keys.tolist() if table else [], table, strict=True):
            value = {**as_value(_VALUE_NAMES[group.kind], numbers), "key": key}
            stamp = {"stamp": beside[key]} if key in beside else {}
            values.setdefault(robots.get(key, _letter(key)), []).append(value | stamp)
    return values


def _places(entries: list[list[_Measurement]], chosen: Callable[[_Measurement], bool]) -> list[list[int]]:
    """[entry, measurement] of those chosen."""
    return [[at, number] for at, entry in enumerate(entries) for number, one in enumerate(entry) if chosen(one)]


def _text(document: dict[str, Any]) -> str:
    """One line for each entry and each value."""
    lines = []
    for title, content in document.items():
        if not isinstance(content, dict):
            lines.append(f"{json.dumps(title)}: {json.dumps(content)}")
        else:
            robots = [f"{json.dumps(letter)}: [{_lines(content[letter])}]" for letter in content]
            lines.append(f"{json.dumps(title)}: {{{', '.join(robots)}}}")
    return "{" + ",\n".join(lines) + "}\n"


def _lines(items: list[Any]) -> str:
    return "".join(["\n", ",\n".join(map(json.dumps, items))]) if items else ""
