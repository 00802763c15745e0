"""Operations of rotations and poses: the numbers of the result, and its slopes.  MATH §3.11.

Values are those of variables: se2 (x, y, θ), se3 (translation, quaternion x y z w), so3 a quaternion.  A pose changes
by an increment in its own frame, translation first, so it has six slopes and seven numbers:

    a ∘ b:  δt = R_bᵀ (δt_a + δφ_a × t_b) + δt_b,   δφ = R_bᵀ δφ_a + δφ_b                                  (3.50)
    c = a⁻¹:  δt = R_a (t_c × δφ_a − δt_a),   δφ = −R_a δφ_a                                              (3.51)
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from factorbus.solver.formulas.terms import Operand, angle_of, cosine, floor, over, pick, root, sine
from factorbus.solver.kernels.model.se3 import HALF_TURN, HALF_TURN_SLOPE

_TWO_PI = 2.0 * math.pi
_SMALL = 1e-8  # of a squared angle: below it the series are exact to rounding


class Dual(NamedTuple):
    """The numbers of a value, and what a change of it has."""

    v: Sequence[Operand]
    d: Sequence[Operand]


def wrapped_angle(angle: Operand) -> Operand:
    """The same angle in [−π, π)."""
    wrapped = angle - _TWO_PI * floor((angle + math.pi) / _TWO_PI)
    return pick(wrapped, ">=", math.pi, wrapped - _TWO_PI, wrapped)


def cross_product(a: Sequence[Operand], b: Sequence[Operand]) -> list[Operand]:
    """a × b."""
    return [a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3] for k in range(3)]


def added(a: Sequence[Operand], b: Sequence[Operand]) -> list[Operand]:
    """a + b."""
    return [x + y for x, y in zip(a, b, strict=True)]


def compose_dual(kind: str, a: Dual, b: Dual) -> Dual:
    """a ∘ b.  (3.50)"""
    if kind == "so3":
        return Dual(_product(a.v, b.v), added(_transposed(_matrix(b.v), a.d), b.d))
    if kind == "se2":
        x, y, turn = b.v[0], b.v[1], a.d[2]
        moved = [a.d[0] - turn * y, a.d[1] + turn * x]
        value = [*added(_turned2(a.v[2], [x, y]), a.v[:2]), wrapped_angle(a.v[2] + b.v[2])]
        return Dual(value, [*added(_turned2(b.v[2], moved, back=True), b.d[:2]), turn + b.d[2]])
    R = _matrix(b.v[3:])
    moved = added(a.d[:3], cross_product(a.d[3:], b.v[:3]))
    value = [*added(_times(_matrix(a.v[3:]), b.v[:3]), a.v[:3]), *_unit(_product(a.v[3:], b.v[3:]))]
    return Dual(value, [*added(_transposed(R, moved), b.d[:3]), *added(_transposed(R, a.d[3:]), b.d[3:])])


def inverse_dual(kind: str, a: Dual) -> Dual:
    """a⁻¹.  (3.51)"""
    if kind == "so3":
        return Dual(_conjugate(a.v), _negated(_times(_matrix(a.v), a.d)))
    if kind == "se2":
        x, y = _negated(_turned2(a.v[2], a.v[:2], back=True))
        moved = [a.d[2] * y - a.d[0], -(a.d[2] * x) - a.d[1]]
        return Dual([x, y, wrapped_angle(-a.v[2])], [*_turned2(a.v[2], moved), -a.d[2]])
    R = _matrix(a.v[3:])
    t = _negated(_transposed(R, a.v[:3]))
    moved = [x - y for x, y in zip(cross_product(t, a.d[3:]), a.d[:3], strict=True)]
    return Dual([*t, *_conjugate(a.v[3:])], [*_times(R, moved), *_negated(_times(R, a.d[3:]))])


def rotate(kind: str, a: Dual, b: Dual, moves: bool = False) -> Dual:
    """R b; where it moves, R b + t of the pose a."""
    if kind == "se2":
        turn = a.d[2]
        moved = [b.d[0] - turn * b.v[1], b.d[1] + turn * b.v[0]]
        value = _turned2(a.v[2], b.v)
        if moves:
            value, moved = added(value, a.v[:2]), added(moved, a.d[:2])
        return Dual(value, _turned2(a.v[2], moved))
    R = _matrix(a.v[-4:])
    value, moved = _times(R, b.v), added(b.d, cross_product(a.d[-3:], b.v))
    if moves:
        value, moved = added(value, a.v[:3]), added(moved, a.d[:3])
    return Dual(value, _times(R, moved))


def position(kind: str, a: Dual) -> Dual:
    """t of the pose a: δ = R δt."""
    if kind == "se2":
        return Dual(a.v[:2], _turned2(a.v[2], a.d[:2]))
    return Dual(a.v[:3], _times(_matrix(a.v[3:]), a.d[:3]))


def pose_dual(a: Dual, b: Dual) -> Dual:
    """The pose at a, turned by b: δt = Rᵀ δa."""
    if len(a.v) == 2:
        return Dual([*a.v, wrapped_angle(b.v[0])], [*_turned2(b.v[0], a.d, back=True), *b.d])
    return Dual([*a.v, *b.v], [*_transposed(_matrix(b.v), a.d), *b.d])


def log(a: Dual) -> Dual:
    """The rotation vector φ of a:  δφ' = (I + ½⌊φ⌋ + (1 − ½θ cot ½θ)/θ² ⌊φ⌋²) δφ.  (3.52)"""
    x, y, z, w = _positive(a.v)
    square = x * x + y * y + z * z
    length = root(square)
    half = angle_of(length, w)
    # ½θ = sin ½θ (1 + sin² ½θ / 6)
    scale = pick(square, "<", _SMALL, 2.0 + square / 3.0, over(2.0 * half, length))
    second = pick(square, "<", _SMALL, 1.0 / 12.0, over(1.0 - over(half * w, length), 4.0 * half * half))
    phi = [scale * x, scale * y, scale * z]
    return Dual(phi, _by_powers(0.5, second, phi, a.d))


def exp(a: Dual) -> Dual:
    """The rotation by the rotation vector a:  δφ = (I − (1 − cos θ)/θ² ⌊a⌋ + (θ − sin θ)/θ³ ⌊a⌋²) δa.  (3.53)"""
    square = a.v[0] * a.v[0] + a.v[1] * a.v[1] + a.v[2] * a.v[2]
    angle = root(square)
    half = sine(0.5 * angle)
    scale = pick(square, "<", _SMALL, 0.5 - square / 48.0, over(half, angle))
    w = pick(square, "<", _SMALL, 1.0 - square / 8.0, cosine(0.5 * angle))
    first = pick(square, "<", _SMALL, 0.5 - square / 24.0, over(2.0 * half * half, square))
    second = pick(square, "<", _SMALL, 1.0 / 6.0, over(angle - sine(angle), angle * square))
    return Dual([*(scale * x for x in a.v), w], _by_powers(-first, second, a.v, a.d))


def vector_part(a: Dual) -> Dual:
    """The vector part u of the quaternion ±a, w ≥ 0:  δu = ½ (w I + ⌊u⌋) δφ."""
    *u, w = _positive(a.v)
    slope = pick(w, ">", HALF_TURN, w, HALF_TURN_SLOPE)  # as `se3.turn_slope`
    return Dual(u, [0.5 * (slope * d + e) for d, e in zip(a.d, cross_product(u, a.d), strict=True)])


def _by_powers(first: Operand, second: Operand, u: Sequence[Operand], d: Sequence[Operand]) -> list[Operand]:
    """(I + first ⌊u⌋ + second ⌊u⌋²) d."""
    once = cross_product(u, d)
    return [x + first * y + second * z for x, y, z in zip(d, once, cross_product(u, once), strict=True)]


def _positive(q: Sequence[Operand]) -> list[Operand]:
    return [pick(q[3], "<", 0.0, -x, x) for x in q]


def _negated(a: Sequence[Operand]) -> list[Operand]:
    return [-x for x in a]


def _conjugate(q: Sequence[Operand]) -> list[Operand]:
    return [-q[0], -q[1], -q[2], q[3]]


def _product(a: Sequence[Operand], b: Sequence[Operand]) -> list[Operand]:
    """a ⊗ b, both x y z w."""
    v = [a[3] * x + b[3] * y + z for x, y, z in zip(b[:3], a[:3], cross_product(a[:3], b[:3]), strict=True)]
    return [*v, a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]]


def _unit(q: Sequence[Operand]) -> list[Operand]:
    """1/|q| of what is a unit but for rounding, by one step of Newton's method: its own error is the square of that."""
    scale = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return [scale * x for x in q]


def _matrix(q: Sequence[Operand]) -> list[list[Operand]]:
    """R of a unit quaternion."""
    x, y, z, w = q
    return [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]


def _times(R: Sequence[Sequence[Operand]], a: Sequence[Operand]) -> list[Operand]:
    return [row[0] * a[0] + row[1] * a[1] + row[2] * a[2] for row in R]


def _transposed(R: Sequence[Sequence[Operand]], a: Sequence[Operand]) -> list[Operand]:
    """Rᵀ a."""
    return [R[0][k] * a[0] + R[1][k] * a[1] + R[2][k] * a[2] for k in range(3)]


def _turned2(angle: Operand, a: Sequence[Operand], back: bool = False) -> list[Operand]:
    """R a in the plane, or Rᵀ a."""
    c, s = cosine(angle), sine(angle)
    return [c * a[0] + s * a[1], c * a[1] - s * a[0]] if back else [c * a[0] - s * a[1], s * a[0] + c * a[1]]
