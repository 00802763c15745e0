"""Within which bounds numbers have to stay, so that what follows from them can be computed.  MATH §2.5.

docs/decisions/0001-number-bounds.md says why these.
"""

from factorbus.proto import inertial
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expression_layout import X_WIDTH
from factorbus.solver.kernels.model.factor_rows import information_start, is_member, residual_size
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.sizes import size_of

# Of every number of a value or a measurement: metres, radians, pixels, 1/metre.
MOST_NUMBER = 1e12
# Of the entries of an information matrix, and the least on its diagonal: σ from 1e-12 to 1e12.
MOST_INFORMATION, LEAST_INFORMATION = 1e24, 1e-24
# Of the scale of a loss, in standard deviations; it is at most MOST_NUMBER.
LEAST_SCALE = 1e-12
# Beyond these, though admitted, a number may lead out of bounds in a step.
USUAL_NUMBER, LEAST_USUAL_INFORMATION, MOST_USUAL_INFORMATION = 1e8, 1e-10, 1e16
# Of H and b of a linear factor: rows of R, which have √Ω and a lever arm in them.
MOST_LINEAR = 1e24


@inline_kernel
def are_within(most: float, start: int, count: int, numbers: F64) -> bool:
    """Whether `count` numbers from `start` on are finite and at most `most` in magnitude."""
    within = True
    for c in range(count):
        within &= abs(numbers[start + c]) <= most
    return within


@inline_kernel
def find_outside(v0: int, v1: int, var: I64, values: F64) -> int:
    """The first of the variables v0 .. v1−1 whose value is not within its bounds, or −1."""
    for v in range(v0, v1):
        if not are_within(MOST_NUMBER, var[v, at.V_AT], size_of(var[v, at.V_KIND]), values):
            return v
    return -1


@kernel("int64(int64, int64, int64[:,::1], float64[::1])")
def find_first_outside(v0: int, v1: int, var: I64, values: F64) -> int:
    """`find_outside`, called from Python."""
    return find_outside(v0, v1, var, values)


@kernel("int64(int64[::1], int64[::1])")
def find_escaped(picked: I64, graph_table: I64) -> int:
    """The first of the variables `picked` whose value is not within its bounds, or −1; graph_table: of its arrays."""
    graph = graph_at(graph_table)
    var, values = graph.var, graph.values
    for k in range(picked.size):
        v = picked[k]
        if not are_within(MOST_NUMBER, var[v, at.V_AT], size_of(var[v, at.V_KIND]), values):
            return v
    return -1


@kernel("boolean(int64, int64, int64[::1])")
def are_usual(v0: int, f0: int, graph_table: I64) -> bool:
    """Whether the values of the variables from v0 on, and the numbers of the factors from f0 on, are of usual sizes."""
    graph = graph_at(graph_table)
    var, values, fac = graph.var, graph.values, graph.fac
    payload, counts = graph.payload, graph.counts
    for v in range(v0, counts[at.VARIABLES]):
        if not are_within(USUAL_NUMBER, var[v, at.V_AT], size_of(var[v, at.V_KIND]), values):
            return False
    for f in range(f0, counts[at.FACTORS]):
        if is_member(f, fac):
            continue
        p, dim = information_start(f, var, fac, payload), residual_size(f, fac)
        start, kept = fac[f, at.F_AT], inertial.KEPT if fac[f, at.F_KIND] == at.IMU else 0
        if fac[f, at.F_KIND] == at.OWN:
            start += X_WIDTH
        if not are_within(USUAL_NUMBER, start, p - kept - start, payload):
            return False
        for a in range(dim):
            if not (abs(payload[p]) >= LEAST_USUAL_INFORMATION and abs(payload[p]) <= MOST_USUAL_INFORMATION):
                return False
            p += dim - a
    return True
