"""Operations of expressions on vectors: values, and tangents.  Arguments as in `expression_groups`.  MATH §3.11.

None of them fails: a root of what is negative is 0 and has no slope, as the length of a vector of zeros has none.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, I64, part
from factorbus.solver.kernels.model import expression_layout as at
from factorbus.solver.kernels.model.se2 import wrap


@part
def norm(s: I64, v: F64, T: F64) -> None:
    """‖a‖:  δ = aᵀ δa / ‖a‖."""
    a, n = s[at.A], s[at.N]
    square = 0.0
    for k in range(n):
        square += v[a + k] * v[a + k]
    length = math.sqrt(square)
    v[s[at.OUT]] = length
    for c in range(s[at.FIRST], s[at.LAST]):
        total = 0.0
        for k in range(n):
            total += v[a + k] * T[c, s[at.A_ROW] + k]
        T[c, s[at.ROW]] = total / length if length > 0.0 else 0.0


@part
def dot(s: I64, v: F64, T: F64) -> None:
    """aᵀ b."""
    a, b, ra, rb, n = s[at.A], s[at.B], s[at.A_ROW], s[at.B_ROW], s[at.N]
    total = 0.0
    for k in range(n):
        total += v[a + k] * v[b + k]
    v[s[at.OUT]] = total
    for c in range(s[at.FIRST], s[at.LAST]):
        total = 0.0
        for k in range(n):
            total += v[b + k] * T[c, ra + k] + v[a + k] * T[c, rb + k]
        T[c, s[at.ROW]] = total


@part
def cross3(s: I64, v: F64, T: F64) -> None:
    """a × b:  δ = δa × b + a × δb."""
    a, b, ra, rb, out, row = s[at.A], s[at.B], s[at.A_ROW], s[at.B_ROW], s[at.OUT], s[at.ROW]
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        v[out + k] = v[a + m] * v[b + n] - v[a + n] * v[b + m]
        for c in range(s[at.FIRST], s[at.LAST]):
            of_a = T[c, ra + m] * v[b + n] - T[c, ra + n] * v[b + m]
            T[c, row + k] = of_a + v[a + m] * T[c, rb + n] - v[a + n] * T[c, rb + m]


@part
def cross2(s: I64, v: F64, T: F64) -> None:
    """a × b of the plane, one number."""
    a, b, ra, rb = s[at.A], s[at.B], s[at.A_ROW], s[at.B_ROW]
    v[s[at.OUT]] = v[a] * v[b + 1] - v[a + 1] * v[b]
    for c in range(s[at.FIRST], s[at.LAST]):
        of_a = T[c, ra] * v[b + 1] - T[c, ra + 1] * v[b]
        T[c, s[at.ROW]] = of_a + v[a] * T[c, rb + 1] - v[a + 1] * T[c, rb]


@part
def atan2(s: I64, v: F64, T: F64) -> None:
    """The angle of (b, a):  δ = (b δa − a δb) / (a² + b²)."""
    y, x = v[s[at.A]], v[s[at.B]]
    square = x * x + y * y
    v[s[at.OUT]] = math.atan2(y, x)
    along, across = (x / square, y / square) if square > 0.0 else (0.0, 0.0)
    for c in range(s[at.FIRST], s[at.LAST]):
        T[c, s[at.ROW]] = along * T[c, s[at.A_ROW]] - across * T[c, s[at.B_ROW]]


@part
def of_one(operation: int, s: I64, v: F64, T: F64) -> None:
    """A function of one number."""
    a = v[s[at.A]]
    if operation == _SQRT:
        value = math.sqrt(max(a, 0.0))
        slope = 0.5 / value if value > 0.0 else 0.0
    elif operation == _SIN:
        value, slope = math.sin(a), math.cos(a)
    elif operation == _COS:
        value, slope = math.cos(a), -math.sin(a)
    else:
        value, slope = wrap(a), 1.0
    v[s[at.OUT]] = value
    for c in range(s[at.FIRST], s[at.LAST]):
        T[c, s[at.ROW]] = slope * T[c, s[at.A_ROW]]


@part
def copy(factor: float, s: I64, v: F64, T: F64) -> None:
    """`factor` times a."""
    a, ra, out, row = s[at.A], s[at.A_ROW], s[at.OUT], s[at.ROW]
    for k in range(s[at.N]):
        v[out + k] = factor * v[a + k]
    for c in range(s[at.FIRST], s[at.LAST]):
        for k in range(s[at.N]):
            T[c, row + k] = factor * T[c, ra + k]


@part
def add(factor: float, s: I64, v: F64, T: F64) -> None:
    """a + `factor` b."""
    a, b, ra, rb, out, row = s[at.A], s[at.B], s[at.A_ROW], s[at.B_ROW], s[at.OUT], s[at.ROW]
    for k in range(s[at.N]):
        v[out + k] = v[a + k] + factor * v[b + k]
    for c in range(s[at.FIRST], s[at.LAST]):
        for k in range(s[at.N]):
            T[c, row + k] = T[c, ra + k] + factor * T[c, rb + k]


@part
def multiply_by(each: int, s: I64, v: F64, T: F64) -> None:
    """a times b, number by number; times the one number of b where `each` is 0."""
    a, b, ra, rb, out, row = s[at.A], s[at.B], s[at.A_ROW], s[at.B_ROW], s[at.OUT], s[at.ROW]
    for k in range(s[at.N]):
        v[out + k] = v[a + k] * v[b + each * k]
    for c in range(s[at.FIRST], s[at.LAST]):
        for k in range(s[at.N]):
            T[c, row + k] = v[b + each * k] * T[c, ra + k] + v[a + k] * T[c, rb + each * k]


@part
def divide(s: I64, v: F64, T: F64) -> None:
    """a / b, a number:  δ = (δa − (a / b) δb) / b."""
    ra, rb, out, row, b = s[at.A_ROW], s[at.B_ROW], s[at.OUT], s[at.ROW], v[s[at.B]]
    if b == 0.0:
        v[out : out + s[at.N]] = math.inf
        return
    by = 1.0 / b
    for k in range(s[at.N]):
        v[out + k] = v[s[at.A] + k] * by
    for c in range(s[at.FIRST], s[at.LAST]):
        for k in range(s[at.N]):
            T[c, row + k] = by * (T[c, ra + k] - v[out + k] * T[c, rb])


_SQRT, _SIN, _COS = (at.CODES[name] for name in ("sqrt", "sin", "cos"))
