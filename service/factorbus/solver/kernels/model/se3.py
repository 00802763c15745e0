"""Poses in space x = (x y z, qx qy qz qw): residuals and Jacobians of one factor, ⊞, composition.  MATH §2.2, §3.

Arguments as in `se2`.  Quaternions are x y z w.  ⌊v⌋ is the matrix of v × ·.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel

HALF_TURN = 1e-6  # an error quaternion with less than that for w is one of 180°
HALF_TURN_SLOPE = 2.0 / math.pi
# radians²: below, the terms of the series are exact to rounding, and take half the time of sine and cosine.
SMALL_TURN = 0.04


@inline_kernel
def rotation_matrix(q: F64, k: int) -> tuple:
    """The nine entries of R(q), row by row; q (x y z w) at offset k is of unit length."""
    x, y, z, w = q[k], q[k + 1], q[k + 2], q[k + 3]
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@inline_kernel
def quat_product(ax: float, ay: float, az: float, aw: float, bx: float, by: float, bz: float, bw: float) -> tuple:
    """a ⊗ b, both x y z w."""
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


@inline_kernel
def turn_slope(w: float) -> float:
    """w, that by which half a turn counts along the axis of an error quaternion (v, w); at 180° what to put there.

    At w = 0 the residual v is longest, so its derivative along its axis is 0: a variable that a single factor holds
    would seem free.  There the slope is that of the chord to v = 0, which is half a turn away: 2/π.  MATH (3.6)
    """
    return w if w > HALF_TURN else HALF_TURN_SLOPE


@inline_kernel
def prior_se3(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """r = z⁻¹ x: R_zᵀ (t − t_z), vector part of q_z⁻¹ ⊗ q with w ≥ 0.  MATH (3.5)

    A = [ R_zᵀ R | 0 ; 0 | ½ (w I + ⌊v⌋) ]
    """
    z0, z1, z2, z3, z4, z5, z6, z7, z8 = rotation_matrix(p, k + 3)
    dx, dy, dz = x[i] - p[k], x[i + 1] - p[k + 1], x[i + 2] - p[k + 2]
    r[0] = z0 * dx + z3 * dy + z6 * dz
    r[1] = z1 * dx + z4 * dy + z7 * dz
    r[2] = z2 * dx + z5 * dy + z8 * dz
    vx, vy, vz, w = quat_product(-p[k + 3], -p[k + 4], -p[k + 5], p[k + 6], x[i + 3], x[i + 4], x[i + 5], x[i + 6])
    if w < 0.0:
        vx, vy, vz, w = -vx, -vy, -vz, -w
    r[3], r[4], r[5] = vx, vy, vz
    w = turn_slope(w)
    A[:, :] = 0.0
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    A[0, 0], A[0, 1], A[0, 2] = z0 * a0 + z3 * a3 + z6 * a6, z0 * a1 + z3 * a4 + z6 * a7, z0 * a2 + z3 * a5 + z6 * a8
    A[1, 0], A[1, 1], A[1, 2] = z1 * a0 + z4 * a3 + z7 * a6, z1 * a1 + z4 * a4 + z7 * a7, z1 * a2 + z4 * a5 + z7 * a8
    A[2, 0], A[2, 1], A[2, 2] = z2 * a0 + z5 * a3 + z8 * a6, z2 * a1 + z5 * a4 + z8 * a7, z2 * a2 + z5 * a5 + z8 * a8
    A[3, 3], A[3, 4], A[3, 5] = 0.5 * w, -0.5 * vz, 0.5 * vy
    A[4, 3], A[4, 4], A[4, 5] = 0.5 * vz, 0.5 * w, -0.5 * vx
    A[5, 3], A[5, 4], A[5, 5] = -0.5 * vy, 0.5 * vx, 0.5 * w


@inline_kernel
def between_se3(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """r = z⁻¹ (xᵢ⁻¹ xⱼ).  MATH (3.6)

    d = Rᵢᵀ (tⱼ − tᵢ);  r = (R_zᵀ (d − t_z), v),  (v, w) = q_z⁻¹ ⊗ qᵢ⁻¹ ⊗ qⱼ with w ≥ 0
    A = [ −R_zᵀ | R_zᵀ ⌊d⌋ ; 0 | −½ (w I − ⌊v⌋) R_zᵀ ],   B = [ R_zᵀ Rᵢᵀ Rⱼ | 0 ; 0 | ½ (w I + ⌊v⌋) ]
    """
    z0, z1, z2, z3, z4, z5, z6, z7, z8 = rotation_matrix(p, k + 3)
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    tx, ty, tz = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    dx, dy, dz = a0 * tx + a3 * ty + a6 * tz, a1 * tx + a4 * ty + a7 * tz, a2 * tx + a5 * ty + a8 * tz
    ex, ey, ez = dx - p[k], dy - p[k + 1], dz - p[k + 2]
    r[0] = z0 * ex + z3 * ey + z6 * ez
    r[1] = z1 * ex + z4 * ey + z7 * ez
    r[2] = z2 * ex + z5 * ey + z8 * ez
    qx, qy, qz, qw = quat_product(-x[i + 3], -x[i + 4], -x[i + 5], x[i + 6], x[j + 3], x[j + 4], x[j + 5], x[j + 6])
    vx, vy, vz, w = quat_product(-p[k + 3], -p[k + 4], -p[k + 5], p[k + 6], qx, qy, qz, qw)
    if w < 0.0:
        vx, vy, vz, w = -vx, -vy, -vz, -w
    r[3], r[4], r[5] = vx, vy, vz

    A[:, :] = 0.0
    A[0, 0], A[0, 1], A[0, 2] = -z0, -z3, -z6
    A[1, 0], A[1, 1], A[1, 2] = -z1, -z4, -z7
    A[2, 0], A[2, 1], A[2, 2] = -z2, -z5, -z8
    A[0, 3], A[0, 4], A[0, 5] = z3 * dz - z6 * dy, z6 * dx - z0 * dz, z0 * dy - z3 * dx
    A[1, 3], A[1, 4], A[1, 5] = z4 * dz - z7 * dy, z7 * dx - z1 * dz, z1 * dy - z4 * dx
    A[2, 3], A[2, 4], A[2, 5] = z5 * dz - z8 * dy, z8 * dx - z2 * dz, z2 * dy - z5 * dx
    h, hx, hy, hz = 0.5 * turn_slope(w), 0.5 * vx, 0.5 * vy, 0.5 * vz
    A[3, 3], A[3, 4], A[3, 5] = -h * z0 - hz * z1 + hy * z2, -h * z3 - hz * z4 + hy * z5, -h * z6 - hz * z7 + hy * z8
    A[4, 3], A[4, 4], A[4, 5] = hz * z0 - h * z1 - hx * z2, hz * z3 - h * z4 - hx * z5, hz * z6 - h * z7 - hx * z8
    A[5, 3], A[5, 4], A[5, 5] = -hy * z0 + hx * z1 - h * z2, -hy * z3 + hx * z4 - h * z5, -hy * z6 + hx * z7 - h * z8

    b0, b1, b2, b3, b4, b5, b6, b7, b8 = rotation_matrix(x, j + 3)
    # m = R_zᵀ Rᵢᵀ, then m Rⱼ.
    m0, m1, m2 = z0 * a0 + z3 * a1 + z6 * a2, z0 * a3 + z3 * a4 + z6 * a5, z0 * a6 + z3 * a7 + z6 * a8
    m3, m4, m5 = z1 * a0 + z4 * a1 + z7 * a2, z1 * a3 + z4 * a4 + z7 * a5, z1 * a6 + z4 * a7 + z7 * a8
    m6, m7, m8 = z2 * a0 + z5 * a1 + z8 * a2, z2 * a3 + z5 * a4 + z8 * a5, z2 * a6 + z5 * a7 + z8 * a8
    B[:, :] = 0.0
    B[0, 0], B[0, 1], B[0, 2] = m0 * b0 + m1 * b3 + m2 * b6, m0 * b1 + m1 * b4 + m2 * b7, m0 * b2 + m1 * b5 + m2 * b8
    B[1, 0], B[1, 1], B[1, 2] = m3 * b0 + m4 * b3 + m5 * b6, m3 * b1 + m4 * b4 + m5 * b7, m3 * b2 + m4 * b5 + m5 * b8
    B[2, 0], B[2, 1], B[2, 2] = m6 * b0 + m7 * b3 + m8 * b6, m6 * b1 + m7 * b4 + m8 * b7, m6 * b2 + m7 * b5 + m8 * b8
    B[3, 3], B[3, 4], B[3, 5] = h, -hz, hy
    B[4, 3], B[4, 4], B[4, 5] = hz, h, -hx
    B[5, 3], B[5, 4], B[5, 5] = -hy, hx, h


@inline_kernel
def landmark_se3(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """A point seen from a pose: r = u − z, u = Rᵢᵀ (lⱼ − tᵢ);  A = [ −I | ⌊u⌋ ], B = Rᵢᵀ.  MATH (3.7)"""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    tx, ty, tz = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    ux, uy, uz = a0 * tx + a3 * ty + a6 * tz, a1 * tx + a4 * ty + a7 * tz, a2 * tx + a5 * ty + a8 * tz
    r[0], r[1], r[2] = ux - p[k], uy - p[k + 1], uz - p[k + 2]
    A[0, 0], A[0, 1], A[0, 2], A[0, 3], A[0, 4], A[0, 5] = -1.0, 0.0, 0.0, 0.0, -uz, uy
    A[1, 0], A[1, 1], A[1, 2], A[1, 3], A[1, 4], A[1, 5] = 0.0, -1.0, 0.0, uz, 0.0, -ux
    A[2, 0], A[2, 1], A[2, 2], A[2, 3], A[2, 4], A[2, 5] = 0.0, 0.0, -1.0, -uy, ux, 0.0
    B[0, 0], B[0, 1], B[0, 2] = a0, a3, a6
    B[1, 0], B[1, 1], B[1, 2] = a1, a4, a7
    B[2, 0], B[2, 1], B[2, 2] = a2, a5, a8


@inline_kernel
def half_turn(square: float) -> tuple:
    """(sin(θ/2)/θ, cos(θ/2)) of θ²: the quaternion of a rotation vector φ is (sin(θ/2)/θ φ, cos(θ/2))."""
    if square >= SMALL_TURN:
        angle = math.sqrt(square)
        return math.sin(0.5 * angle) / angle, math.cos(0.5 * angle)
    s = 0.25 * square
    half = 0.5 - s * (1 / 12 - s * (1 / 240 - s * (1 / 10080 - s * (1 / 725760))))
    return half, 1.0 - s * (0.5 - s * (1 / 24 - s * (1 / 720 - s * (1 / 40320 - s * (1 / 3628800)))))


@inline_kernel
def move_se3(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """out = x ⊞ δ = (t + R δt, q ⊗ exp(δφ)), both at offset i; δ at offset d.  MATH (2.2)"""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    ux, uy, uz = step[d], step[d + 1], step[d + 2]
    out[i] = x[i] + a0 * ux + a1 * uy + a2 * uz
    out[i + 1] = x[i + 1] + a3 * ux + a4 * uy + a5 * uz
    out[i + 2] = x[i + 2] + a6 * ux + a7 * uy + a8 * uz
    fx, fy, fz = step[d + 3], step[d + 4], step[d + 5]
    half, cosine = half_turn(fx * fx + fy * fy + fz * fz)
    qx, qy, qz, qw = quat_product(x[i + 3], x[i + 4], x[i + 5], x[i + 6], half * fx, half * fy, half * fz, cosine)
    scale = 1.0 / math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    out[i + 3], out[i + 4], out[i + 5], out[i + 6] = scale * qx, scale * qy, scale * qz, scale * qw


@inline_kernel
def compose_se3(x: F64, i: int, p: F64, k: int, j: int) -> None:
    """xⱼ = xᵢ z."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    x[j] = x[i] + a0 * p[k] + a1 * p[k + 1] + a2 * p[k + 2]
    x[j + 1] = x[i + 1] + a3 * p[k] + a4 * p[k + 1] + a5 * p[k + 2]
    x[j + 2] = x[i + 2] + a6 * p[k] + a7 * p[k + 1] + a8 * p[k + 2]
    qx, qy, qz, qw = quat_product(x[i + 3], x[i + 4], x[i + 5], x[i + 6], p[k + 3], p[k + 4], p[k + 5], p[k + 6])
    scale = 1.0 / math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    x[j + 3], x[j + 4], x[j + 5], x[j + 6] = scale * qx, scale * qy, scale * qz, scale * qw


@inline_kernel
def compose_inverse_se3(x: F64, j: int, p: F64, k: int, i: int) -> None:
    """xᵢ = xⱼ z⁻¹: first the rotation, then tᵢ = tⱼ − Rᵢ t_z."""
    qx, qy, qz, qw = quat_product(x[j + 3], x[j + 4], x[j + 5], x[j + 6], -p[k + 3], -p[k + 4], -p[k + 5], p[k + 6])
    scale = 1.0 / math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    x[i + 3], x[i + 4], x[i + 5], x[i + 6] = scale * qx, scale * qy, scale * qz, scale * qw
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    x[i] = x[j] - a0 * p[k] - a1 * p[k + 1] - a2 * p[k + 2]
    x[i + 1] = x[j + 1] - a3 * p[k] - a4 * p[k + 1] - a5 * p[k + 2]
    x[i + 2] = x[j + 2] - a6 * p[k] - a7 * p[k + 1] - a8 * p[k + 2]


@inline_kernel
def place_landmark_se3(x: F64, i: int, p: F64, k: int, j: int) -> None:
    """lⱼ = tᵢ + Rᵢ z."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    x[j] = x[i] + a0 * p[k] + a1 * p[k + 1] + a2 * p[k + 2]
    x[j + 1] = x[i + 1] + a3 * p[k] + a4 * p[k + 1] + a5 * p[k + 2]
    x[j + 2] = x[i + 2] + a6 * p[k] + a7 * p[k + 1] + a8 * p[k + 2]
