"""Admission: rows of a batch are checked and written behind the rows in use; the caller moves the counts back when
one is bad.  One call per group of a batch, because a step has little time.

Keys are found through an open-addressing hash table: `table` holds variable index + 1, 0 where free.  Variables are
entered in the order of their indices and removed in the reverse order, so removing is clearing the slot.
"""

import math

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import (
    LEAST_INFORMATION,
    LEAST_SCALE,
    MOST_INFORMATION,
    MOST_LINEAR,
    MOST_NUMBER,
    are_within,
)
from factorbus.solver.kernels.model.kinds import direction_at, is_checked, is_linear, positive_at, quaternion_at
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.sizes import dim_of, kinds_of_ends, residual_dim, values_of_ends

# A quaternion may be off unit length by what six printed digits leave, and more; beyond that it is another thing.
_QUATERNION_TOLERANCE = 1e-3
# A pivot of Ω below this share of its diagonal entry is rounding: the matrix is singular.
_PIVOT_TOLERANCE = 1e-14


@inline_kernel
def slot_of(key: int, table: I64, keys: I64) -> int:
    """Where `key` is in the table, or the free slot where it would go."""
    k = int(key)
    h = k ^ (k >> 32)
    h = (h * 0x45D9F3B) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    h ^= h >> 16
    mask = table.size - 1
    slot = h & mask
    while table[slot] != 0 and keys[table[slot] - 1] != key:
        slot = (slot + 1) & mask
    return slot


@kernel("int64(int64, int64[::1], int64[::1])")
def find_variable(key: int, table: I64, keys: I64) -> int:
    """Index of the variable `key`, or −1."""
    return int(table[slot_of(key, table, keys)]) - 1


@kernel("void(int64, int64[::1], int64[::1])")
def enter_keys(count: int, table: I64, keys: I64) -> None:
    """Fill an empty table with the first `count` keys."""
    for v in range(count):
        table[slot_of(keys[v], table, keys)] = v + 1


@kernel("void(int64, int64, int64[::1], int64[::1])")
def remove_keys(first: int, last: int, table: I64, keys: I64) -> None:
    """Remove the variables first .. last−1, which are the last that were entered."""
    for v in range(last - 1, first - 1, -1):
        table[slot_of(keys[v], table, keys)] = 0


@kernel(
    "UniTuple(int64, 2)(int64, boolean, int64[::1], float64[:,::1], int64[::1], int64[::1], int64[:,::1], float64[::1],"
    " int64[::1], int64[::1])"
)
def admit_variables(
    kind: int, fixed: bool, new: I64, given: F64, table: I64, keys: I64, var: I64, values: F64, dims: I64, counts: I64
) -> tuple:
    """Append variables of one kind; `given` (n, size) has their values, or (0, size) none.  Gives (row, fault)."""
    size = given.shape[1]
    for n in range(new.size):
        slot = slot_of(new[n], table, keys)
        if table[slot] != 0:
            return n, at.DUPLICATE
        x = counts[at.VALUES]
        if given.shape[0] > 0:
            for c in range(size):
                values[x + c] = given[n, c]
            wrong = check_value(kind, x, size, values)
            if wrong != at.GOOD:
                return n, wrong
        append_variable(kind, fixed, new[n], slot, size, table, keys, var, dims, counts)
    return -1, at.GOOD


@kernel(
    "UniTuple(int64, 2)(int64, int64, int64[:,::1], float64[:,::1], float64[:,::1], float64[::1], int64[::1],"
    " int64[::1], int64[:,::1], int64[:,::1], float64[::1], int64[::1])"
)
def admit_factors(
    kind: int, loss: int, ends: I64, z: F64, info: F64, scale: F64, table: I64, keys: I64, var: I64, fac: I64,
    payload: F64, counts: I64,
) -> tuple:  # fmt: skip
    """Append factors of one kind: ends (m, arity) keys, z (m, size), info (m, triangle), and with a loss its scale
    (m,), else (0,).  Gives (row, fault)."""
    size, triangle = z.shape[1], info.shape[1]
    scratch = np.empty((6, 6))
    for m in range(ends.shape[0]):
        i, j, wrong = find_ends(kind, ends[m, 0], ends[m, ends.shape[1] - 1], table, keys, var)
        if wrong != at.GOOD:
            return m, wrong
        p = counts[at.PAYLOAD]
        for c in range(size):
            payload[p + c] = z[m, c]
        for c in range(triangle):
            payload[p + size + c] = info[m, c]
        wrong = check_numbers(kind, p, size, triangle, payload, scratch)
        if wrong != at.GOOD:
            return m, wrong
        numbers = size + triangle
        if loss != at.NO_LOSS:
            if not (scale[m] >= LEAST_SCALE and scale[m] <= MOST_NUMBER):
                return m, at.BAD_SCALE
            payload[p + numbers] = scale[m]
            numbers += 1
        append_factor(kind, loss, i, j, numbers, var, fac, counts)
    return -1, at.GOOD


@inline_kernel
def check_value(kind: int, x: int, size: int, values: F64) -> int:
    """What is wrong with the new value that starts at x; it is brought into its normal form."""
    if not are_within(MOST_NUMBER, x, size, values):
        return at.OUT_OF_BOUNDS
    if kind == at.SE2:
        values[x + 2] = wrap(values[x + 2])
    if kind == at.IDP:
        values[x + 3] = wrap(values[x + 3])
    if kind == at.SE3 and not make_unit(values, x + 3):
        return at.BAD_QUATERNION
    return at.GOOD


@inline_kernel
def append_variable(
    kind: int, fixed: bool, key: int, slot: int, size: int, table: I64, keys: I64, var: I64, dims: I64, counts: I64
) -> None:
    """One more variable, whose value is behind those in use already, if it has one; `slot` is where its key goes."""
    v = counts[at.VARIABLES]
    dim = dim_of(kind)
    table[slot] = v + 1
    keys[v] = key
    var[v, at.V_KIND], var[v, at.V_AT] = kind, counts[at.VALUES]
    var[v, at.V_SCALAR], var[v, at.V_COLUMN], var[v, at.V_DIAGONAL] = -1, -1, -1
    if not fixed:
        var[v, at.V_SCALAR], var[v, at.V_COLUMN] = counts[at.SCALARS], counts[at.COLUMNS]
        dims[counts[at.COLUMNS]] = dim
        counts[at.SCALARS] += dim
        counts[at.COLUMNS] += 1
    counts[at.VALUES] += size
    counts[at.VARIABLES] += 1


@inline_kernel
def find_ends(kind: int, a: int, b: int, table: I64, keys: I64, var: I64) -> tuple:
    """(i, j, fault): the variables with these keys, for a factor of that kind; j is −1 where it has one end."""
    first, second = kinds_of_ends(kind)
    i = table[slot_of(a, table, keys)] - 1
    if i < 0:
        return i, -1, at.UNKNOWN_FIRST
    if var[i, at.V_KIND] != first:
        return i, -1, at.WRONG_KIND_FIRST
    if second < 0:
        return i, -1, at.GOOD
    j = table[slot_of(b, table, keys)] - 1
    if j < 0:
        return i, j, at.UNKNOWN_SECOND
    if i == j:
        return i, j, at.SELF_LOOP
    has_become_a_point = kind == at.IDP_SEEN and var[j, at.V_KIND] == at.POINT3
    if var[j, at.V_KIND] != second and not has_become_a_point:
        return i, j, at.WRONG_KIND_SECOND
    return i, j, at.GOOD


@inline_kernel
def check_numbers(kind: int, p: int, size: int, triangle: int, payload: F64, scratch: F64) -> int:
    """What is wrong with the new measurement that starts at p, or with its information."""
    if not (are_within_kind(kind, p, size, payload) and are_within(MOST_INFORMATION, p + size, triangle, payload)):
        return at.OUT_OF_BOUNDS
    if is_checked(kind):
        wrong = check_measurement(kind, p, payload)
        if wrong != at.GOOD:
            return wrong
    dim = residual_dim(kind)
    if not is_positive_definite(dim, payload, p + size, scratch):
        return at.NOT_POSITIVE_DEFINITE
    c = p + size
    for a in range(dim):
        if payload[c] < LEAST_INFORMATION:
            return at.OUT_OF_BOUNDS
        c += dim - a
    return at.GOOD


@inline_kernel
def are_within_kind(kind: int, p: int, size: int, payload: F64) -> bool:
    """Whether the measurement that starts at p is within bounds; H and b of a linear factor are what R may hold."""
    if not is_linear(kind):
        return are_within(MOST_NUMBER, p, size, payload)
    y = values_of_ends(kind)
    return are_within(MOST_NUMBER, p, y, payload) and are_within(MOST_LINEAR, p + y, size - y, payload)


@part
def check_measurement(kind: int, p: int, payload: F64) -> int:
    """What is wrong with a measurement whose numbers are within bounds; directions and quaternions become unit."""
    n = positive_at(kind)
    if n >= 0 and not payload[p + n] > 0.0:
        return at.BAD_RANGE
    for e in range(2):
        n = direction_at(kind, e)
        if n >= 0 and not make_direction(payload, p + n):
            return at.BAD_DIRECTION
        n = quaternion_at(kind, e)
        if n >= 0 and not make_unit(payload, p + n):
            return at.BAD_QUATERNION
    return at.GOOD


@inline_kernel
def make_direction(v: F64, k: int) -> bool:
    """Bring the vector at k to unit length, unless it is there to the last bit; False: it has none."""
    n2 = v[k] * v[k] + v[k + 1] * v[k + 1] + v[k + 2] * v[k + 2]
    if not n2 > 1e-100:
        return False
    if abs(n2 - 1.0) > 4e-16:
        scale = 1.0 / math.sqrt(n2)
        for c in range(3):
            v[k + c] *= scale
    return True


@inline_kernel
def append_factor(kind: int, loss: int, i: int, j: int, numbers: int, var: I64, fac: I64, counts: I64) -> None:
    """One more factor, whose numbers are behind those in use already; of a feature that is a point by now, of that."""
    f = counts[at.FACTORS]
    if kind == at.IDP_SEEN and var[j, at.V_KIND] == at.POINT3:
        kind = at.POINT_SEEN
    fac[f, at.F_KIND], fac[f, at.F_I], fac[f, at.F_J], fac[f, at.F_AT] = kind, i, j, counts[at.PAYLOAD]
    fac[f, at.F_II], fac[f, at.F_JJ], fac[f, at.F_IJ], fac[f, at.F_FLAGS] = -1, -1, -1, loss << at.LOSS_SHIFT
    counts[at.PAYLOAD] += numbers
    counts[at.FACTORS] += 1


@inline_kernel
def make_unit(q: F64, k: int) -> bool:
    """Bring the quaternion at k to unit length, unless it is there to the last bit; False: it is none."""
    n2 = q[k] * q[k] + q[k + 1] * q[k + 1] + q[k + 2] * q[k + 2] + q[k + 3] * q[k + 3]
    if not abs(n2 - 1.0) <= 2.0 * _QUATERNION_TOLERANCE:
        return False
    if abs(n2 - 1.0) > 4e-16:
        scale = 1.0 / math.sqrt(n2)
        for c in range(4):
            q[k + c] *= scale
    return True


@inline_kernel
def is_positive_definite(n: int, upper: F64, start: int, L: F64) -> bool:
    """Whether the n × n symmetric matrix with this upper triangle (row by row from `start`) is positive definite: its
    Cholesky factor, made in the (6, 6) scratch `L`, has pivots above rounding."""
    k = start
    for a in range(n):
        for b in range(a, n):
            L[b, a] = upper[k]
            k += 1
    for a in range(n):
        diagonal = L[a, a]
        for c in range(a):
            L[a, a] -= L[a, c] * L[a, c]
        if not (diagonal > 0.0 and L[a, a] > _PIVOT_TOLERANCE * diagonal):
            return False
        L[a, a] = math.sqrt(L[a, a])
        for b in range(a + 1, n):
            for c in range(a):
                L[b, a] -= L[b, c] * L[a, c]
            L[b, a] /= L[a, a]
    return True
