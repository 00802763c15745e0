"""Operations of expressions on rotations and poses: values, and tangents.  MATH §3.11.

Each takes an instruction s (`expression_layout`), all values v, and all tangents T (scalars, rows): what the value at a
row changes by for each scalar of the variables.  A pose changes by an increment in its own frame, translation first:

    a ∘ b:  δt = R_bᵀ (δt_a + δφ_a × t_b) + δt_b,   δφ = R_bᵀ δφ_a + δφ_b                                  (3.50)
    c = a⁻¹:  δt = R_a (t_c × δφ_a − δt_a),   δφ = −R_a δφ_a                                              (3.51)
"""

import math

from factorbus.solver.kernels.jit.compile import F64, I64, part
from factorbus.solver.kernels.model import expression_layout as at
from factorbus.solver.kernels.model.se2 import compose_se2, wrap
from factorbus.solver.kernels.model.se3 import compose_se3, quat_product, rotation_matrix, turn_slope

_SMALL = 1e-8  # of a squared angle: below it the series are exact to rounding


@part
def compose_so3(s: I64, v: F64, T: F64) -> None:
    """a ∘ b of rotations."""
    a, b, out, ra, rb, row = s[at.A], s[at.B], s[at.OUT], s[at.A_ROW], s[at.B_ROW], s[at.ROW]
    v[out], v[out + 1], v[out + 2], v[out + 3] = quat_product(
        v[a], v[a + 1], v[a + 2], v[a + 3], v[b], v[b + 1], v[b + 2], v[b + 3]
    )
    q = rotation_matrix(v, b)
    for c in range(s[at.FIRST], s[at.LAST]):
        x, y, z = T[c, ra], T[c, ra + 1], T[c, ra + 2]
        for k in range(3):
            T[c, row + k] = q[k] * x + q[3 + k] * y + q[6 + k] * z + T[c, rb + k]


@part
def compose_pose2(s: I64, v: F64, T: F64) -> None:
    """a ∘ b of poses in the plane."""
    a, b, out, ra, rb, row = s[at.A], s[at.B], s[at.OUT], s[at.A_ROW], s[at.B_ROW], s[at.ROW]
    compose_se2(v, a, v, b, out)
    cos, sin, x, y = math.cos(v[b + 2]), math.sin(v[b + 2]), v[b], v[b + 1]
    for c in range(s[at.FIRST], s[at.LAST]):
        turn = T[c, ra + 2]
        dx, dy = T[c, ra] - turn * y, T[c, ra + 1] + turn * x
        T[c, row] = cos * dx + sin * dy + T[c, rb]
        T[c, row + 1] = cos * dy - sin * dx + T[c, rb + 1]
        T[c, row + 2] = turn + T[c, rb + 2]


@part
def compose_pose3(s: I64, v: F64, T: F64) -> None:
    """a ∘ b of poses in space.  (3.50)"""
    a, b, out, ra, rb, row = s[at.A], s[at.B], s[at.OUT], s[at.A_ROW], s[at.B_ROW], s[at.ROW]
    compose_se3(v, a, v, b, out)
    q, x, y, z = rotation_matrix(v, b + 3), v[b], v[b + 1], v[b + 2]
    for c in range(s[at.FIRST], s[at.LAST]):
        u0, u1, u2 = T[c, ra + 3], T[c, ra + 4], T[c, ra + 5]
        d0, d1, d2 = T[c, ra] + u1 * z - u2 * y, T[c, ra + 1] + u2 * x - u0 * z, T[c, ra + 2] + u0 * y - u1 * x
        for k in range(3):
            T[c, row + k] = q[k] * d0 + q[3 + k] * d1 + q[6 + k] * d2 + T[c, rb + k]
            T[c, row + 3 + k] = q[k] * u0 + q[3 + k] * u1 + q[6 + k] * u2 + T[c, rb + 3 + k]


@part
def inverse_so3(s: I64, v: F64, T: F64) -> None:
    """a⁻¹ of a rotation."""
    a, out, ra, row = s[at.A], s[at.OUT], s[at.A_ROW], s[at.ROW]
    v[out], v[out + 1], v[out + 2], v[out + 3] = -v[a], -v[a + 1], -v[a + 2], v[a + 3]
    q = rotation_matrix(v, a)
    for c in range(s[at.FIRST], s[at.LAST]):
        x, y, z = T[c, ra], T[c, ra + 1], T[c, ra + 2]
        for k in range(3):
            T[c, row + k] = -(q[3 * k] * x + q[3 * k + 1] * y + q[3 * k + 2] * z)


@part
def inverse_pose2(s: I64, v: F64, T: F64) -> None:
    """a⁻¹ of a pose in the plane."""
    a, out, ra, row = s[at.A], s[at.OUT], s[at.A_ROW], s[at.ROW]
    cos, sin = math.cos(v[a + 2]), math.sin(v[a + 2])
    x, y = -(cos * v[a] + sin * v[a + 1]), sin * v[a] - cos * v[a + 1]
    v[out], v[out + 1], v[out + 2] = x, y, wrap(-v[a + 2])
    for c in range(s[at.FIRST], s[at.LAST]):
        turn = T[c, ra + 2]
        dx, dy = turn * y - T[c, ra], -turn * x - T[c, ra + 1]
        T[c, row] = cos * dx - sin * dy
        T[c, row + 1] = sin * dx + cos * dy
        T[c, row + 2] = -turn


@part
def inverse_pose3(s: I64, v: F64, T: F64) -> None:
    """a⁻¹ of a pose in space.  (3.51)"""
    a, out, ra, row = s[at.A], s[at.OUT], s[at.A_ROW], s[at.ROW]
    q = rotation_matrix(v, a + 3)
    x = -(q[0] * v[a] + q[3] * v[a + 1] + q[6] * v[a + 2])
    y = -(q[1] * v[a] + q[4] * v[a + 1] + q[7] * v[a + 2])
    z = -(q[2] * v[a] + q[5] * v[a + 1] + q[8] * v[a + 2])
    v[out], v[out + 1], v[out + 2] = x, y, z
    v[out + 3], v[out + 4], v[out + 5], v[out + 6] = -v[a + 3], -v[a + 4], -v[a + 5], v[a + 6]
    for c in range(s[at.FIRST], s[at.LAST]):
        u0, u1, u2 = T[c, ra + 3], T[c, ra + 4], T[c, ra + 5]
        d0, d1, d2 = y * u2 - z * u1 - T[c, ra], z * u0 - x * u2 - T[c, ra + 1], x * u1 - y * u0 - T[c, ra + 2]
        for k in range(3):
            T[c, row + k] = q[3 * k] * d0 + q[3 * k + 1] * d1 + q[3 * k + 2] * d2
            T[c, row + 3 + k] = -(q[3 * k] * u0 + q[3 * k + 1] * u1 + q[3 * k + 2] * u2)


@part
def rotate2(moves: bool, s: I64, v: F64, T: F64) -> None:
    """R b of the pose a in the plane; where it moves, R b + t."""
    a, b, out, ra, rb, row = s[at.A], s[at.B], s[at.OUT], s[at.A_ROW], s[at.B_ROW], s[at.ROW]
    cos, sin, x, y = math.cos(v[a + 2]), math.sin(v[a + 2]), v[b], v[b + 1]
    v[out] = cos * x - sin * y + (v[a] if moves else 0.0)
    v[out + 1] = sin * x + cos * y + (v[a + 1] if moves else 0.0)
    for c in range(s[at.FIRST], s[at.LAST]):
        turn = T[c, ra + 2]
        dx, dy = T[c, rb] - turn * y, T[c, rb + 1] + turn * x
        if moves:
            dx, dy = dx + T[c, ra], dy + T[c, ra + 1]
        T[c, row], T[c, row + 1] = cos * dx - sin * dy, sin * dx + cos * dy


@part
def rotate3(moves: bool, s: I64, v: F64, T: F64) -> None:
    """R b of the rotation a; where it moves, R b + t of the pose a in space."""
    a, b, out, ra, rb, row = s[at.A], s[at.B], s[at.OUT], s[at.A_ROW], s[at.B_ROW], s[at.ROW]
    turned = 3 if moves else 0
    q, x, y, z = rotation_matrix(v, a + turned), v[b], v[b + 1], v[b + 2]
    for k in range(3):
        v[out + k] = q[3 * k] * x + q[3 * k + 1] * y + q[3 * k + 2] * z + (v[a + k] if moves else 0.0)
    for c in range(s[at.FIRST], s[at.LAST]):
        u0, u1, u2 = T[c, ra + turned], T[c, ra + turned + 1], T[c, ra + turned + 2]
        d0, d1, d2 = T[c, rb] + u1 * z - u2 * y, T[c, rb + 1] + u2 * x - u0 * z, T[c, rb + 2] + u0 * y - u1 * x
        if moves:
            d0, d1, d2 = d0 + T[c, ra], d1 + T[c, ra + 1], d2 + T[c, ra + 2]
        for k in range(3):
            T[c, row + k] = q[3 * k] * d0 + q[3 * k + 1] * d1 + q[3 * k + 2] * d2


@part
def position(s: I64, v: F64, T: F64) -> None:
    """t of the pose a, of two or three numbers: δ = R δt."""
    a, out, ra, row = s[at.A], s[at.OUT], s[at.A_ROW], s[at.ROW]
    for k in range(s[at.N]):
        v[out + k] = v[a + k]
    if s[at.N] == 2:
        cos, sin = math.cos(v[a + 2]), math.sin(v[a + 2])
        for c in range(s[at.FIRST], s[at.LAST]):
            T[c, row], T[c, row + 1] = cos * T[c, ra] - sin * T[c, ra + 1], sin * T[c, ra] + cos * T[c, ra + 1]
        return
    q = rotation_matrix(v, a + 3)
    for c in range(s[at.FIRST], s[at.LAST]):
        for k in range(3):
            T[c, row + k] = q[3 * k] * T[c, ra] + q[3 * k + 1] * T[c, ra + 1] + q[3 * k + 2] * T[c, ra + 2]


@part
def pose2(s: I64, v: F64, T: F64) -> None:
    """The pose in the plane at a with the heading b: δt = Rᵀ δa."""
    a, b, out, ra, rb, row = s[at.A], s[at.B], s[at.OUT], s[at.A_ROW], s[at.B_ROW], s[at.ROW]
    v[out], v[out + 1], v[out + 2] = v[a], v[a + 1], wrap(v[b])
    cos, sin = math.cos(v[b]), math.sin(v[b])
    for c in range(s[at.FIRST], s[at.LAST]):
        T[c, row], T[c, row + 1] = cos * T[c, ra] + sin * T[c, ra + 1], cos * T[c, ra + 1] - sin * T[c, ra]
        T[c, row + 2] = T[c, rb]


@part
def pose3(s: I64, v: F64, T: F64) -> None:
    """The pose in space at a with the rotation b: δt = Rᵀ δa."""
    a, b, out, ra, rb, row = s[at.A], s[at.B], s[at.OUT], s[at.A_ROW], s[at.B_ROW], s[at.ROW]
    for k in range(3):
        v[out + k] = v[a + k]
    for k in range(4):
        v[out + 3 + k] = v[b + k]
    q = rotation_matrix(v, b)
    for c in range(s[at.FIRST], s[at.LAST]):
        for k in range(3):
            T[c, row + k] = q[k] * T[c, ra] + q[3 + k] * T[c, ra + 1] + q[6 + k] * T[c, ra + 2]
            T[c, row + 3 + k] = T[c, rb + k]


@part
def log(s: I64, v: F64, T: F64) -> None:
    """The rotation vector φ of a:  δφ' = (I + ½⌊φ⌋ + (1 − ½θ cot ½θ)/θ² ⌊φ⌋²) δφ.  (3.52)"""
    a, out, row = s[at.A], s[at.OUT], s[at.ROW]
    sign = -1.0 if v[a + 3] < 0.0 else 1.0
    x, y, z, w = sign * v[a], sign * v[a + 1], sign * v[a + 2], sign * v[a + 3]
    sine2 = x * x + y * y + z * z
    if sine2 < _SMALL:  # ½θ = sin ½θ (1 + sin² ½θ / 6)
        scale, second = 2.0 + sine2 / 3.0, 1.0 / 12.0
    else:
        sine = math.sqrt(sine2)
        half = math.atan2(sine, w)
        scale, second = 2.0 * half / sine, (1.0 - half * w / sine) / (4.0 * half * half)
    v[out], v[out + 1], v[out + 2] = scale * x, scale * y, scale * z
    times(0.5, second, s, v[out:], T[:, row:], T)


@part
def exp(s: I64, v: F64, T: F64) -> None:
    """The rotation by the rotation vector a:  δφ = (I − (1 − cos θ)/θ² ⌊a⌋ + (θ − sin θ)/θ³ ⌊a⌋²) δa.  (3.53)"""
    a, out, row = s[at.A], s[at.OUT], s[at.ROW]
    square = v[a] * v[a] + v[a + 1] * v[a + 1] + v[a + 2] * v[a + 2]
    if square < _SMALL:
        scale, w, first, second = 0.5 - square / 48.0, 1.0 - square / 8.0, 0.5 - square / 24.0, 1.0 / 6.0
    else:
        angle = math.sqrt(square)
        sine = math.sin(0.5 * angle)
        scale, w, first = sine / angle, math.cos(0.5 * angle), 2.0 * sine * sine / square
        second = (angle - math.sin(angle)) / (angle * square)
    for k in range(3):
        v[out + k] = scale * v[a + k]
    v[out + 3] = w
    times(-first, second, s, v[a:], T[:, row:], T)


@part
def times(first: float, second: float, s: I64, u: F64, out: F64, T: F64) -> None:
    """out = (I + first ⌊u⌋ + second ⌊u⌋²) of what a changes by."""
    ra, x, y, z = s[at.A_ROW], u[0], u[1], u[2]
    for c in range(s[at.FIRST], s[at.LAST]):
        d0, d1, d2 = T[c, ra], T[c, ra + 1], T[c, ra + 2]
        e0, e1, e2 = y * d2 - z * d1, z * d0 - x * d2, x * d1 - y * d0
        out[c, 0] = d0 + first * e0 + second * (y * e2 - z * e1)
        out[c, 1] = d1 + first * e1 + second * (z * e0 - x * e2)
        out[c, 2] = d2 + first * e2 + second * (x * e1 - y * e0)


@part
def vector_part(s: I64, v: F64, T: F64) -> None:
    """The vector part u of the quaternion ±a, w ≥ 0:  δu = ½ (w I + ⌊u⌋) δφ."""
    a, out, ra, row = s[at.A], s[at.OUT], s[at.A_ROW], s[at.ROW]
    sign = -1.0 if v[a + 3] < 0.0 else 1.0
    x, y, z, w = sign * v[a], sign * v[a + 1], sign * v[a + 2], turn_slope(sign * v[a + 3])
    v[out], v[out + 1], v[out + 2] = x, y, z
    for c in range(s[at.FIRST], s[at.LAST]):
        d0, d1, d2 = T[c, ra], T[c, ra + 1], T[c, ra + 2]
        T[c, row] = 0.5 * (w * d0 + y * d2 - z * d1)
        T[c, row + 1] = 0.5 * (w * d1 + z * d0 - x * d2)
        T[c, row + 2] = 0.5 * (w * d2 + x * d1 - y * d0)
