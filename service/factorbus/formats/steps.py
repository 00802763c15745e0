"""The replay of a graph: one `Batch` for each pose, in time order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from factorbus.formats.ranging import RANGES
from factorbus.formats.schedule import POSES, Roster, Schedule, roster, scheduled
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import NO_STAMP


@dataclass(frozen=True, slots=True)
class _VariableColumns:
    kind: str
    keys: I64
    values: F64 | None
    fixed: bool
    stamps: I64 | None
    bounds: list[int]


@dataclass(frozen=True, slots=True)
class _FactorColumns:
    kind: str
    keys: I64
    measured: F64
    information: F64
    loss: str
    scale: F64 | None
    bounds: list[int]


class Steps(Sequence[Batch]):
    """The batches of a replay; each is built when it is asked for.

    Poses come in the order of their keys, or of time where all have a stamp.  A step is a new pose with its edges to
    poses that are in (the one from the pose before it first, the rest in the order of the file), the points it is the
    first to see, and its observations.  A pose that nothing joins to earlier ones waits for the pose that does, and a
    factor between two poses that is of a later time than both for a pose of its time.  New variables have no value, so
    that the service composes them from what was measured, except fixed ones, poses that only points or ranges join to
    the rest, points that only ranges see, and with `use_values` all that have one.  Where nothing is fixed and no pose
    has a prior the first pose is fixed, at its value or the origin.
    """

    def __init__(self, count: int, variables: list[_VariableColumns], factors: list[_FactorColumns]) -> None:
        self._count, self._variables, self._factors = count, variables, factors

    def __len__(self) -> int:
        return self._count

    @property
    def poses(self) -> int:
        """Number of poses in all of them: the file may have more, that no edge names."""
        return sum(len(group.keys) for group in self._variables if group.kind in POSES)

    @overload
    def __getitem__(self, index: int) -> Batch: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Batch]: ...
    def __getitem__(self, index: int | slice) -> Batch | Sequence[Batch]:
        if isinstance(index, slice):
            return [self._step(k) for k in range(*index.indices(self._count))]
        place = index + self._count if index < 0 else index
        if not 0 <= place < self._count:
            raise IndexError(f"step {index} of {self._count}")
        return self._step(place)

    def __iter__(self) -> Iterator[Batch]:
        return map(self._step, range(self._count))

    def _step(self, k: int) -> Batch:
        variables, factors = [], []
        for group in self._variables:
            low, high = group.bounds[k], group.bounds[k + 1]
            if low < high:
                values = None if group.values is None else group.values[low:high]
                stamps = None if group.stamps is None else group.stamps[low:high]
                variables.append(Variables(group.kind, group.keys[low:high], values, group.fixed, stamps))
        for group in self._factors:
            low, high = group.bounds[k], group.bounds[k + 1]
            if low < high:
                piece = slice(low, high)
                scale = None if group.scale is None else group.scale[piece]
                measured, information = group.measured[piece], group.information[piece]
                factors.append(Factors(group.kind, group.keys[piece], measured, information, group.loss, scale))
        return Batch(tuple(variables), tuple(factors))


def planned(file: str, batch: Batch, lines: Sequence[I64], times: Sequence[I64], use_values: bool) -> Steps:
    """The steps of `batch`, whose factors stand on `lines` and may have times of their own.  Raises FormatError."""
    names = roster(file, batch, times)
    return _cut(batch, lines, names, scheduled(file, batch, names, use_values), use_values)


def at_once(batch: Batch) -> Steps:
    """A single step, of cameras that have no order in time."""
    variables = [_VariableColumns(*group, [0, len(group.keys)]) for group in batch.variables]
    return Steps(1, variables, [_FactorColumns(*group[:6], [0, len(group.keys)]) for group in batch.factors])


def planned_whole(file: str, batch: Batch, lines: Sequence[I64], use_values: bool) -> Batch:
    """The same as one batch.  Raises FormatError."""
    names = roster(file, batch)
    plan = scheduled(file, batch, names)
    return _cut(batch, lines, names, Schedule(np.zeros_like(plan.entry), plan.root, plan.given), use_values)[0]


def _cut(batch: Batch, lines: Sequence[I64], names: Roster, plan: Schedule, use_values: bool) -> Steps:
    """Columns sorted by step, and where each step begins in them."""
    turns, step = np.unique(plan.entry, return_inverse=True)
    variables = _variable_columns(batch, names, plan, step, len(turns), use_values)
    factors = [
        _factor_columns(group, rows, at, names, np.maximum(step[rows].max(axis=1), _first(turns, since)), len(turns))
        for group, rows, since, at in zip(batch.factors, names.ends, names.since, lines, strict=True)
    ]
    return Steps(len(turns), variables, factors)


def _first(turns: I64, since: I64) -> I64:
    """The first step of a turn from `since` on, or the last one."""
    return np.minimum(np.searchsorted(turns, since), len(turns) - 1)


def _variable_columns(
    batch: Batch, names: Roster, plan: Schedule, step: I64, count: int, use_values: bool
) -> list[_VariableColumns]:
    fixed = names.fixed.copy()
    valued = names.fixed | (names.valued & use_values)
    valued[plan.given] = True
    if plan.root >= 0:
        fixed[plan.root] = valued[plan.root] = True
    columns = []
    for kind in VARIABLE_KINDS:
        rows, table, stamps = _values(batch, kind)
        for is_fixed in (True, False):
            for has_value in (True, False):
                mine = (fixed[rows] == is_fixed) & (valued[rows] == has_value)
                if mine.any():
                    given = Variables(kind, rows[mine], table[mine] if has_value else None, is_fixed, stamps[mine])
                    columns.append(_sorted(given, names, step, count))
    return columns


def _sorted(given: Variables, names: Roster, step: I64, count: int) -> _VariableColumns:
    """By step.  given: in place of keys, rows in the roster."""
    kind, rows, table, fixed, stamps = given
    order = np.lexsort((names.keys[rows] if kind in POSES else rows, step[rows]))
    rows = rows[order]
    values = None if table is None else table[order]
    known = None if stamps is None or (stamps == NO_STAMP).all() else stamps[order]
    return _VariableColumns(kind, names.keys[rows], values, fixed, known, _bounds(step[rows], count))


def _values(batch: Batch, kind: str) -> tuple[I64, F64, I64]:
    """(rows in the roster, values, time stamps) of the variables of a kind; the origin where there is no value."""
    rows, tables, first = [np.empty(0, np.int64)], [np.empty((0, VARIABLE_KINDS[kind].size))], 0
    stamps = [np.empty(0, np.int64)]
    for group in batch.variables:
        if group.kind == kind:
            rows.append(np.arange(first, first + len(group.keys)))
            tables.append(_origins(kind, len(group.keys)) if group.values is None else group.values)
            stamps.append(np.full(len(group.keys), NO_STAMP) if group.stamps is None else group.stamps)
        first += len(group.keys)
    return np.concatenate(rows), np.concatenate(tables), np.concatenate(stamps)


def _origins(kind: str, count: int) -> F64:
    origins = np.zeros((count, VARIABLE_KINDS[kind].size))
    if kind == "se3":
        origins[:, 6] = 1
    return origins


def _factor_columns(group: Factors, ends: I64, lines: I64, names: Roster, at: I64, count: int) -> _FactorColumns:
    """By step, `at` (m,)."""
    order = np.lexsort((lines, ~_odometry(group, ends, lines, names), at))
    scale = None if group.scale is None else group.scale[order]
    return _FactorColumns(
        group.kind,
        group.keys[order],
        group.measured[order],
        group.information[order],
        group.loss,
        scale,
        _bounds(at[order], count),
    )


def _odometry(group: Factors, ends: I64, lines: I64, names: Roster) -> np.ndarray:
    """Whether a factor is the first in the file to join its pose to the pose before it."""
    first = np.zeros(len(ends), bool)
    joins = group.kind not in RANGES and all(kind in POSES for kind in FACTOR_KINDS[group.kind].connects)
    if joins and ends.shape[1] == 2:
        one, other = ends.T
        rows = np.flatnonzero((names.before[one] == other) | (names.before[other] == one))
        rows = rows[np.argsort(lines[rows], kind="stable")]
        _, earliest = np.unique(names.rank[ends[rows]].max(axis=1), return_index=True)
        first[rows[earliest]] = True
    return first


def _bounds(sorted_steps: I64, count: int) -> list[int]:
    """Where step k begins, for k = 0 .. count."""
    return np.searchsorted(sorted_steps, np.arange(count + 1)).tolist()
