"""What the linear model of a factor between two poses misses of its residual at the estimate, exactly.  MATH §9.6

With R₀ and R the first pose's rotation where it is linearized and at the estimate, φ its turn between these, and
t₀ and t what lies between the two positions, in the map's frame, the model misses of what the first pose sees

    Rᵀt − R₀ᵀt + φ × R₀ᵀt₀                                                                               (9.33)

which is −½φ²u and φ × (sⱼ − sᵢ) to second order; and in space of the vector part v of the turn, that of an error
quaternion (v, w), with a = R_zᵀφᵢ and b = φⱼ,

    v − v₀ − ½ (w₀ (b − a) + v₀ × (b + a))                                                               (9.34)
"""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.seen_in_space import error_quaternion
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.se3 import quat_product, rotation_matrix, turn_slope

SMALL_TURN = 0.1  # radians: below it the series are exact to rounding


@inline_kernel
def missed_error_se2(graph: Graph, tree: Tree, f: int) -> tuple[float, float, float, float, float]:
    """√ω times (9.33) of factor f between plane poses, less what a chord step has corrected its model by; since both
    were linearized, |sⱼ − sᵢ|², the square of the second pose's shift as seen from the first, φ, and by how much the
    second has turned as seen from the first.
    """
    var, fac, values, row = graph.var, graph.fac, graph.values, tree.factor_errors[f]
    i, j = fac[f, at.F_I], fac[f, at.F_J]
    phi = turn_since_linearized(i, var, tree.scalars[0])
    bx, by, moved, shift = missed_se2(var[i, at.V_AT], var[j, at.V_AT], phi, values, tree.lin[0])
    if row[tl.E_FORM] >= tl.CORRECTED:
        bx, by = bx - row[tl.E_MISSED], by - row[tl.E_MISSED + 1]
    psi = abs(turn_since_linearized(j, var, tree.scalars[0]) - phi)
    return row[tl.E_ROOT] * math.sqrt(bx * bx + by * by), moved, shift, phi, psi


@inline_kernel
def turn_since_linearized(i: int, var: I64, delta: F64) -> float:
    """φ of plane pose i; 0 of a fixed one."""
    return float(delta[var[i, at.V_SCALAR] + 2]) if var[i, at.V_SCALAR] >= 0 else 0.0


@inline_kernel
def missed_se2(x: int, y: int, phi: float, values: F64, lin: F64) -> tuple[float, float, float, float]:
    """R₀ times (9.33), of the plane poses at offsets x and y, so in the map's frame; of the angle nothing is missed.
    And the squares of what y has shifted by as x has not, and as seen from x.
    """
    tx, ty = values[y] - values[x], values[y + 1] - values[x + 1]
    sx, sy = tx - (lin[y] - lin[x]), ty - (lin[y + 1] - lin[x + 1])
    versed, late = versed_and_late(phi)
    bx, by = -versed * tx - late * ty + phi * sy, -versed * ty + late * tx - phi * sx
    sine, moved = phi - late, sx * sx + sy * sy
    sx, sy = sx - versed * tx + sine * ty, sy - versed * ty - sine * tx
    return bx, by, moved, sx * sx + sy * sy


@part
def missed_error_se3(graph: Graph, tree: Tree, f: int, seen: tuple) -> tuple[float, float, float]:
    """√(bᵀ Ω b) of factor f between poses in space, b being (9.33) and (9.34) less what a chord step has corrected its
    model by; by how much the second pose has shifted and turned as seen from the first, since both were linearized.
    seen: `seen_se3` of it at the estimate
    """
    p, k, row = graph.payload, graph.fac[f, at.F_AT] + 7, tree.factor_errors[f]
    b0, b1, b2, b3, b4, b5, shift, psi = missed_se3(graph, tree, f, seen)
    if row[tl.E_FORM] >= tl.CORRECTED:
        b0, b1, b2 = b0 - row[tl.E_MISSED], b1 - row[tl.E_MISSED + 1], b2 - row[tl.E_MISSED + 2]
        b3, b4, b5 = b3 - row[tl.E_MISSED + 3], b4 - row[tl.E_MISSED + 4], b5 - row[tl.E_MISSED + 5]
    turned = b3 * (p[k + 15] * b3 + 2.0 * (p[k + 16] * b4 + p[k + 17] * b5))
    turned += b4 * (p[k + 18] * b4 + 2.0 * p[k + 19] * b5) + b5 * p[k + 20] * b5
    if row[tl.E_FORM] == tl.ISOTROPIC or row[tl.E_FORM] == tl.ISOTROPIC + tl.CORRECTED:
        return math.sqrt(max(p[k] * (b0 * b0 + b1 * b1 + b2 * b2) + turned, 0.0)), shift, psi
    total = b0 * (p[k] * b0 + 2.0 * (p[k + 1] * b1 + p[k + 2] * b2 + p[k + 3] * b3 + p[k + 4] * b4 + p[k + 5] * b5))
    total += b1 * (p[k + 6] * b1 + 2.0 * (p[k + 7] * b2 + p[k + 8] * b3 + p[k + 9] * b4 + p[k + 10] * b5))
    total += b2 * (p[k + 11] * b2 + 2.0 * (p[k + 12] * b3 + p[k + 13] * b4 + p[k + 14] * b5))
    return math.sqrt(max(total + turned, 0.0)), shift, psi


@inline_kernel
def versed_and_late(phi: float) -> tuple[float, float]:
    """1 − cos φ and φ − sin φ."""
    if not abs(phi) < SMALL_TURN:
        return 1.0 - math.cos(phi), phi - math.sin(phi)
    q = phi * phi
    versed = q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0 - q * (1.0 / 40320.0))))
    return versed, phi * q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5040.0 - q * (1.0 / 362880.0))))


@part
def missed_se3(
    graph: Graph, tree: Tree, f: int, seen: tuple
) -> tuple[float, float, float, float, float, float, float, float]:
    """R_zᵀ times (9.33), and (9.34), of factor f between poses in space, so in the frame of its residual.  And by how
    much the second pose has shifted and turned as seen from the first.
    """
    var, fac, p, x, lin, delta = graph.var, graph.fac, graph.payload, graph.values, tree.lin[0], tree.scalars[0]
    i, j, k = var[fac[f, at.F_I], at.V_AT], var[fac[f, at.F_J], at.V_AT], fac[f, at.F_AT]
    first, second = var[fac[f, at.F_I], at.V_SCALAR], var[fac[f, at.F_J], at.V_SCALAR]
    px = py = pz = bx = by = bz = 0.0
    if first >= 0:
        px, py, pz = delta[first + 3], delta[first + 4], delta[first + 5]
    if second >= 0:
        bx, by, bz = delta[second + 3], delta[second + 4], delta[second + 5]
    tx, ty, tz = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    sx, sy, sz, vx, vy, vz, vw = seen
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(lin, i + 3)
    ux = sx - (a0 * tx + a3 * ty + a6 * tz)
    uy = sy - (a1 * tx + a4 * ty + a7 * tz)
    uz = sz - (a2 * tx + a5 * ty + a8 * tz)
    tx, ty, tz = lin[j] - lin[i], lin[j + 1] - lin[i + 1], lin[j + 2] - lin[i + 2]
    dx, dy, dz = a0 * tx + a3 * ty + a6 * tz, a1 * tx + a4 * ty + a7 * tz, a2 * tx + a5 * ty + a8 * tz
    sx, sy, sz = sx - dx, sy - dy, sz - dz
    shift = math.sqrt(sx * sx + sy * sy + sz * sz)
    ux, uy, uz = ux + py * dz - pz * dy, uy + pz * dx - px * dz, uz + px * dy - py * dx
    z0, z1, z2, z3, z4, z5, z6, z7, z8 = rotation_matrix(p, k + 3)
    ax, ay, az = z0 * px + z3 * py + z6 * pz, z1 * px + z4 * py + z7 * pz, z2 * px + z5 * py + z8 * pz
    v0, v1, v2, w = error_quaternion(i, j, k, p, lin)
    rx, ry, rz, _ = quat_product(-v0, -v1, -v2, w, vx, vy, vz, vw)
    w = turn_slope(w)
    sx, sy, sz = bx + ax, by + ay, bz + az
    return (
        z0 * ux + z3 * uy + z6 * uz,
        z1 * ux + z4 * uy + z7 * uz,
        z2 * ux + z5 * uy + z8 * uz,
        vx - v0 - 0.5 * (w * (bx - ax) + v1 * sz - v2 * sy),
        vy - v1 - 0.5 * (w * (by - ay) + v2 * sx - v0 * sz),
        vz - v2 - 0.5 * (w * (bz - az) + v0 * sy - v1 * sx),
        shift,
        2.0 * math.sqrt(rx * rx + ry * ry + rz * rz),
    )
