"""The columns of a batch as bytes, and where in them each lies: what admission reads, of arrays as of a message.

A robot's steps look alike: the same numbers of variables and factors of each kind.  What follows from the kinds, types
and shapes of such a step is worked out once and remembered; what is left of a step is to join its columns.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from factorbus.proto.kinds import FACTOR_KINDS as WIRE_KINDS
from factorbus.solver import errors
from factorbus.solver.graph.factors import FACTOR_KIND_OF_CODE, FACTOR_KINDS, LENS_AT, LOSSES
from factorbus.solver.graph.groups import BatchLike
from factorbus.solver.graph.observations import with_limits
from factorbus.solver.graph.variables import VARIABLE_KINDS
from factorbus.solver.kernels.graph import group_table as gt
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

_I64, _F64 = np.dtype("<i8"), np.dtype("<f8")
_END = (gt.END,) + (0,) * (gt.G_WIDTH - 1)
_WORD = 8
_ABSENT = (None, ())  # the form of a column that is not there
_NO_SIZES = (0, 0, 0, gt.NOWHERE, gt.NOWHERE, 0)  # the last columns of a group whose kind says what its sizes are
_LISTED = frozenset(WIRE_KINDS.keys())  # all others are of families, or are none


class Columns(NamedTuple):
    """Groups of variables and factors whose columns lie in `raw`; groups (n + 1, G_WIDTH) says where."""

    raw: bytes
    groups: I64


def locate_columns(batch: BatchLike) -> tuple[bytes, I64, errors.SolverError | None]:
    """The columns of `batch`; or of its first groups, and what is wrong with the kind or a shape of the next one."""
    form: list[Any] = []
    columns: list[Any] = []
    for group in batch.variables:
        keys, values, stamps = group.keys, group.values, group.stamps
        columns.append(keys)
        form += (group.kind, group.fixed, (keys.dtype, keys.shape) if type(keys) is ndarray else _form(keys))
        for column in (values, stamps):
            if column is None:
                form.append(_ABSENT)
            else:
                columns.append(column)
                form.append(_form(column))
    variables = len(form)
    for group in batch.factors:
        keys, measured, information = group.keys, group.measured, group.information
        columns += (keys, measured, information)
        if group.kind not in _LISTED:
            columns += _columns_of_kind(group.kind)
        form += (group.kind, group.loss)
        if type(keys) is type(measured) is type(information) is ndarray:
            form += (keys.dtype, keys.shape), (measured.dtype, measured.shape), (information.dtype, information.shape)
        else:
            form += _form(keys), _form(measured), _form(information)
        if group.loss and group.scale is not None:
            columns.append(group.scale)
            form.append(_form(group.scale))
        else:
            form.append(_ABSENT)
    try:
        groups, problem = _table(variables, tuple(form)), None
    except errors.SolverError as found:
        groups, problem = _table_before(variables, tuple(form)), found
        columns = columns[: _count_columns(groups)]
    try:
        return b"".join(columns), groups, problem
    except TypeError:  # one of them is not contiguous
        return b"".join([column if type(column) is bytes else column.tobytes() for column in columns]), groups, problem


def limit_lenses(raw: bytes, groups: I64) -> tuple[bytes, I64, errors.SolverError | None]:
    """The same columns, where lenses have their limits; or those before the first group of factors with a lens that is
    none, and what is wrong with it."""
    # Of the last row, and of those behind it, nothing but the kind of the last is written.
    last = int(np.argmax(groups[:, gt.G_KIND] == gt.END))
    groups, added, end = groups[: last + 1].copy(), list[bytes](), len(raw)
    for g in range(last):
        row = groups[g]
        kind = FACTOR_KIND_OF_CODE.get(int(row[gt.G_KIND])) if row[gt.G_FACTORS] else None
        if kind is None or kind.name not in LENS_AT:
            continue
        row[gt.G_LIMITED], count = 1, int(row[gt.G_COUNT])
        if not count:
            continue
        measured = floats_at(raw, int(row[gt.G_NUMBERS]), count * kind.size).reshape(count, kind.size)
        try:
            limited = with_limits(kind, measured)
        except errors.SolverError as problem:
            stays = (groups[:, gt.G_FACTORS] == 0) | (np.arange(len(groups)) < g)
            stays[last] = True
            return b"".join([raw, *added]), groups[stays], problem
        added.append(limited.tobytes())
        row[gt.G_NUMBERS], end = end, end + len(added[-1])
    return b"".join([raw, *added]), groups, None


def ints_at(raw: bytes, start: int, count: int) -> I64:
    """`count` int64 from raw[start] on."""
    return np.frombuffer(raw, _I64, count, start)


def floats_at(raw: bytes, start: int, count: int) -> F64:
    """`count` float64 from raw[start] on."""
    return np.frombuffer(raw, _F64, count, start)


def _form(column: Any) -> tuple[Any, Any]:
    """The type and the shape of an array; of anything else the name of what it is."""
    return (column.dtype, column.shape) if isinstance(column, ndarray) else (type(column).__name__, None)


@lru_cache(maxsize=1024)
def _table(variables: int, form: tuple[Any, ...]) -> I64:
    """The table of groups of a form; `variables` of its entries are of variables.  Raises as `_iter_rows`."""
    return np.array([*_iter_rows(variables, form), _END], np.int64)


def _table_before(variables: int, form: tuple[Any, ...]) -> I64:
    """The table of the groups before the first that is wrong."""
    rows = []
    try:
        for row in _iter_rows(variables, form):
            rows.append(row)  # noqa: PERF402  (those before a problem count)
    except errors.SolverError:
        pass
    return np.array([*rows, _END], np.int64)


def _count_columns(groups: I64) -> int:
    """How many columns the groups have."""
    places = [gt.G_KEYS, gt.G_NUMBERS, gt.G_INFORMATION, gt.G_SCALE, gt.G_STAMPS, gt.G_ENDS, gt.G_HEAD]
    return int(np.count_nonzero(groups[:-1, places] != gt.NOWHERE))


def _iter_rows(variables: int, form: tuple[Any, ...]) -> Iterator[tuple[int, ...]]:
    """The rows of the table.  Raises UnknownKind, BadShape, BadLoss."""
    here = 0
    for k in range(0, variables, 5):
        name, fixed, keys, values, stamps = form[k : k + 5]
        kind = VARIABLE_KINDS.get(name)
        if kind is None:
            raise errors.UnknownKind("variable", name, tuple(VARIABLE_KINDS))
        _check(keys, _I64, (-1,), name, "keys")
        count = keys[1][0]
        at_keys, at_values, at_stamps, here = here, gt.NOWHERE, gt.NOWHERE, here + _WORD * count
        if values is not _ABSENT:
            _check(values, _F64, (count, kind.size), name, "values")
            at_values, here = here, here + _WORD * count * kind.size
        if stamps is not _ABSENT:
            _check(stamps, _I64, (count,), name, "stamps")
            at_stamps, here = here, here + _WORD * count
        places = at_keys, at_values, gt.NOWHERE, gt.NOWHERE, at_stamps
        yield kind.code, 0, count, bool(fixed), at.NO_LOSS, *places, 0, *_NO_SIZES
    for k in range(variables, len(form), 6):
        name, loss, keys, measured, information, scale = form[k : k + 6]
        kind = FACTOR_KINDS.get(name)
        if kind is None:
            raise errors.UnknownKind("factor", name, WIRE_KINDS.names(name))
        _check(keys, _I64, (-1, len(kind.connects)), name, "keys")
        count = keys[1][0]
        _check(measured, _F64, (count, kind.size), name, "measured")
        _check(information, _F64, (count, kind.triangle), name, "information")
        at_keys, at_measured = here, here + _WORD * count * len(kind.connects)
        at_information = at_measured + _WORD * count * kind.size
        here = at_information + _WORD * count * kind.triangle
        at_scale, sizes = gt.NOWHERE, _NO_SIZES
        if kind.code >= at.LINEAR:
            before, ends = here + _WORD * len(kind.connects), len(kind.connects)
            sizes = ends, kind.dim, kind.size, here, before if kind.before else gt.NOWHERE, kind.before
            here = before + _WORD * kind.before
        if loss:
            _check_loss(name, loss, scale, count)
            at_scale, here = here, here + _WORD * count
        places = at_keys, at_measured, at_information, at_scale, gt.NOWHERE
        yield kind.code, 1, count, 0, LOSSES[loss] if loss else at.NO_LOSS, *places, 0, *sizes


@lru_cache(maxsize=1024)
def _columns_of_kind(name: str) -> tuple[bytes, ...]:
    """Of a kind of a family: the codes of the kinds of the variables, and of an own one its head."""
    kind = FACTOR_KINDS.get(name)
    if kind is None:
        return ()
    ends = np.array([end.code for end in kind.connects], _I64).tobytes()
    return (ends, kind.head.astype(_F64).tobytes()) if kind.before else (ends,)


def _check_loss(kind: str, loss: str, scale: tuple[Any, Any], count: int) -> None:
    if loss not in LOSSES:
        raise errors.BadLoss(kind, f"the loss {loss!r}", f"none, or one of {', '.join(LOSSES)}")
    if scale is _ABSENT:
        raise errors.BadLoss(f"{kind} {loss}", "no scale", "one for each factor, standard deviations")
    _check(scale, _F64, (count,), kind, "scale")


def _check(form: tuple[Any, Any], dtype: np.dtype, shape: tuple[int, ...], kind: str, name: str) -> None:
    """Raises BadShape unless a column is of this type and shape; −1: any size."""
    seen, has = form
    if has is None or seen != dtype:
        raise errors.BadShape(f"{kind} {name}", str(seen), f"an array of {dtype}")
    if has != shape and (len(has) != len(shape) or has[1:] != shape[1:] or shape[0] >= 0):
        wanted = " × ".join("n" if n < 0 else str(n) for n in shape)
        raise errors.BadShape(f"{kind} {name}", " × ".join(map(str, has)), wanted)
