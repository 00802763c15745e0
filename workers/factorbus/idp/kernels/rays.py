"""Pixels to features: y, how it turns with the camera, and how it moves with the pixel.  MATH §3, §4.

A feature is y = (x y z, θ, φ, ρ): the camera's position when it was first seen (metres), azimuth and elevation of its
ray in the world (radians), inverse distance along the ray (1/metre).

    h_W = R(q) h,   θ = atan2(h_x, h_z),   φ = atan2(−h_y, s),   s = √(h_x² + h_z²)          (3.1)

Azimuth and elevation depend on the camera's attitude through its small rotation δ (world axes, radians) alone:

    ∂(θ, φ)/∂δ = G = [ tan φ sin θ   1   tan φ cos θ ;  cos θ   0   −sin θ ]                   (3.2)
    ∂(θ, φ)/∂q = G T(q),   T = 2/|q|² [ −n | q0 I + ⌊n⌋ ],   q = (q0, n)                      (3.3)
    ∂(θ, φ)/∂(u, v) = M = ∂(θ, φ)/∂h_W R(q) ∂h/∂(u, v)                                        (3.4)
"""

import math

from factorbus.idp.kernels.camera import CAMERA_MODEL, CameraModel
from factorbus.idp.kernels.compile import F64, I64, inline_kernel, kernel, types
from factorbus.idp.kernels.layout import NOT_FINITE, OUTSIDE_IMAGE, VERTICAL, Q, R
from factorbus.solver.lenses.models import ray

# sin of the smallest angle between a ray and the vertical axis: nearer, azimuth is noise.
_VERTICAL = 1e-6


@kernel(types.void(CAMERA_MODEL, types.float64[::1], types.float64, *[types.float64[:, ::1]] * 4, types.int64[::1]))
def features_of_pixels(
    camera: CameraModel, x: F64, rho: float, pixels: F64, y: F64, turn: F64, slope: F64, status: I64
) -> None:
    """Features of distorted pixels.  MATH (3.1) to (3.4)

    in   x (13,) camera state   pixels (n, 2)   rho: of all of them
    out  y (n, 6)   turn (n, 4): tan φ sin θ, tan φ cos θ, cos θ, sin θ   slope (n, 4): M row by row   status (n,)
    """
    width, height = camera.width, camera.height
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = camera_rotation(x)
    for k in range(pixels.shape[0]):
        u, v = pixels[k, 0], pixels[k, 1]
        good, a, b, c, d0, d1, d2, d3, d4, d5 = ray(camera.model, camera.lens, u, v)
        if width > 0.0 and not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            good = OUTSIDE_IMAGE
        hx, hy, hz = r0 * a + r1 * b + r2 * c, r3 * a + r4 * b + r5 * c, r6 * a + r7 * b + r8 * c
        s2 = hx * hx + hz * hz
        n2 = s2 + hy * hy
        s = math.sqrt(s2)
        if not s2 > _VERTICAL * _VERTICAL * n2:
            good, s, n2 = VERTICAL, 1.0, 1.0
        if not (abs(u) < math.inf and abs(v) < math.inf):
            good = NOT_FINITE
        status[k] = good
        sine, cosine, tangent = hx / s, hz / s, -hy / s
        y[k, 0], y[k, 1], y[k, 2] = x[R], x[R + 1], x[R + 2]
        y[k, 3], y[k, 4], y[k, 5] = math.atan2(hx, hz), math.atan2(-hy, s), rho
        turn[k, 0], turn[k, 1], turn[k, 2], turn[k, 3] = tangent * sine, tangent * cosine, cosine, sine
        # ∂θ/∂h_W = (cos θ, 0, −sin θ)/s;  ∂φ/∂h_W = (h_x h_y/s, −s, h_z h_y/s)/n²
        e0, e2 = cosine / s, -sine / s
        f0, f1, f2 = sine * hy / n2, -s / n2, cosine * hy / n2
        for j in range(2):
            du, dv, dw = (d0, d2, d4) if j == 0 else (d1, d3, d5)
            gx, gy, gz = r0 * du + r1 * dv + r2 * dw, r3 * du + r4 * dv + r5 * dw, r6 * du + r7 * dv + r8 * dw
            slope[k, j] = e0 * gx + e2 * gz
            slope[k, 2 + j] = f0 * gx + f1 * gy + f2 * gz


@kernel("void(float64[::1], float64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1])")
def feature_jacobians(x: F64, turn: F64, slope: F64, A: F64, B: F64) -> None:
    """The dense Jacobians.  MATH (4.1), (4.2)

        A = ∂y/∂x_v:  I under r for (x, y, z);  G T under q for (θ, φ)
        B = ∂y/∂h_d, h_d = (u, v, ρ):  M for (θ, φ);  1 for ρ

    in   x (13,)  turn, slope (n, 4) as from `features_of_pixels`
    out  A (n, 6, 13)   B (n, 6, 3)
    """
    t00, t01, t02, t03, t10, t11, t12, t13, t20, t21, t22, t23 = turning(x)
    for k in range(turn.shape[0]):
        a, b, c, d = turn[k, 0], turn[k, 1], turn[k, 2], turn[k, 3]
        A[k, :, :] = 0.0
        A[k, 0, R], A[k, 1, R + 1], A[k, 2, R + 2] = 1.0, 1.0, 1.0
        A[k, 3, Q], A[k, 3, Q + 1] = a * t00 + t10 + b * t20, a * t01 + t11 + b * t21
        A[k, 3, Q + 2], A[k, 3, Q + 3] = a * t02 + t12 + b * t22, a * t03 + t13 + b * t23
        A[k, 4, Q], A[k, 4, Q + 1] = c * t00 - d * t20, c * t01 - d * t21
        A[k, 4, Q + 2], A[k, 4, Q + 3] = c * t02 - d * t22, c * t03 - d * t23
        B[k, :, :] = 0.0
        B[k, 3, 0], B[k, 3, 1], B[k, 4, 0], B[k, 4, 1] = slope[k, 0], slope[k, 1], slope[k, 2], slope[k, 3]
        B[k, 5, 2] = 1.0


@inline_kernel
def camera_rotation(x: F64) -> tuple:
    """R(q) of the state's quaternion row by row, not normalized: R(s q) = s² R(q).  MATH (1.1)"""
    a, b, c, d = x[Q], x[Q + 1], x[Q + 2], x[Q + 3]
    return (
        a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (d * b + a * c),
        2.0 * (b * c + a * d), a * a - b * b + c * c - d * d, 2.0 * (c * d - a * b),
        2.0 * (d * b - a * c), 2.0 * (c * d + a * b), a * a - b * b - c * c + d * d,
    )  # fmt: skip


@inline_kernel
def turning(x: F64) -> tuple:
    """T(q) row by row, 3 × 4: the small rotation δ = T dq about the world's axes that a change dq makes.  MATH (3.3)"""
    a, b, c, d = x[Q], x[Q + 1], x[Q + 2], x[Q + 3]
    t = 2.0 / (a * a + b * b + c * c + d * d)
    a, b, c, d = t * a, t * b, t * c, t * d
    return (-b, a, -d, c, -c, d, a, -b, -d, -c, b, a)
