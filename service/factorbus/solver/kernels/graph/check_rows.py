"""What is wrong with the numbers of a new variable or factor.  Angles, quaternions and directions become normal.

The numbers are those that stand behind the ones in use, in the arenas of the graph.
"""

import math

from factorbus.proto import inertial
from factorbus.solver.kernels.graph import group_table as gt
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import (
    LEAST_INFORMATION,
    LEAST_SCALE,
    MOST_INFORMATION,
    MOST_LINEAR,
    MOST_NUMBER,
    are_within,
)
from factorbus.solver.kernels.model.expression_layout import X_BEFORE, X_QUATERNION, X_WIDTH
from factorbus.solver.kernels.model.imu_expansion import write_expansion
from factorbus.solver.kernels.model.imu_layout import ImuLayout
from factorbus.solver.kernels.model.imu_noise import write_root
from factorbus.solver.kernels.model.imu_walk import walk_samples
from factorbus.solver.kernels.model.kinds import direction_at, positive_at, quaternion_at
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.sizes import information_at, quaternion_of, scale_of, size_of

# A quaternion may be off unit length by what six printed digits leave, and more; beyond that it is another thing.
_QUATERNION_TOLERANCE = 1e-3
# A pivot of Ω below this share of its diagonal entry is rounding: the matrix is singular.
_PIVOT_TOLERANCE = 1e-14


@inline_kernel
def check_value(kind: int, x: int, size: int, values: F64) -> int:
    """What is wrong with the new value that starts at x; it is brought into its normal form."""
    if not are_within(MOST_NUMBER, x, size, values):
        return gt.OUT_OF_BOUNDS
    if kind == at.SE2:
        values[x + 2] = wrap(values[x + 2])
    if kind == at.IDP:
        values[x + 3] = wrap(values[x + 3])
    return check_rotation(kind, x, values)


@inline_kernel
def check_rotation(kind: int, x: int, values: F64) -> int:
    """What is wrong with quaternion and scale, if it has these, of the value at x of a kind of variable."""
    turn, scale = quaternion_of(kind), scale_of(kind)
    if turn >= 0 and not normalize_quaternion(values, x + turn):
        return gt.BAD_QUATERNION
    return gt.OUT_OF_BOUNDS if scale >= 0 and not values[x + scale] >= LEAST_SCALE else gt.GOOD


@part
def check_linear(kinds: I64, p: int, size: int, payload: F64) -> int:
    """What is wrong with a new linear model of variables of these kinds, whose numbers start at p: y within the bounds
    of values, quaternions of unit length, H and b within those of what R may hold."""
    y = p
    for n in range(kinds.size):
        if not are_within(MOST_NUMBER, y, size_of(kinds[n]), payload):
            return gt.OUT_OF_BOUNDS
        fault = check_rotation(kinds[n], y, payload)
        if fault != gt.GOOD:
            return fault
        y += size_of(kinds[n])
    return gt.GOOD if are_within(MOST_LINEAR, y, p + size - y, payload) else gt.OUT_OF_BOUNDS


@part
def check_own_measurement(p: int, payload: F64) -> int:
    """What is wrong with a new measurement of an own kind, whose payload starts at p."""
    end, turn = int(payload[p + X_BEFORE]), int(payload[p + X_QUATERNION])
    if not are_within(MOST_NUMBER, p + X_WIDTH, end - X_WIDTH, payload):
        return gt.OUT_OF_BOUNDS
    if turn >= 0 and not normalize_quaternion(payload, p + X_WIDTH + turn):
        return gt.BAD_QUATERNION
    return gt.GOOD


@part
def check_imu(form: ImuLayout, p: int, payload: F64) -> int:
    """What is wrong with a new inertial measurement of that form, which starts at p; what is kept of samples is
    written behind them."""
    size = form.start + (inertial.SAMPLE * form.samples if form.samples > 0 else inertial.DELTA)
    if not are_within(MOST_NUMBER, p, size, payload):
        return gt.OUT_OF_BOUNDS
    if form.mount < 0 and not normalize_quaternion(payload, p + form.mount_at + 3):
        return gt.BAD_QUATERNION
    if form.samples == 0:
        if not payload[p + form.start] > 0.0:
            return gt.BAD_DURATION
        return gt.GOOD if normalize_quaternion(payload, p + form.start + 1) else gt.BAD_QUATERNION
    for n in range(inertial.INTEGRATION):
        if not payload[p + n] > 0.0:
            return gt.BAD_NOISE
    if not payload[p + inertial.INTEGRATION] >= 0.0:
        return gt.BAD_NOISE
    for k in range(p + form.start, p + size, inertial.SAMPLE):
        if not payload[k] > 0.0:
            return gt.BAD_DURATION
    walk = walk_samples(form, payload[p:])
    if not write_root(payload[p:], walk, size, payload[p:]):
        return gt.BAD_NOISE
    write_expansion(form, payload[p:], walk)
    return gt.GOOD if are_within(MOST_LINEAR, p + size, inertial.ROOT, payload) else gt.BAD_NOISE


@part
def check_information(dim: int, p: int, payload: F64, scratch: F64) -> int:
    """What is wrong with the information of a new factor, whose upper triangle starts at p; scratch (dim, dim)."""
    if not are_within(MOST_INFORMATION, p, dim * (dim + 1) // 2, payload):
        return gt.OUT_OF_BOUNDS
    if not is_positive_definite(dim, payload, p, scratch):
        return gt.NOT_POSITIVE_DEFINITE
    for a in range(dim):
        if payload[p] < LEAST_INFORMATION:
            return gt.OUT_OF_BOUNDS
        p += dim - a
    return gt.GOOD


@part
def check_measurement(kind: int, p: int, payload: F64) -> int:
    """What is wrong with a new measurement that starts at p; directions and quaternions become unit."""
    if not are_within(MOST_NUMBER, p, information_at(kind), payload):
        return gt.OUT_OF_BOUNDS
    n = positive_at(kind)
    if n >= 0 and not payload[p + n] > 0.0:
        return gt.BAD_RANGE
    if (kind == at.PRIOR_SIM3 or kind == at.BETWEEN_SIM3) and not payload[p + n] >= LEAST_SCALE:
        return gt.BAD_RANGE
    for e in range(2):
        n = direction_at(kind, e)
        if n >= 0 and not normalize_direction(payload, p + n):
            return gt.BAD_DIRECTION
        n = quaternion_at(kind, e)
        if n >= 0 and not normalize_quaternion(payload, p + n):
            return gt.BAD_QUATERNION
    return gt.GOOD


@inline_kernel
def normalize_direction(v: F64, k: int) -> bool:
    """Bring the vector at k, of any length but zero, to unit length; False: it has none."""
    n2 = v[k] * v[k] + v[k + 1] * v[k + 1] + v[k + 2] * v[k + 2]
    if not n2 > 1e-100:
        return False
    normalize(v, k, 3, n2)
    return True


@inline_kernel
def normalize_quaternion(q: F64, k: int) -> bool:
    """Bring the quaternion at k, whose length may be off by rounding only, to unit length; False: it is none."""
    n2 = q[k] * q[k] + q[k + 1] * q[k + 1] + q[k + 2] * q[k + 2] + q[k + 3] * q[k + 3]
    if not abs(n2 - 1.0) <= 2.0 * _QUATERNION_TOLERANCE:
        return False
    normalize(q, k, 4, n2)
    return True


@inline_kernel
def normalize(v: F64, k: int, size: int, n2: float) -> None:
    """Divide v[k : k + size] by its length √n2, unless that is 1 to the last bit."""
    if abs(n2 - 1.0) > 4e-16:
        scale = 1.0 / math.sqrt(n2)
        for c in range(size):
            v[k + c] *= scale


@inline_kernel
def is_positive_definite(n: int, upper: F64, start: int, L: F64) -> bool:
    """Whether the n × n symmetric matrix with this upper triangle (row by row from `start`) is positive definite: its
    Cholesky factor, made in the (n, n) scratch `L`, has pivots above rounding."""
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
