"""Factors that are another kind with further variables: where, when and through what lens.  MATH §3.8, §3.9.

The base kind has its residual at the pose c = f ∘ a ∘ m in place of the pose a, and where its other variable is a pose
too, at b ∘ m in place of b:

    m   a mount, or Exp(ξ δ) of a sensor that measured δ seconds after the time of the pose
    f   the pose of the map in the frame that the measurement is in

With A = ∂r/∂c and Ad(m⁻¹) what a displacement of a is of c,

    ∂r/∂a = A Ad(m⁻¹),   ∂r/∂m = A,   ∂r/∂δ = A ξ,   ∂r/∂f = A Ad((a ∘ m)⁻¹)             (3.35), (3.38), (3.40)
    Ad(m⁻¹) = [ R_mᵀ | −R_mᵀ ⌊t_m⌋ ; 0 | R_mᵀ ]

and where the other end is a pose too, that of the sensor in its place, ∂r/∂m has both.  A lever arm that is a variable
is put into the measurement, ∂r/∂λ = R_c; a bias is added to the residual; a scale stretches the measured translation.
So are numbers of a lens (`intrinsics`).
"""

import math

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.exponential import exp_se2, exp_se3
from factorbus.solver.kernels.model.intrinsics import add_intrinsics, has_focal_length, no_pixel, put_lens
from factorbus.solver.kernels.model.kinds import (
    ARM,
    BIAS,
    FRAME,
    MOUNT,
    OFFSET,
    SCALE,
    base_kind,
    end_of_modifier,
    lens_is_variable,
    residual_of,
)
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.kernels.model.se2 import compose_se2
from factorbus.solver.kernels.model.se3 import compose_se3, rotation_matrix
from factorbus.solver.kernels.model.sizes import arity_of, dim_of, information_at, kind_of_end, residual_dim

POSE = 7  # numbers of a pose, at most
INNER, FIRST, SECOND, OUTER = 0, POSE, 2 * POSE, 3 * POSE  # in the scratch: m, the ends of the base kind, a ∘ m
SCRATCH = 4 * POSE


@part
def composed(kind: int, x: F64, places: I64, p: F64, k: int, r: F64, J: F64, start: I64) -> float:
    """r and J of a kind that has a base; gives what χ² has beside rᵀ Ω r.

    places: where the values of the variables begin in x; the measurement is at p[k].
    out  r (R_SIZE,), J (dim, Σ d): the Jacobians side by side, that of the n-th variable from column start[n] on
    """
    of, dim, planar = base_kind(kind), residual_dim(kind), kind_of_end(kind, 0) == at.SE2
    joins_poses = joins_two_poses(of)
    A, B, y, z = np.zeros((6, 6)), np.zeros((6, 6)), np.empty(SCRATCH), np.empty(information_at(kind) + 3)
    put_measurement(kind, planar, x, places, p, k, z)
    has_inner, frame = put_inner(kind, planar, x, places, z, y), end_of_modifier(kind, FRAME)
    put_sensor(has_inner, planar, x, places[0], y, FIRST)
    if frame >= 0:
        copy_pose(planar, y, FIRST, y, OUTER)
        put_product(planar, x, places[frame], y, OUTER, FIRST)
    if joins_poses:
        put_sensor(has_inner, planar, x, places[1], y, SECOND)
    elif arity_of(of) > 1:
        for c in range(dim_of(kind_of_end(of, 1))):
            y[SECOND + c] = x[places[1] + c]
    more = residual_of(of, y, Ends(FIRST, SECOND), z, 0, r, A, B)
    if lens_is_variable(kind):
        if not has_focal_length(z):
            more = no_pixel(r, A, B)
        add_intrinsics(kind, y, Ends(FIRST, SECOND), z, r, A, J, start)

    carry_over(has_inner, dim, planar, y, INNER, A, J, start[0])
    if joins_poses:
        carry_over(has_inner, dim, planar, y, INNER, B, J, start[1])
    elif arity_of(of) > 1:
        copy_columns(dim, dim_of(kind_of_end(of, 1)), B, J, start[1])
    if frame >= 0:
        carry_over(True, dim, planar, y, OUTER, A, J, start[frame])
    if joins_poses:
        for a in range(dim):
            for c in range(6):
                A[a, c] += B[a, c]
    add_further(kind, x, places, z, A, r, J, start)
    return more


@inline_kernel
def joins_two_poses(kind: int) -> bool:
    """Whether the variables of a kind are two poses."""
    return arity_of(kind) == 2 and kind_of_end(kind, 1) == kind_of_end(kind, 0)


@inline_kernel
def put_measurement(kind: int, planar: bool, x: F64, places: I64, p: F64, k: int, z: F64) -> None:
    """What is measured to z, from 0 on; a lever arm that is a variable goes behind it, numbers of a lens into it."""
    size, arm = information_at(kind), end_of_modifier(kind, ARM)
    for c in range(size):
        z[c] = p[k + c]
    if arm >= 0:
        for c in range(2 if planar else 3):
            z[size + c] = x[places[arm] + c]
    if lens_is_variable(kind):
        put_lens(kind, x, places, z)


@inline_kernel
def put_inner(kind: int, planar: bool, x: F64, places: I64, z: F64, y: F64) -> bool:
    """m to y[INNER], a mount or Exp(ξ δ), whose ξ is behind what the base kind measures; False: there is none."""
    mount, offset = end_of_modifier(kind, MOUNT), end_of_modifier(kind, OFFSET)
    if mount >= 0:
        copy_pose(planar, x, places[mount], y, INNER)
    elif offset >= 0:
        twist, delta = information_at(base_kind(kind)), x[places[offset]]
        if planar:
            exp_se2(z, twist, delta, y, INNER)
        else:
            exp_se3(z, twist, delta, y, INNER)
    return mount >= 0 or offset >= 0


@inline_kernel
def copy_pose(planar: bool, x: F64, i: int, y: F64, to: int) -> None:
    """The pose at x[i] to y[to]."""
    for c in range(3 if planar else 7):
        y[to + c] = x[i + c]


@inline_kernel
def put_sensor(has_inner: bool, planar: bool, x: F64, i: int, y: F64, to: int) -> None:
    """The sensor's pose, xᵢ ∘ m with m at y[INNER], or xᵢ where there is no m, to y[to]."""
    copy_pose(planar, x, i, y, to)
    if has_inner:
        if planar:
            compose_se2(y, to, y, INNER, to)
        else:
            compose_se3(y, to, y, INNER, to)


@inline_kernel
def put_product(planar: bool, x: F64, i: int, y: F64, j: int, to: int) -> None:
    """xᵢ ∘ y_j to y[to]."""
    copy_pose(planar, x, i, y, to)
    if planar:
        compose_se2(y, to, y, j, to)
    else:
        compose_se3(y, to, y, j, to)


@part
def add_further(kind: int, x: F64, places: I64, z: F64, A: F64, r: F64, J: F64, start: I64) -> None:
    """What the variables of modifiers but the frame do to r, and their columns of J; A: ∂r/∂c, or with ∂r/∂(b ∘ m)."""
    dim, planar = residual_dim(kind), kind_of_end(kind, 0) == at.SE2
    mount, offset, arm = end_of_modifier(kind, MOUNT), end_of_modifier(kind, OFFSET), end_of_modifier(kind, ARM)
    bias, scale = end_of_modifier(kind, BIAS), end_of_modifier(kind, SCALE)
    if mount >= 0:
        copy_columns(dim, 3 if planar else 6, A, J, start[mount])
    if arm >= 0:  # of a position A begins with R_c
        copy_columns(dim, dim, A, J, start[arm])
    if offset >= 0:
        twist = information_at(base_kind(kind))
        for a in range(dim):
            J[a, start[offset]] = 0.0
            for c in range(3 if planar else 6):
                J[a, start[offset]] += A[a, c] * z[twist + c]
    if bias >= 0:
        r[0] += x[places[bias]]
        J[0, start[bias]] = 1.0
    if scale >= 0:
        scale_translation(planar, x[places[scale]], z, r, J, start[scale])


@inline_kernel
def scale_translation(planar: bool, s: float, z: F64, r: F64, J: F64, column: int) -> None:
    """r += (1 − s) R_zᵀ t_z and J = −R_zᵀ t_z: of a relative pose whose translation is s t_z.  (3.37)"""
    if planar:
        c, n = math.cos(z[2]), math.sin(z[2])
        J[0, column], J[1, column] = -c * z[0] - n * z[1], n * z[0] - c * z[1]
    else:
        q = rotation_matrix(z, 3)
        for a in range(3):
            J[a, column] = -(q[a] * z[0] + q[3 + a] * z[1] + q[6 + a] * z[2])
    for a in range(2 if planar else 3):
        r[a] += (s - 1.0) * J[a, column]


@inline_kernel
def copy_columns(dim: int, width: int, A: F64, J: F64, start: int) -> None:
    """A into J from column `start` on."""
    for a in range(dim):
        for c in range(width):
            J[a, start + c] = A[a, c]


@part
def carry_over(has_inner: bool, dim: int, planar: bool, y: F64, m: int, A: F64, J: F64, start: int) -> None:
    """A Ad(m⁻¹), into J from column `start` on, with the pose m at y[m]; A where there is none.  (3.35)"""
    if not has_inner:
        copy_columns(dim, 3 if planar else 6, A, J, start)
        return
    if planar:
        c, s = math.cos(y[m + 2]), math.sin(y[m + 2])
        for a in range(dim):
            n0, n1 = A[a, 0] * c - A[a, 1] * s, A[a, 0] * s + A[a, 1] * c
            J[a, start], J[a, start + 1] = n0, n1
            J[a, start + 2] = A[a, 2] + n1 * y[m] - n0 * y[m + 1]
        return
    q = rotation_matrix(y, m + 3)
    for a in range(dim):
        n0 = A[a, 0] * q[0] + A[a, 1] * q[1] + A[a, 2] * q[2]
        n1 = A[a, 0] * q[3] + A[a, 1] * q[4] + A[a, 2] * q[5]
        n2 = A[a, 0] * q[6] + A[a, 1] * q[7] + A[a, 2] * q[8]
        J[a, start], J[a, start + 1], J[a, start + 2] = n0, n1, n2
        h0 = A[a, 3] * q[0] + A[a, 4] * q[1] + A[a, 5] * q[2]
        h1 = A[a, 3] * q[3] + A[a, 4] * q[4] + A[a, 5] * q[5]
        h2 = A[a, 3] * q[6] + A[a, 4] * q[7] + A[a, 5] * q[8]
        J[a, start + 3] = h0 + y[m + 1] * n2 - y[m + 2] * n1
        J[a, start + 4] = h1 + y[m + 2] * n0 - y[m] * n2
        J[a, start + 5] = h2 + y[m] * n1 - y[m + 1] * n0
