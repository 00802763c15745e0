"""Admission of columns that lie in the bytes of a message: one call for all of a small batch.

It takes what is in order and fits into the room there is.  Anything else it leaves as it was: the caller makes room, or
the usual way of admission says what is wrong.
"""

import numpy as np

from factorbus.solver.kernels.graph.admit import (
    append_factor,
    append_variable,
    check_numbers,
    check_value,
    find_ends,
    remove_keys,
    slot_of,
)
from factorbus.solver.kernels.graph.initialize import reach
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import find_outside
from factorbus.solver.kernels.model.records import graph_at


@kernel("int64(Bytes(uint8, 1, 'C', readonly=True), int64[:,::1], int64[::1])")
def admit_bytes(raw: bytes, groups: I64, graph_table: I64) -> int:
    """Append the groups of variables and factors in `raw`, and give values to the variables that come without.

    graph_table: of its arrays (`records`).  Gives the number of the first factor; or NO_ROOM or NOT_IN_ORDER, and
    nothing changed.
    """
    graph = graph_at(graph_table)
    table, keys, var = graph.table, graph.keys, graph.var
    values, dims, fac = graph.values, graph.dims, graph.fac
    payload, counts, stamps = graph.payload, graph.counts, graph.stamps
    if not has_room(groups, table, keys, values, fac, payload, counts):
        return at.NO_ROOM
    before = counts.copy()
    v0, f0 = before[at.VARIABLES], before[at.FACTORS]
    if take_groups(raw, groups, table, keys, var, values, dims, stamps, fac, payload, counts):
        if count_missing(groups) == 0:
            return f0
        reached = list_given(groups, counts[at.VARIABLES] - v0)
        missing = reach(True, v0, f0, counts[at.FACTORS], var, fac, values, payload, reached)
        if missing < 0 and find_outside(v0, counts[at.VARIABLES], var, values) < 0:
            return f0
    remove_keys(v0, counts[at.VARIABLES], table, keys)
    for k in range(counts.size):
        counts[k] = before[k]
    return at.NOT_IN_ORDER


@inline_kernel
def has_room(groups: I64, table: I64, keys: I64, values: F64, fac: I64, payload: F64, counts: I64) -> bool:
    """Whether all groups fit behind what there is."""
    variables, factors = counts[at.VARIABLES], counts[at.FACTORS]
    numbers, measured, g = counts[at.VALUES], counts[at.PAYLOAD], 0
    while groups[g, at.G_KIND] != at.END:
        count = groups[g, at.G_COUNT]
        if groups[g, at.G_FACTORS] == 0:
            variables, numbers = variables + count, numbers + count * groups[g, at.G_SIZE]
        else:
            factors += count
            measured += count * (groups[g, at.G_SIZE] + groups[g, at.G_TRIANGLE])
        g += 1
    return (
        variables <= keys.size
        and 2 * variables <= table.size
        and numbers <= values.size
        and factors <= fac.shape[0]
        and measured <= payload.size
    )


@inline_kernel
def take_groups(
    raw: bytes,
    groups: I64,
    table: I64,
    keys: I64,
    var: I64,
    values: F64,
    dims: I64,
    stamps: I64,
    fac: I64,
    payload: F64,
    counts: I64,
) -> bool:
    """Append group after group; False: one of them is not in order."""
    scratch = np.empty((6, 6))
    end = 0
    while groups[end, at.G_KIND] != at.END:
        end += 1
    for g in range(end):
        if groups[g, at.G_FACTORS] == 0:
            for n in range(groups[g, at.G_COUNT]):
                if not take_variable(raw, groups[g], n, table, keys, var, values, dims, stamps, counts):
                    return False
    for g in range(end):
        if groups[g, at.G_FACTORS] != 0:
            for n in range(groups[g, at.G_COUNT]):
                if not take_factor(raw, groups[g], n, table, keys, var, fac, payload, counts, scratch):
                    return False
    return True


@part
def take_variable(
    raw: bytes, group: I64, n: int, table: I64, keys: I64, var: I64, values: F64, dims: I64, stamps: I64, counts: I64
) -> bool:
    """Append the n-th variable of a group, if it is in order."""
    kind, size, x = group[at.G_KIND], group[at.G_SIZE], counts[at.VALUES]
    key = word(raw, group[at.G_KEYS] + 8 * n)
    slot = slot_of(key, table, keys)
    if table[slot] != 0:
        return False
    if group[at.G_NUMBERS] >= 0:
        copy_numbers(raw, group[at.G_NUMBERS] + 8 * n * size, size, values, x)
        if check_value(kind, x, size, values) != at.GOOD:
            return False
    stamp = word(raw, group[at.G_STAMPS] + 8 * n) if group[at.G_STAMPS] >= 0 else at.NO_STAMP
    stamps[counts[at.VARIABLES]] = stamp
    counts[at.STAMPED] += 1 if stamp != at.NO_STAMP else 0
    append_variable(kind, group[at.G_FIXED] != 0, key, slot, size, table, keys, var, dims, counts)
    return True


@part
def take_factor(
    raw: bytes, group: I64, n: int, table: I64, keys: I64, var: I64, fac: I64, payload: F64, counts: I64, scratch: F64
) -> bool:
    """Append the n-th factor of a group, if it is in order."""
    kind, size, triangle, arity = group[at.G_KIND], group[at.G_SIZE], group[at.G_TRIANGLE], group[at.G_ARITY]
    p, first = counts[at.PAYLOAD], group[at.G_KEYS] + 8 * n * arity
    i, j, wrong = find_ends(kind, word(raw, first), word(raw, first + 8 * (arity - 1)), table, keys, var)
    if wrong != at.GOOD:
        return False
    copy_numbers(raw, group[at.G_NUMBERS] + 8 * n * size, size, payload, p)
    copy_numbers(raw, group[at.G_INFORMATION] + 8 * n * triangle, triangle, payload, p + size)
    if check_numbers(kind, p, size, triangle, payload, scratch) != at.GOOD:
        return False
    append_factor(kind, at.NO_LOSS, i, j, size + triangle, var, fac, counts)
    return True


@inline_kernel
def count_missing(groups: I64) -> int:
    """New variables that came without values."""
    g, missing = 0, 0
    while groups[g, at.G_KIND] != at.END:
        if groups[g, at.G_FACTORS] == 0 and groups[g, at.G_NUMBERS] < 0:
            missing += groups[g, at.G_COUNT]
        g += 1
    return missing


@part
def list_given(groups: I64, count: int) -> I64:
    """For each new variable whether it came with a value: 1 or 0."""
    given, g, v = np.zeros(count, np.int64), 0, 0
    while groups[g, at.G_KIND] != at.END:
        if groups[g, at.G_FACTORS] == 0:
            if groups[g, at.G_NUMBERS] >= 0:
                given[v : v + groups[g, at.G_COUNT]] = 1
            v += groups[g, at.G_COUNT]
        g += 1
    return given


@part
def copy_numbers(raw: bytes, start: int, count: int, out: F64, to: int) -> None:
    """The doubles in raw[start:] to out[to:]."""
    for c in range(count):
        out[to + c] = np.int64(word(raw, start + 8 * c)).view(np.float64)


@part
def word(raw: bytes, start: int) -> int:
    """The little-endian int64 in raw[start : start + 8]."""
    bits = np.int64(0)
    for k in range(8):
        bits |= np.int64(raw[start + k]) << np.int64(8 * k)
    return bits  # type: ignore[return-value]
