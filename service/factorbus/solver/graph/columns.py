"""Where the columns of a batch lie, as the table that admission reads (`kernels/graph/group_table.py`).

Shapes and types are checked here; what concerns single rows is the kernel's.
"""

import ctypes
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from factorbus.solver import errors
from factorbus.solver.graph.factors import FACTOR_KIND_OF_CODE, FACTOR_KINDS, LENS_AT, LOSSES
from factorbus.solver.graph.groups import BatchLike, FactorsLike, VariablesLike
from factorbus.solver.graph.observations import with_limits
from factorbus.solver.graph.variables import VARIABLE_KINDS
from factorbus.solver.kernels.graph import group_table as gt
from factorbus.solver.kernels.graph.locate import locate_column, locate_factors, locate_variables
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

_I64, _F64 = np.dtype(np.int64), np.dtype(np.float64)
_NO_VALUES = {size: np.empty((0, size)) for size in {kind.size for kind in VARIABLE_KINDS.values()}}
_END = (gt.END,) + (0,) * (gt.G_WIDTH - 1)
_WORD = 8


class Columns(NamedTuple):
    """Groups of variables and factors by the addresses of their columns.

    groups (n + 1, G_WIDTH): the table.  held: what the columns lie in, and has to stay.
    """

    groups: I64
    held: Any


def locate_columns(batch: BatchLike) -> tuple[Columns, errors.SolverError | None]:
    """The columns of `batch`; or of its first groups, and what is wrong with the kind or a shape of the next one."""
    rows: list[tuple[int, ...]] = []
    held: list[ndarray] = []
    problem = None
    try:
        for variables in batch.variables:
            rows.append(_locate_variables(variables, held))  # noqa: PERF401  (those before a problem count)
        for factors in batch.factors:
            rows.append(_locate_factors(factors, held))  # noqa: PERF401
    except errors.SolverError as found:
        problem = found
    rows.append(_END)
    return Columns(np.array(rows, np.int64), held), problem


def limit_lenses(columns: Columns) -> tuple[Columns, errors.SolverError | None]:
    """The same columns, where lenses have their limits; or those before the first group of factors with a lens that is
    none, and what is wrong with it."""
    groups, held = columns.groups.copy(), [columns.held]
    for g in range(len(groups)):
        row = groups[g]
        if row[gt.G_KIND] == gt.END:
            break
        kind = FACTOR_KIND_OF_CODE[int(row[gt.G_KIND])] if row[gt.G_FACTORS] else None
        if kind is None or kind.name not in LENS_AT or row[gt.G_LIMITED]:
            continue
        count = int(row[gt.G_COUNT])
        measured = floats_at(int(row[gt.G_NUMBERS]), count * kind.size).reshape(count, kind.size)
        try:
            limited = with_limits(kind, measured)
        except errors.SolverError as problem:
            stays = (groups[:, gt.G_FACTORS] == 0) | (np.arange(len(groups)) < g) | (groups[:, gt.G_KIND] == gt.END)
            return Columns(groups[stays], held), problem
        held.append(limited)
        row[gt.G_NUMBERS], row[gt.G_LIMITED] = locate_column(limited.reshape(-1)), 1
    return Columns(groups, held), None


def ints_at(address: int, count: int) -> I64:
    """A copy of so many int64 at the address."""
    return np.frombuffer(ctypes.string_at(address, _WORD * count), _I64)


def floats_at(address: int, count: int) -> F64:
    """A copy of so many float64 at the address."""
    return np.frombuffer(ctypes.string_at(address, _WORD * count), _F64)


def _locate_variables(group: VariablesLike, held: list[ndarray]) -> tuple[int, ...]:
    """A row of the table; its columns go to `held`."""
    kind = VARIABLE_KINDS.get(group.kind)
    if kind is None:
        raise errors.UnknownKind("variable", group.kind, tuple(VARIABLE_KINDS))
    keys = _column(group.keys, _I64, (-1,), group.kind, "keys")
    given = group.values
    values = (
        _NO_VALUES[kind.size] if given is None else _column(given, _F64, (keys.size, kind.size), group.kind, "values")
    )
    held += (keys, values)
    at_keys, at_values = locate_variables(keys, values)
    at_stamps = gt.NOWHERE
    if group.stamps is not None:
        stamps = _column(group.stamps, _I64, (keys.size,), group.kind, "stamps")
        held.append(stamps)
        at_stamps = locate_column(stamps)
    at_values = gt.NOWHERE if given is None else at_values
    return kind.code, 0, keys.size, bool(group.fixed), at.NO_LOSS, at_keys, at_values, 0, gt.NOWHERE, at_stamps, 0


def _locate_factors(group: FactorsLike, held: list[ndarray]) -> tuple[int, ...]:
    """A row of the table; its columns go to `held`."""
    kind = FACTOR_KINDS.get(group.kind)
    if kind is None:
        raise errors.UnknownKind("factor", group.kind, tuple(FACTOR_KINDS))
    keys = _column(group.keys, _I64, (-1, len(kind.connects)), group.kind, "keys")
    count = len(keys)
    measured = _column(group.measured, _F64, (count, kind.size), group.kind, "measured")
    information = _column(group.information, _F64, (count, kind.triangle), group.kind, "information")
    is_camera = kind.name in LENS_AT
    if is_camera:
        measured = with_limits(kind, measured)
    held += (keys, measured, information)
    loss, at_scale = at.NO_LOSS, gt.NOWHERE
    if group.loss:
        loss, scale = _loss(group, count)
        held.append(scale)
        at_scale = locate_column(scale)
    at_keys, at_measured, at_information = locate_factors(keys, measured, information)
    return kind.code, 1, count, 0, loss, at_keys, at_measured, at_information, at_scale, gt.NOWHERE, is_camera


def _loss(group: FactorsLike, count: int) -> tuple[int, F64]:
    """(code, scales) of the loss of a group."""
    code = LOSSES.get(group.loss)
    if code is None:
        raise errors.BadLoss(group.kind, f"the loss {group.loss!r}", f"none, or one of {', '.join(LOSSES)}")
    if group.scale is None:
        raise errors.BadLoss(f"{group.kind} {group.loss}", "no scale", "one for each factor, standard deviations")
    return code, _column(group.scale, _F64, (count,), group.kind, "scale")


def _column(array: ndarray, dtype: np.dtype, shape: tuple[int, ...], kind: str, name: str) -> ndarray:
    """`array` if it can be read where it is, a copy that can where it is not aligned or not contiguous."""
    if not isinstance(array, ndarray) or array.dtype != dtype:
        seen = str(array.dtype) if isinstance(array, ndarray) else type(array).__name__
        raise errors.BadShape(f"{kind} {name}", seen, f"an array of {dtype}")
    if array.shape != shape and (len(array.shape) != len(shape) or array.shape[1:] != shape[1:] or shape[0] >= 0):
        wanted = " × ".join("n" if n < 0 else str(n) for n in shape)
        raise errors.BadShape(f"{kind} {name}", " × ".join(map(str, array.shape)), wanted)
    flags = array.flags
    return array if flags.carray or (flags.c_contiguous and flags.aligned) else np.array(array, dtype, order="C")
