"""Admission: the rows of groups are checked and written behind those that the graph has, all in one call.

Variables come first, whatever the order of their groups, then factors.  A row that is not in order ends it: the rows
before it are in the graph then, for the function that names the fault, and the caller goes back to its mark.
"""

import numpy as np

from factorbus.proto import inertial
from factorbus.solver.kernels.graph import group_table as gt
from factorbus.solver.kernels.graph.check_rows import (
    check_imu,
    check_information,
    check_linear,
    check_measurement,
    check_own_measurement,
    check_value,
)
from factorbus.solver.kernels.graph.initialize import reach
from factorbus.solver.kernels.graph.key_table import slot_of
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import LEAST_SCALE, MOST_NUMBER, find_outside
from factorbus.solver.kernels.model.expression_layout import X_RIGID
from factorbus.solver.kernels.model.factor_rows import row_of_pair, rows_of_arity
from factorbus.solver.kernels.model.imu_layout import ImuLayout, imu_layout
from factorbus.solver.kernels.model.kinds import is_camera, is_joined
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.model.sizes import (
    arity_of,
    dim_of,
    has_own_sizes,
    information_at,
    kind_of_end,
    kinds_of_ends,
    residual_dim,
    size_of,
)


@kernel("UniTuple(int64, 4)(Bytes(uint8, 1, 'C', readonly=True), int64[:,::1], int64[::1])")
def admit_groups(raw: bytes, groups: I64, graph_table: I64) -> tuple:
    """Append the variables and factors whose columns lie in `raw`, and give values to the variables that come without.

    groups (n + 1, G_WIDTH): where they lie, see `group_table`; that they lie inside is not checked.  graph_table: of
    the graph's arrays (`records`).

    Gives (fault, group, row, rest): GOOD and what is left to be done; or what is wrong, with which row of which group.
    With NO_ROOM and NO_LIMITS nothing was done.
    """
    graph = graph_at(graph_table)
    counts = graph.counts
    fault = check_room(groups, graph)
    if fault != gt.GOOD:
        return fault, -1, -1, 0
    v0, f0, rest = counts[at.VARIABLES], counts[at.FACTORS], 0
    for factors in range(2):
        g = 0
        while groups[g, gt.G_KIND] != gt.END:
            if groups[g, gt.G_FACTORS] == factors:
                if factors == 0:
                    row, fault = append_variables(raw, groups[g], graph)
                else:
                    row, fault, left = append_factors(raw, groups[g], graph)
                    rest |= left
                if fault != gt.GOOD:
                    return fault, g, row, 0
            g += 1
    if count_missing(groups) > 0:
        reached = list_given(groups, counts[at.VARIABLES] - v0)
        if reach(True, v0, f0, counts[at.FACTORS], graph_table, reached) >= 0:
            rest |= gt.UNREACHED
        else:
            outside = find_outside(v0, counts[at.VARIABLES], graph.var, graph.values)
            if outside >= 0:
                return gt.COMPOSED_OUT_OF_BOUNDS, -1, outside, 0
    return gt.GOOD, -1, -1, rest


@part
def check_room(groups: I64, graph: Graph) -> int:
    """GOOD; NO_ROOM: the groups do not fit behind what there is; NO_LIMITS: a lens has no limit yet."""
    counts = graph.counts
    variables, factors = counts[at.VARIABLES], counts[at.FACTORS]
    numbers, measured, g = counts[at.VALUES], counts[at.PAYLOAD], 0
    while groups[g, gt.G_KIND] != gt.END:
        kind, count = groups[g, gt.G_KIND], groups[g, gt.G_COUNT]
        if groups[g, gt.G_FACTORS] == 0:
            variables, numbers = variables + count, numbers + count * size_of(kind)
        else:
            arity, dim, size = shape_of(groups[g])
            size += groups[g, gt.G_LENGTH]
            factors += count * rows_of_arity(arity)
            measured += count * (
                size + kept_of(kind) + dim * (dim + 1) // 2 + (1 if groups[g, gt.G_LOSS] != at.NO_LOSS else 0)
            )
            if is_camera(kind) and groups[g, gt.G_LIMITED] == 0:
                return gt.NO_LIMITS
        g += 1
    has_room = (
        variables <= graph.keys.size
        and 2 * variables <= graph.table.size
        and numbers <= graph.values.size
        and factors <= len(graph.fac)
        and measured <= graph.payload.size
    )
    return gt.GOOD if has_room else gt.NO_ROOM


@part
def append_variables(raw: bytes, group: I64, graph: Graph) -> tuple:
    """Append the variables of a group.  Gives (row, fault) of the first that is not in order, or (−1, GOOD)."""
    kind, stamps, values, counts = group[gt.G_KIND], graph.stamps, graph.values, graph.counts
    size = size_of(kind)
    for n in range(group[gt.G_COUNT]):
        key, x = int_at(raw, group[gt.G_KEYS] + 8 * n), counts[at.VALUES]
        slot = slot_of(key, graph.table, graph.keys)
        if graph.table[slot] != 0:
            return n, gt.DUPLICATE
        if group[gt.G_NUMBERS] != gt.NOWHERE:
            copy_numbers(raw, group[gt.G_NUMBERS] + 8 * n * size, size, values, x)
            fault = check_value(kind, x, size, values)
            if fault != gt.GOOD:
                return n, fault
        stamp = int_at(raw, group[gt.G_STAMPS] + 8 * n) if group[gt.G_STAMPS] != gt.NOWHERE else at.NO_STAMP
        stamps[counts[at.VARIABLES]] = stamp
        counts[at.STAMPED] += 1 if stamp != at.NO_STAMP else 0
        append_variable(kind, group[gt.G_FIXED] != 0, key, slot, graph)
    return -1, gt.GOOD


@inline_kernel
def shape_of(group: I64) -> tuple:
    """(variables, numbers of a residual, numbers measured) of each factor of a group."""
    kind = group[gt.G_KIND]
    if has_own_sizes(kind):
        return group[gt.G_ARITY], group[gt.G_ROWS], group[gt.G_SIZE]
    return arity_of(kind), residual_dim(kind), information_at(kind)


@inline_kernel
def kept_of(kind: int) -> int:
    """Numbers that are kept behind the measurement of a kind, and follow from it."""
    return inertial.KEPT if kind == at.IMU else 0


@part
def append_factors(raw: bytes, group: I64, graph: Graph) -> tuple:
    """Append the factors of a group.  Gives (row, fault, what is left to be done for them): of the first that is not in
    order, or (−1, GOOD, …)."""
    kind, loss, payload, counts = group[gt.G_KIND], group[gt.G_LOSS], graph.payload, graph.counts
    arity, dim, size = shape_of(group)
    triangle, ends, kinds = dim * (dim + 1) // 2, np.empty(arity, np.int64), np.empty(arity, np.int64)
    has_ends = group[gt.G_ENDS] != gt.NOWHERE
    for n in range(arity):
        kinds[n] = int_at(raw, group[gt.G_ENDS] + 8 * n) if has_ends else kind_of_end(kind, n)
    is_many, scratch = has_ends or is_joined(kind), np.empty((dim, dim))
    rest, before = (gt.OBSERVED if is_camera(kind) else 0) | (gt.OWN if kind == at.OWN else 0), group[gt.G_LENGTH]
    stored = before + size + kept_of(kind)
    for n in range(group[gt.G_COUNT]):
        p, first = counts[at.PAYLOAD], group[gt.G_KEYS] + 8 * n * arity
        i = j = -1
        if is_many:
            fault = find_many_ends(kinds, raw, first, graph, ends)
        else:
            i, j, fault = find_ends(kind, int_at(raw, first), int_at(raw, first + 8 * (arity - 1)), graph)
        if fault != gt.GOOD:
            return n, fault, rest
        copy_numbers(raw, group[gt.G_HEAD], before, payload, p)
        copy_numbers(raw, group[gt.G_NUMBERS] + 8 * n * size, size, payload, p + before)
        copy_numbers(raw, group[gt.G_INFORMATION] + 8 * n * triangle, triangle, payload, p + stored)
        fault = check_measured(kind, kinds, p, size, payload)
        if fault == gt.GOOD:
            fault = check_information(dim, p + stored, payload, scratch)
        if fault != gt.GOOD:
            return n, fault, rest
        numbers = stored + triangle
        if loss != at.NO_LOSS:
            scale = float_at(raw, group[gt.G_SCALE] + 8 * n)
            if not (scale >= LEAST_SCALE and scale <= MOST_NUMBER):
                return n, gt.BAD_SCALE, rest
            payload[p + numbers] = scale
            numbers += 1
        if is_many:
            append_factor_rows(kind, loss, dim, ends, numbers, graph)
            if kind == at.IMU or kind == at.PREINTEGRATED:
                mark_imu(imu_form(kind, kinds, size), len(ends), graph)
        else:
            append_factor(kind, loss, i, j, numbers, graph)
    return -1, gt.GOOD, rest


@inline_kernel
def check_measured(kind: int, kinds: I64, p: int, size: int, payload: F64) -> int:
    """What is wrong with a new measurement of a kind; p: where its payload starts."""
    if kind == at.LINEAR:
        return check_linear(kinds, p, size, payload)
    if kind == at.OWN:
        return check_own_measurement(p, payload)
    if kind == at.IMU or kind == at.PREINTEGRATED:
        return check_imu(imu_form(kind, kinds, size), p, payload)
    return check_measurement(kind, p, payload)


@inline_kernel
def imu_form(kind: int, kinds: I64, size: int) -> ImuLayout:
    """How a measurement of that size lies, of an inertial kind with variables of these kinds."""
    is_mounted = kinds.size > inertial.MOMENTS and kinds[inertial.MOMENTS] == at.SE3
    if kind == at.PREINTEGRATED:
        return imu_layout(0, is_mounted, kinds.size)
    before = imu_layout(1, is_mounted, kinds.size).start
    return imu_layout((size - before) // inertial.SAMPLE, is_mounted, kinds.size)


@inline_kernel
def mark_imu(form: ImuLayout, ends: int, graph: Graph) -> None:
    """The newest factor is an inertial one of that form."""
    first = graph.counts[at.FACTORS] - rows_of_arity(ends)
    graph.fac[first, at.F_FLAGS] |= form.samples << at.SAMPLES_SHIFT | (at.MOUNTED if form.mount >= 0 else 0)


@inline_kernel
def append_variable(kind: int, fixed: bool, key: int, slot: int, graph: Graph) -> None:
    """One more variable, whose value is behind those in use already, if it has one; `slot` is where its key goes."""
    var, counts = graph.var, graph.counts
    v, dim = counts[at.VARIABLES], dim_of(kind)
    graph.table[slot] = v + 1
    graph.keys[v] = key
    var[v, at.V_KIND], var[v, at.V_AT] = kind, counts[at.VALUES]
    var[v, at.V_SCALAR], var[v, at.V_COLUMN], var[v, at.V_DIAGONAL] = -1, -1, -1
    if not fixed:
        var[v, at.V_SCALAR], var[v, at.V_COLUMN] = counts[at.SCALARS], counts[at.COLUMNS]
        graph.dims[counts[at.COLUMNS]] = dim
        counts[at.SCALARS] += dim
        counts[at.COLUMNS] += 1
    counts[at.VALUES] += size_of(kind)
    counts[at.VARIABLES] += 1


@inline_kernel
def find_ends(kind: int, a: int, b: int, graph: Graph) -> tuple:
    """(i, j, fault): the variables with these keys, for a factor of that kind; j is −1 where it has one end."""
    first, second = kinds_of_ends(kind)
    table, keys, var = graph.table, graph.keys, graph.var
    i = table[slot_of(a, table, keys)] - 1
    if i < 0:
        return i, -1, gt.UNKNOWN_FIRST
    if var[i, at.V_KIND] != first:
        return i, -1, gt.WRONG_KIND_FIRST
    if second < 0:
        return i, -1, gt.GOOD
    j = table[slot_of(b, table, keys)] - 1
    if j < 0:
        return i, j, gt.UNKNOWN_SECOND
    if i == j:
        return i, j, gt.SELF_LOOP
    has_become_a_point = kind == at.IDP_SEEN and var[j, at.V_KIND] == at.POINT3
    if var[j, at.V_KIND] != second and not has_become_a_point:
        return i, j, gt.WRONG_KIND_SECOND
    return i, j, gt.GOOD


@part
def find_many_ends(kinds: I64, raw: bytes, keys: int, graph: Graph, ends: I64) -> int:
    """Write to `ends` the variables whose keys begin at raw[keys], for a factor of variables of these `kinds`.

    Gives GOOD, or what is wrong: of which variable with LATER_END more for each before it.
    """
    for n in range(kinds.size):
        v = graph.table[slot_of(int_at(raw, keys + 8 * n), graph.table, graph.keys)] - 1
        if v < 0:
            return gt.UNKNOWN_FIRST + gt.LATER_END * n
        if graph.var[v, at.V_KIND] != kinds[n]:
            return gt.WRONG_KIND_FIRST + gt.LATER_END * n
        for m in range(n):
            if ends[m] == v:
                return gt.SELF_LOOP + gt.LATER_END * n
        ends[n] = v
    return gt.GOOD


@part
def append_factor_rows(kind: int, loss: int, dim: int, ends: I64, numbers: int, graph: Graph) -> None:
    """One more factor that `many` evaluates: a row, or one for each pair of its variables (`factor_rows`)."""
    fac, counts, count = graph.fac, graph.counts, rows_of_arity(ends.size)
    first = counts[at.FACTORS]
    for n in range(max(ends.size - 1, 1)):
        for m in range(n + 1, max(ends.size, 2)):
            f = row_of_pair(first, n, m, max(ends.size, 2))
            fac[f, at.F_KIND], fac[f, at.F_I], fac[f, at.F_AT] = at.MEMBER, ends[n], -1
            fac[f, at.F_J] = ends[m] if m < ends.size else -1
            fac[f, at.F_II], fac[f, at.F_JJ], fac[f, at.F_IJ] = -1, -1, -1
            fac[f, at.F_FLAGS] = (f - first) << at.OFFSET_SHIFT
    fac[first, at.F_KIND], fac[first, at.F_AT] = kind, counts[at.PAYLOAD]
    fac[first, at.F_FLAGS] = dim << at.DIM_SHIFT | ends.size << at.ENDS_SHIFT | loss << at.LOSS_SHIFT
    if kind == at.OWN and graph.payload[counts[at.PAYLOAD] + X_RIGID] != 0.0:
        fac[first, at.F_FLAGS] |= at.RIGID
    counts[at.PAYLOAD] += numbers
    counts[at.FACTORS] += count
    counts[at.MEMBERS] += count - 1


@inline_kernel
def append_factor(kind: int, loss: int, i: int, j: int, numbers: int, graph: Graph) -> None:
    """One more factor, whose numbers are behind those in use already; of a feature that is a point by now, of that."""
    fac, counts = graph.fac, graph.counts
    f = counts[at.FACTORS]
    if kind == at.IDP_SEEN and graph.var[j, at.V_KIND] == at.POINT3:
        kind = at.POINT_SEEN
    fac[f, at.F_KIND], fac[f, at.F_I], fac[f, at.F_J], fac[f, at.F_AT] = kind, i, j, counts[at.PAYLOAD]
    fac[f, at.F_II], fac[f, at.F_JJ], fac[f, at.F_IJ], fac[f, at.F_FLAGS] = -1, -1, -1, loss << at.LOSS_SHIFT
    counts[at.PAYLOAD] += numbers
    counts[at.FACTORS] += 1


@inline_kernel
def count_missing(groups: I64) -> int:
    """New variables that come without values."""
    g, missing = 0, 0
    while groups[g, gt.G_KIND] != gt.END:
        if groups[g, gt.G_FACTORS] == 0 and groups[g, gt.G_NUMBERS] == gt.NOWHERE:
            missing += groups[g, gt.G_COUNT]
        g += 1
    return missing


@part
def list_given(groups: I64, count: int) -> I64:
    """For each of `count` new variables whether it came with a value: 1 or 0."""
    given, g, v = np.zeros(count, np.int64), 0, 0
    while groups[g, gt.G_KIND] != gt.END:
        if groups[g, gt.G_FACTORS] == 0:
            if groups[g, gt.G_NUMBERS] != gt.NOWHERE:
                given[v : v + groups[g, gt.G_COUNT]] = 1
            v += groups[g, gt.G_COUNT]
        g += 1
    return given


@part
def copy_numbers(raw: bytes, start: int, count: int, out: F64, to: int) -> None:
    """The doubles in raw[start:] to out[to:]."""
    for c in range(count):
        out[to + c] = float_at(raw, start + 8 * c)


@inline_kernel
def float_at(raw: bytes, start: int) -> float:
    """The little-endian double in raw[start : start + 8]."""
    return np.int64(int_at(raw, start)).view(np.float64)


@part
def int_at(raw: bytes, start: int) -> int:
    """The little-endian int64 in raw[start : start + 8]."""
    bits = np.int64(0)
    for k in range(8):
        bits |= np.int64(raw[start + k]) << np.int64(8 * k)
    return bits  # type: ignore[return-value]
