"""Plane poses x = (x, y, θ): residuals and Jacobians of one factor, ⊞, composition.  MATH §2.1, §3.

Every residual kernel has the same eight arguments: `x` the arena of values with the variables at offsets i and j,
`p` the arena of payloads with the measurement z at k; it fills r (6,), A = ∂r/∂xᵢ and B = ∂r/∂xⱼ (6, 6), each in
its upper left corner.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel

_TWO_PI = 2.0 * math.pi
SMALL_ANGLE = 0.1  # radians: below it the series of sine and cosine are exact to rounding


@inline_kernel
def wrap(angle: float) -> float:
    """The same angle in [−π, π); an angle that is there already keeps its bits."""
    wrapped = angle - _TWO_PI * math.floor((angle + math.pi) / _TWO_PI)
    return wrapped - _TWO_PI if wrapped >= math.pi else wrapped


@inline_kernel
def small_turn(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle below SMALL_ANGLE, by series that are exact to rounding."""
    q = angle * angle
    c = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0 - q * (1.0 / 40320.0))))
    s = angle * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5040.0 - q * (1.0 / 362880.0)))))
    return c, s


@inline_kernel
def prior_se2(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """r = z⁻¹ x.  MATH (3.1)"""
    c, s = math.cos(p[k + 2]), math.sin(p[k + 2])
    dx, dy = x[i] - p[k], x[i + 1] - p[k + 1]
    r[0] = c * dx + s * dy
    r[1] = c * dy - s * dx
    r[2] = wrap(x[i + 2] - p[k + 2])
    c, s = math.cos(r[2]), math.sin(r[2])
    A[0, 0], A[0, 1], A[0, 2] = c, -s, 0.0
    A[1, 0], A[1, 1], A[1, 2] = s, c, 0.0
    A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, 1.0


@inline_kernel
def between_se2(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """r = z⁻¹ (xᵢ⁻¹ xⱼ).  MATH (3.2)

    d = Rᵢᵀ (tⱼ − tᵢ);  r = (R_zᵀ (d − t_z), wrap(θⱼ − θᵢ − θ_z))
    A = [ −R_zᵀ | R_zᵀ (d_y, −d_x)ᵀ ; 0 | −1 ],   B = [ R_zᵀ Rᵢᵀ Rⱼ | 0 ; 0 | 1 ]
    """
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    tx, ty = x[j] - x[i], x[j + 1] - x[i + 1]
    dx, dy = c * tx + s * ty, c * ty - s * tx
    cz, sz = math.cos(p[k + 2]), math.sin(p[k + 2])
    ex, ey = dx - p[k], dy - p[k + 1]
    r[0] = cz * ex + sz * ey
    r[1] = cz * ey - sz * ex
    r[2] = wrap(x[j + 2] - x[i + 2] - p[k + 2])
    A[0, 0], A[0, 1], A[0, 2] = -cz, -sz, cz * dy - sz * dx
    A[1, 0], A[1, 1], A[1, 2] = sz, -cz, -cz * dx - sz * dy
    A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, -1.0
    c, s = math.cos(r[2]), math.sin(r[2])
    B[0, 0], B[0, 1], B[0, 2] = c, -s, 0.0
    B[1, 0], B[1, 1], B[1, 2] = s, c, 0.0
    B[2, 0], B[2, 1], B[2, 2] = 0.0, 0.0, 1.0


@inline_kernel
def landmark_se2(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """A point seen from a pose: r = u − z, u = Rᵢᵀ (lⱼ − tᵢ).  MATH (3.3)

    A = [ −I | (u_y, −u_x)ᵀ ],   B = Rᵢᵀ
    """
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    tx, ty = x[j] - x[i], x[j + 1] - x[i + 1]
    ux, uy = c * tx + s * ty, c * ty - s * tx
    r[0], r[1] = ux - p[k], uy - p[k + 1]
    A[0, 0], A[0, 1], A[0, 2] = -1.0, 0.0, uy
    A[1, 0], A[1, 1], A[1, 2] = 0.0, -1.0, -ux
    B[0, 0], B[0, 1] = c, s
    B[1, 0], B[1, 1] = -s, c


@inline_kernel
def bearing_range_se2(x: F64, i: int, j: int, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """A point seen from a pose at a bearing and a range: r = (wrap(atan2(u_y, u_x) − β), |u| − ρ).  MATH (3.4)

    With g = ∂(bearing, range)/∂u = [ (−u_y, u_x) / |u|² ; (u_x, u_y) / |u| ] the Jacobians are g times those of
    `landmark_se2`.  At u = 0 there is no bearing; g is taken as zero there, so that a point may lie on a pose.
    """
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    tx, ty = x[j] - x[i], x[j + 1] - x[i + 1]
    ux, uy = c * tx + s * ty, c * ty - s * tx
    distance = math.sqrt(ux * ux + uy * uy)
    inverse = 1.0 / distance if distance > 1e-150 else 0.0
    nx, ny = ux * inverse, uy * inverse
    r[0] = wrap(math.atan2(uy, ux) - p[k])
    r[1] = distance - p[k + 1]
    gx, gy = -ny * inverse, nx * inverse
    A[0, 0], A[0, 1], A[0, 2] = -gx, -gy, gx * uy - gy * ux
    A[1, 0], A[1, 1], A[1, 2] = -nx, -ny, nx * uy - ny * ux
    B[0, 0], B[0, 1] = gx * c - gy * s, gx * s + gy * c
    B[1, 0], B[1, 1] = nx * c - ny * s, nx * s + ny * c


@inline_kernel
def move_se2(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """out = x ⊞ δ = (t + R δt, wrap(θ + δθ)), both at offset i; δ at offset d.  MATH (2.1)"""
    turn_se2(x, i, math.cos(x[i + 2]), math.sin(x[i + 2]), step, d, out)


@inline_kernel
def turn_se2(x: F64, i: int, c: float, s: float, step: F64, d: int, out: F64) -> None:
    """The same where c, s = cos θ, sin θ are known."""
    out[i] = x[i] + c * step[d] - s * step[d + 1]
    out[i + 1] = x[i + 1] + s * step[d] + c * step[d + 1]
    out[i + 2] = wrap(x[i + 2] + step[d + 2])


@inline_kernel
def compose_se2(x: F64, i: int, p: F64, k: int, j: int) -> None:
    """xⱼ = xᵢ z."""
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    x[j] = x[i] + c * p[k] - s * p[k + 1]
    x[j + 1] = x[i + 1] + s * p[k] + c * p[k + 1]
    x[j + 2] = wrap(x[i + 2] + p[k + 2])


@inline_kernel
def compose_inverse_se2(x: F64, j: int, p: F64, k: int, i: int) -> None:
    """xᵢ = xⱼ z⁻¹."""
    theta = wrap(x[j + 2] - p[k + 2])
    c, s = math.cos(theta), math.sin(theta)
    x[i] = x[j] - c * p[k] + s * p[k + 1]
    x[i + 1] = x[j + 1] - s * p[k] - c * p[k + 1]
    x[i + 2] = theta


@inline_kernel
def place_landmark_se2(x: F64, i: int, p: F64, k: int, j: int) -> None:
    """lⱼ = tᵢ + Rᵢ z."""
    c, s = math.cos(x[i + 2]), math.sin(x[i + 2])
    x[j] = x[i] + c * p[k] - s * p[k + 1]
    x[j + 1] = x[i + 1] + s * p[k] + c * p[k + 1]


@inline_kernel
def place_bearing_range_se2(x: F64, i: int, p: F64, k: int, j: int) -> None:
    """lⱼ = tᵢ + ρ (cos, sin)(θᵢ + β)."""
    angle = x[i + 2] + p[k]
    x[j] = x[i] + p[k + 1] * math.cos(angle)
    x[j + 1] = x[i + 1] + p[k + 1] * math.sin(angle)
