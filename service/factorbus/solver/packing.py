"""A small batch as bytes: its columns side by side and where they lie, to be admitted in one compiled call.

A robot's steps look alike: so many variables of this kind, so many factors of that.  What follows from such a shape is
worked out once and remembered; what is left of a step is to join its columns.
"""

from typing import NamedTuple

import numpy as np

from factorbus.solver.factors import FACTOR_KINDS, LENS_AT
from factorbus.solver.groups import BatchLike
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import I64
from factorbus.solver.variables import VARIABLE_KINDS

_FEW = 64  # rows; with more the columns are better left where they are
_SHAPES = 1024
_I64, _F64 = np.dtype(np.int64), np.dtype(np.float64)


class Packed(NamedTuple):
    """Bytes and where in them the columns lie, and which of the new variables have a value: as `try_admit` wants it."""

    raw: bytes
    groups: I64
    reached: I64


class Packing:
    """Packs small batches."""

    def __init__(self) -> None:
        self._known: dict[tuple, tuple[I64, I64] | None] = {}

    def pack(self, batch: BatchLike) -> Packed | None:
        """None: it is not small, or there is something about its columns that admission has to look at."""
        shape: list = []
        raw: list[bytes] = []
        for group in batch.variables:
            keys, values = group.keys, group.values
            if type(keys) is not np.ndarray or keys.dtype is not _I64:
                return None
            raw.append(keys.tobytes())
            if values is None:
                shape.append((group.kind, group.fixed, keys.shape, None))
            elif type(values) is np.ndarray and values.dtype is _F64:
                raw.append(values.tobytes())
                shape.append((group.kind, group.fixed, keys.shape, values.shape))
            else:
                return None
        shape.append(None)  # variables end here
        for group in batch.factors:
            keys, measured, information = group.keys, group.measured, group.information
            if group.loss or type(keys) is not np.ndarray or keys.dtype is not _I64:
                return None
            for column in (measured, information):
                if type(column) is not np.ndarray or column.dtype is not _F64:
                    return None
            raw += (keys.tobytes(), measured.tobytes(), information.tobytes())
            shape.append((group.kind, keys.shape, measured.shape, information.shape))
        found = self._layout(tuple(shape))
        return Packed(b"".join(raw), found[0], found[1].copy()) if found else None

    def _layout(self, shape: tuple) -> tuple[I64, I64] | None:
        """Where the columns lie, and which variables have values.  None: not small, or not as their kinds want them."""
        if shape not in self._known:
            if len(self._known) == _SHAPES:
                self._known.clear()
            self._known[shape] = _laid_out(shape)
        return self._known[shape]


def _laid_out(shape: tuple) -> tuple[I64, I64] | None:
    end = shape.index(None)
    rows, reached, offset = [], [], 0
    for name, fixed, keys, values in shape[:end]:
        kind = VARIABLE_KINDS.get(name)
        if kind is None or len(keys) != 1 or values not in (None, (keys[0], kind.size)):
            return None
        numbers = offset + 8 * keys[0]
        rows.append((kind.code, 0, keys[0], fixed, 1, kind.size, 0, offset, -1 if values is None else numbers, -1))
        offset = numbers + (0 if values is None else 8 * keys[0] * kind.size)
        reached += [int(values is not None)] * keys[0]
    for name, keys, measured, information in shape[end + 1 :]:
        kind = FACTOR_KINDS.get(name)
        if kind is None or name in LENS_AT:
            return None
        count, arity = keys[0], len(kind.connects)
        if (keys, measured, information) != ((count, arity), (count, kind.size), (count, kind.triangle)):
            return None
        numbers = offset + 8 * count * arity
        behind = numbers + 8 * count * kind.size
        rows.append((kind.code, 1, count, 0, arity, kind.size, kind.triangle, offset, numbers, behind))
        offset = behind + 8 * count * kind.triangle
    if sum(row[at.G_COUNT] for row in rows) > _FEW:
        return None
    rows.append((at.END,) + (0,) * (at.G_WIDTH - 1))
    return np.array(rows, np.int64), np.array(reached, np.int64)
