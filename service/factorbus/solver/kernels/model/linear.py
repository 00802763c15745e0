"""A linear model of any number of variables around given values: a Gaussian.  MATH §3.6.

    r = Σ H_n (x_n ⊟ y_n) + b                                                                            (3.26)

y_n the values at which its sender has linearized, H_n its Jacobians there, b its residual there.  A difference is
a local increment: ⊟ of a pose in the plane is (R_yᵀ (t − t_y), wrap(θ − θ_y)), of one in space (R_yᵀ (t − t_y), 2 v)
with (v, w) = q_y⁻¹ ⊗ q, w ≥ 0: twice the vector part of a quaternion, the rotation vector to second order.  Of a
rotation it is 2 v, of a similarity (R_yᵀ (t − t_y) / s_y, 2 v, ln s/s_y).  Of a point it is x − y, and of a feature of
inverse depth too, its θ wrapped.

Payload: y of each variable, H of each (rows × its tangent, row by row), b (rows).
"""

import math

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.se3 import quat_product, rotation_matrix, turn_slope
from factorbus.solver.kernels.model.sizes import dim_of, size_of


@part
def linear(x: F64, kinds: I64, places: I64, p: F64, r: F64, J: F64) -> None:
    """r (rows,) and J (rows, Σ d): the Jacobians side by side.

    kinds, places (n,): of the variables, and where their values begin in x; p: the payload from the measurement on
    """
    rows, h, y, start = len(J), 0, 0, 0
    for n in range(kinds.size):
        h += size_of(kinds[n])
    for n in range(kinds.size):
        _add_end(kinds[n], start, x[places[n] :], p[y:], p[h:], r, J)
        h, y, start = h + rows * dim_of(kinds[n]), y + size_of(kinds[n]), start + dim_of(kinds[n])
    for a in range(rows):
        r[a] += p[h + a]


@part
def _add_end(end: int, start: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x ⊟ y) of a variable of the kind `end`, and J from column `start` on."""
    if end == at.SE2:
        _add_se2(start, x, y, H, r, J)
    elif end == at.SE3:
        _add_se3(start, x, y, H, r, J)
    elif end == at.SO3:
        _add_turn(start, 3, 0, x, y, H, r, J)
    elif end == at.SIM3:
        _add_sim3(start, x, y, H, r, J)
    else:
        _add_vector(end, start, x, y, H, r, J)


@inline_kernel
def _add_se2(start: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x ⊟ y),  J = H [ R_yᵀ R | 0 ; 0 | 1 ]."""
    c, s = math.cos(y[2]), math.sin(y[2])
    dx, dy = x[0] - y[0], x[1] - y[1]
    e0, e1, e2 = c * dx + s * dy, c * dy - s * dx, wrap(x[2] - y[2])
    c, s = math.cos(e2), math.sin(e2)
    for a in range(len(J)):
        h0, h1, h2 = H[3 * a], H[3 * a + 1], H[3 * a + 2]
        r[a] += h0 * e0 + h1 * e1 + h2 * e2
        J[a, start], J[a, start + 1], J[a, start + 2] = h0 * c + h1 * s, h1 * c - h0 * s, h2


@part
def _add_se3(start: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x ⊟ y),  J = H [ R_yᵀ R | 0 ; 0 | w I + ⌊v⌋ ]."""
    z, q = rotation_matrix(y, 3), rotation_matrix(x, 3)
    d0, d1, d2 = x[0] - y[0], x[1] - y[1], x[2] - y[2]
    e0, e1, e2 = z[0] * d0 + z[3] * d1 + z[6] * d2, z[1] * d0 + z[4] * d1 + z[7] * d2, z[2] * d0 + z[5] * d1 + z[8] * d2
    vx, vy, vz, w = quat_product(-y[3], -y[4], -y[5], y[6], x[3], x[4], x[5], x[6])
    if w < 0.0:
        vx, vy, vz, w = -vx, -vy, -vz, -w
    w = turn_slope(w)
    for a in range(len(J)):
        n = 6 * a
        r[a] += H[n] * e0 + H[n + 1] * e1 + H[n + 2] * e2 + 2.0 * (H[n + 3] * vx + H[n + 4] * vy + H[n + 5] * vz)
        # Of H's translation part times R_yᵀ, m, then times R.
        m0 = H[n] * z[0] + H[n + 1] * z[1] + H[n + 2] * z[2]
        m1 = H[n] * z[3] + H[n + 1] * z[4] + H[n + 2] * z[5]
        m2 = H[n] * z[6] + H[n + 1] * z[7] + H[n + 2] * z[8]
        for b in range(3):
            J[a, start + b] = m0 * q[b] + m1 * q[3 + b] + m2 * q[6 + b]
        h0, h1, h2 = H[n + 3], H[n + 4], H[n + 5]
        J[a, start + 3] = h0 * w + h1 * vz - h2 * vy
        J[a, start + 4] = h1 * w - h0 * vz + h2 * vx
        J[a, start + 5] = h2 * w + h0 * vy - h1 * vx


@part
def _add_turn(start: int, width: int, at_q: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H 2 v,  J = H (w I + ⌊v⌋): of the rotation that begins at at_q in the value, and in the tangent, which is
    `width` wide."""
    q = at_q
    vx, vy, vz, w = quat_product(-y[q], -y[q + 1], -y[q + 2], y[q + 3], x[q], x[q + 1], x[q + 2], x[q + 3])
    if w < 0.0:
        vx, vy, vz, w = -vx, -vy, -vz, -w
    w, c = turn_slope(w), start + at_q
    for a in range(len(J)):
        h0, h1, h2 = H[width * a + at_q], H[width * a + at_q + 1], H[width * a + at_q + 2]
        r[a] += 2.0 * (h0 * vx + h1 * vy + h2 * vz)
        J[a, c], J[a, c + 1], J[a, c + 2] = (
            h0 * w + h1 * vz - h2 * vy,
            h1 * w - h0 * vz + h2 * vx,
            h2 * w + h0 * vy - h1 * vx,
        )


@part
def _add_sim3(start: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x ⊟ y),  J = H [ (s/s_y) R_yᵀ R | 0 | 0 ; 0 | w I + ⌊v⌋ | 0 ; 0 | 0 | 1 ]."""
    z, q, s = rotation_matrix(y, 3), rotation_matrix(x, 3), 1.0 / y[7]
    d0, d1, d2 = s * (x[0] - y[0]), s * (x[1] - y[1]), s * (x[2] - y[2])
    ratio = s * x[7]
    for a in range(len(J)):
        n = 7 * a
        m0 = H[n] * z[0] + H[n + 1] * z[1] + H[n + 2] * z[2]  # of H's translation part times R_yᵀ
        m1 = H[n] * z[3] + H[n + 1] * z[4] + H[n + 2] * z[5]
        m2 = H[n] * z[6] + H[n + 1] * z[7] + H[n + 2] * z[8]
        r[a] += m0 * d0 + m1 * d1 + m2 * d2 + H[n + 6] * math.log(ratio)
        for b in range(3):
            J[a, start + b] = ratio * (m0 * q[b] + m1 * q[3 + b] + m2 * q[6 + b])
        J[a, start + 6] = H[n + 6]
    _add_turn(start, 7, 3, x, y, H, r, J)


@inline_kernel
def _add_vector(end: int, start: int, x: F64, y: F64, H: F64, r: F64, J: F64) -> None:
    """r += H (x − y),  J = H: of a point, or a feature, which has an angle at 3."""
    d = dim_of(end)
    for c in range(d):
        e = x[c] - y[c]
        if end == at.IDP and c == 3:
            e = wrap(e)
        for a in range(len(J)):
            J[a, start + c] = H[d * a + c]
            r[a] += H[d * a + c] * e
