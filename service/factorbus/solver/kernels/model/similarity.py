"""Rotations x = (qx qy qz qw) and similarities x = (x y z, qx qy qz qw, s), p ↦ s R p + t: ⊞, composition, and the
residuals of their factors, which `many` evaluates.  MATH §2.6, §3.12.

Of a rotation ⊞ is q ⊗ exp(δφ), of a similarity (t + s R δt, q ⊗ exp(δφ), s e^δσ): composed with (δt, exp δφ, e^δσ).
"""

import math

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.se3 import half_turn, quat_product, rotation_matrix, turn_slope


@inline_kernel
def move_so3(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """out = x ⊞ δ, both at offset i; δ at offset d."""
    turn_quaternion(x, i, step, d, out)


@inline_kernel
def move_sim3(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """out = x ⊞ δ, both at offset i; δ at offset d."""
    a, s = rotation_matrix(x, i + 3), x[i + 7]
    ux, uy, uz = s * step[d], s * step[d + 1], s * step[d + 2]
    out[i] = x[i] + a[0] * ux + a[1] * uy + a[2] * uz
    out[i + 1] = x[i + 1] + a[3] * ux + a[4] * uy + a[5] * uz
    out[i + 2] = x[i + 2] + a[6] * ux + a[7] * uy + a[8] * uz
    turn_quaternion(x, i + 3, step, d + 3, out)
    out[i + 7] = s * math.exp(step[d + 6])


@inline_kernel
def turn_quaternion(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """out = q ⊗ exp(δφ), of unit length; as in `move_se3`."""
    fx, fy, fz = step[d], step[d + 1], step[d + 2]
    half, cosine = half_turn(fx * fx + fy * fy + fz * fz)
    put_quaternion(quat_product(x[i], x[i + 1], x[i + 2], x[i + 3], half * fx, half * fy, half * fz, cosine), out, i)


@inline_kernel
def put_quaternion(q: tuple, x: F64, i: int) -> None:
    """A quaternion, brought to unit length, to x[i]."""
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    x[i], x[i + 1], x[i + 2], x[i + 3] = scale * q[0], scale * q[1], scale * q[2], scale * q[3]


@part
def compose_similar(kind: int, forward: bool, i: int, j: int, z: int, x: F64, p: F64) -> None:
    """The end that has no value gets the one that makes the residual of a relative rotation or similarity zero:
    xⱼ = xᵢ z, or xᵢ = xⱼ z⁻¹."""
    if kind == at.BETWEEN_SO3:
        if forward:
            put_quaternion(product_at(x, i, p, z), x, j)
        else:
            put_quaternion(product_at_inverse(x, j, p, z), x, i)
    elif forward:
        a, s = rotation_matrix(x, i + 3), x[i + 7]
        for c in range(3):
            x[j + c] = x[i + c] + s * (a[3 * c] * p[z] + a[3 * c + 1] * p[z + 1] + a[3 * c + 2] * p[z + 2])
        put_quaternion(product_at(x, i + 3, p, z + 3), x, j + 3)
        x[j + 7] = s * p[z + 7]
    else:
        put_quaternion(product_at_inverse(x, j + 3, p, z + 3), x, i + 3)
        s = x[j + 7] / p[z + 7]
        a, x[i + 7] = rotation_matrix(x, i + 3), s
        for c in range(3):
            x[i + c] = x[j + c] - s * (a[3 * c] * p[z] + a[3 * c + 1] * p[z + 1] + a[3 * c + 2] * p[z + 2])


@inline_kernel
def product_at(x: F64, i: int, p: F64, k: int) -> tuple:
    """The quaternion at x[i] ⊗ that at p[k]."""
    return quat_product(x[i], x[i + 1], x[i + 2], x[i + 3], p[k], p[k + 1], p[k + 2], p[k + 3])


@inline_kernel
def product_at_inverse(x: F64, i: int, p: F64, k: int) -> tuple:
    """The quaternion at x[i] ⊗ the inverse of that at p[k]."""
    return quat_product(x[i], x[i + 1], x[i + 2], x[i + 3], -p[k], -p[k + 1], -p[k + 2], p[k + 3])


@inline_kernel
def place_landmark_sim3(x: F64, i: int, p: F64, k: int, j: int) -> None:
    """lⱼ = tᵢ + sᵢ Rᵢ z."""
    a, s = rotation_matrix(x, i + 3), x[i + 7]
    for c in range(3):
        x[j + c] = x[i + c] + s * (a[3 * c] * p[k] + a[3 * c + 1] * p[k + 1] + a[3 * c + 2] * p[k + 2])


@inline_kernel
def rotation_error(x: F64, i: int, p: F64, k: int) -> tuple:
    """(v, w) of q_z⁻¹ ⊗ q with w ≥ 0, the quaternion q_z at p[k]."""
    vx, vy, vz, w = quat_product(-p[k], -p[k + 1], -p[k + 2], p[k + 3], x[i], x[i + 1], x[i + 2], x[i + 3])
    if w < 0.0:
        vx, vy, vz, w = -vx, -vy, -vz, -w
    return vx, vy, vz, w


@inline_kernel
def between_rotation_error(x: F64, i: int, j: int, p: F64, k: int) -> tuple:
    """(v, w) of q_z⁻¹ ⊗ qᵢ⁻¹ ⊗ qⱼ with w ≥ 0."""
    qx, qy, qz, qw = quat_product(-x[i], -x[i + 1], -x[i + 2], x[i + 3], x[j], x[j + 1], x[j + 2], x[j + 3])
    vx, vy, vz, w = quat_product(-p[k], -p[k + 1], -p[k + 2], p[k + 3], qx, qy, qz, qw)
    if w < 0.0:
        vx, vy, vz, w = -vx, -vy, -vz, -w
    return vx, vy, vz, w


@inline_kernel
def put_turn(v: tuple, row: int, column: int, r: F64, J: F64) -> None:
    """r = v, and its Jacobian ½ (w I + ⌊v⌋) by the rotation whose error v is."""
    hx, hy, hz, h = 0.5 * v[0], 0.5 * v[1], 0.5 * v[2], 0.5 * turn_slope(v[3])
    r[row], r[row + 1], r[row + 2] = v[0], v[1], v[2]
    J[row, column], J[row, column + 1], J[row, column + 2] = h, -hz, hy
    J[row + 1, column], J[row + 1, column + 1], J[row + 1, column + 2] = hz, h, -hx
    J[row + 2, column], J[row + 2, column + 1], J[row + 2, column + 2] = -hy, hx, h


@inline_kernel
def put_turn_from(v: tuple, z: tuple, row: int, column: int, J: F64) -> None:
    """The Jacobian −½ (w I − ⌊v⌋) R_zᵀ by the rotation that v is relative to."""
    hx, hy, hz, h = 0.5 * v[0], 0.5 * v[1], 0.5 * v[2], 0.5 * turn_slope(v[3])
    for c in range(3):
        z0, z1, z2 = z[3 * c], z[3 * c + 1], z[3 * c + 2]
        J[row, column + c] = -h * z0 - hz * z1 + hy * z2
        J[row + 1, column + c] = hz * z0 - h * z1 - hx * z2
        J[row + 2, column + c] = -hy * z0 + hx * z1 - h * z2


@part
def similar(kind: int, x: F64, places: I64, p: F64, k: int, r: F64, J: F64) -> None:
    """Residual and Jacobians, side by side, of a factor of rotations or similarities; J comes with zeros.

    places: where the values of the variables begin in x; the measurement is at p[k]
    """
    i, j = places[0], places[places.size - 1]
    if kind == at.PRIOR_SO3:
        put_turn(rotation_error(x, i, p, k), 0, 0, r, J)
    elif kind == at.BETWEEN_SO3:
        v = between_rotation_error(x, i, j, p, k)
        put_turn(v, 0, 3, r, J)
        put_turn_from(v, rotation_matrix(p, k), 0, 0, J)
    elif kind == at.ATTITUDE_SO3:
        attitude_so3(x, i, p, k, r, J)
    elif kind == at.PRIOR_SIM3:
        prior_sim3(x, i, p, k, r, J)
    elif kind == at.BETWEEN_SIM3:
        between_sim3(x, i, j, p, k, r, J)
    elif kind == at.LANDMARK_SIM3:
        landmark_sim3(x, i, j, p, k, r, J)
    else:
        a, s = rotation_matrix(x, i + 3), x[i + 7]
        for c in range(3):  # position_sim3: r = t − z
            r[c] = x[i + c] - p[k + c]
            J[c, 0], J[c, 1], J[c, 2] = s * a[3 * c], s * a[3 * c + 1], s * a[3 * c + 2]


@inline_kernel
def attitude_so3(x: F64, i: int, p: F64, k: int, r: F64, J: F64) -> None:
    """r = b − z,  b = Rᵀ g,  ∂r/∂δφ = ⌊b⌋: as (3.22)."""
    a, g0, g1, g2 = rotation_matrix(x, i), p[k + 3], p[k + 4], p[k + 5]
    b0, b1 = a[0] * g0 + a[3] * g1 + a[6] * g2, a[1] * g0 + a[4] * g1 + a[7] * g2
    b2 = a[2] * g0 + a[5] * g1 + a[8] * g2
    r[0], r[1], r[2] = b0 - p[k], b1 - p[k + 1], b2 - p[k + 2]
    J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = -b2, b1, b2, -b0, -b1, b0


@inline_kernel
def prior_sim3(x: F64, i: int, p: F64, k: int, r: F64, J: F64) -> None:
    """z⁻¹ x: r = (R_zᵀ (t − t_z) / s_z, v, ln s/s_z).  (3.56)"""
    z, a, s = rotation_matrix(p, k + 3), rotation_matrix(x, i + 3), 1.0 / p[k + 7]
    d0, d1, d2 = s * (x[i] - p[k]), s * (x[i + 1] - p[k + 1]), s * (x[i + 2] - p[k + 2])
    for c in range(3):
        r[c] = z[c] * d0 + z[3 + c] * d1 + z[6 + c] * d2
        for e in range(3):
            J[c, e] = s * x[i + 7] * (z[c] * a[e] + z[3 + c] * a[3 + e] + z[6 + c] * a[6 + e])
    put_turn(rotation_error(x, i + 3, p, k + 3), 3, 3, r, J)
    r[6], J[6, 6] = math.log(x[i + 7] * s), 1.0


@inline_kernel
def between_sim3(x: F64, i: int, j: int, p: F64, k: int, r: F64, J: F64) -> None:
    """z⁻¹ (xᵢ⁻¹ xⱼ): d = Rᵢᵀ (tⱼ − tᵢ) / sᵢ,  r = (R_zᵀ (d − t_z) / s_z, v, ln sⱼ/(sᵢ s_z)).  (3.57)"""
    z, a, b = rotation_matrix(p, k + 3), rotation_matrix(x, i + 3), rotation_matrix(x, j + 3)
    inverse, s = 1.0 / x[i + 7], 1.0 / p[k + 7]
    t0, t1, t2 = inverse * (x[j] - x[i]), inverse * (x[j + 1] - x[i + 1]), inverse * (x[j + 2] - x[i + 2])
    d0, d1, d2 = a[0] * t0 + a[3] * t1 + a[6] * t2, a[1] * t0 + a[4] * t1 + a[7] * t2, a[2] * t0 + a[5] * t1 + a[8] * t2
    for c in range(3):
        m0, m1, m2 = s * z[c], s * z[3 + c], s * z[6 + c]  # a row of R_zᵀ / s_z
        r[c] = m0 * (d0 - p[k]) + m1 * (d1 - p[k + 1]) + m2 * (d2 - p[k + 2])
        J[c, 0], J[c, 1], J[c, 2] = -m0, -m1, -m2
        J[c, 3], J[c, 4], J[c, 5] = m1 * d2 - m2 * d1, m2 * d0 - m0 * d2, m0 * d1 - m1 * d0
        J[c, 6] = -(m0 * d0 + m1 * d1 + m2 * d2)
        ratio = x[j + 7] * inverse
        n0, n1 = m0 * a[0] + m1 * a[1] + m2 * a[2], m0 * a[3] + m1 * a[4] + m2 * a[5]
        n2 = m0 * a[6] + m1 * a[7] + m2 * a[8]
        for e in range(3):
            J[c, 7 + e] = ratio * (n0 * b[e] + n1 * b[3 + e] + n2 * b[6 + e])
    v = between_rotation_error(x, i + 3, j + 3, p, k + 3)
    put_turn(v, 3, 10, r, J)
    put_turn_from(v, z, 3, 3, J)
    r[6], J[6, 6], J[6, 13] = math.log(x[j + 7] * inverse * s), -1.0, 1.0


@inline_kernel
def landmark_sim3(x: F64, i: int, j: int, p: F64, k: int, r: F64, J: F64) -> None:
    """u = Rᵢᵀ (lⱼ − tᵢ) / sᵢ,  r = u − z,  by the pose [ −I | ⌊u⌋ | −u ], by the point Rᵢᵀ / sᵢ.  (3.58)"""
    a, s = rotation_matrix(x, i + 3), 1.0 / x[i + 7]
    t0, t1, t2 = s * (x[j] - x[i]), s * (x[j + 1] - x[i + 1]), s * (x[j + 2] - x[i + 2])
    u0, u1, u2 = a[0] * t0 + a[3] * t1 + a[6] * t2, a[1] * t0 + a[4] * t1 + a[7] * t2, a[2] * t0 + a[5] * t1 + a[8] * t2
    r[0], r[1], r[2] = u0 - p[k], u1 - p[k + 1], u2 - p[k + 2]
    J[0, 0], J[1, 1], J[2, 2] = -1.0, -1.0, -1.0
    J[0, 4], J[0, 5], J[1, 3], J[1, 5], J[2, 3], J[2, 4] = -u2, u1, u2, -u0, -u1, u0
    J[0, 6], J[1, 6], J[2, 6] = -u0, -u1, -u2
    for c in range(3):
        J[c, 7], J[c, 8], J[c, 9] = s * a[c], s * a[3 + c], s * a[6 + c]
