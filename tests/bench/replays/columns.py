"""A replay as arrays: a row for every variable, the rows of every factor, and how many there are at each step."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factorbus.proto.messages import Batch

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Values = dict[str, tuple[I64, F64]]  # kind -> keys (n,), values (n, size)

SIZES = {"se2": 3, "se3": 7, "point2": 2, "point3": 3}
ENDS = {
    "between_se2": ("se2", "se2"),
    "between_se3": ("se3", "se3"),
    "landmark_se2": ("se2", "point2"),
    "landmark_se3": ("se3", "point3"),
    "bearing_range_se2": ("se2", "point2"),
}


@dataclass(frozen=True, slots=True)
class FactorColumns:
    """Factors of one kind in the order of the steps.

    first, second (m,): rows of their variables.  measured (m, size).  information (m, r, r): full and symmetric.
    until (steps + 1,): how many of them belong to the steps before step k.
    """

    kind: str
    first: I64
    second: I64
    measured: F64
    information: F64
    until: I64

    def up_to(self, step: int) -> tuple[I64, I64, F64, F64]:
        """(first, second, measured, information) of the factors of steps 0 .. step."""
        m = self.until[step + 1]
        return self.first[:m], self.second[:m], self.measured[:m], self.information[:m]


@dataclass(frozen=True, slots=True)
class Columns:
    """A whole replay.  keys: per kind of variable, its keys in ascending order; a key's row is its place there.

    until: per kind (steps + 1,), how many variables came before step k.  arrival: per kind, rows in order of arrival.
    """

    steps: int
    keys: dict[str, I64]
    arrival: dict[str, I64]
    until: dict[str, I64]
    factors: tuple[FactorColumns, ...]
    fixed: dict[str, I64] = field(default_factory=dict)

    def table(self, values: Values) -> dict[str, F64]:
        """Values by row; what is not among `values` is not a number."""
        tables = {}
        for kind, keys in self.keys.items():
            table = np.full((len(keys), SIZES[kind]), np.nan)
            if kind in values:
                mine, numbers = values[kind]
                rows = np.searchsorted(keys, mine)
                if (rows == len(keys)).any() or (keys[np.minimum(rows, len(keys) - 1)] != mine).any():
                    raise ValueError(f"an estimate of {kind} has keys that are not in the graph")
                table[rows] = numbers
            tables[kind] = table
        return tables

    def dof(self) -> int:
        """Residual components minus free scalars."""
        tangent = {"se2": 3, "se3": 6, "point2": 2, "point3": 3}
        scalars = sum(tangent[k] * (len(v) - len(self.fixed.get(k, ()))) for k, v in self.keys.items())
        return sum(f.information.shape[1] * len(f.first) for f in self.factors) - scalars


def columns_of(steps: Sequence[Batch]) -> Columns:
    """Gather `steps`.  Raises ValueError for a kind of factor that is not in `ENDS`."""
    count = len(steps)
    arrived: dict[str, list[I64]] = {}
    fixed: dict[str, list[I64]] = {}
    came: dict[str, I64] = {}
    groups: dict[str, list[tuple[I64, F64, F64]]] = {}
    made: dict[str, I64] = {}
    for k, batch in enumerate(steps):
        for group in batch.variables:
            arrived.setdefault(group.kind, []).append(group.keys)
            came.setdefault(group.kind, np.zeros(count + 1, np.int64))[k + 1] += len(group.keys)
            if group.fixed:
                fixed.setdefault(group.kind, []).append(group.keys)
        for group in batch.factors:
            if group.kind not in ENDS:
                raise ValueError(f"factors of kind {group.kind} are not evaluated here; known: {', '.join(ENDS)}")
            groups.setdefault(group.kind, []).append((group.keys, group.measured, group.information))
            made.setdefault(group.kind, np.zeros(count + 1, np.int64))[k + 1] += len(group.keys)
    order = {kind: np.concatenate(parts) for kind, parts in arrived.items()}
    keys = {kind: np.sort(all_keys) for kind, all_keys in order.items()}
    factors = tuple(_factors(kind, keys, parts, np.cumsum(made[kind])) for kind, parts in groups.items())
    return Columns(
        steps=count,
        keys=keys,
        arrival={kind: np.searchsorted(keys[kind], order[kind]) for kind in keys},
        until={kind: np.cumsum(counts) for kind, counts in came.items()},
        factors=factors,
        fixed={kind: np.searchsorted(keys[kind], np.concatenate(parts)) for kind, parts in fixed.items()},
    )


def symmetric(triangles: F64) -> F64:
    """Upper triangles row by row (m, r(r+1)/2) as full matrices (m, r, r)."""
    r = int((np.sqrt(8 * triangles.shape[1] + 1) - 1) / 2)
    full = np.zeros((len(triangles), r, r))
    row, column = np.triu_indices(r)
    full[:, row, column] = triangles
    full[:, column, row] = triangles
    return full


def _factors(kind: str, keys: dict[str, I64], parts: list[tuple[I64, F64, F64]], until: I64) -> FactorColumns:
    ends, measured, information = (np.concatenate(column) for column in zip(*parts, strict=True))
    a, b = ENDS[kind]
    return FactorColumns(
        kind,
        np.searchsorted(keys[a], ends[:, 0]),
        np.searchsorted(keys[b], ends[:, 1]),
        measured,
        symmetric(information),
        until,
    )
