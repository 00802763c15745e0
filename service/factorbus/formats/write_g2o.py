"""Write a graph as g2o text.  Numbers are written so that reading gives the same bits."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TextIO

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.records import G2O
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import format_symbol, symbol_parts

_VERTEX_NAMES = {record.kind: name for name, record in G2O.vertices.items()}
_EDGE_NAMES = {record.kind: name for name, record in G2O.edges.items()}
_OFFSET = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"


def write_g2o(path_or_file: str | os.PathLike[str] | TextIO, batch: Batch) -> None:
    """Write `batch` to a path or an open text file: vertices, FIX, edges, each in the order of the batch.

    An id is the index of the variable's key (x12 → 12) when no two keys share one; otherwise variables are numbered
    in order.  Variables without a value get no vertex line.  Raises FormatError for what g2o has no record for
    (bearings, ranges, positions, headings, attitudes, linear factors, priors on 2D points, sights, features of inverse
    depth, losses), before anything is written.
    """
    text = g2o_text(batch)
    if isinstance(path_or_file, str | os.PathLike):
        Path(path_or_file).write_text(text, encoding="ascii")
    else:
        path_or_file.write(text)


def g2o_text(batch: Batch) -> str:
    """The same as text."""
    _refuse_unwritable(batch)
    keys, ids = _numbering(batch)
    return "\n".join([*_lines(batch, keys, ids), ""])


def _lines(batch: Batch, keys: I64, ids: I64) -> Iterator[str]:
    if any(G2O.edges[_EDGE_NAMES[group.kind]].offset for group in batch.factors):
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
    name = _EDGE_NAMES[group.kind]
    offset = " 0" if G2O.edges[name].offset else ""
    numbers = np.concatenate([group.measured, group.information], axis=1)
    for ends, row in zip(ids.tolist(), numbers.tolist(), strict=True):
        yield f"{name} {' '.join(map(str, ends))}{offset} {_plain(row)}"


def _plain(numbers: Iterable[float]) -> str:
    """Shortest texts that read back as the same floats."""
    return " ".join([repr(number).removesuffix(".0") for number in numbers])


def _refuse_unwritable(batch: Batch) -> None:
    for group in batch.factors:
        if group.kind not in _EDGE_NAMES:
            raise FormatError(
                "g2o", None, f"{len(group.keys)} factor(s) of kind {group.kind}", f"only {', '.join(_EDGE_NAMES)}"
            )
        if group.loss:
            raise FormatError(
                "g2o", None, f"{len(group.keys)} factor(s) {group.kind} with the loss {group.loss}", "none with a loss"
            )
    named = np.concatenate([np.empty(0, np.int64), *(group.keys.ravel() for group in batch.factors)])
    for group in batch.variables:
        if group.kind not in _VERTEX_NAMES:
            raise FormatError(
                "g2o", None, f"{len(group.keys)} variable(s) of kind {group.kind}", f"only {', '.join(_VERTEX_NAMES)}"
            )
        if group.values is None and not np.isin(group.keys, named).all():
            lost = group.keys[~np.isin(group.keys, named)][0]
            raise FormatError(
                "g2o", None, f"{format_symbol(int(lost))} has neither a value nor a factor", "one of them"
            )
    known = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables)])
    if not np.isin(named, known).all():
        lost = named[~np.isin(named, known)][0]
        raise FormatError(
            "g2o", None, f"a factor of {format_symbol(int(lost))}, which is not in the graph", "all variables"
        )


def _numbering(batch: Batch) -> tuple[I64, I64]:
    """(keys, sorted, and the id of each)."""
    keys = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables)])
    ids = np.array([symbol_parts(key)[1] for key in keys.tolist()], np.int64)
    if len(np.unique(ids)) < len(ids) or (ids < 0).any():
        ids = np.arange(len(keys))
    order = np.argsort(keys)
    return keys[order], ids[order]
