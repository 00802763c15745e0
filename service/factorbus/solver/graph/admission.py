"""A batch is checked and taken into the graph, whole or not at all.

Kinds and shapes are checked where the columns are located (`columns`), rows by the kernel that writes them behind those
in use; what concerns rows together is checked when all are there.
"""

import numpy as np

from factorbus.proto import inertial
from factorbus.proto import kinds as wire
from factorbus.solver import errors
from factorbus.solver.graph import observations, own_kinds
from factorbus.solver.graph.columns import Columns, floats_at, ints_at, limit_lenses, locate_columns
from factorbus.solver.graph.factor_graph import FactorGraph, Mark
from factorbus.solver.graph.factors import (
    FACTOR_KIND_OF_CODE,
    LOSS_OF_CODE,
    FactorKind,
    imu_of_size,
    kinds_by_number,
    linear_of,
)
from factorbus.solver.graph.groups import BatchLike
from factorbus.solver.graph.triangulation import place_by_bearings
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.graph import group_table as gt
from factorbus.solver.kernels.graph.admit import admit_groups
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
from factorbus.solver.kernels.model.expression_layout import X_NUMBER
from factorbus.wording import outside

UNIT_LENGTH = (1.0 - 1e-3, 1.0 + 1e-3)  # of a quaternion, as it may come
_NEAR = "choose units and an origin near the data"


def admit(graph: FactorGraph, batch: BatchLike | Columns) -> int:
    """Append `batch` to `graph` and give values to the variables that come without; gives the id of its first factor.

    Raises UnknownKind, BadShape, DuplicateVariable, UnknownVariable, KindMismatch, SelfLoop, NotFinite, OutOfBounds,
    BadQuaternion, BadRange, BadLens, BadObservation, BadLoss, NotPositiveDefinite, Uninitialized; `graph` is as
    it was then.
    """
    if not isinstance(batch, Columns) and not hasattr(batch, "variables"):
        raise errors.BadShape("batch", f"an object of type {type(batch).__name__}", "a Batch; of a Draft its batch()")
    raw, groups, problem = (batch.raw, batch.groups, None) if isinstance(batch, Columns) else locate_columns(batch)
    mark, own = graph.mark(), graph.own
    first = mark[at.FACTORS] + graph.id_shift
    try:
        if not isinstance(batch, Columns):
            for group in batch.factors:
                if "(" in group.kind:
                    own_kinds.take_own_kinds(graph, batch)
                    break
        fault, g, row, rest = admit_groups(raw, groups, graph.array_table)
        if fault == gt.NO_LIMITS:
            raw, groups, lens = limit_lenses(raw, groups)
            problem = lens or problem
            fault, g, row, rest = admit_groups(raw, groups, graph.array_table)
        if fault == gt.NO_ROOM:
            graph.make_room(groups)
            fault, g, row, rest = admit_groups(raw, groups, graph.array_table)
        if g >= 0:
            if fault == gt.DUPLICATE:
                raise _duplicate(graph, raw, groups[g], row, mark[at.VARIABLES])
            raise _find_bad_row(graph, raw, groups[g], row, fault)
        if problem is not None:
            raise problem
        if fault == gt.COMPOSED_OUT_OF_BOUNDS:
            raise value_out_of_bounds(graph, row)
        if graph.counts.item(at.MEMBERS):
            graph.name_rows(mark[at.FACTORS], first)
        if rest:
            _finish(graph, groups, mark, rest)
    except BaseException:
        graph.forget(mark)
        graph.own = own
        raise
    return first


def _finish(graph: FactorGraph, groups: I64, mark: Mark, rest: int) -> None:
    """What the kernel leaves to be done for groups that are in order."""
    if rest & gt.UNREACHED:
        _compose(graph, mark[at.VARIABLES], mark[at.FACTORS], _list_given(groups))
    if rest & gt.OBSERVED:
        observations.check(graph, mark[at.FACTORS])
    if rest & gt.OWN:
        own_kinds.check_residuals(graph, mark[at.FACTORS])


def _list_given(groups: I64) -> I64:
    """For each new variable whether it came with a value: 1 or 0."""
    groups = groups[: int(np.argmax(groups[:, gt.G_KIND] == gt.END))]
    groups = groups[groups[:, gt.G_FACTORS] == 0]
    return np.repeat((groups[:, gt.G_NUMBERS] != gt.NOWHERE).astype(np.int64), groups[:, gt.G_COUNT])


def _compose(graph: FactorGraph, first: int, first_factor: int, reached: I64) -> None:
    missing = _find_missing(graph, first, first_factor, reached)
    if missing >= 0 and place_by_bearings(graph, first, first_factor, reached):
        missing = _find_missing(graph, first, first_factor, reached)
    if missing >= 0:
        raise errors.Uninitialized(int(graph.keys[missing]), graph.factors_of(missing))
    outside = find_first_outside(first, int(graph.counts[at.VARIABLES]), graph.var, graph.values)
    if outside >= 0:
        raise value_out_of_bounds(graph, outside)


def value_out_of_bounds(graph: FactorGraph, v: int) -> errors.SolverError:
    """The error that names the variable with index v, whose value is NaN, infinite or too large."""
    kind, start = VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])], int(graph.var[v, at.V_AT])
    where = f"the value of {kind} {errors.printed(int(graph.keys[v]))}"
    return out_of_bounds(where, graph.values[start : start + kind.size])


def out_of_bounds(where: str, numbers: F64, most: float = MOST_NUMBER, advice: str = _NEAR) -> errors.SolverError:
    """The error for the first of `numbers` that is NaN, infinite, or beyond `most`."""
    bad = np.flatnonzero(~(np.abs(numbers) <= most))
    if not np.isfinite(numbers).all() or not bad.size:
        return errors.NotFinite(where)
    return errors.OutOfBounds(where, float(numbers[bad[0]]), -most, most, advice)


def _find_missing(graph: FactorGraph, first: int, first_factor: int, reached: I64) -> int:
    """Compose values for those that are not `reached` yet; gives one that nothing leads to, or −1."""
    return int(reach(True, first, first_factor, int(graph.counts[at.FACTORS]), graph.array_table, reached))


def _duplicate(graph: FactorGraph, raw: bytes, group: I64, n: int, first: int) -> errors.SolverError:
    """The n-th variable of a group is there already: in the map, or since `first` in what is being admitted."""
    key = int(ints_at(raw, int(group[gt.G_KEYS]) + 8 * n, 1)[0])
    return errors.DuplicateVariable(key, graph.find(key) >= first)


def _find_bad_row(graph: FactorGraph, raw: bytes, group: I64, n: int, fault: int) -> errors.SolverError:
    """What is wrong with the n-th row of a group."""
    code, keys, numbers = (int(group[column]) for column in (gt.G_KIND, gt.G_KEYS, gt.G_NUMBERS))
    if not group[gt.G_FACTORS]:
        kind = VARIABLE_KIND_OF_CODE[code]
        value = floats_at(raw, numbers + 8 * n * kind.size, kind.size) if numbers != gt.NOWHERE else None
        return _bad_variable(kind.name, fault, int(ints_at(raw, keys + 8 * n, 1)[0]), value)
    kind, loss = _kind_of(graph, raw, group), int(group[gt.G_LOSS])
    if fault == gt.BAD_SCALE:
        scale = floats_at(raw, int(group[gt.G_SCALE]) + 8 * n, 1)[0]
        wanted = f"{LEAST_SCALE:g} to {MOST_NUMBER:g}, standard deviations"
        return errors.BadLoss(
            f"{kind} {LOSS_OF_CODE[loss]}", f"the scale {outside(scale, LEAST_SCALE, MOST_NUMBER)}", wanted
        )
    arity, triangle = len(kind.connects), kind.triangle
    information = floats_at(raw, int(group[gt.G_INFORMATION]) + 8 * n * triangle, triangle)
    measured = floats_at(raw, numbers + 8 * n * kind.size, kind.size)
    return _bad_factor(graph, kind, fault, ints_at(raw, keys + 8 * n * arity, arity), measured, information)


def _kind_of(graph: FactorGraph, raw: bytes, group: I64) -> FactorKind:
    """The kind of a group of factors."""
    if (code := int(group[gt.G_KIND])) < at.LINEAR:
        return FACTOR_KIND_OF_CODE[code]
    if code == at.OWN:
        own = floats_at(raw, int(group[gt.G_HEAD]), int(group[gt.G_LENGTH]))
        return kinds_by_number(graph.own)[int(own[X_NUMBER])]
    ends = ints_at(raw, int(group[gt.G_ENDS]), int(group[gt.G_ARITY]))
    if code in (at.IMU, at.PREINTEGRATED):
        return imu_of_size(code == at.PREINTEGRATED, ends, int(group[gt.G_SIZE]))
    return linear_of(int(group[gt.G_ROWS]), tuple(ends.tolist()))


def _bad_variable(kind: str, wrong: int, key: int, value: F64 | None) -> errors.SolverError:
    where = f"{kind} {errors.printed(key)}"
    if wrong == gt.BAD_QUATERNION and value is not None:
        at_q = wire.VARIABLE_KINDS[kind].quaternion_at
        return errors.BadQuaternion(where, outside(float(np.linalg.norm(value[at_q : at_q + 4])), *UNIT_LENGTH))
    if (scale := _scale_out_of_bounds(where, kind, value)) is not None:
        return scale
    return out_of_bounds(f"the value of {where}", np.zeros(0) if value is None else value)


def _bad_factor(
    graph: FactorGraph, kind: FactorKind, wrong: int, ends: I64, measured: F64, information: F64
) -> errors.SolverError:
    keys = [int(key) for key in ends]
    later, wrong = divmod(wrong, gt.LATER_END)
    where = f"{kind} ({', '.join(map(errors.printed, keys))})"
    if wrong in (gt.UNKNOWN_FIRST, gt.UNKNOWN_SECOND):
        return errors.UnknownVariable(keys[wrong - gt.UNKNOWN_FIRST + later], where)
    if wrong in (gt.WRONG_KIND_FIRST, gt.WRONG_KIND_SECOND):
        end = wrong - gt.WRONG_KIND_FIRST + later
        seen = VARIABLE_KIND_OF_CODE[int(graph.var[graph.find(keys[end]), at.V_KIND])]
        return errors.KindMismatch(keys[end], where, seen.name, kind.connects[end].name)
    if wrong == gt.SELF_LOOP:
        return errors.SelfLoop(keys[later], where)
    if wrong == gt.BAD_QUATERNION:
        return errors.BadQuaternion(where, outside(_worst_norm(kind, measured), *UNIT_LENGTH))
    if wrong == gt.BAD_RANGE and kind.size == wire.VARIABLE_KINDS["sim3"].size:
        return _scale_out_of_bounds(where, "sim3", measured) or errors.BadRange(where, float(measured[-1]))
    if wrong == gt.BAD_RANGE:
        return errors.BadRange(where, float(measured[min(1, kind.size - 1)]))
    if wrong == gt.BAD_DIRECTION:
        return errors.BadDirection(where)
    if wrong == gt.BAD_DURATION:
        form = inertial.form_of_name(kind.name)
        if not form.samples:
            return errors.BadSamples(where, f"a duration of {measured[form.start]:g} s", "more than 0 s")
        durations = measured[form.start :: inertial.SAMPLE]
        sample = int(np.flatnonzero(~(durations > 0.0))[0])
        return errors.BadSamples(where, f"sample {sample} lasts {durations[sample]:g} s", "more than 0 s")
    if wrong == gt.BAD_NOISE:
        return _bad_noise(where, measured)
    if wrong == gt.NOT_POSITIVE_DEFINITE:
        matrix = np.zeros((kind.dim, kind.dim))
        matrix[np.triu_indices(kind.dim)] = information
        return errors.NotPositiveDefinite(where, float(np.linalg.eigvalsh(matrix, UPLO="U")[0]))
    return _number_out_of_bounds(kind, where, measured, information)


def _bad_noise(where: str, measured: F64) -> errors.SolverError:
    """A noise density is not positive, or the covariance of Δ is singular, as that of one sample is."""
    noise = measured[: inertial.NOISE]
    if (noise[: inertial.INTEGRATION] > 0.0).all() and noise[inertial.INTEGRATION] >= 0.0:
        seen = f"the covariance of Δ is singular with noise of integration {noise[inertial.INTEGRATION]:g} m/√s"
        return errors.BadSamples(where, seen, "a larger one, 1e-4 say, or more samples")
    seen = ", ".join(f"{number:g}" for number in noise.tolist())
    return errors.BadSamples(where, f"noise densities {seen}", "all above 0, and the last, of integration, 0 or more")


def _scale_out_of_bounds(where: str, kind: str, value: F64 | None) -> errors.SolverError | None:
    """Of a value with a scale that is too small or no number above 0; None: it is not."""
    at_s = wire.VARIABLE_KINDS[kind].scale_at
    if value is None or at_s < 0 or value[at_s] >= LEAST_SCALE or not np.isfinite(value).all():
        return None
    return errors.OutOfBounds(f"the scale of {where}", float(value[at_s]), LEAST_SCALE, MOST_NUMBER, "give one above 0")


def _worst_norm(kind: FactorKind, measured: F64) -> float:
    """Of the quaternions of a measurement the length that is furthest from one."""
    starts, here = [0 if kind.size == 4 else 3], 0
    if kind.code == at.LINEAR:
        starts = []
        for end in kind.connects:
            starts += [here + at_q] if (at_q := wire.VARIABLE_KINDS[end.name].quaternion_at) >= 0 else []
            here += end.size
    if kind.code in (at.IMU, at.PREINTEGRATED):
        form = inertial.form_of_name(kind.name)
        starts = [*[form.mount_at + 3] * (not form.mount), *[form.start + 1] * (not form.samples)]
    if kind.own:
        starts = [{"so3": 0}.get(str(kind.own.measured), 3)]
    norms = [float(np.linalg.norm(measured[start : start + 4])) for start in starts]
    return max(norms, key=lambda norm: abs(norm - 1.0))


def _number_out_of_bounds(kind: FactorKind, where: str, measured: F64, information: F64) -> errors.SolverError:
    """Of a measurement or an information matrix."""
    plain = sum(end.size for end in kind.connects) if kind.code == at.LINEAR else kind.size
    for numbers, most in ((measured[:plain], MOST_NUMBER), (measured[plain:], MOST_LINEAR)):
        if not (np.abs(numbers) <= most).all():
            return out_of_bounds(f"the measurement of {where}", numbers, most)
    if not (np.abs(information) <= MOST_INFORMATION).all():
        return out_of_bounds(f"the information of {where}", information, MOST_INFORMATION, "give a larger sigma")
    least = float(information[np.cumsum([0, *range(kind.dim, 1, -1)])].min())
    where = f"the diagonal of the information of {where}"
    return errors.OutOfBounds(where, least, LEAST_INFORMATION, MOST_INFORMATION, "give a smaller sigma")
