"""What is known of one variable, or of two together, as a linear model around given values.  MATH §3.6.

    r = Σ H_e (x_e ⊟ y_e) + b                                                                            (3.26)

y_e the values at which its sender has linearized, H_e its Jacobians there, b its residual there.  A difference is
a local increment: ⊟ of a pose in the plane is (R_yᵀ (t − t_y), wrap(θ − θ_y)), of one in space (R_yᵀ (t − t_y), 2 v)
with (v, w) = q_y⁻¹ ⊗ q, w ≥ 0: twice the vector part of a quaternion, the rotation vector to second order.  Of a point
it is x − y, and of a feature of inverse depth too, its θ wrapped.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.se3 import quat_product, rotation_matrix, turn_slope
from factorbus.solver.kernels.model.sizes import dim_of, kinds_of_ends, residual_dim, size_of


@part
def linear_se2(kind: int, x: F64, ends: Ends, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """Of poses in the plane alone: straight code.  Payload: y of each end (3), H of each (3 × 3), b (3)."""
    count = 1 if kind == at.LINEAR_SE2 else 2
    h = k + 3 * count
    for a in range(3):
        r[a] = p[h + 9 * count + a]
    add_se2(3, x[ends.i :], p[k:], p[h:], r, A)
    if count == 2:
        add_se2(3, x[ends.j :], p[k + 3 :], p[h + 9 :], r, B)


@part
def linear(kind: int, x: F64, ends: Ends, p: F64, k: int, r: F64, A: F64, B: F64) -> None:
    """Of any variables.  Payload: y of each end, H of each (rows × its tangent), b (rows)."""
    first, second = kinds_of_ends(kind)
    rows, d, h = residual_dim(kind), dim_of(first), k + size_of(first)
    b = h + rows * d
    if second >= 0:
        h += size_of(second)
        b = h + rows * (d + dim_of(second))
    for a in range(rows):
        r[a] = p[b + a]
    add_end(first, rows, x[ends.i :], p[k:], p[h:], r, A)
    if second >= 0:
        add_end(second, rows, x[ends.j :], p[k + size_of(first) :], p[h + rows * d :], r, B)


@part
def add_end(end: int, rows: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x ⊟ y) of a variable of the kind `end`, and its J; H (rows × its tangent) row by row."""
    if end == at.SE2:
        add_se2(rows, x, y, H, r, J)
    elif end == at.SE3:
        add_se3(rows, x, y, H, r, J)
    else:
        add_vector(end, rows, x, y, H, r, J)


@inline_kernel
def add_se2(rows: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x ⊟ y),  J = H [ R_yᵀ R | 0 ; 0 | 1 ]."""
    c, s = math.cos(y[2]), math.sin(y[2])
    dx, dy = x[0] - y[0], x[1] - y[1]
    e0, e1, e2 = c * dx + s * dy, c * dy - s * dx, wrap(x[2] - y[2])
    c, s = math.cos(e2), math.sin(e2)
    for a in range(rows):
        h0, h1, h2 = H[3 * a], H[3 * a + 1], H[3 * a + 2]
        r[a] += h0 * e0 + h1 * e1 + h2 * e2
        J[a, 0], J[a, 1], J[a, 2] = h0 * c + h1 * s, h1 * c - h0 * s, h2


@part
def add_se3(rows: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x ⊟ y),  J = H [ R_yᵀ R | 0 ; 0 | w I + ⌊v⌋ ]."""
    z, q = rotation_matrix(y, 3), rotation_matrix(x, 3)
    d0, d1, d2 = x[0] - y[0], x[1] - y[1], x[2] - y[2]
    e0, e1, e2 = z[0] * d0 + z[3] * d1 + z[6] * d2, z[1] * d0 + z[4] * d1 + z[7] * d2, z[2] * d0 + z[5] * d1 + z[8] * d2
    vx, vy, vz, w = quat_product(-y[3], -y[4], -y[5], y[6], x[3], x[4], x[5], x[6])
    if w < 0.0:
        vx, vy, vz, w = -vx, -vy, -vz, -w
    w = turn_slope(w)
    for a in range(rows):
        n = 6 * a
        r[a] += H[n] * e0 + H[n + 1] * e1 + H[n + 2] * e2 + 2.0 * (H[n + 3] * vx + H[n + 4] * vy + H[n + 5] * vz)
        # Of H's translation part times R_yᵀ, m, then times R.
        m0 = H[n] * z[0] + H[n + 1] * z[1] + H[n + 2] * z[2]
        m1 = H[n] * z[3] + H[n + 1] * z[4] + H[n + 2] * z[5]
        m2 = H[n] * z[6] + H[n + 1] * z[7] + H[n + 2] * z[8]
        for b in range(3):
            J[a, b] = m0 * q[b] + m1 * q[3 + b] + m2 * q[6 + b]
        h0, h1, h2 = H[n + 3], H[n + 4], H[n + 5]
        J[a, 3], J[a, 4], J[a, 5] = h0 * w + h1 * vz - h2 * vy, h1 * w - h0 * vz + h2 * vx, h2 * w + h0 * vy - h1 * vx


@inline_kernel
def add_vector(end: int, rows: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x − y),  J = H: of a point, or a feature, which has an angle at 3."""
    d = dim_of(end)
    for c in range(d):
        e = x[c] - y[c]
        if end == at.IDP and c == 3:
            e = wrap(e)
        for a in range(rows):
            J[a, c] = H[d * a + c]
            r[a] += J[a, c] * e
