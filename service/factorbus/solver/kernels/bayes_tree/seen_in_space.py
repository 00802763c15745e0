"""What a factor between two poses in space sees at the estimate, and its χ².  MATH (3.6)

Most steps look no further: what the linear model misses (`missed_residual`) goes on from what is seen here.
"""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.se3 import quat_product, rotation_matrix


@part
def between_se3_chi2(f: int, graph: Graph, tree: Tree) -> tuple[float, float, tuple]:
    """rᵀΩr of factor f, the square of the translation in r, and what `seen_se3` gives at the estimate.

    Where Ω is the same for a translation in all directions the frame of the measurement does not matter.
    """
    var, fac, x, p = graph.var, graph.fac, graph.values, graph.payload
    i, j, k, form = (
        var[fac[f, at.F_I], at.V_AT],
        var[fac[f, at.F_J], at.V_AT],
        fac[f, at.F_AT],
        tree.factor_errors[f, tl.E_FORM],
    )
    seen = seen_se3(i, j, k, p, x)
    sx, sy, sz, r3, r4, r5, _ = seen
    ex, ey, ez = sx - p[k], sy - p[k + 1], sz - p[k + 2]
    gap, q = ex * ex + ey * ey + ez * ez, k + 7
    turned = r3 * (p[q + 15] * r3 + 2.0 * (p[q + 16] * r4 + p[q + 17] * r5))
    turned += r4 * (p[q + 18] * r4 + 2.0 * p[q + 19] * r5) + r5 * p[q + 20] * r5
    if form == tl.ISOTROPIC or form == tl.ISOTROPIC + tl.CORRECTED:
        return p[q] * gap + turned, gap, seen
    z0, z1, z2, z3, z4, z5, z6, z7, z8 = rotation_matrix(p, k + 3)
    r0, r1, r2 = z0 * ex + z3 * ey + z6 * ez, z1 * ex + z4 * ey + z7 * ez, z2 * ex + z5 * ey + z8 * ez
    total = r0 * (p[q] * r0 + 2.0 * (p[q + 1] * r1 + p[q + 2] * r2 + p[q + 3] * r3 + p[q + 4] * r4 + p[q + 5] * r5))
    total += r1 * (p[q + 6] * r1 + 2.0 * (p[q + 7] * r2 + p[q + 8] * r3 + p[q + 9] * r4 + p[q + 10] * r5))
    total += r2 * (p[q + 11] * r2 + 2.0 * (p[q + 12] * r3 + p[q + 13] * r4 + p[q + 14] * r5))
    return total + turned, gap, seen


@inline_kernel
def seen_se3(i: int, j: int, k: int, p: F64, x: F64) -> tuple:
    """Rᵢᵀ (tⱼ − tᵢ), 3 numbers, and the error quaternion, 4, of poses at offsets i and j of x; the measurement is at
    offset k of p.
    """
    tx, ty, tz = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(x, i + 3)
    vx, vy, vz, w = error_quaternion(i, j, k, p, x)
    return (
        a0 * tx + a3 * ty + a6 * tz,
        a1 * tx + a4 * ty + a7 * tz,
        a2 * tx + a5 * ty + a8 * tz,
        vx,
        vy,
        vz,
        w,
    )


@inline_kernel
def error_quaternion(i: int, j: int, k: int, p: F64, x: F64) -> tuple:
    """q_z⁻¹ ⊗ qᵢ⁻¹ ⊗ qⱼ with w ≥ 0, x y z w."""
    qx, qy, qz, qw = quat_product(-x[i + 3], -x[i + 4], -x[i + 5], x[i + 6], x[j + 3], x[j + 4], x[j + 5], x[j + 6])
    vx, vy, vz, w = quat_product(-p[k + 3], -p[k + 4], -p[k + 5], p[k + 6], qx, qy, qz, qw)
    if w < 0.0:
        return -vx, -vy, -vz, -w
    return vx, vy, vz, w


@inline_kernel
def is_isotropic_in_space(k: int, p: F64) -> bool:
    """Whether the information behind a measurement at k is the same for a translation in all directions and has
    nothing to do with the rotation.
    """
    mixed = 0.0
    for a in range(3):
        for b in range(a + 1, 6):
            mixed += abs(p[k + 7 + a * 6 - a * (a + 1) // 2 + b])
    return mixed == 0.0 and p[k + 7] == p[k + 13] and p[k + 7] == p[k + 18]
