"""Features and rays to pixels, with Jacobians: what a filter predicts it will see.  MATH §6."""

import math

from factorbus.idp.kernels.camera import CAMERA_MODEL, CameraModel
from factorbus.idp.kernels.compile import F64, I64, inline_kernel, kernel, types
from factorbus.idp.kernels.layout import BEHIND, GOOD, NOT_FINITE, OUTSIDE_IMAGE, OUTSIDE_LENS, Q, R
from factorbus.idp.kernels.rays import camera_rotation, turning
from factorbus.solver.lenses.models import project, ray

_CUBE = types.float64[:, :, ::1]
_MATRIX = types.float64[:, ::1]
_STATUS = types.int64[::1]


@kernel(types.void(CAMERA_MODEL, types.float64[::1], _MATRIX, _MATRIX, _CUBE, _CUBE, _STATUS))
def observe(camera: CameraModel, x: F64, y: F64, h: F64, Hx: F64, Hy: F64, status: I64) -> None:
    """Distorted pixels of features, by the camera's state and by the feature.  MATH (6.1), (6.2)

        a = ((x, y, z) − r) ρ + m(θ, φ),   h_C = R(q)ᵀ a,   h = pixel of h_C,   F = ∂h/∂h_C R(q)ᵀ
        ∂h/∂r = −ρ F,  ∂h/∂q = F ⌊a⌋ T(q),  ∂h/∂(x, y, z) = ρ F,  ∂h/∂θ = F m_θ,  ∂h/∂φ = F m_φ,
        ∂h/∂ρ = F ((x, y, z) − r)

    in   x (13,)   y (n, 6)
    out  h (n, 2)   Hx (n, 2, 13)   Hy (n, 2, 6)   status (n,)
    """
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = camera_rotation(x)
    t00, t01, t02, t03, t10, t11, t12, t13, t20, t21, t22, t23 = turning(x)
    Hx[:, :, :] = 0.0
    for k in range(y.shape[0]):
        rho, st, ct, sp, cp = y[k, 5], math.sin(y[k, 3]), math.cos(y[k, 3]), math.sin(y[k, 4]), math.cos(y[k, 4])
        dx, dy, dz = y[k, 0] - x[R], y[k, 1] - x[R + 1], y[k, 2] - x[R + 2]
        a0, a1, a2 = dx * rho + cp * st, dy * rho - sp, dz * rho + cp * ct
        c0, c1, c2 = r0 * a0 + r3 * a1 + r6 * a2, r1 * a0 + r4 * a1 + r7 * a2, r2 * a0 + r5 * a1 + r8 * a2
        good, u, v, e0, e1, e2, e3, e4, e5 = project(camera.model, camera.lens, c0, c1, c2)
        h[k, 0], h[k, 1] = u, v
        status[k] = pixel_status(camera, good, c2, u, v)
        for i in range(2):
            g0, g1, g2 = (e0, e1, e2) if i == 0 else (e3, e4, e5)
            f0, f1, f2 = g0 * r0 + g1 * r1 + g2 * r2, g0 * r3 + g1 * r4 + g2 * r5, g0 * r6 + g1 * r7 + g2 * r8
            Hx[k, i, R], Hx[k, i, R + 1], Hx[k, i, R + 2] = -rho * f0, -rho * f1, -rho * f2
            b0, b1, b2 = f1 * a2 - f2 * a1, f2 * a0 - f0 * a2, f0 * a1 - f1 * a0  # F ⌊a⌋
            Hx[k, i, Q], Hx[k, i, Q + 1] = b0 * t00 + b1 * t10 + b2 * t20, b0 * t01 + b1 * t11 + b2 * t21
            Hx[k, i, Q + 2], Hx[k, i, Q + 3] = b0 * t02 + b1 * t12 + b2 * t22, b0 * t03 + b1 * t13 + b2 * t23
            Hy[k, i, 0], Hy[k, i, 1], Hy[k, i, 2] = rho * f0, rho * f1, rho * f2
            Hy[k, i, 3] = cp * (f0 * ct - f2 * st)
            Hy[k, i, 4] = -f0 * sp * st - f1 * cp - f2 * sp * ct
            Hy[k, i, 5] = f0 * dx + f1 * dy + f2 * dz


@kernel(types.void(CAMERA_MODEL, _MATRIX, _MATRIX, _CUBE, _STATUS))
def project_rays(camera: CameraModel, rays: F64, h: F64, slope: F64, status: I64) -> None:
    """Distorted pixels of rays in camera axes.  MATH §2

    in   rays (n, 3)
    out  h (n, 2)   slope (n, 2, 3) = ∂(u, v)/∂ray   status (n,)
    """
    for k in range(rays.shape[0]):
        good, u, v, e0, e1, e2, e3, e4, e5 = project(camera.model, camera.lens, rays[k, 0], rays[k, 1], rays[k, 2])
        h[k, 0], h[k, 1] = u, v
        slope[k, 0, 0], slope[k, 0, 1], slope[k, 0, 2] = e0, e1, e2
        slope[k, 1, 0], slope[k, 1, 1], slope[k, 1, 2] = e3, e4, e5
        status[k] = pixel_status(camera, good, rays[k, 2], u, v)


@kernel(types.void(CAMERA_MODEL, _MATRIX, _MATRIX, _CUBE, _STATUS))
def unproject_pixels(camera: CameraModel, pixels: F64, rays: F64, slope: F64, status: I64) -> None:
    """Rays of distorted pixels in camera axes.  MATH §2

    in   pixels (n, 2)
    out  rays (n, 3)   slope (n, 3, 2) = ∂ray/∂(u, v)   status (n,)
    """
    for k in range(pixels.shape[0]):
        good, a, b, c, d0, d1, d2, d3, d4, d5 = ray(camera.model, camera.lens, pixels[k, 0], pixels[k, 1])
        rays[k, 0], rays[k, 1], rays[k, 2] = a, b, c
        slope[k, 0, 0], slope[k, 0, 1] = d0, d1
        slope[k, 1, 0], slope[k, 1, 1] = d2, d3
        slope[k, 2, 0], slope[k, 2, 1] = d4, d5
        finite = abs(pixels[k, 0]) < math.inf and abs(pixels[k, 1]) < math.inf
        status[k] = good if finite else NOT_FINITE


@kernel(
    "void(float64[::1], float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], float64[:,:,::1], "
    "float64[::1])"
)
def points(x: F64, y: F64, Pyy: F64, J: F64, p: F64, Ppp: F64, linearity: F64) -> None:
    """Features as points, with covariance, and how good a Gaussian that is.  MATH (6.3), (6.4)

        p = (x, y, z) + m(θ, φ)/ρ,   ∂p/∂y = [ I | m_θ/ρ | m_φ/ρ | −m/ρ² ]
        linearity = 4 (σ_ρ/ρ²) |cos α| / |p − r|,  α the angle at p between the anchor and the present camera

    in   x (13,)   y (n, 6)   Pyy (n, 6, 6)
    work J (3, 6)
    out  p (n, 3) metres   Ppp (n, 3, 3) metres²   linearity (n,)
    """
    for k in range(y.shape[0]):
        st, ct, sp, cp = math.sin(y[k, 3]), math.cos(y[k, 3]), math.sin(y[k, 4]), math.cos(y[k, 4])
        d = 1.0 / y[k, 5]
        m0, m1, m2 = cp * st, -sp, cp * ct
        p[k, 0], p[k, 1], p[k, 2] = y[k, 0] + m0 * d, y[k, 1] + m1 * d, y[k, 2] + m2 * d
        J[:, :] = 0.0
        J[0, 0], J[1, 1], J[2, 2] = 1.0, 1.0, 1.0
        J[0, 3], J[2, 3] = m2 * d, -m0 * d
        J[0, 4], J[1, 4], J[2, 4] = -sp * st * d, -cp * d, -sp * ct * d
        J[0, 5], J[1, 5], J[2, 5] = -m0 * d * d, -m1 * d * d, -m2 * d * d
        for a in range(3):
            for b in range(a, 3):
                total = 0.0
                for i in range(6):
                    for j in range(6):
                        total += J[a, i] * Pyy[k, i, j] * J[b, j]
                Ppp[k, a, b], Ppp[k, b, a] = total, total
        u0, u1, u2 = p[k, 0] - x[R], p[k, 1] - x[R + 1], p[k, 2] - x[R + 2]
        distance = math.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
        cosine = (u0 * m0 + u1 * m1 + u2 * m2) / distance
        linearity[k] = 4.0 * math.sqrt(Pyy[k, 5, 5]) * d * d * abs(cosine) / distance


@inline_kernel
def pixel_status(camera: CameraModel, good: int, depth: float, u: float, v: float) -> int:
    """The status of a pixel that the lens gave: whether it is one, in front, and in the image."""
    if good != GOOD:
        return OUTSIDE_LENS if depth > 0.0 else BEHIND
    if not (abs(u) < math.inf and abs(v) < math.inf and abs(depth) < math.inf):
        return NOT_FINITE
    width, height = camera.width, camera.height
    if width > 0.0 and not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        return OUTSIDE_IMAGE
    return GOOD
