"""Changes of a graph that are no additions, checked and collected: what is to stay, and how.  `edited` makes them.

    remove_factors     factors (n,)                     these factors go
    remove_variables   keys (n,), alone                 these variables go, and every factor on them; with `alone` it is
                                                        refused where another factor than those removed is on them
    loss               factors (n,), loss, scale (n,)   these factors have this loss from now on; "": none
    weigh              factors (n,), weight (n,)        Ω becomes w Ω
    fix, free          keys (n,)                        variables are held where they are; or estimated again
    place              kind, keys (n,), values, carry   variables of one kind, also fixed ones, go to these values; the
                                                        estimate goes on from there; with `carry` all that no change
                                                        places goes along with what it hangs on (`carrying`)
    marginalize        keys (n,)                        these variables go; what their factors say of others is kept as
                                                        linear factors (`marginal`)
    accept, reject     factors (n,)                     of closures that are tested: `closures.switching` makes them

Changes are made one after the other: what the first has removed the second cannot name.  Each names what it is about
once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from factorbus.proto import kinds as wire
from factorbus.solver import errors
from factorbus.solver.changes.carrying import carry_along
from factorbus.solver.changes.marginal import marginals
from factorbus.solver.closures.naming import NotAClosure
from factorbus.solver.graph.admission import UNIT_LENGTH, out_of_bounds
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import is_first, losses_of, of_whole_factors, rows_of_factors
from factorbus.solver.graph.factors import LOSSES
from factorbus.solver.graph.groups import FactorGroup
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE, VARIABLE_KINDS
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import LEAST_INFORMATION, LEAST_SCALE, MOST_INFORMATION, MOST_NUMBER
from factorbus.wording import outside

CHANGES = (
    "remove_factors",
    "remove_variables",
    "loss",
    "weigh",
    "fix",
    "free",
    "place",
    "marginalize",
    "accept",
    "reject",
)
# A marginal is of the graph as it is: of what came before in the insert, it sees what is removed and nothing else.
_BEFORE_MARGINALIZE = {"remove_factors", "remove_variables"}
_NONE = np.empty(0, np.int64)
_WEIGHTS = (1e-12, 1e12)  # beyond, a factor holds nothing, or nothing else does


class ChangeLike(Protocol):
    """One change; fields that its kind has no use for are not looked at."""

    @property
    def change(self) -> str: ...
    @property
    def factors(self) -> I64 | None: ...
    @property
    def keys(self) -> I64 | None: ...
    @property
    def loss(self) -> str: ...
    @property
    def scale(self) -> F64 | None: ...
    @property
    def weight(self) -> F64 | None: ...
    @property
    def alone(self) -> bool: ...
    @property
    def kind(self) -> str: ...
    @property
    def values(self) -> F64 | None: ...
    @property
    def carry(self) -> bool: ...


@dataclass(slots=True)
class Edits:
    """What is to become of each variable (n,) and each row of factors (m,) of a graph; rows of one factor alike.

    stays, kept: whether it is there afterwards   free: whether a variable is estimated
    loss, scale: code of the loss and its scale   weight: what Ω is multiplied by   values: as in the graph
    placed (n,): whether a variable was given a value; carry: whether others go along with such
    touched (m,): whether a factor was given a loss or a weight
    added: factors that take the place of some   counted: what is to be told of it
    made: the names of the changes so far, also of those without an effect
    """

    stays: np.ndarray
    free: np.ndarray
    kept: np.ndarray
    loss: I64
    scale: F64
    weight: F64
    values: F64
    placed: np.ndarray
    touched: np.ndarray
    carry: bool = False
    added: list[FactorGroup] = field(default_factory=list)
    counted: dict[str, int] = field(default_factory=dict)
    made: set[str] = field(default_factory=set)


def collect(graph: FactorGraph, changes: Sequence[ChangeLike]) -> Edits:
    """`changes` in their order.

    Raises UnknownKind, UnknownFactor, NotInMap, NamedTwice, InUse, BadLoss, BadWeight, BadShape, KindMismatch,
    NotFinite, OutOfBounds, BadQuaternion, TooConnected, Underconstrained, BadOrder.
    """
    edits = unchanged(graph)
    before = edits.free.copy()
    for change in changes:
        make = _MAKE.get(change.change)
        if make is None:
            raise errors.UnknownKind("change", change.change, CHANGES)
        make(graph, edits, change)
        edits.made.add(change.change)
    if edits.carry:
        edits.values = carry_along(graph, edits.values, edits.placed, edits.stays, edits.kept)
    first = is_first(graph.fac[: edits.kept.size])
    edits.counted = {
        "removed_variables": int(np.count_nonzero(~edits.stays)),
        "removed_factors": int(np.count_nonzero(~edits.kept & first)),
        "edited_factors": int(np.count_nonzero(edits.touched & edits.kept & first)),
        "fixed_variables": int(np.count_nonzero(edits.stays & before & ~edits.free)),
        "freed_variables": int(np.count_nonzero(edits.stays & ~before & edits.free)),
        "placed_variables": int(np.count_nonzero(edits.placed)),
        "added_factors": sum(len(group.keys) for group in edits.added),
    }
    return edits


def unchanged(graph: FactorGraph) -> Edits:
    """Everything as it is."""
    variables, factors = int(graph.counts[at.VARIABLES]), int(graph.counts[at.FACTORS])
    fac, var = graph.fac[:factors], graph.var[:variables]
    loss = losses_of(fac)
    scale = np.zeros(factors)
    robust = np.flatnonzero(loss != at.NO_LOSS)
    scale[robust] = graph.payload[fac[robust, at.F_AT] + sum(graph.sizes_of(robust))]
    return Edits(
        np.ones(variables, bool),
        var[:, at.V_COLUMN] >= 0,
        np.ones(factors, bool),
        loss,
        scale,
        np.ones(factors),
        graph.values[: graph.counts[at.VALUES]],
        np.zeros(variables, bool),
        np.zeros(factors, bool),
    )


def _remove_factors(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    edits.kept[rows_of_factors(graph.fac, _factors(graph, edits, change))] = False


def _remove_variables(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    gone = _variables(graph, edits, change)
    edits.stays[gone] = False
    fac = graph.fac[: edits.kept.size]
    left = edits.stays[fac[:, at.F_I]] & ((fac[:, at.F_J] < 0) | edits.stays[fac[:, at.F_J]])
    left = ~of_whole_factors(fac, ~left)
    if change.alone and (on_them := np.flatnonzero(edits.kept & ~left & is_first(fac))).size:
        row = int(on_them[0])
        end = next(v for v in graph.ends_of(row) if not edits.stays[v])
        key, factor = int(graph.keys[end]), int(graph.ids_of(on_them[:1])[0])
        raise errors.InUse(key, factor, graph.describe(row), on_them.size)
    edits.kept &= left


def _set_loss(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    rows = _factors(graph, edits, change)
    code = at.NO_LOSS
    if change.loss:
        if change.loss not in LOSSES:
            raise errors.BadLoss("change loss", f"the loss {change.loss!r:.40}", f"none, or one of {', '.join(LOSSES)}")
        scale = _numbers("loss", "scale", change.scale, rows.size)
        if (bad := np.flatnonzero(~((scale >= LEAST_SCALE) & (scale <= MOST_NUMBER)))).size:
            wanted = f"{LEAST_SCALE:g} to {MOST_NUMBER:g}, standard deviations"
            raise errors.BadLoss(
                f"change loss of factor {_id(graph, rows, bad)}",
                outside(float(scale[bad[0]]), LEAST_SCALE, MOST_NUMBER),
                wanted,
            )
        code, edits.scale[rows] = LOSSES[change.loss], scale
    edits.loss[rows] = code
    edits.touched[rows_of_factors(graph.fac, rows)] = True


def _weigh(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    rows = _factors(graph, edits, change)
    weight = _numbers("weigh", "weight", change.weight, rows.size)
    least, most = _WEIGHTS
    if (bad := np.flatnonzero(~((weight >= least) & (weight <= most)))).size:
        raise errors.BadWeight(
            _id(graph, rows, bad), outside(float(weight[bad[0]]), least, most), f"from {least:g} to {most:g}"
        )
    np.multiply.at(edits.weight, rows, weight)
    _check_weighed(graph, edits, rows)
    edits.touched[rows_of_factors(graph.fac, rows)] = True


def _check_weighed(graph: FactorGraph, edits: Edits, rows: I64) -> None:
    """Is Ω of these factors still within its bounds?  Raises BadWeight."""
    for kind, of in graph.kinds_of(rows):
        omega = np.abs(graph.payload[graph.fac[of, at.F_AT, None] + kind.information_at + np.arange(kind.triangle)])
        diagonal = omega[:, np.cumsum([0, *range(kind.dim, 1, -1)])]
        least, most = LEAST_INFORMATION / diagonal.min(axis=1), MOST_INFORMATION / omega.max(axis=1)
        bad = np.flatnonzero(~((least <= edits.weight[of]) & (edits.weight[of] <= most)))
        if bad.size:
            seen = outside(float(edits.weight[of[bad[0]]]), float(least[bad[0]]), float(most[bad[0]]))
            wanted = f"{least[bad[0]]:g} to {most[bad[0]]:g}, which keeps its information in bounds"
            raise errors.BadWeight(_id(graph, of, bad), seen, wanted)


def _fix(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    edits.free[_variables(graph, edits, change)] = False


def _free(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    edits.free[_variables(graph, edits, change)] = True


def _place(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    picked, kind = _variables(graph, edits, change), VARIABLE_KINDS.get(change.kind)
    if kind is None:
        raise errors.UnknownKind("variable", change.kind, tuple(VARIABLE_KINDS))
    for v in picked[graph.var[picked, at.V_KIND] != kind.code].tolist():
        seen = VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])].name
        raise errors.KindMismatch(int(graph.keys[v]), "change place", seen, kind.name)
    values = change.values
    if values is None or values.shape != (picked.size, kind.size):
        seen = "none" if values is None else " × ".join(map(str, values.shape))
        raise errors.BadShape("change place values", seen, f"{picked.size} × {kind.size}")
    edits.values, edits.carry = edits.values.copy(), edits.carry or change.carry
    edits.placed[picked] = True
    edits.values[graph.var[picked, at.V_AT, None] + np.arange(kind.size)] = _checked(kind.name, picked, values, graph)


def _checked(kind: str, picked: I64, values: F64, graph: FactorGraph) -> F64:
    """Values as variables keep them.  Raises NotFinite, OutOfBounds, BadQuaternion."""
    keys, values = graph.keys[picked], values.copy()
    for row in np.flatnonzero(~(np.abs(values) <= MOST_NUMBER).all(axis=1)).tolist():
        raise out_of_bounds(f"the value of {kind} {errors.printed(int(keys[row]))}", values[row])
    at_q, at_s = wire.VARIABLE_KINDS[kind].quaternion_at, wire.VARIABLE_KINDS[kind].scale_at
    for row in np.flatnonzero(values[:, at_s] < LEAST_SCALE).tolist() if at_s >= 0 else []:
        where = f"the scale of {kind} {errors.printed(int(keys[row]))}"
        raise errors.OutOfBounds(where, float(values[row, at_s]), LEAST_SCALE, MOST_NUMBER, "give one above 0")
    if at_q >= 0:
        turns = values[:, at_q : at_q + 4]
        norms = np.linalg.norm(turns, axis=1)
        for row in np.flatnonzero((norms < UNIT_LENGTH[0]) | (norms > UNIT_LENGTH[1])).tolist():
            raise errors.BadQuaternion(
                f"{kind} {errors.printed(int(keys[row]))}", outside(float(norms[row]), *UNIT_LENGTH)
            )
        turns /= norms[:, None]
    if kind in ("se2", "idp"):
        angle = 2 if kind == "se2" else 3
        values[:, angle] -= 2 * np.pi * np.floor((values[:, angle] + np.pi) / (2 * np.pi))
    return values


def _marginalize(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    gone = np.unique(_variables(graph, edits, change))
    if not edits.made <= _BEFORE_MARGINALIZE:
        raise errors.BadOrder("marginalize", "before any loss, weigh, fix, free, place or marginalize")
    made, replaced = marginals(graph, gone, edits.kept)
    edits.added += made
    edits.stays[gone] = False
    fac = graph.fac[: edits.kept.size]
    edits.kept &= ~of_whole_factors(fac, np.asarray(np.isin(fac[:, at.F_I : at.F_J + 1], gone).any(axis=1)))
    edits.kept[replaced] = False


def _override(graph: FactorGraph, edits: Edits, change: ChangeLike) -> None:
    """Of a map that tests closures: then it does not come to this."""
    rows = _factors(graph, edits, change)
    if rows.size:
        raise NotAClosure(_id(graph, rows, np.zeros(1, np.int64)), 0)


_MAKE = {
    "remove_factors": _remove_factors,
    "remove_variables": _remove_variables,
    "loss": _set_loss,
    "weigh": _weigh,
    "fix": _fix,
    "free": _free,
    "place": _place,
    "marginalize": _marginalize,
    "accept": _override,
    "reject": _override,
}


def _factors(graph: FactorGraph, edits: Edits, change: ChangeLike) -> I64:
    """Rows of the factors that a change names.  Raises UnknownFactor."""
    ids = _NONE if change.factors is None else change.factors
    rows = graph.rows_of(ids)
    missing = np.flatnonzero([row < 0 or not edits.kept[row] for row in rows.tolist()])
    if missing.size:
        raise errors.UnknownFactor(int(ids[missing[0]]), graph.next_id)
    if (twice := _twice(ids)) is not None:
        raise errors.NamedTwice(change.change, f"factor {twice}", factor=twice)
    return rows


def _variables(graph: FactorGraph, edits: Edits, change: ChangeLike) -> I64:
    """Indices of the variables that a change names.  Raises NotInMap."""
    keys = _NONE if change.keys is None else change.keys
    found = np.array([graph.find(key) for key in keys.tolist()], np.int64)
    missing = np.flatnonzero([v < 0 or not edits.stays[v] for v in found.tolist()])
    if missing.size:
        raise errors.NotInMap(int(keys[missing[0]]), change.change)
    if (twice := _twice(keys)) is not None:
        raise errors.NamedTwice(change.change, errors.printed(twice), key=twice)
    return found


def _twice(named: I64) -> int | None:
    """One of those that are named more than once."""
    different, counts = np.unique(named, return_counts=True)
    return int(different[counts > 1][0]) if different.size < named.size else None


def _numbers(change: str, name: str, given: F64 | None, count: int) -> F64:
    if given is None or given.shape != (count,):
        seen = "none" if given is None else " × ".join(map(str, given.shape))
        raise errors.BadShape(f"change {change} {name}", seen, f"{count}, one for each factor")
    return given


def _id(graph: FactorGraph, rows: I64, bad: I64) -> int:
    return int(graph.ids_of(rows[bad[:1]])[0])
