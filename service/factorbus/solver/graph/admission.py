"""Judging a batch: everything about it is checked before any of it counts.

Shapes and kinds are checked here; what concerns single rows is checked by the kernels in the pass that writes them
behind the rows in use.  The caller goes back to its mark when this raises, so a batch is taken whole or not at all.
"""

import numpy as np

from factorbus.solver import errors
from factorbus.solver.graph import observations as sights
from factorbus.solver.graph.factor_graph import Graph
from factorbus.solver.graph.factors import FACTOR_KINDS, LENS_AT, LOSSES, FactorKind
from factorbus.solver.graph.groups import BatchLike, FactorsLike, VariablesLike
from factorbus.solver.graph.joints import SINGLE, check_joints
from factorbus.solver.graph.triangulation import place_by_bearings
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE, VARIABLE_KINDS
from factorbus.solver.kernels.graph.admit import admit_factors, admit_variables
from factorbus.solver.kernels.graph.initialize import reach
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import (
    LEAST_INFORMATION,
    LEAST_SCALE,
    MOST_INFORMATION,
    MOST_LINEAR,
    MOST_NUMBER,
    find_first_outside,
)
from factorbus.solver.kernels.model.kinds import LINEAR

_I64 = np.dtype(np.int64)
_F64 = np.dtype(np.float64)
_NO_SCALE = np.empty(0)
_NONE = np.empty(0, np.int64)
_NO_VALUES = {size: np.empty((0, size)) for size in {kind.size for kind in VARIABLE_KINDS.values()}}


def admit(graph: Graph, batch: BatchLike, whole: bool = True) -> None:
    """Append `batch` to `graph` and give values to the variables that come without.

    whole: a linear factor of one variable may have a negative definite Ω where those that came together make a form
    that is positive semidefinite (`joints`); else it may not.

    Raises UnknownKind, BadShape, DuplicateVariable, UnknownVariable, KindMismatch, SelfLoop, NotFinite, OutOfBounds,
    BadQuaternion, BadRange, BadLens, BadSight, BadLoss, NotPositiveDefinite, Apart, Uninitialized; `graph` then
    holds a part of the batch and must go back to its mark.
    """
    counts = graph.counts.tolist()
    first, first_factor = counts[at.VARIABLES], counts[at.FACTORS]
    new, given = 0, []
    for group in batch.variables:
        count, has_values = _admit_variables(graph, group)
        if has_values:
            given.append((new, new + count))
        new += count
    negative = [_admit_factors(graph, group, whole) for group in batch.factors]
    if len(given) < len(batch.variables):
        reached = np.zeros(new, np.int64)
        for begin, behind in given:
            reached[begin:behind] = 1
        _compose(graph, first, first_factor, reached)
    if any(group.kind in LENS_AT for group in batch.factors):
        sights.check(graph, first_factor)
    if any(negative):
        check_joints(graph, first_factor)


def _admit_variables(graph: Graph, group: VariablesLike) -> tuple[int, bool]:
    """(how many, whether they come with values)."""
    kind = VARIABLE_KINDS.get(group.kind)
    if kind is None:
        raise errors.UnknownKind("variable", group.kind, tuple(VARIABLE_KINDS))
    keys = _column(group.keys, _I64, (-1,), group.kind, "keys")
    if group.values is None:
        values = _NO_VALUES[kind.size]
    else:
        values = _column(group.values, _F64, (keys.size, kind.size), group.kind, "values")
    graph.reserve_variables(keys.size, keys.size * kind.size)
    row, wrong = admit_variables(
        kind.code, bool(group.fixed), keys, values, graph.table, graph.keys, graph.var, graph.values, graph.dims,
        graph.counts,
    )  # fmt: skip
    if wrong != at.GOOD:
        raise _bad_variable(kind.name, wrong, int(keys[row]), values[row] if len(values) else None)
    stamps = None if group.stamps is None else _column(group.stamps, _I64, (keys.size,), group.kind, "stamps")
    graph.stamp_last(keys.size, stamps)
    return keys.size, group.values is not None


def _admit_factors(graph: Graph, group: FactorsLike, whole: bool) -> bool:
    """Gives whether there are any of negative weight."""
    kind = FACTOR_KINDS.get(group.kind)
    if kind is None:
        raise errors.UnknownKind("factor", group.kind, tuple(FACTOR_KINDS))
    ends = _column(group.keys, _I64, (-1, len(kind.connects)), group.kind, "keys")
    measured = _column(group.measured, _F64, (len(ends), kind.size), group.kind, "measured")
    information = _column(group.information, _F64, (len(ends), kind.triangle), group.kind, "information")
    if kind.name in LENS_AT:
        measured = sights.with_limits(kind, measured)
    loss, scale = at.NO_LOSS, _NO_SCALE
    if group.loss:
        loss, scale = _loss(group, len(ends))
    negative = _NONE
    if whole and kind.name in SINGLE and loss == at.NO_LOSS:
        negative = np.flatnonzero(information[:, 0] < 0.0)
        if negative.size:
            information = information.copy()
            information[negative] *= -1.0
    graph.reserve_factors(len(ends), len(ends) * (kind.size + kind.triangle + 1))
    first = int(graph.counts[at.FACTORS])
    row, wrong = admit_factors(
        kind.code, loss, ends, measured, information, scale, graph.table, graph.keys, graph.var, graph.fac,
        graph.payload, graph.counts,
    )  # fmt: skip
    if wrong == at.BAD_SCALE:
        wanted = f"{LEAST_SCALE:g} to {MOST_NUMBER:g}, standard deviations"
        raise errors.BadLoss(f"{kind} {group.loss}", f"the scale {scale[row]:g}", wanted)
    if wrong != at.GOOD:
        raise _bad_factor(graph, kind, wrong, ends[row], measured[row], information[row])
    for begin in (graph.fac[first + negative, at.F_AT] + kind.size).tolist():
        graph.payload[begin : begin + kind.triangle] *= -1.0
    return negative.size > 0


def _loss(group: FactorsLike, count: int) -> tuple[int, F64]:
    """(code, scales) of the loss of a group."""
    code = LOSSES.get(group.loss)
    if code is None:
        raise errors.BadLoss(group.kind, f"the loss {group.loss!r}", f"none, or one of {', '.join(LOSSES)}")
    if group.scale is None:
        raise errors.BadLoss(f"{group.kind} {group.loss}", "no scale", "one for each factor, standard deviations")
    return code, _column(group.scale, _F64, (count,), group.kind, "scale")


def _compose(graph: Graph, first: int, first_factor: int, reached: I64) -> None:
    missing = _find_missing(graph, first, first_factor, reached)
    if missing >= 0 and place_by_bearings(graph, first, first_factor, reached):
        missing = _find_missing(graph, first, first_factor, reached)
    if missing >= 0:
        raise errors.Uninitialized(int(graph.keys[missing]))
    outside = find_first_outside(first, int(graph.counts[at.VARIABLES]), graph.var, graph.values)
    if outside >= 0:
        raise value_out_of_bounds(graph, outside)


def value_out_of_bounds(graph: Graph, v: int) -> errors.SolverError:
    """The error that names the variable with index v, whose value is NaN, infinite or too large."""
    kind, start = VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])], int(graph.var[v, at.V_AT])
    where = f"the value of {kind} {errors.printed(int(graph.keys[v]))}"
    return out_of_bounds(where, graph.values[start : start + kind.size])


def out_of_bounds(where: str, numbers: F64, most: float = MOST_NUMBER) -> errors.SolverError:
    """The error for the first of `numbers` that is NaN, infinite, or beyond `most`."""
    bad = np.flatnonzero(~(np.abs(numbers) <= most))
    if not np.isfinite(numbers).all() or not bad.size:
        return errors.NotFinite(where)
    return errors.OutOfBounds(where, float(numbers[bad[0]]), -most, most)


def _find_missing(graph: Graph, first: int, first_factor: int, reached: I64) -> int:
    """Compose values for those that are not `reached` yet; gives one that nothing leads to, or −1."""
    return reach(
        True, first, first_factor, int(graph.counts[at.FACTORS]), graph.var, graph.fac, graph.values, graph.payload,
        reached,
    )  # fmt: skip


def _column(array: np.ndarray, dtype: np.dtype, shape: tuple[int, ...], kind: str, name: str) -> np.ndarray:
    """`array` if it is fit for a kernel, a copy that is where it is not writable, aligned or contiguous."""
    if not isinstance(array, np.ndarray) or array.dtype != dtype:
        seen = str(array.dtype) if isinstance(array, np.ndarray) else type(array).__name__
        raise errors.BadShape(f"{kind} {name}", seen, f"an array of {dtype}")
    if array.shape != shape and (len(array.shape) != len(shape) or array.shape[1:] != shape[1:] or shape[0] >= 0):
        wanted = " × ".join("n" if n < 0 else str(n) for n in shape)
        raise errors.BadShape(f"{kind} {name}", " × ".join(map(str, array.shape)), wanted)
    return array if array.flags.carray else np.array(array, dtype, order="C")


def _bad_variable(kind: str, wrong: int, key: int, value: F64 | None) -> errors.SolverError:
    where = f"{kind} {errors.printed(key)}"
    if wrong == at.DUPLICATE:
        return errors.DuplicateVariable(key)
    if wrong == at.BAD_QUATERNION and value is not None:
        return errors.BadQuaternion(where, float(np.linalg.norm(value[3:])))
    return out_of_bounds(f"the value of {where}", np.zeros(0) if value is None else value)


def _bad_factor(
    graph: Graph, kind: FactorKind, wrong: int, ends: I64, measured: F64, information: F64
) -> errors.SolverError:
    keys = [int(key) for key in ends]
    where = f"{kind} ({', '.join(map(errors.printed, keys))})"
    if wrong in (at.UNKNOWN_FIRST, at.UNKNOWN_SECOND):
        return errors.UnknownVariable(keys[wrong - at.UNKNOWN_FIRST], where)
    if wrong in (at.WRONG_KIND_FIRST, at.WRONG_KIND_SECOND):
        end = wrong - at.WRONG_KIND_FIRST
        seen = VARIABLE_KIND_OF_CODE[int(graph.var[graph.find(keys[end]), at.V_KIND])]
        return errors.KindMismatch(keys[end], where, seen.name, kind.connects[end].name)
    if wrong == at.SELF_LOOP:
        return errors.SelfLoop(keys[0], where)
    if wrong == at.BAD_QUATERNION:
        return errors.BadQuaternion(where, float(np.linalg.norm(measured[3:7])))
    if wrong == at.BAD_RANGE:
        return errors.BadRange(where, float(measured[min(1, kind.size - 1)]))
    if wrong == at.BAD_DIRECTION:
        return errors.BadDirection(where)
    if wrong == at.NOT_POSITIVE_DEFINITE:
        matrix = np.zeros((kind.dim, kind.dim))
        matrix[np.triu_indices(kind.dim)] = information
        return errors.NotPositiveDefinite(where, float(np.linalg.eigvalsh(matrix, UPLO="U")[0]))
    return _number_out_of_bounds(kind, where, measured, information)


def _number_out_of_bounds(kind: FactorKind, where: str, measured: F64, information: F64) -> errors.SolverError:
    """Of a measurement or an information matrix."""
    plain = sum(end.size for end in kind.connects) if LINEAR[kind.code] else kind.size
    for numbers, most in ((measured[:plain], MOST_NUMBER), (measured[plain:], MOST_LINEAR)):
        if not (np.abs(numbers) <= most).all():
            return out_of_bounds(f"the measurement of {where}", numbers, most)
    if not (np.abs(information) <= MOST_INFORMATION).all():
        return out_of_bounds(f"the information of {where}", information, MOST_INFORMATION)
    least = float(information[np.cumsum([0, *range(kind.dim, 1, -1)])].min())
    return errors.OutOfBounds(f"the diagonal of the information of {where}", least, LEAST_INFORMATION, MOST_INFORMATION)
