"""Write a graph as g2o text.  Numbers are written so that reading gives the same bits."""

import os
from collections.abc import Iterator
from typing import TextIO

import numpy as np

from factorbus.formats.left_out import FileNotes, LeftOut
from factorbus.formats.numbering import numbered
from factorbus.formats.records import G2O, Edge
from factorbus.formats.whole_file import write_whole
from factorbus.formats.writable import Form, Written, number_text, writable
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Factors, Variables

_VERTEX_NAMES = {record.kind: name for name, record in G2O.vertices.items()}
# The first record of each kind that is read is the one to write, as long as it says nothing but the factor.
_EDGES: dict[str, tuple[str, Edge]] = {}
for _name, _record in G2O.edges.items():
    if not _record.lead:
        _EDGES.setdefault(_record.kind, (_name, _record))
_OFFSET = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"
_FORM = Form("g2o", frozenset(_VERTEX_NAMES), {kind: record.measured for kind, (_, record) in _EDGES.items()})


def write_g2o(
    path_or_file: str | os.PathLike[str] | TextIO, batch: Batch, strict: bool = False, ids: str = "auto"
) -> FileNotes:
    """Write `batch` to a path or an open text file, as `as_g2o` makes it; returns its notes.  Raises FormatError."""
    written = as_g2o(batch, strict, ids)
    if isinstance(path_or_file, str | os.PathLike):
        write_whole(path_or_file, written.text, encoding="ascii")
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
    kept = writable(batch, _FORM, left)
    keys, names = numbered(kept, ids, left)
    text = "\n".join([*_lines(kept, keys, names), ""])
    return Written(text, left.told())


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
            yield f"{name} {number} {number_text(values)}"


def _edge_lines(group: Factors, ids: I64) -> Iterator[str]:
    name, record = _EDGES[group.kind]
    offset = " 0" if record.parameters else ""
    numbers = np.concatenate([group.measured[:, : record.measured], group.information], axis=1)
    for ends, row in zip(ids.tolist(), numbers.tolist(), strict=True):
        yield f"{name} {' '.join(map(str, ends))}{offset} {number_text(row)}"
