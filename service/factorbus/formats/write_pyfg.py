"""Write a graph as PyFactorGraph's text: `pyfg` has the records.

Values, measurements, names and times are written so that reading gives the same bits.  Of an information matrix the
file has the inverse, so its last digits may differ.
"""

import os
from collections.abc import Iterator

import numpy as np

from factorbus.formats.left_out import FileNotes, LeftOut
from factorbus.formats.pyfg import FACTORS, PYFG, RANGE, RANGES, VERTICES
from factorbus.formats.seconds import seconds_text
from factorbus.formats.weights import doubled_rotations, inverted_weights
from factorbus.formats.whole_file import write_whole
from factorbus.formats.writable import Form, Written, number_text, writable
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import format_symbol
from factorbus.wording import counted

_VERTEX_NAMES = {record.kind: name for name, record in VERTICES.items()}
_FACTOR_NAMES = {record.kind: name for name, record in FACTORS.items()} | dict.fromkeys(RANGES.values(), RANGE)
_FORM = Form(
    "PyFactorGraph (.pyfg)",
    frozenset(_VERTEX_NAMES),
    {kind: FACTOR_KINDS[kind].size for kind in _FACTOR_NAMES},
    frozenset(record.kind for record in VERTICES.values() if record.timed),
    fixes=False,
    covariances=True,
)


def write_pyfg(path: str | os.PathLike[str], batch: Batch, strict: bool = False) -> FileNotes:
    """Write `batch` to a path, as `as_pyfg` makes it; returns its notes.  Raises FormatError."""
    written = as_pyfg(batch, strict)
    write_whole(path, written.text, encoding="ascii")
    return written.notes


def as_pyfg(batch: Batch, strict: bool = False) -> Written:
    """`batch` as pyfg text: vertices, poses first, then factors, each in the order of the batch.

    What pyfg has no record for is left out and said: losses (the factor stays, without), which variables are fixed,
    factors and variables of other kinds, times of points, variables without a value that no factor names.  With
    `strict` it is refused instead.  A factor has the time of the last of its poses.  Raises FormatError, before
    anything is written.
    """
    left = LeftOut(PYFG, strict)
    kept = writable(batch, _FORM, left)
    stamps = _stamps(kept, left)
    poses_first = sorted(kept.variables, key=lambda group: not VARIABLE_KINDS[group.kind].is_pose)
    lines = [line for group in poses_first for line in _vertex_lines(group, stamps)]
    lines += [line for group in kept.factors for line in _factor_lines(group, stamps)]
    return Written("\n".join([*lines, ""]), left.told())


def _stamps(batch: Batch, left: LeftOut) -> dict[int, int]:
    """The time stamp of each pose that has one; empty where the file could not say so."""
    timed = [group for group in batch.variables if group.kind in _FORM.timed]
    stamps = {
        key: stamp
        for group in timed
        if group.stamps is not None and group.values is not None
        for key, stamp in zip(group.keys.tolist(), group.stamps.tolist(), strict=True)
        if stamp != NO_STAMP
    }
    unsaid = [g.stamps for g in timed if g.values is None and g.stamps is not None]
    left.drop("time stamps", sum(int((s != NO_STAMP).sum()) for s in unsaid), "a pose without a value has no line")
    if not any(stamps.values()):
        left.drop("time stamps", len(stamps), "all are 0, which in a pyfg is a file without times")
        return {}
    without = sum(len(group.keys) for group in timed if group.values is not None) - len(stamps)
    if without:
        left.say(f"{counted(without, 'pose')} without a time stamp: written with the time 0")
    return stamps


def _vertex_lines(group: Variables, stamps: dict[int, int]) -> Iterator[str]:
    if group.values is not None:
        name = _VERTEX_NAMES[group.kind]
        timed = VERTICES[name].timed
        for key, values in zip(group.keys.tolist(), group.values.tolist(), strict=True):
            time = f"{seconds_text(stamps.get(key, 0))} " if timed else ""
            yield f"{name} {time}{format_symbol(key)} {number_text(values)}"


def _factor_lines(group: Factors, stamps: dict[int, int]) -> Iterator[str]:
    name, kind = _FACTOR_NAMES[group.kind], FACTOR_KINDS[group.kind]
    covariance = inverted_weights(group.information, kind.dim)
    if kind.half_angles:
        covariance = doubled_rotations(covariance)
    numbers = np.concatenate([group.measured, covariance], axis=1)
    for ends, row in zip(group.keys.tolist(), numbers.tolist(), strict=True):
        time = max((stamps[key] for key in ends if key in stamps), default=0)
        yield f"{name} {seconds_text(time)} {' '.join(map(format_symbol, ends))} {number_text(row)}"
