"""Lenses whose numbers are variables: f alone, f k1 k2 as in Bundler, or fx fy cx cy k1 k2 p1 p2 k3.  MATH §3.9.

They take the place of those in the measurement, and the residual is that of the base kind with them.  With h the point
in the camera, x = h_x/h_z, y = h_y/h_z, ρ² = x² + y², (x', y') distorted as in workers/MATH (2.5), f_u = f, f_v = f a

    ∂(u, v)/∂f = (u − c_x, v − c_y)/f,    ∂u/∂f_u = x',    ∂v/∂f_v = y',    ∂(u, v)/∂(c_x, c_y) = I            (3.54)
    ∂(x', y')/∂(k1, k2, k3) = (x, y) (ρ², ρ⁴, ρ⁶),    ∂(x', y')/∂p1 = (2 x y, ρ² + 2 y²),
    ∂(x', y')/∂p2 = (ρ² + 2 x², 2 x y)

a = f_v/f_u of the measurement.  Of the radial model pixels are undistorted, and ∂(u, v)/∂f = −(h_z/f) ∂(u, v)/∂h_z.
"""

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import INACTIVE_CHI2
from factorbus.solver.kernels.model.kinds import BUNDLER, FOCAL, INTRINSICS, end_of_modifier
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.kernels.model.se3 import rotation_matrix
from factorbus.solver.lenses.layout import CX, CY, FU, FV, GOOD, LENS_SIZE, LIMIT, MORE, NO_FOCAL_LENGTH, RADIAL
from factorbus.solver.lenses.limits import UNLIMITED

CODE, LENS = 2, 3  # where they begin in what a point_seen measures


@inline_kernel
def put_lens(kind: int, x: F64, places: I64, z: F64) -> None:
    """The numbers of the lens that are variables into the measurement z.

    A model whose distortion is a variable has no limit: where it is one to one is not known beforehand.
    """
    focal, bundler, all_of_it = (
        end_of_modifier(kind, FOCAL),
        end_of_modifier(kind, BUNDLER),
        end_of_modifier(kind, INTRINSICS),
    )
    if all_of_it >= 0:
        i = places[all_of_it]
        for c in range(4):
            z[LENS + c] = x[i + c]
        for c in range(LENS_SIZE - MORE):
            z[LENS + MORE + c] = x[i + 4 + c]
        z[LENS + LIMIT] = UNLIMITED
        return
    f = x[places[max(focal, bundler)]]
    z[LENS + FV] *= f / z[LENS + FU]
    z[LENS + FU] = f
    if bundler >= 0:
        z[LENS + MORE], z[LENS + MORE + 1] = x[places[bundler] + 1], x[places[bundler] + 2]
        z[LENS + LIMIT] = UNLIMITED


@inline_kernel
def has_focal_length(z: F64) -> bool:
    """Whether the focal lengths of the lens in z are above 0: without, it shows nothing."""
    return z[LENS + FU] > 0.0 and z[LENS + FV] > 0.0


@inline_kernel
def no_pixel(r: F64, A: F64, B: F64) -> float:
    """The residual and Jacobians of an inactive observation; what it adds to χ²."""
    r[at.R_STATUS] = NO_FOCAL_LENGTH
    r[0], r[1] = 0.0, 0.0
    A[:2, :6] = 0.0
    B[:2, :6] = 0.0
    return INACTIVE_CHI2


@part
def add_intrinsics(kind: int, y: F64, ends: Ends, z: F64, r: F64, A: F64, J: F64, start: I64) -> None:
    """The columns of the numbers of the lens, which is in z; camera and point begin at y[ends].  (3.54)"""
    i, j = ends
    focal, bundler, all_of_it = (
        end_of_modifier(kind, FOCAL),
        end_of_modifier(kind, BUNDLER),
        end_of_modifier(kind, INTRINSICS),
    )
    c = start[max(focal, bundler, all_of_it)]
    if r[at.R_STATUS] != GOOD:
        for a in range(2):
            for n in range(9 if all_of_it >= 0 else 3 if bundler >= 0 else 1):
                J[a, c + n] = 0.0
        return
    q = rotation_matrix(y, i + 3)
    d0, d1, d2 = y[j] - y[i], y[j + 1] - y[i + 1], y[j + 2] - y[i + 2]
    h0, h1, h2 = q[0] * d0 + q[3] * d1 + q[6] * d2, q[1] * d0 + q[4] * d1 + q[7] * d2, q[2] * d0 + q[5] * d1 + q[8] * d2
    fu, fv, u, v = z[LENS + FU], z[LENS + FV], r[0] + z[0] - z[LENS + CX], r[1] + z[1] - z[LENS + CY]
    s, t = h0 / h2, h1 / h2
    if all_of_it < 0:
        J[0, c], J[1, c] = u / fu, v / fu
        if z[CODE] == RADIAL:  # by the pose A has −∂(u, v)/∂h
            J[0, c], J[1, c] = A[0, 2] * h2 / fu, A[1, 2] * h2 / fu
    p = s * s + t * t
    if bundler >= 0:
        J[0, c + 1], J[0, c + 2] = fu * s * p, fu * s * p * p
        J[1, c + 1], J[1, c + 2] = fv * t * p, fv * t * p * p
    if all_of_it >= 0:
        J[0, c], J[0, c + 1], J[0, c + 2], J[0, c + 3] = u / fu, 0.0, 1.0, 0.0
        J[1, c], J[1, c + 1], J[1, c + 2], J[1, c + 3] = 0.0, v / fv, 0.0, 1.0
        J[0, c + 4], J[0, c + 5], J[0, c + 8] = fu * s * p, fu * s * p * p, fu * s * p * p * p
        J[1, c + 4], J[1, c + 5], J[1, c + 8] = fv * t * p, fv * t * p * p, fv * t * p * p * p
        J[0, c + 6], J[0, c + 7] = fu * 2.0 * s * t, fu * (p + 2.0 * s * s)
        J[1, c + 6], J[1, c + 7] = fv * (p + 2.0 * t * t), fv * 2.0 * s * t
