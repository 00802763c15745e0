"""The graph as columns: variables and factors in arenas that grow by doubling.  The arenas are laid out in
`kernels/model/layout.py`.

A `Mark` is how much of everything was in use at some moment; `forget` goes back to it.  Nothing that was there then
has been moved, so going back is setting counts and clearing the keys that came after.
"""

from typing import Any, TypeAlias

import numpy as np

from factorbus.proto import inertial
from factorbus.solver.errors import printed
from factorbus.solver.formulas.own_code import own_code_of
from factorbus.solver.graph.arenas import lines, slots_of, with_room
from factorbus.solver.graph.factor_ids import FactorIds
from factorbus.solver.graph.factor_rows import (
    arities_of,
    ends_of_rows,
    first_rows,
    is_first,
    losses_of,
    rows_of_arities,
)
from factorbus.solver.graph.factors import (
    FACTOR_KIND_OF_CODE,
    LOSS_OF_CODE,
    FactorKind,
    imu_of,
    kinds_by_number,
    linear_of,
)
from factorbus.solver.graph.groups import FactorGroup, Group
from factorbus.solver.graph.rows import Rows, Span
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.graph import group_table as gt
from factorbus.solver.kernels.graph.key_table import enter_keys, find_variable, remove_keys
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model import records
from factorbus.solver.kernels.model.expression_layout import X_NUMBER
from factorbus.solver.kernels.model.kinds import CAMERA, OF_FAMILY
from factorbus.solver.kernels.model.retract import common_label, gather_values

Mark: TypeAlias = tuple[int, ...]

# By the code of a kind; the last are of members, and of families, whose sizes are each factor's own.
_NO_SIZE = (0,) * at.FURTHER_CODES
_MEASURED = np.array([*(FACTOR_KIND_OF_CODE[code].size for code in sorted(FACTOR_KIND_OF_CODE)), *_NO_SIZE], np.int64)
_TRIANGLE = np.array(
    [*(FACTOR_KIND_OF_CODE[code].triangle for code in sorted(FACTOR_KIND_OF_CODE)), *_NO_SIZE], np.int64
)
_NO_KEYS: I64 = np.empty(0, np.int64)
_new = tuple.__new__


class FactorGraph(FactorIds):
    """Variables and factors, and the index of variables by key.  The arrays are public: kernels work on them."""

    ARENAS = records.Graph._fields
    # Of a solver's state: they follow from the rest.
    NOT_KEPT = ("_rows", "_id_room", "_unlisted", "array_table", "own_before", "own_code")

    def __init__(self) -> None:
        super().__init__()
        # Room for the first few hundred factors: the step that finds none takes several times as long.
        self.keys: I64 = np.empty(256, np.int64)
        self.var: I64 = lines((256, at.V_WIDTH), np.int64)
        self.dims: I64 = np.zeros(256, np.int64)
        self.stamps: I64 = np.empty(256, np.int64)
        self.values: F64 = np.zeros(1024)
        self.fac: I64 = lines((512, at.F_WIDTH), np.int64)
        self.payload: F64 = np.empty(8192)
        self.counts: I64 = np.zeros(at.COUNTS, np.int64)
        self.table: I64 = np.zeros(slots_of(0), np.int64)
        # No keys yet: it loads the kernel, which the step that needs a larger table would have to wait for.
        enter_keys(0, self.table, self.keys)
        self.holes = 0  # numbers of the payload that no factor has any more
        self.own: tuple[str, ...] = ()  # the own kinds of its factors: their formulas, each once
        # Where kinds came since the last step: how many rows of factors there were, and the kinds.
        self.own_before: tuple[int, tuple[str, ...]] | None = None
        self._rows = Rows()

    def __setattr__(self, name: str, value: Any) -> None:
        """With its own kinds a graph holds their code."""
        super().__setattr__(name, value)
        if name == "own":
            self.own_code = tuple(map(own_code_of, value))

    @property
    def has_observations(self) -> bool:
        """Whether any camera has seen anything."""
        kinds = self.fac[: self.counts[at.FACTORS], at.F_KIND]
        return bool(CAMERA[kinds].any())

    def mark(self) -> Mark:
        """How much is in use now."""
        return tuple(self.counts.tolist())

    def forget(self, mark: Mark) -> None:
        """Go back to `mark`."""
        if (slots := slots_of(mark[at.VARIABLES])) < self.table.size:
            self._enter_keys(mark[at.VARIABLES], slots)
        else:
            remove_keys(mark[at.VARIABLES], int(self.counts[at.VARIABLES]), self.table, self.keys)
        self.dims[mark[at.COLUMNS] : self.counts[at.COLUMNS]] = 0
        self.counts[:] = mark
        if self.own_before is not None and mark[at.FACTORS] <= self.own_before[0]:
            self.own, self.own_before = self.own_before[1], None
        self.forget_ids()
        if self._rows.forget(mark[at.VARIABLES]):
            # Somebody may have an estimate of what is gone, its keys and stamps.
            self.keys, self.stamps = self.keys.copy(), self.stamps.copy()

    def copied(self) -> "FactorGraph":
        """The same graph with arrays of its own, as large as what is in use."""
        variables, factors, values, payload, columns, *_ = self.counts.tolist()
        other = FactorGraph()
        other.keys, other.var = self.keys[:variables].copy(), self.var[:variables].copy()
        other.stamps = self.stamps[:variables].copy()
        other.dims, other.table, other.counts = self.dims[:columns].copy(), self.table.copy(), self.counts.copy()
        other.values, other.payload = self.values[:values].copy(), self.payload[:payload].copy()
        other.fac = self.fac[:factors].copy()
        other.ids, other.id_shift, other.holes = self.ids.copy(), self.id_shift, self.holes
        other.own = self.own
        return other

    def make_room(self, groups: I64) -> None:
        """For groups of variables and factors as `kernels/graph/group_table.py` has them."""
        groups = groups[: int(np.argmax(groups[:, gt.G_KIND] == gt.END))]
        variables, factors = groups[groups[:, gt.G_FACTORS] == 0], groups[groups[:, gt.G_FACTORS] != 0]
        kinds = [VARIABLE_KIND_OF_CODE[code] for code in variables[:, gt.G_KIND].tolist()]
        counts = variables[:, gt.G_COUNT].tolist()
        self.reserve_variables(sum(counts), sum(n * kind.size for n, kind in zip(counts, kinds, strict=True)))
        counts, sizes = factors[:, gt.G_COUNT], np.array([_shape(group) for group in factors]).reshape(-1, 2)
        more = int((counts * rows_of_arities(sizes[:, 0])).sum())
        self.reserve_factors(more, int((counts * (sizes[:, 1] + 1)).sum()))

    def reserve_variables(self, more: int, numbers: int) -> None:
        """Make room for `more` variables and the numbers of all their values."""
        counts = self.counts.tolist()
        if (need := counts[at.VARIABLES] + more) > self.keys.size:
            together = self.keys, self.var, self.dims, self.stamps
            self.keys, self.var, self.dims, self.stamps = (with_room(array, need) for array in together)
        if (need := counts[at.VALUES] + numbers) > self.values.size:
            self.values = with_room(self.values, need)
        if (slots := slots_of(counts[at.VARIABLES] + more)) > self.table.size:
            self._enter_keys(counts[at.VARIABLES], slots)

    def reserve_factors(self, more: int, numbers: int) -> None:
        """Make room for `more` rows of factors and all numbers of these (measurement, information, scale of a loss)."""
        counts = self.counts.tolist()
        if (need := counts[at.FACTORS] + more) > len(self.fac):
            self.fac = with_room(self.fac, need)
        if (need := counts[at.PAYLOAD] + numbers) > self.payload.size:
            self.payload = with_room(self.payload, need)

    def in_use(self) -> dict[str, slice]:
        """What of each arena a copy needs: what is behind that may be of a batch that was refused."""
        variables, factors, values, payload, *_ = (slice(count) for count in self.counts.tolist())
        of_variables = dict.fromkeys(("keys", "var", "stamps", "dims"), variables)
        return of_variables | {"values": values, "fac": factors, "payload": payload}

    def _enter_keys(self, variables: int, slots: int) -> None:
        """A new table of the first variables."""
        self.table = np.zeros(slots, np.int64)
        enter_keys(variables, self.table, self.keys)

    def take(self, other: "FactorGraph") -> None:
        """Become `other`."""
        for name, array in other.__getstate__().items():
            setattr(self, name, array)

    def memory_bytes(self) -> int:
        """Bytes in use of all arenas."""
        variables, factors, values, payload, columns, *_ = self.counts.tolist()
        return 8 * (variables * (at.V_WIDTH + 2) + factors * at.F_WIDTH + values + payload + columns + self.table.size)

    def stamps_of(self, rows: I64) -> I64 | None:
        """The time stamps of the variables at these indices, NO_STAMP of one without; None: none of them has one."""
        if not self.counts[at.STAMPED]:
            return None
        stamps = self.stamps[rows]
        return stamps if (stamps != at.NO_STAMP).any() else None

    @property
    def factor_count(self) -> int:
        """Factors; those of more than two variables have several rows."""
        return int(self.counts[at.FACTORS] - self.counts[at.MEMBERS])

    def rows_of_first(self, factors: int) -> int:
        """How many rows the first `factors` of the factors have."""
        fac = self.fac[: self.counts[at.FACTORS]]
        if not self.counts[at.MEMBERS]:
            return min(factors, len(fac))
        starts = np.flatnonzero(is_first(fac))
        return int(starts[factors]) if factors < starts.size else len(fac)

    def find(self, key: int) -> int:
        """Index of the variable `key`, or −1."""
        return int(find_variable(key, self.table, self.keys))

    def variables(self, picked: I64 | None = None) -> list[Group]:
        """Values of all variables, or of those at the indices `picked`: a copy, one group per kind and fixedness.

        Of all variables, keys, stamps and the values of fixed ones are read-only: they may have been given before.
        """
        if picked is None:
            spans = self._rows.follow(self.var, self.counts.item(at.VARIABLES))
            keys, values, stamps = self.keys, self.values, self.stamps if self.counts.item(at.STAMPED) else None
            return [span.group(keys, values, stamps) if span.together else self._scattered(span) for span in spans]
        if (label := common_label(picked, self.array_table)) >= 0:
            return [self._gathered(label, picked)]
        var = self.var[picked]
        labels = 2 * var[:, at.V_KIND] + (var[:, at.V_COLUMN] < 0)
        return [self._gathered(k, picked[labels == k]) for k in np.flatnonzero(np.bincount(labels)).tolist()]

    def _scattered(self, span: Span) -> Group:
        values, rows = np.empty((span.count, span.size)), span.rows()
        gather_values(rows, self.array_table, _NO_KEYS, values)
        if span.fixed:  # as where they are together
            values.flags.writeable = False
        stamps = self.stamps_of(rows)
        if stamps is not None:
            stamps.flags.writeable = False
        return _new(Group, (span.kind, span.keys_apart(self.keys), values, span.fixed, stamps))

    def _gathered(self, label: int, rows: I64) -> Group:
        kind = VARIABLE_KIND_OF_CODE[label // 2]
        keys, values = np.empty(rows.size, np.int64), np.empty((rows.size, kind.size))
        gather_values(rows, self.array_table, keys, values)
        return Group(kind.name, keys, values, bool(label % 2), self.stamps_of(rows))

    def kind_of(self, row: int) -> FactorKind:
        """The kind of the factor that begins at a row."""
        code, flags = (int(n) for n in self.fac[row, [at.F_KIND, at.F_FLAGS]])
        if code < at.LINEAR:
            return FACTOR_KIND_OF_CODE[code]
        if code == at.OWN:
            return kinds_by_number(self.own)[int(self.payload[self.fac[row, at.F_AT] + X_NUMBER])]
        if code in (at.IMU, at.PREINTEGRATED):
            mounted, ends = bool(flags & at.MOUNTED), flags >> at.ENDS_SHIFT & at.ENDS_MASK
            return imu_of(flags >> at.SAMPLES_SHIFT & at.SAMPLES_MASK, mounted, ends)
        return linear_of(flags >> at.DIM_SHIFT, tuple(self.var[self.ends_of(row), at.V_KIND].tolist()))

    def kinds_of(self, rows: I64) -> list[tuple[FactorKind, I64]]:
        """The kinds of the factors that begin at these rows, each with the rows that it is of."""
        codes, found = self.fac[rows, at.F_KIND], list[tuple[FactorKind, I64]]()
        for code in np.flatnonzero(np.bincount(codes)).tolist() if rows.size else ():
            of = rows[codes == code]
            if code < at.LINEAR:
                found.append((FACTOR_KIND_OF_CODE[code], of))
                continue
            kinds: dict[FactorKind, list[int]] = {}
            for row in of.tolist():
                kinds.setdefault(self.kind_of(row), []).append(row)
            found += [(kind, np.array(of_kind)) for kind, of_kind in kinds.items()]
        return found

    def sizes_of(self, rows: I64) -> tuple[I64, I64]:
        """(numbers before the information, numbers of it) of each of these rows; none of those that begin no factor."""
        fac = self.fac[rows]
        measured, triangle = _MEASURED[fac[:, at.F_KIND]], _TRIANGLE[fac[:, at.F_KIND]]
        for k in np.flatnonzero(OF_FAMILY[fac[:, at.F_KIND]]).tolist():
            kind = self.kind_of(int(rows[k]))
            measured[k], triangle[k] = kind.information_at, kind.triangle
        return measured, triangle

    def factors(self, most: int | None = None) -> list[FactorGroup]:
        """All factors, or those of the first `most` rows: a copy, a group for each kind and loss."""
        fac = self.fac[: self.counts[at.FACTORS]][:most]
        groups, losses = list[FactorGroup](), losses_of(fac)
        firsts = np.flatnonzero(is_first(fac))
        for kind, rows in self.kinds_of(firsts[np.argsort(self.ids_of(firsts), kind="stable")]):
            groups += [
                self._group(kind, code, rows[losses[rows] == code])
                for code in np.flatnonzero(np.bincount(losses[rows])).tolist()
            ]
        return groups

    def factor_named(self, factor_id: int) -> FactorGroup:
        """The factor with this id, which is there."""
        rows = self.rows_of(np.array([factor_id]))
        return self._group(self.kind_of(int(rows[0])), int(losses_of(self.fac[rows])[0]), rows)

    def _group(self, kind: FactorKind, code: int, rows: I64) -> FactorGroup:
        """Factors of one kind and loss."""
        fac, loss, picked = self.fac, LOSS_OF_CODE.get(code, ""), self.fac[rows]
        ends = self.keys[ends_of_rows(fac, rows, len(kind.connects))]
        width = kind.width + (1 if loss else 0)
        numbers = self.payload[picked[:, at.F_AT, None] + np.arange(width)]
        numbers = np.hsplit(numbers, [kind.before, kind.before + kind.size, kind.information_at, kind.width])
        _, measured, _, information, scale = numbers
        own = scale[:, 0].copy() if loss else None
        return FactorGroup(kind.name, ends, measured.copy(), information.copy(), loss, own, self.ids_of(rows))

    def factors_of(self, variable: int) -> list[str]:
        """The factors on one variable, for a person: "between_se2 (x1, x2)"."""
        return [self.describe(row) for row in self.rows_on(variable).tolist()]

    def count_factors(self, variable: int) -> int:
        """How many factors are on one variable."""
        return self.rows_on(variable).size

    def rows_on(self, variable: int) -> I64:
        """The first rows of the factors on one variable."""
        fac = self.fac[: self.counts[at.FACTORS]]
        rows = np.flatnonzero((fac[:, at.F_I] == variable) | (fac[:, at.F_J] == variable))
        return np.unique(first_rows(fac)[rows]) if self.counts[at.MEMBERS] else rows

    def ends_of(self, row: int) -> list[int]:
        """The variables of the factor that begins at a row."""
        arity = int(arities_of(self.fac[row : row + 1])[0])
        return ends_of_rows(self.fac, np.array([row]), arity)[0].tolist()

    def columns_bytes(self) -> tuple[int, int]:
        """Bytes of all variables, and of all factors, as columns, keys and stamps included."""
        variables, factors, values, payload, _, _, stamped, _ = self.counts.tolist()
        return 8 * (variables * (2 if stamped else 1) + values), 8 * (2 * factors + payload - self.holes)

    def describe(self, row: int) -> str:
        """The factor that begins at a row, for a person."""
        ends = [int(self.keys[v]) for v in self.ends_of(row)]
        return f"{self.kind_of(row)} ({', '.join(printed(key) for key in ends)})"


def _shape(group: I64) -> tuple[int, int]:
    """(variables, numbers without the scale of a loss) of each factor of a group."""
    if (code := int(group[gt.G_KIND])) >= at.LINEAR:
        rows, kept = int(group[gt.G_ROWS]), inertial.KEPT if code == at.IMU else 0
        before = int(group[gt.G_LENGTH]) + int(group[gt.G_SIZE]) + kept
        return int(group[gt.G_ARITY]), before + rows * (rows + 1) // 2
    kind = FACTOR_KIND_OF_CODE[code]
    return len(kind.connects), kind.width
