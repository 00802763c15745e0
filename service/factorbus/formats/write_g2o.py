"""Write a graph as g2o text.  Numbers are written so that reading gives the same bits."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.left_out import LeftOut, shown
from factorbus.formats.numbering import numbered
from factorbus.formats.records import G2O, Edge
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import format_symbol

_VERTEX_NAMES = {record.kind: name for name, record in G2O.vertices.items()}
# The first record of each kind that is read is the one to write, as long as it says nothing but the factor.
_EDGES: dict[str, tuple[str, Edge]] = {}
for _name, _record in G2O.edges.items():
    if not _record.lead:
        _EDGES.setdefault(_record.kind, (_name, _record))
_OFFSET = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"
# How many of what are left out, by name and reason.  A kind may come in several groups: each is said once for the file.
_Lost = Counter[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Written:
    """The text of a file; notes: what was left out of it, for people; left_out: the same, counted by kind."""

    text: str
    notes: tuple[str, ...]
    left_out: dict[str, int]


def write_g2o(
    path_or_file: str | os.PathLike[str] | TextIO, batch: Batch, strict: bool = False, ids: str = "auto"
) -> tuple[str, ...]:
    """Write `batch` to a path or an open text file, as `as_g2o` makes it; returns its notes.  Raises FormatError."""
    written = as_g2o(batch, strict, ids)
    if isinstance(path_or_file, str | os.PathLike):
        Path(path_or_file).write_text(written.text, encoding="ascii")
    else:
        path_or_file.write(written.text)
    return written.notes


def g2o_text(batch: Batch, strict: bool = False, ids: str = "auto") -> str:
    """The text alone.  Raises FormatError."""
    return as_g2o(batch, strict, ids).text


def as_g2o(batch: Batch, strict: bool = False, ids: str = "auto") -> Written:
    """`batch` as g2o text: parameters, vertices, FIX, edges, each in the order of the batch.

    What g2o has no record for is left out and said: losses (the edge stays, without), time stamps, factors and
    variables of other kinds, variables without a value that no edge names.  With `strict` it is refused instead.
    Variables without a value get no vertex line.  ids: how keys become ids (`numbering.numbered`).  Raises FormatError,
    before anything is written.
    """
    left = LeftOut("g2o", strict)
    kept = _writable(batch, left)
    keys, names = numbered(kept, ids, left)
    text = "\n".join([*_lines(kept, keys, names), ""])
    return Written(text, tuple(left.notes), dict(left.counts))


def _lines(batch: Batch, keys: I64, ids: I64) -> Iterator[str]:
    if any(_EDGES[group.kind][1].parameters for group in batch.factors):
        yield _OFFSET
    for group in batch.variables:
        yield from _vertex_lines(group, ids[np.searchsorted(keys, group.keys)])
    for group in batch.variables:
        if group.fixed:
            yield from (f"FIX {number}" for number in ids[np.searchsorted(keys, group.keys)].tolist())
    for group in batch.factors:
        yield from _edge_lines(group, ids[np.searchsorted(keys, group.keys)])


def _vertex_lines(group: Variables, ids: I64) -> Iterator[str]:
    if group.values is not None:
        name = _VERTEX_NAMES[group.kind]
        for number, values in zip(ids.tolist(), group.values.tolist(), strict=True):
            yield f"{name} {number} {_plain(values)}"


def _edge_lines(group: Factors, ids: I64) -> Iterator[str]:
    name, record = _EDGES[group.kind]
    offset = " 0" if record.parameters else ""
    numbers = np.concatenate([group.measured[:, : record.measured], group.information], axis=1)
    for ends, row in zip(ids.tolist(), numbers.tolist(), strict=True):
        yield f"{name} {' '.join(map(str, ends))}{offset} {_plain(row)}"


def _plain(numbers: Iterable[float]) -> str:
    """Shortest texts that read back as the same floats."""
    return " ".join([repr(number).removesuffix(".0") for number in numbers])


def _writable(batch: Batch, left: LeftOut) -> Batch:
    """What of `batch` g2o has records for.  Raises FormatError for a factor of a variable that is not there."""
    _refuse_unknown(batch)
    lost = _Lost()
    variables = []
    for group in batch.variables:
        if group.kind in _VERTEX_NAMES:
            variables.append(group)
        else:
            lost[group.kind, "g2o has no record for such variables"] += len(group.keys)
        stamps = 0 if group.stamps is None else int((group.stamps != NO_STAMP).sum())
        lost["time stamps", f"g2o has no record for the time of {group.kind} variables"] += stamps
    gone = np.concatenate(
        [np.empty(0, np.int64), *(group.keys for group in batch.variables if group.kind not in _VERTEX_NAMES)]
    )
    factors = [kept for group in batch.factors if (kept := _writable_factors(group, gone, lost)) is not None]
    named = np.concatenate([np.empty(0, np.int64), *(group.keys.ravel() for group in factors)])
    told = tuple(_told(variables, named, lost))
    for (name, why), count in lost.items():
        left.drop(name, count, why)
    return Batch(told, tuple(factors))


def _writable_factors(group: Factors, gone: I64, lost: _Lost) -> Factors | None:
    if group.kind not in _EDGES or np.isin(group.keys, gone).any():
        lost[group.kind, "g2o has no record for such factors"] += len(group.keys)
        return None
    kept = np.ones(len(group.keys), bool)
    if group.kind in ("position_se2", "position_se3"):
        kept = (group.measured[:, _EDGES[group.kind][1].measured :] == 0.0).all(axis=1)
        lost[group.kind, "g2o has no record for an antenna beside its pose"] += int((~kept).sum())
    if group.loss:
        lost[f"{group.kind} loss", f"g2o has no losses: written without their {group.loss}"] += len(group.keys)
    if not kept.any():
        return None
    return Factors(group.kind, group.keys[kept], group.measured[kept], group.information[kept])


def _told(variables: list[Variables], named: I64, lost: _Lost) -> Iterator[Variables]:
    """The variables that a vertex line or an edge tells of."""
    untold: list[str] = []
    for group in variables:
        told = np.isin(group.keys, named) if group.values is None else np.ones(len(group.keys), bool)
        untold += [format_symbol(key) for key in group.keys[~told].tolist()]
        if told.any():
            yield group if told.all() else group._replace(keys=group.keys[told])
    lost["variables", f"neither a value nor an edge tells of {shown(untold)}"] += len(untold)


def _refuse_unknown(batch: Batch) -> None:
    known = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables)])
    named = np.concatenate([np.empty(0, np.int64), *(group.keys.ravel() for group in batch.factors)])
    if not np.isin(named, known).all():
        lost = named[~np.isin(named, known)][0]
        raise FormatError(
            "g2o", None, f"a factor of {format_symbol(int(lost))}, which is not in the graph", "all variables"
        )
