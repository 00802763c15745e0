"""Operations of vectors and numbers: the numbers of the result, and its slopes.  MATH §3.11.

None of them fails: a root of what is negative, and what is divided by 0, is no number, NaN.  The root of 0 and the
length of a vector of zeros have no slope.
"""

from collections.abc import Sequence
from functools import reduce

from factorbus.solver.formulas.groups import Dual, cross_product
from factorbus.solver.formulas.terms import (
    NO_SLOPE,
    Operand,
    angle_of,
    cosine,
    over,
    pick,
    plus,
    reciprocal,
    root,
    sine,
)


def _inner(a: Sequence[Operand], b: Sequence[Operand]) -> Operand:
    return reduce(plus, (x * y for x, y in zip(a, b, strict=True)))


def norm(a: Dual) -> Dual:
    """‖a‖:  δ = aᵀ δa / ‖a‖."""
    length = root(_inner(a.v, a.v))
    return Dual([length], [pick(length, "==", 0.0, NO_SLOPE, over(_inner(a.v, a.d), length))])


def dot(a: Dual, b: Dual) -> Dual:
    """aᵀ b."""
    return Dual([_inner(a.v, b.v)], [_inner(b.v, a.d) + _inner(a.v, b.d)])


def cross_dual(a: Dual, b: Dual) -> Dual:
    """a × b; in the plane one number."""
    if len(a.v) == 2:
        slope = a.d[0] * b.v[1] - a.d[1] * b.v[0] + a.v[0] * b.d[1] - a.v[1] * b.d[0]
        return Dual([a.v[0] * b.v[1] - a.v[1] * b.v[0]], [slope])
    return Dual(cross_product(a.v, b.v), list(map(plus, cross_product(a.d, b.v), cross_product(a.v, b.d))))


def atan2(a: Dual, b: Dual) -> Dual:
    """The angle of (b, a):  δ = (b δa − a δb) / (a² + b²)."""
    y, x = a.v[0], b.v[0]
    square = x * x + y * y
    along, across = (pick(square, "==", 0.0, 0.0, over(part, square)) for part in (x, y))
    return Dual([angle_of(y, x)], [along * a.d[0] - across * b.d[0]])


def sqrt(a: Dual) -> Dual:
    """√a."""
    value = root(a.v[0])
    return Dual([value], [pick(value, "==", 0.0, 0.0, over(0.5, value)) * a.d[0]])


def sin(a: Dual) -> Dual:
    """sin a."""
    return Dual([sine(a.v[0])], [cosine(a.v[0]) * a.d[0]])


def cos(a: Dual) -> Dual:
    """cos a."""
    return Dual([cosine(a.v[0])], [-sine(a.v[0]) * a.d[0]])


def select(a: Dual, b: Dual, c: Dual) -> Dual:
    """b where a ≥ 0, else c."""
    return Dual(*([pick(a.v[0], ">=", 0.0, x, y) for x, y in zip(*of, strict=True)] for of in zip(b, c, strict=True)))


def multiply_dual(a: Dual, b: Dual) -> Dual:
    """a b, number by number, or by the one number of one of them."""
    if len(a.v) < len(b.v):
        a, b = b, a
    v, d = ([part[0]] * len(a.v) if len(part) == 1 else part for part in b)
    slopes = [y * e + x * f for x, e, y, f in zip(a.v, a.d, v, d, strict=True)]
    return Dual([x * y for x, y in zip(a.v, v, strict=True)], slopes)


def divide(a: Dual, b: Dual) -> Dual:
    """a / b, a number:  δ = (δa − (a / b) δb) / b."""
    by = reciprocal(b.v[0])
    value = [x * by for x in a.v]
    return Dual(value, [by * (d - x * b.d[0]) for x, d in zip(value, a.d, strict=True)])
