"""The Hessian of a factor at its variables' linearization points, kept until one of them moves.  MATH §9.2."""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import has_free
from factorbus.solver.kernels.bayes_tree.error_terms import lever_of, root_weight, shift_error_weight
from factorbus.solver.kernels.bayes_tree.factor_chi2 import is_isotropic
from factorbus.solver.kernels.bayes_tree.hessian_of_many import write_hessian_rows
from factorbus.solver.kernels.bayes_tree.hessian_room import hessian_size, keep_jacobian, kept_samples
from factorbus.solver.kernels.bayes_tree.imu_error import is_plain_imu
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.simd import Panel, six
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import is_member, is_one_of_many, loss_code
from factorbus.solver.kernels.model.kinds import is_bounded, is_camera, is_rigid
from factorbus.solver.kernels.model.linearize import Scratch, evaluate_apart, multiply
from factorbus.solver.kernels.model.many import linearize_kept, square_of, width_of
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.se2 import SMALL_ANGLE, small_turn, wrap
from factorbus.solver.kernels.model.sizes import dim_of, end_dims, information_at, residual_dim
from factorbus.solver.lenses.layout import GOOD


@part
def linearize_factor(graph: Graph, tree: Tree, f: int, scratch: Scratch) -> None:
    """Write the Hessian of factor f at the linearization points, and what its shift error depends on there.

    Of a factor of more than two variables with its first row that of all its rows, and with its others nothing.
    """
    if is_one_of_many(f, graph.fac):
        if not is_member(f, graph.fac):
            linearize_rows(graph, tree, f)
        return
    kind, hessian, factor_errors, h = graph.fac[f, at.F_KIND], tree.hessian, tree.factor_errors, tree.link[f, tl.L_AT]
    if factor_errors[f, tl.E_FORM] >= tl.CORRECTED:
        factor_errors[f, tl.E_FORM] -= tl.CORRECTED
    if kind == at.BETWEEN_SE2 and loss_code(f, graph.fac) == at.NO_LOSS:
        more = 0.0
        evaluate_between_se2(graph, tree, f, scratch)
    else:
        more = evaluate_apart(
            f, graph.var, graph.fac, tree.lin[0], graph.payload, scratch.r, scratch.H[0], scratch.H[1]
        )
    # Sizes as constants, so that each call becomes straight code.
    if kind == at.BETWEEN_SE2:
        _write(graph, tree, f, 3, 3, 3, more, scratch)
        factor_errors[f, tl.E_TURN] = hessian[h + 9 + 9 + 8]
    elif kind == at.LANDMARK_SE2 or kind == at.BEARING_RANGE_SE2:
        _write(graph, tree, f, 2, 3, 2, more, scratch)
        factor_errors[f, tl.E_SHIFT] = gradient_norm(2, h + 9 + 6 + 4, hessian)
    elif kind == at.BETWEEN_SE3:
        _write_between_se3(graph, tree, f, more, scratch)
        factor_errors[f, tl.E_TURN] = hessian[h + 36 + 36 + 35]
    elif kind == at.LANDMARK_SE3:
        _write(graph, tree, f, 3, 6, 3, more, scratch)
        factor_errors[f, tl.E_SHIFT] = gradient_norm(3, h + 36 + 18 + 9, hessian)
    else:
        _write_other(graph, tree, f, more, scratch)
        if is_camera(kind):
            note_inactive(f, scratch.r[at.R_STATUS] != GOOD, tree.link, tree.state)


@inline_kernel
def evaluate_between_se2(graph: Graph, tree: Tree, f: int, scratch: Scratch) -> None:
    """`between_se2` at the linearization points, of which cosine and sine are known.

    R_z = Rᵢᵀ Rⱼ R_rᵀ, r being the angle of the residual.
    """
    var, fac, p, x, turns = graph.var, graph.fac, graph.payload, tree.lin[0], tree.turns
    r, A, B = scratch.r, scratch.H[0], scratch.H[1]
    v, u, k = fac[f, at.F_I], fac[f, at.F_J], fac[f, at.F_AT]
    i, j = var[v, at.V_AT], var[u, at.V_AT]
    c, s, c1, s1 = turns[v, tl.U_COS], turns[v, tl.U_SIN], turns[u, tl.U_COS], turns[u, tl.U_SIN]
    turn = wrap(x[j + 2] - x[i + 2] - p[k + 2])
    cr, sr = small_turn(turn) if abs(turn) < SMALL_ANGLE else (math.cos(turn), math.sin(turn))
    c1, s1 = c * c1 + s * s1, c * s1 - s * c1
    cz, sz = c1 * cr + s1 * sr, s1 * cr - c1 * sr
    tx, ty = x[j] - x[i], x[j + 1] - x[i + 1]
    dx, dy = c * tx + s * ty, c * ty - s * tx
    ex, ey = dx - p[k], dy - p[k + 1]
    r[0], r[1], r[2] = cz * ex + sz * ey, cz * ey - sz * ex, turn
    A[0, 0], A[0, 1], A[0, 2] = -cz, -sz, cz * dy - sz * dx
    A[1, 0], A[1, 1], A[1, 2] = sz, -cz, -cz * dx - sz * dy
    A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, -1.0
    B[0, 0], B[0, 1], B[0, 2] = cr, -sr, 0.0
    B[1, 0], B[1, 1], B[1, 2] = sr, cr, 0.0
    B[2, 0], B[2, 1], B[2, 2] = 0.0, 0.0, 1.0


@part
def linearize_rows(graph: Graph, tree: Tree, f: int) -> None:
    """The Hessians of all rows of the factor that begins at row f, and what is kept of its Jacobian."""
    var, fac, out, link, state, totals = graph.var, graph.fac, tree.hessian, tree.link, tree.state, tree.totals
    more, many = linearize_kept(f, var, fac, tree.lin[0], graph.payload, kept_samples(f, var, fac, tree))
    last = link[f, tl.L_AT] + hessian_size(width_of(0, many), width_of(1, many)) - 1
    was, chi2 = out[last], more + square_of(many)
    write_hessian_rows(f, many, chi2, link, out)
    keep_jacobian(f, graph, tree, many)
    if f < state[tl.S_TAKEN] and not has_free(f, var, fac):
        # No clique takes the first row in: its χ² is among the constants.
        totals[tl.T_CONSTANT] += chi2 - was
        totals[tl.T_MODEL] += chi2 - was
    if is_camera(fac[f, at.F_KIND]):
        note_inactive(f, many.r[at.R_STATUS] != GOOD, link, state)


@inline_kernel
def gradient_norm(count: int, g: int, hessian: F64) -> float:
    """|Ω r| of what is seen: the gradient of the pose's translation, from offset g on."""
    total = 0.0
    for a in range(count):
        total += hessian[g + a] * hessian[g + a]
    return math.sqrt(total)


@inline_kernel
def note_inactive(f: int, inactive: bool, link: I64, state: I64) -> None:
    """Count an observation that has no pixel any more, or has one again."""
    if inactive != (link[f, tl.L_KIND] == tl.INACTIVE):
        state[tl.S_INACTIVE] += 1 if inactive else -1
        link[f, tl.L_KIND] = tl.INACTIVE if inactive else tl.EXACT


@part
def _write_other(graph: Graph, tree: Tree, f: int, more: float, scratch: Scratch) -> None:
    """Of the kinds that are not worth straight code."""
    kind = graph.fac[f, at.F_KIND]
    di, dj = end_dims(kind)
    _write(graph, tree, f, residual_dim(kind), di, dj, more, scratch)


@part
def _write_between_se3(graph: Graph, tree: Tree, f: int, more: float, scratch: Scratch) -> None:
    """`_write`, in half its products: the lower left quarter of both Jacobians and the upper right one of B are zero.

    Of A, B, Ω A and Ω B side by side in J, six a row, all places are constants: so rows become vectors.
    """
    payload, out, r, h = graph.payload, tree.hessian, scratch.r, tree.link[f, tl.L_AT]
    J, M = scratch.H.reshape(144), scratch.W.reshape(36)
    p = graph.fac[f, at.F_AT] + information_at(at.BETWEEN_SE3)
    for a in range(6):
        for b in range(a, 6):
            M[6 * a + b] = M[6 * b + a] = payload[p]
            p += 1
    chi2 = more
    for a in range(6):
        e = 0.0
        for b in range(6):
            e += M[6 * a + b] * r[b]
        chi2 += r[a] * e
    for a in range(6):
        six(M, Panel(6 * a, 1, 6), J, 0, J, 72 + 6 * a)
        six(M, Panel(6 * a, 1, 6), J, 36, J, 108 + 6 * a)
    for a in range(3):
        six(J, Panel(a, 6, 3), J, 72, out, h + 6 * a)
        six(J, Panel(a, 6, 3), J, 108, out, h + 36 + 6 * a)
        six(J, Panel(36 + a, 6, 3), J, 108, out, h + 72 + 6 * a)
    for a in range(3, 6):
        six(J, Panel(a, 6, 6), J, 72, out, h + 6 * a)
        six(J, Panel(a, 6, 6), J, 108, out, h + 36 + 6 * a)
        six(J, Panel(54 + a, 6, 3), J, 126, out, h + 72 + 6 * a)
    for a in range(6):
        r[a] = -r[a]
    six(r, Panel(0, 1, 6), J, 72, out, h + 108)
    six(r, Panel(0, 1, 6), J, 108, out, h + 114)
    out[h + 120] = chi2


@inline_kernel
def _write(graph: Graph, tree: Tree, f: int, dr: int, di: int, dj: int, more: float, scratch: Scratch) -> None:
    payload, out, r, W, h = graph.payload, tree.hessian, scratch.r, scratch.W, tree.link[f, tl.L_AT]
    A, B, WA, WB = scratch.H[0], scratch.H[1], scratch.H[2], scratch.H[3]
    p = graph.fac[f, at.F_AT] + information_at(graph.fac[f, at.F_KIND])
    for a in range(dr):
        for b in range(a, dr):
            W[a, b] = W[b, a] = payload[p]
            p += 1
    chi2 = more
    for a in range(dr):
        e = 0.0
        for b in range(dr):
            e += W[a, b] * r[b]
        chi2 += r[a] * e
    multiply(dr, di, W, A, WA)
    h = _product(dr, di, di, A, WA, h, out)
    if dj > 0:
        multiply(dr, dj, W, B, WB)
        h = _product(dr, di, dj, A, WB, h, out)
        h = _product(dr, dj, dj, B, WB, h, out)
    h = _gradient(dr, di, WA, r, h, out)
    if dj > 0:
        h = _gradient(dr, dj, WB, r, h, out)
    out[h] = chi2


@inline_kernel
def _product(dr: int, d: int, e: int, A: F64, WB: F64, h: int, out: F64) -> int:
    """Aᵀ Ω B, row by row."""
    for a in range(d):
        for b in range(e):
            total = 0.0
            for k in range(dr):
                total += A[k, a] * WB[k, b]
            out[h + a * e + b] = total
    return h + d * e


@inline_kernel
def _gradient(dr: int, d: int, WA: F64, r: F64, h: int, out: F64) -> int:
    """−Aᵀ Ω r."""
    for a in range(d):
        total = 0.0
        for k in range(dr):
            total += WA[k, a] * r[k]
        out[h + a] = -total
    return h + d


@inline_kernel
def lever_of_seen(f: int, graph: Graph, tree: Tree) -> tuple[float, float]:
    """d and √ω of factor f, by which a pose sees another one or a point and whose error is computed: how far apart they
    are, and what a shift of the other one weighs in its Hessian.  Where both turn as a whole its model misses up to
    √ω ½ d φ², as in (9.4).
    """
    var, fac, x = graph.var, graph.fac, tree.lin[0]
    i, j = fac[f, at.F_I], fac[f, at.F_J]
    di, dj = dim_of(var[i, at.V_KIND]), dim_of(var[j, at.V_KIND])
    h, square, weight = tree.link[f, tl.L_AT] + di * di + di * dj, 0.0, 0.0
    for a in range(2 if var[i, at.V_KIND] == at.SE2 else 3):
        gap = x[var[j, at.V_AT] + a] - x[var[i, at.V_AT] + a]
        square += gap * gap
        weight += tree.hessian[h + a * dj + a]
    return math.sqrt(square), math.sqrt(weight)


@part
def weigh_factor(graph: Graph, tree: Tree, f: int, scratch: Scratch) -> None:
    """Add a factor that was just linearized to what measures δ: the diagonal sums, and terms of its error.

    scratch.W holds its information, as `linearize_factor` left it.
    """
    var, fac, payload = graph.var, graph.fac, graph.payload
    link, hessian, scalars, factor_errors, turns = tree.link, tree.hessian, tree.scalars, tree.factor_errors, tree.turns
    kind, h = fac[f, at.F_KIND], link[f, tl.L_AT]
    i, j = fac[f, at.F_I], fac[f, at.F_J]
    di = dim_of(var[i, at.V_KIND])
    dj = dim_of(var[j, at.V_KIND]) if j >= 0 else 0
    s = var[i, at.V_SCALAR]
    if s >= 0:
        for a in range(di):
            scalars[1, s + a] += hessian[h + a * di + a]
    if not is_one_of_many(f, fac) and (is_bounded(kind) or is_camera(kind)):
        distance = lever_of(kind, payload, fac[f, at.F_AT])
        root = root_weight(kind, scratch.W, distance)
    elif is_rigid(kind) or fac[f, at.F_FLAGS] & at.RIGID != 0:
        distance, root = lever_of_seen(f, graph, tree)
    else:  # it says where in the world they are, so they are in nothing that moves as a whole
        distance = root = 0.0
    turns[i, tl.U_LEVER] = max(turns[i, tl.U_LEVER], distance * root)
    if j >= 0:
        s = var[j, at.V_SCALAR]
        if s >= 0:
            for a in range(dj):
                scalars[1, s + a] += hessian[h + di * di + di * dj + a * dj + a]
    factor_errors[f, tl.E_LEVER], factor_errors[f, tl.E_ROOT] = distance, root
    if kind == at.BETWEEN_SE2 or kind == at.BETWEEN_SE3:
        factor_errors[f, tl.E_SHIFT] = shift_error_weight(root, distance, factor_errors[f, tl.E_TURN])
    factor_errors[f, tl.E_FORM] = tl.ISOTROPIC if is_isotropic(kind, fac[f, at.F_AT], payload) else 0.0
    if is_plain_imu(f, fac, payload):
        factor_errors[f, tl.E_FORM] = tl.PLAIN_SAMPLES
