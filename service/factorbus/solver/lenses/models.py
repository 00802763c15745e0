"""Lenses: from a distorted pixel to a ray, from a ray to a distorted pixel, each with its Jacobian.  MATH §2 (workers).

Camera axes: x right, y down, z forward.  A ray h is a direction in them; its length means nothing.  All models give

    ray      (status, h_x, h_y, h_z,  ∂h/∂(u, v) row by row: six numbers)
    project  (status, u, v,  ∂(u, v)/∂h row by row: six numbers)
"""

import math

from factorbus.solver.lenses.compile import F64, inline_kernel
from factorbus.solver.lenses.layout import CX, CY, FISHEYE, FU, FV, GOOD, LIMIT, MORE, OUTSIDE_LENS, RADTAN

# Newton's method doubles the digits a step: from anywhere sensible, ten are plenty.
_STEPS = 30
_CLOSE = 1e-15


@inline_kernel
def ray(model: int, lens: F64, u: float, v: float) -> tuple:
    """The ray of distorted pixel (u, v)."""
    if model == RADTAN:
        return ray_radtan(lens, u, v)
    if model == FISHEYE:
        return ray_fisheye(lens, u, v)
    return ray_radial(lens, u, v)


@inline_kernel
def project(model: int, lens: F64, hx: float, hy: float, hz: float) -> tuple:
    """The distorted pixel of ray h; OUTSIDE_LENS where the lens shows nothing of it."""
    if model == RADTAN:
        return project_radtan(lens, hx, hy, hz)
    if model == FISHEYE:
        return project_fisheye(lens, hx, hy, hz)
    return project_radial(lens, hx, hy, hz)


@inline_kernel
def undistort_radial(lens: F64, u: float, v: float) -> tuple:
    """(D, J_u row by row) of the two-parameter radial model at distorted pixel (u, v).  MATH (2.1), (2.2)

    x_d = (u − C_x) d_x, y_d = (v − C_y) d_y in mm;  D = 1 + k1 r_d² + k2 r_d⁴;  g = 2 (k1 + 2 k2 r_d²)
    undistorted pixel (C_x + D (u − C_x), C_y + D (v − C_y))
    J_u = [ D + g x_d²   g x_d y_d d_y/d_x ; g x_d y_d d_x/d_y   D + g y_d² ]
    """
    dx, dy, k1, k2 = lens[MORE], lens[MORE + 1], lens[MORE + 2], lens[MORE + 3]
    x, y = (u - lens[CX]) * dx, (v - lens[CY]) * dy
    r2 = x * x + y * y
    D = 1.0 + (k1 + k2 * r2) * r2
    g = 2.0 * (k1 + 2.0 * k2 * r2)
    return D, D + g * x * x, g * x * y * (dy / dx), g * x * y * (dx / dy), D + g * y * y


@inline_kernel
def ray_radial(lens: F64, u: float, v: float) -> tuple:
    """h = ((u_u − C_x)/f_u, (v_u − C_y)/f_v, 1).  MATH (2.3)"""
    D, j00, j01, j10, j11 = undistort_radial(lens, u, v)
    fu, fv = lens[FU], lens[FV]
    a, b = u - lens[CX], v - lens[CY]
    x, y = a * lens[MORE], b * lens[MORE + 1]
    status = GOOD if math.sqrt(x * x + y * y) < lens[LIMIT] else OUTSIDE_LENS
    return status, a * D / fu, b * D / fv, 1.0, j00 / fu, j01 / fu, j10 / fv, j11 / fv, 0.0, 0.0


@inline_kernel
def project_radial(lens: F64, hx: float, hy: float, hz: float) -> tuple:
    """Undistorted pixel, then r_d from r_d + k1 r_d³ + k2 r_d⁵ = r_u by Newton's method.  MATH (2.4)

    ∂(u, v)/∂h = J_u⁻¹ ∂(u_u, v_u)/∂h, J_u at the distorted pixel.
    """
    fu, fv, dx, dy, k1, k2 = lens[FU], lens[FV], lens[MORE], lens[MORE + 1], lens[MORE + 2], lens[MORE + 3]
    a, b = fu * hx / hz, fv * hy / hz
    x, y = a * dx, b * dy
    ru = math.sqrt(x * x + y * y)
    limit = lens[LIMIT]
    status = GOOD
    if not hz > 0.0 or (limit < math.inf and not ru < limit * (1.0 + (k1 + k2 * limit * limit) * limit * limit)):
        status = OUTSIDE_LENS
    rd = min(ru, limit)
    if k1 >= 0.0 and k2 > 0.0:  # far outside: not far above r_d, where the first steps take a fifth off at a time
        rd = min(rd, (ru / k2) ** 0.2)
    for _ in range(_STEPS):
        r2 = rd * rd
        slope = 1.0 + (3.0 * k1 + 5.0 * k2 * r2) * r2
        if not slope > 0.0:  # at the limit
            break
        step = (rd * (1.0 + (k1 + k2 * r2) * r2) - ru) / slope
        rd = min(max(rd - step, 0.0), limit)
        if abs(step) <= _CLOSE * rd:
            break
    D = 1.0 + (k1 + k2 * rd * rd) * rd * rd
    u, v = lens[CX] + a / D, lens[CY] + b / D
    _, j00, j01, j10, j11 = undistort_radial(lens, u, v)
    det = j00 * j11 - j01 * j10
    e0, e1, f0, f1 = fu / hz, -a / hz, fv / hz, -b / hz
    return (
        status, u, v, j11 * e0 / det, -j01 * f0 / det, (j11 * e1 - j01 * f1) / det,
        -j10 * e0 / det, j00 * f0 / det, (j00 * f1 - j10 * e1) / det,
    )  # fmt: skip


@inline_kernel
def distort_radtan(lens: F64, x: float, y: float) -> tuple:
    """(x', y', ∂(x', y')/∂(x, y) row by row) of OpenCV's radial–tangential model.  MATH (2.5)

    L = 1 + k1 r² + k2 r⁴ + k3 r⁶
    x' = L x + 2 p1 x y + p2 (r² + 2 x²),   y' = L y + p1 (r² + 2 y²) + 2 p2 x y
    """
    k1, k2, p1, p2, k3 = lens[MORE], lens[MORE + 1], lens[MORE + 2], lens[MORE + 3], lens[MORE + 4]
    r2 = x * x + y * y
    L = 1.0 + (k1 + (k2 + k3 * r2) * r2) * r2
    g = 2.0 * (k1 + (2.0 * k2 + 3.0 * k3 * r2) * r2)  # ∂L/∂x = g x
    cross = g * x * y + 2.0 * (p1 * x + p2 * y)
    return (
        L * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        L * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        L + g * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        cross,
        cross,
        L + g * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@inline_kernel
def ray_radtan(lens: F64, u: float, v: float) -> tuple:
    """h = (x, y, 1) with distort(x, y) = ((u − C_x)/f_u, (v − C_y)/f_v), by Newton's method.  MATH (2.6)"""
    fu, fv, limit = lens[FU], lens[FV], lens[LIMIT]
    a, b = (u - lens[CX]) / fu, (v - lens[CY]) / fv
    x, y = a, b
    status = OUTSIDE_LENS
    for _ in range(_STEPS):
        xd, yd, j00, j01, j10, j11 = distort_radtan(lens, x, y)
        det = j00 * j11 - j01 * j10
        if not abs(det) > 0.0:
            break
        sx, sy = (j11 * (xd - a) - j01 * (yd - b)) / det, (j00 * (yd - b) - j10 * (xd - a)) / det
        x, y = x - sx, y - sy
        if abs(sx) + abs(sy) <= 4.0 * _CLOSE * (1.0 + abs(x) + abs(y)):
            status = GOOD
            break
    _, _, j00, j01, j10, j11 = distort_radtan(lens, x, y)
    det = j00 * j11 - j01 * j10
    if not (det > 0.0 and math.sqrt(x * x + y * y) < limit):
        status, det = OUTSIDE_LENS, 1.0
    return status, x, y, 1.0, j11 / (det * fu), -j01 / (det * fv), -j10 / (det * fu), j00 / (det * fv), 0.0, 0.0


@inline_kernel
def project_radtan(lens: F64, hx: float, hy: float, hz: float) -> tuple:
    """(u, v) = (C_x + f_u x', C_y + f_v y') with x = h_x/h_z, y = h_y/h_z.  MATH (2.5)"""
    fu, fv = lens[FU], lens[FV]
    x, y = hx / hz, hy / hz
    status = GOOD if hz > 0.0 and math.sqrt(x * x + y * y) < lens[LIMIT] else OUTSIDE_LENS
    xd, yd, j00, j01, j10, j11 = distort_radtan(lens, x, y)
    return (
        status, lens[CX] + fu * xd, lens[CY] + fv * yd,
        fu * j00 / hz, fu * j01 / hz, -fu * (j00 * x + j01 * y) / hz,
        fv * j10 / hz, fv * j11 / hz, -fv * (j10 * x + j11 * y) / hz,
    )  # fmt: skip


@inline_kernel
def distort_fisheye(lens: F64, theta: float) -> tuple:
    """(θ_d, dθ_d/dθ) of OpenCV's fisheye model: θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸).  MATH (2.7)"""
    k1, k2, k3, k4 = lens[MORE], lens[MORE + 1], lens[MORE + 2], lens[MORE + 3]
    t = theta * theta
    L = 1.0 + (k1 + (k2 + (k3 + k4 * t) * t) * t) * t
    return theta * L, 1.0 + (3.0 * k1 + (5.0 * k2 + (7.0 * k3 + 9.0 * k4 * t) * t) * t) * t


@inline_kernel
def ray_fisheye(lens: F64, u: float, v: float) -> tuple:
    """h = (s w_x, s w_y, cos θ), of unit length, also for θ ≥ 90°.  MATH (2.8)

    w = ((u − C_x)/f_u, (v − C_y)/f_v), θ_d = |w|, θ by Newton's method, s = sin θ / θ_d
    ∂h_xy/∂w = s I + t w wᵀ with t = (ds/dθ_d)/θ_d, ∂h_z/∂w = −(sin θ / θ_d) (dθ/dθ_d) wᵀ
    """
    fu, fv, limit = lens[FU], lens[FV], lens[LIMIT]
    a, b = (u - lens[CX]) / fu, (v - lens[CY]) / fv
    d = math.sqrt(a * a + b * b)
    theta = min(d, limit)
    status = OUTSIDE_LENS
    for _ in range(_STEPS):
        seen, slope = distort_fisheye(lens, theta)
        if not slope > 0.0:  # at the limit
            break
        step = (seen - d) / slope
        theta = min(max(theta - step, 0.0), limit)
        if abs(step) <= 4.0 * _CLOSE * (1.0 + theta):
            status = GOOD
            break
    _, slope = distort_fisheye(lens, theta)
    if not (theta < limit and slope > 0.0):
        status, slope = OUTSIDE_LENS, 1.0
    sine, cosine = math.sin(theta), math.cos(theta)
    s, t = 1.0, 0.0
    if d > 1e-8:
        s = sine / d
        t = (cosine / slope - s) / (d * d)
    z = -s / slope
    return (
        status, s * a, s * b, cosine,
        (s + t * a * a) / fu, t * a * b / fv, t * a * b / fu, (s + t * b * b) / fv, z * a / fu, z * b / fv,
    )  # fmt: skip


@inline_kernel
def project_fisheye(lens: F64, hx: float, hy: float, hz: float) -> tuple:
    """θ = atan2(|h_xy|, h_z), w = (θ_d/|h_xy|) h_xy, (u, v) = (C_x + f_u w_x, C_y + f_v w_y).  MATH (2.7)

    ∂w/∂h_xy = m I + c h_xy h_xyᵀ, ∂w/∂h_z = −(dθ_d/dθ)/|h|² h_xy, with m = θ_d/|h_xy| and
    c = ((dθ_d/dθ) h_z/|h|² − m)/|h_xy|², all of h/|h|_∞: squares of its numbers are neither 0 nor infinite then
    """
    size, limit = max(abs(hx), abs(hy), abs(hz)), lens[LIMIT]
    hx, hy, hz = hx / size, hy / size, hz / size
    r2 = hx * hx + hy * hy
    n2 = r2 + hz * hz
    r = math.sqrt(r2)
    theta = math.atan2(r, hz)
    status = GOOD if theta < limit and 0.0 < n2 < math.inf else OUTSIDE_LENS
    d, slope = distort_fisheye(lens, theta)
    m, c = 1.0 / hz, 0.0
    if r > 1e-8 * abs(hz):
        m = d / r
        c = (slope * hz / n2 - m) / r2
    z = -slope / n2
    u, v, fu, fv = lens[CX] + lens[FU] * m * hx, lens[CY] + lens[FV] * m * hy, lens[FU] / size, lens[FV] / size
    return (
        status, u, v,
        fu * (m + c * hx * hx), fu * c * hx * hy, fu * z * hx,
        fv * c * hx * hy, fv * (m + c * hy * hy), fv * z * hy,
    )  # fmt: skip
