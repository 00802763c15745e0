"""Formulas in exact arithmetic, for proofs: two that come to the same number here are the same formula.

Numbers are residues of a prime of 128 bits in place of real ones, taken at random.  A rotation is a unit quaternion, or
in the plane a unit (cos, sin), of such numbers.  √, and what is left of log, exp and of an angle as a number, are
functions that nothing is known of but that the same arguments give the same: a hash of these.  `select` is a mean of
both its sides, so both count.  What two formulas have in common by the rules of arithmetic, of composing motions and of
angles is the same number for them, and what is no such rule makes two numbers that agree once in 2¹⁰⁰ times.

The prime is one of the formula's own, so that nobody finds constants that are 0 modulo it and not elsewhere.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

from factorbus.proto.expressions.declaration import CONSTANT, Declaration
from factorbus.proto.expressions.formula import write_formula
from factorbus.proto.expressions.operations import SE2, SO3, Type

_BITS = 128
_SMALL_FACTORS = (3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37)
_MOST_TIMES = 8  # an angle is taken this often


class NotProven(ArithmeticError):
    """A formula divides by what is always 0, or has an operation that is not known here."""


class Exact(NamedTuple):
    """A number; of an angle (cos, sin), which is all that is known of it modulo 2π."""

    number: int
    unit: tuple[int, int] | None = None


class Plane(NamedTuple):
    """A pose in the plane."""

    position: tuple[int, ...]
    unit: tuple[int, int]


class Space(NamedTuple):
    """A pose in space."""

    position: tuple[int, ...]
    quaternion: tuple[int, ...]


class ExactArithmetic:
    """Carries a formula out.

    A value of type n is a list of n `Exact`, an se2 a `Plane`, an se3 a `Space`, an so3 a quaternion x y z w.
    """

    def __init__(self, declared: Declaration) -> None:
        self.declared, self._seed = declared, write_formula(declared).encode()
        self.prime = _prime_from(int.from_bytes(hashlib.sha256(self._seed).digest()[: _BITS // 8], "big"))

    def carry_out(self, values: Sequence[Any]) -> tuple[list[int], list[int]]:
        """The residual at the values of the variables and z; and what roots were taken of, and what was divided by.

        Raises NotProven.
        """
        known, edges = [*values], list[int]()
        for node in self.declared.nodes:
            if node.operation == CONSTANT:
                known.append([Exact(self._constant(number)) for number in node.numbers])
                continue
            of = [known[k] for k in node.of]
            if node.operation == "sqrt":
                edges.append(of[0][0].number)
            if node.operation == "divide":
                edges.append(of[1][0].number)
            do = _DO.get(node.operation)
            if do is None:
                raise NotProven(node.operation)
            known.append(do(self, [int(k) for k in node.numbers], *of))
        return [each.number for each in known[-1]], edges

    def random_value(self, kind: Type, *names: object) -> Any:
        """The value that has these names."""
        draws = [self.some("value", *names, n) for n in range(kind if isinstance(kind, int) else 7)]
        if isinstance(kind, int):
            return [Exact(draw) for draw in draws]
        if kind == SE2:
            return Plane(tuple(draws[:2]), self.circle(draws[2]))
        quaternion = self.unit_quaternion(draws[3:])
        return quaternion if kind == SO3 else Space(tuple(draws[:3]), quaternion)

    def some(self, *of: object) -> int:
        """The number that a function which nothing is known of gives for these arguments."""
        return int.from_bytes(hashlib.sha256(repr((self._seed, of)).encode()).digest(), "big") % self.prime

    def over(self, a: int, b: int) -> int:
        """a / b.  Raises NotProven: b is 0."""
        if b % self.prime == 0:
            raise NotProven("divided by nothing")
        return a * pow(b, -1, self.prime) % self.prime

    def circle(self, t: int) -> tuple[int, int]:
        """A point of the unit circle."""
        by = self.over(1, 1 + t * t)
        return (1 - t * t) * by % self.prime, 2 * t * by % self.prime

    def unit_quaternion(self, q: Sequence[int]) -> tuple[int, ...]:
        """q ⊗ q / ‖q‖²."""
        by = self.over(1, sum(x * x for x in q))
        return tuple(x * by % self.prime for x in _product(q, q))

    def angle(self, unit: tuple[int, int]) -> Exact:
        """The angle in [−π, π) of this (cos, sin)."""
        unit = unit[0] % self.prime, unit[1] % self.prime
        return Exact(self.some("angle", unit), unit)

    def unit_of(self, a: Exact) -> tuple[int, int]:
        """(cos, sin) of a number."""
        return a.unit or self.circle(self.some("circle", a.number))

    def root(self, a: int) -> int:
        """√a."""
        return self.some("root", a % self.prime)

    def even(self, name: str, *of: int) -> int:
        """What nothing is known of but its arguments."""
        return self.some(name, *(x % self.prime for x in of))

    def plain(self, numbers: Sequence[int]) -> list[Exact]:
        """A vector of these."""
        return [Exact(number % self.prime) for number in numbers]

    def _constant(self, number: float) -> int:
        exact = Fraction(number)
        return self.over(exact.numerator, exact.denominator)


def _prime_from(start: int) -> int:
    """The first prime from there on of which −1 is no square, so that 1 + t² is never 0."""
    candidate = (start | (1 << (_BITS - 1))) | 3
    while not _is_prime(candidate):
        candidate += 4
    return candidate


def _is_prime(n: int) -> bool:
    """By Miller and Rabin: a random number of this size that passes is none once in 2¹⁰⁰ times."""
    if any(n % factor == 0 for factor in _SMALL_FACTORS):
        return False
    half = n >> 1  # n = 3 modulo 4: n − 1 is twice an odd number
    return all(pow(base, half, n) in (1, n - 1) for base in (2, *_SMALL_FACTORS))


def _product(a: Sequence[int], b: Sequence[int]) -> tuple[int, ...]:
    x, y, z = _cross(a[:3], b[:3])
    return (
        a[3] * b[0] + b[3] * a[0] + x,
        a[3] * b[1] + b[3] * a[1] + y,
        a[3] * b[2] + b[3] * a[2] + z,
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


def _cross(a: Sequence[int], b: Sequence[int]) -> tuple[int, int, int]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _both(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    """(cos, sin) of the sum of two angles."""
    return a[0] * b[0] - a[1] * b[1], a[1] * b[0] + a[0] * b[1]


def _back(a: tuple[int, int]) -> tuple[int, int]:
    return a[0], -a[1]


def turn_exact(of: ExactArithmetic, turn: Any, v: Sequence[int]) -> tuple[int, ...]:
    """R v of a rotation or pose."""
    if isinstance(turn, Plane):
        return tuple(x % of.prime for x in _both(turn.unit, (v[0], v[1])))
    q = turn.quaternion if isinstance(turn, Space) else turn
    t = [2 * x for x in _cross(q[:3], v)]
    return tuple((x + q[3] * y + z) % of.prime for x, y, z in zip(v, t, _cross(q[:3], t), strict=True))


def move_exact(of: ExactArithmetic, pose: Any, v: Sequence[int]) -> tuple[int, ...]:
    """R v + t of a pose."""
    return tuple((x + y) % of.prime for x, y in zip(turn_exact(of, pose, v), pose.position, strict=True))


def compose_exact(of: ExactArithmetic, a: Any, b: Any) -> Any:
    """a ∘ b of rotations or poses."""
    if isinstance(a, Plane):
        unit = _both(a.unit, b.unit)
        return Plane(move_exact(of, a, b.position), (unit[0] % of.prime, unit[1] % of.prime))
    if isinstance(a, Space):
        return Space(move_exact(of, a, b.position), _reduced(of, _product(a.quaternion, b.quaternion)))
    return _reduced(of, _product(a, b))


def _reduced(of: ExactArithmetic, numbers: Sequence[int]) -> tuple[int, ...]:
    return tuple(number % of.prime for number in numbers)


def _inverse(of: ExactArithmetic, a: Any) -> Any:
    if isinstance(a, Plane):
        back = Plane((0, 0), _back(a.unit))
        return Plane(tuple(-x for x in turn_exact(of, back, a.position)), back.unit)
    q = a.quaternion if isinstance(a, Space) else a
    back = (-q[0], -q[1], -q[2], q[3])
    return Space(tuple(-x for x in turn_exact(of, back, a.position)), back) if isinstance(a, Space) else back


def _along(of: ExactArithmetic, name: str, q: Sequence[int]) -> list[Exact]:
    """(x, y, z) of the quaternion ±q by a function of its w²: it turns as they do, and is the same for both signs."""
    by = q[3] * of.even(name, q[3] * q[3])
    return of.plain([by * x for x in q[:3]])


def _log(of: ExactArithmetic, a: Any) -> list[Exact]:
    if isinstance(a, Plane):
        return [*of.plain(a.position), of.angle(a.unit)]
    if isinstance(a, Space):
        return [*of.plain(a.position), *_along(of, "log", a.quaternion)]
    return _along(of, "log", a)


def _exp(of: ExactArithmetic, a: Sequence[Exact]) -> tuple[int, ...]:
    """A quaternion along a."""
    v = [x.number for x in a]
    square = sum(x * x for x in v)
    t = of.even("exp", square)
    by = of.over(1, 1 + t * t * square)
    return _reduced(of, [*(2 * t * x * by for x in v), (1 - t * t * square) * by])


def _pose(of: ExactArithmetic, a: Sequence[Exact], b: Any) -> Any:
    position = tuple(x.number for x in a)
    return Plane(position, of.unit_of(b[0])) if len(a) == 2 else Space(position, b)


def _atan2(of: ExactArithmetic, a: Sequence[Exact], b: Sequence[Exact]) -> list[Exact]:
    y, x = a[0].number, b[0].number
    by = of.over(1, of.root(x * x + y * y))
    return [of.angle((x * by, y * by))]


def _sum(of: ExactArithmetic, a: Exact, b: Exact, sign: int) -> Exact:
    unit = None
    if a.unit or b.unit:
        other = of.unit_of(b)
        unit = _both(of.unit_of(a), other if sign > 0 else _back(other))
        unit = unit[0] % of.prime, unit[1] % of.prime
    return Exact((a.number + sign * b.number) % of.prime, unit)


def _times(of: ExactArithmetic, a: Exact, b: Exact) -> Exact:
    """An angle times an integer is one, too."""
    number = a.number * b.number % of.prime
    for angle, by in ((a, b.number), (b, a.number)):
        times = by if by <= _MOST_TIMES else by - of.prime
        if angle.unit and times >= -_MOST_TIMES:
            unit = (1, 0)
            for _ in range(abs(times)):
                unit = _both(unit, angle.unit if times > 0 else _back(angle.unit))
            return Exact(number, (unit[0] % of.prime, unit[1] % of.prime))
    return Exact(number)


def _multiplied(of: ExactArithmetic, a: Sequence[Exact], b: Sequence[Exact]) -> list[Exact]:
    count = max(len(a), len(b))
    a, b = (list(x) * count if len(x) == 1 else x for x in (a, b))
    return [_times(of, x, y) for x, y in zip(a, b, strict=True)]


def _select(of: ExactArithmetic, a: Sequence[Exact], b: Sequence[Exact], c: Sequence[Exact]) -> list[Exact]:
    share = of.even("select", a[0].number)
    return of.plain([share * x.number + (1 - share) * y.number for x, y in zip(b, c, strict=True)])


def _dot(a: Sequence[Exact], b: Sequence[Exact]) -> int:
    return sum(x.number * y.number for x, y in zip(a, b, strict=True))


def _cross_of(of: ExactArithmetic, a: Sequence[Exact], b: Sequence[Exact]) -> list[Exact]:
    u, v = ([x.number for x in each] for each in (a, b))
    return of.plain(_cross(u, v) if len(u) == 3 else [u[0] * v[1] - u[1] * v[0]])


def _divided(of: ExactArithmetic, a: Sequence[Exact], b: Sequence[Exact]) -> list[Exact]:
    by = of.over(1, b[0].number)
    return of.plain([x.number * by for x in a])


_DO: dict[str, Callable[..., Any]] = {
    "compose": lambda of, _, a, b: compose_exact(of, a, b),
    "inverse": lambda of, _, a: _inverse(of, a),
    "act": lambda of, _, a, b: of.plain(
        (move_exact if isinstance(a, Plane | Space) else turn_exact)(of, a, [x.number for x in b])
    ),
    "rotate": lambda of, _, a, b: of.plain(turn_exact(of, a, [x.number for x in b])),
    "position": lambda of, _, a: of.plain(a.position),
    "rotation": lambda _of, _, a: a.quaternion,
    "heading": lambda of, _, a: [of.angle(a.unit)],
    "pose": lambda of, _, a, b: _pose(of, a, b),
    "log": lambda of, _, a: _log(of, a),
    "exp": lambda of, _, a: _exp(of, a),
    "vector_part": lambda of, _, a: _along(of, "vector part", a),
    "norm": lambda of, _, a: [Exact(of.root(_dot(a, a)))],
    "dot": lambda of, _, a, b: of.plain([_dot(a, b)]),
    "cross": lambda of, _, a, b: _cross_of(of, a, b),
    "atan2": lambda of, _, a, b: _atan2(of, a, b),
    "sqrt": lambda of, _, a: [Exact(of.root(a[0].number))],
    "sin": lambda of, _, a: [Exact(of.unit_of(a[0])[1])],
    "cos": lambda of, _, a: [Exact(of.unit_of(a[0])[0])],
    "wrap": lambda of, _, a: [of.angle(of.unit_of(a[0]))],
    "select": lambda of, _, a, b, c: _select(of, a, b, c),
    "add": lambda of, _, a, b: [_sum(of, x, y, 1) for x, y in zip(a, b, strict=True)],
    "subtract": lambda of, _, a, b: [_sum(of, x, y, -1) for x, y in zip(a, b, strict=True)],
    "negate": lambda of, _, a: [_sum(of, Exact(0), x, -1) if x.unit else Exact(-x.number % of.prime) for x in a],
    "multiply": lambda of, _, a, b: _multiplied(of, a, b),
    "divide": lambda of, _, a, b: _divided(of, a, b),
    "part": lambda _of, numbers, a: a[numbers[0] : numbers[0] + numbers[1]],
    "vector": lambda _of, _, *all_of: [x for each in all_of for x in each],
}
