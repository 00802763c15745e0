"""A small batch as bytes: its columns side by side and where they lie, to be admitted in one compiled call.

A robot's steps look alike: so many variables of this kind, so many factors of that.  What follows from such a shape is
worked out once and remembered; what is left of a step is to join its columns.
"""

from typing import Any

import numpy as np
from numpy import ndarray

from factorbus.solver.graph.factors import FACTOR_KINDS, LENS_AT
from factorbus.solver.graph.groups import BatchLike
from factorbus.solver.graph.variables import VARIABLE_KINDS
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at

_FEW = 64  # rows; with more the columns are better left where they are
_SHAPES = 1024
_FACTORS = object()  # in a shape: here the factors begin
_I64, _F64 = np.dtype(np.int64), np.dtype(np.float64)


class Packing:
    """Packs small batches.

    Types are compared where they are not the same object, as those of arrays from another process.
    """

    def __init__(self) -> None:
        self._known: dict[tuple, I64 | None] = {}

    def pack(self, batch: BatchLike) -> tuple[bytes, I64] | None:
        """Bytes and where in them the columns lie, as `admit_bytes` wants it.

        None: the batch is not small, or there is something about its columns that admission has to look at.
        """
        shape: list = []
        raw: list[Any] = []
        for group in batch.variables:
            keys, values = group.keys, group.values
            if type(keys) is not ndarray or (keys.dtype is not _I64 and keys.dtype != _I64):
                return None
            raw.append(keys)
            if values is None:
                shape += (group.kind, group.fixed, keys.shape, None)
            elif type(values) is ndarray and (values.dtype is _F64 or values.dtype == _F64):
                raw.append(values)
                shape += (group.kind, group.fixed, keys.shape, values.shape)
            else:
                return None
            stamps = group.stamps
            if stamps is None:
                shape.append(None)
            elif type(stamps) is ndarray and (stamps.dtype is _I64 or stamps.dtype == _I64):
                raw.append(stamps)
                shape.append(stamps.shape)
            else:
                return None
        shape.append(_FACTORS)
        for group in batch.factors:
            keys, measured, information = group.keys, group.measured, group.information
            if (
                group.loss
                or not type(keys) is type(measured) is type(information) is ndarray
                or (keys.dtype is not _I64 and keys.dtype != _I64)
                or (measured.dtype is not _F64 and measured.dtype != _F64)
                or (information.dtype is not _F64 and information.dtype != _F64)
            ):
                return None
            raw += (keys, measured, information)
            shape += (group.kind, keys.shape, measured.shape, information.shape)
        groups = self._layout(tuple(shape))
        if groups is None:
            return None
        try:
            return b"".join(raw), groups
        except TypeError:  # one of them is not contiguous
            return None

    def _layout(self, shape: tuple) -> I64 | None:
        """Where the columns lie.  None: not small, or not as their kinds want them."""
        try:
            return self._known[shape]
        except KeyError:
            if len(self._known) == _SHAPES:
                self._known.clear()
            return self._known.setdefault(shape, _laid_out(shape))


def _laid_out(shape: tuple) -> I64 | None:
    """shape: five entries for each group of variables, the word _FACTORS, four for each group of factors."""
    end = next(k for k in range(0, len(shape), 5) if shape[k] is _FACTORS)
    rows, offset = [], 0
    for k in range(0, end, 5):
        name, fixed, keys, values, stamps = shape[k : k + 5]
        kind = VARIABLE_KINDS.get(name)
        if kind is None or len(keys) != 1 or values not in (None, (keys[0], kind.size)) or stamps not in (None, keys):
            return None
        numbers = offset + 8 * keys[0]
        behind = numbers + (0 if values is None else 8 * keys[0] * kind.size)
        where = (-1 if values is None else numbers, -1, -1 if stamps is None else behind)
        rows.append((kind.code, 0, keys[0], fixed, 1, kind.size, 0, offset, *where))
        offset = behind + (0 if stamps is None else 8 * keys[0])
    for k in range(end + 1, len(shape), 4):
        name, keys, measured, information = shape[k : k + 4]
        kind = FACTOR_KINDS.get(name)
        if kind is None or name in LENS_AT:
            return None
        count, arity = keys[0], len(kind.connects)
        if (keys, measured, information) != ((count, arity), (count, kind.size), (count, kind.triangle)):
            return None
        numbers = offset + 8 * count * arity
        behind = numbers + 8 * count * kind.size
        rows.append((kind.code, 1, count, 0, arity, kind.size, kind.triangle, offset, numbers, behind, -1))
        offset = behind + 8 * count * kind.triangle
    if sum(row[at.G_COUNT] for row in rows) > _FEW:
        return None
    rows.append((at.END,) + (0,) * (at.G_WIDTH - 1))
    return np.array(rows, np.int64)
