"""Subtrees that move as a whole.  MATH §9.7.

Relative measurements do not change when all that they join moves together, so neither do the rows of R made of them:
with the motion of the map as a rigid body, ξ = (t, ω), and J the displacement by it in the tangent space of each
variable at its linearization point,

    R_F J_F + R_S J_S = 0                                                                    (9.20)

Where the separator moved by J_S ξ, all that was eliminated below it moves by J ξ, and none of it has to be solved.
"""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.error_terms import turn_of
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, PLACE, move_variable, note_moved
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.scratch import free_since, scratch_used, take
from factorbus.solver.kernels.jit.sorting import put_in_order
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import is_rigid
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.se3 import rotation_matrix

MOTION = tl.MOTION
BODIES = 64  # that move at once, at most
# Scratch of this: ξ since a clique was solved, what of it is new, the displacement of the variable at hand, the largest
# square of what back-substitution left undone, and the new motion of each body.
WHOLE, FRESH, LOCAL, LEFT, TABLE = 0, 6, 12, 18, 19
SIZE = TABLE + BODIES * MOTION
SINGULAR = 1e-12


@inline_kernel
def is_invariant(f: int, var: I64, fac: I64) -> bool:
    """Whether factor f says nothing of where in the world its variables are."""
    kind, j = fac[f, at.F_KIND], fac[f, at.F_J]
    if j < 0 or var[j, at.V_COLUMN] < 0 or var[fac[f, at.F_I], at.V_COLUMN] < 0:
        return False
    return is_rigid(kind) or fac[f, at.F_FLAGS] & at.RIGID != 0


@part
def fit_motion(
    graph: Graph, tree: Tree, row: I64, since: int, far: float, delta: F64, weight: F64, motion: F64
) -> bool:
    """Whether the separator moved as a rigid body since the frontals were solved with it, no scalar being off by more
    than √far σ; motion gets ξ.  since: where `motions` has what is known of it already
    """
    var = graph.var
    lists, numbers, lin, turns, motions = tree.lists, tree.numbers, tree.lin[0], tree.turns, tree.motions
    first = row[tl.C_LIST] + row[tl.C_FRONTALS]
    last, used = first + row[tl.C_SEPARATORS], row[tl.C_USED] + row[tl.C_PIVOTS]
    kind = var[lists[first], at.V_KIND]
    if kind == at.SE2 or kind == at.POINT2:
        fit_plane(graph, tree, first, last, used, delta, weight, motion)
    elif not fit_space(graph, tree, first, last, used, delta, weight, motion):
        return False
    for s in range(first, last):
        v = lists[s]
        d = var[v, at.V_SCALAR]
        displace(v, var, lin, turns, motion, WHOLE, motion)
        for a in range(dim_of_variable(var, v)):
            gap = delta[d + a] - numbers[used] - motion[LOCAL + a]
            if not gap * gap * weight[d + a] <= far:
                return False
            used += 1
    for a in range(MOTION):
        motion[FRESH + a] = motion[WHOLE + a] - (motions[since + a] if row[tl.C_MOVES] & tl.MOVED != 0 else 0.0)
    return True


@inline_kernel
def fit_plane(graph: Graph, tree: Tree, first: int, last: int, used: int, delta: F64, weight: F64, motion: F64) -> None:
    """ξ nearest to how the variables moved, by the weights of their first scalars."""
    var = graph.var
    lists, numbers, lin, turns = tree.lists, tree.numbers, tree.lin[0], tree.turns
    x0, y0 = lin[var[lists[first], at.V_AT]], lin[var[lists[first], at.V_AT] + 1]
    mass = px = py = ux = uy = inertia = torque = 0.0
    for s in range(first, last):
        v = lists[s]
        d, x = var[v, at.V_SCALAR], var[v, at.V_AT]
        w, dx, dy = weight[d], lin[x] - x0, lin[x + 1] - y0
        gx, gy = delta[d] - numbers[used], delta[d + 1] - numbers[used + 1]
        used += 2
        if var[v, at.V_KIND] == at.SE2:
            c, z, turn_weight = turns[v, tl.U_COS], turns[v, tl.U_SIN], weight[d + 2]
            gx, gy = c * gx - z * gy, z * gx + c * gy
            inertia += turn_weight
            torque += turn_weight * (delta[d + 2] - numbers[used])
            used += 1
        mass += w
        px += w * dx
        py += w * dy
        ux += w * gx
        uy += w * gy
        inertia += w * (dx * dx + dy * dy)
        torque += w * (dx * gy - dy * gx)
    inertia -= (px * px + py * py) / mass
    torque -= (px * uy - py * ux) / mass
    turn = torque / inertia if inertia > 0.0 else 0.0
    px, py = px / mass + x0, py / mass + y0
    motion[WHOLE], motion[WHOLE + 1], motion[WHOLE + 2] = ux / mass + turn * py, uy / mass - turn * px, 0.0
    motion[WHOLE + 3], motion[WHOLE + 4], motion[WHOLE + 5] = 0.0, 0.0, turn


@inline_kernel
def moved_in_space(d: int, place: int, x: int, kind: int, numbers: F64, delta: F64, lin: F64) -> tuple:
    """How a variable moved and turned, in the map's frame."""
    gx, gy = delta[d] - numbers[place], delta[d + 1] - numbers[place + 1]
    gz = delta[d + 2] - numbers[place + 2]
    if kind != at.SE3:
        return gx, gy, gz, 0.0, 0.0, 0.0
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(lin, x + 3)
    hx, hy = delta[d + 3] - numbers[place + 3], delta[d + 4] - numbers[place + 4]
    hz = delta[d + 5] - numbers[place + 5]
    return (
        a0 * gx + a1 * gy + a2 * gz,
        a3 * gx + a4 * gy + a5 * gz,
        a6 * gx + a7 * gy + a8 * gz,
        a0 * hx + a1 * hy + a2 * hz,
        a3 * hx + a4 * hy + a5 * hz,
        a6 * hx + a7 * hy + a8 * hz,
    )


@inline_kernel
def fit_space(graph: Graph, tree: Tree, first: int, last: int, used: int, delta: F64, weight: F64, motion: F64) -> bool:
    """The same of poses and points in space; False: any turn about some axis would do."""
    var = graph.var
    lists, numbers, lin = tree.lists, tree.numbers, tree.lin[0]
    origin = var[lists[first], at.V_AT]
    x0, y0, z0 = lin[origin], lin[origin + 1], lin[origin + 2]
    mass = px = py = pz = ux = uy = uz = 0.0
    xx = xy = xz = yy = yz = zz = bx = by = bz = 0.0
    for s in range(first, last):
        v = lists[s]
        d, x, w = var[v, at.V_SCALAR], var[v, at.V_AT], weight[var[v, at.V_SCALAR]]
        gx, gy, gz, hx, hy, hz = moved_in_space(d, used, x, var[v, at.V_KIND], numbers, delta, lin)
        turn_weight = weight[d + 3] if var[v, at.V_KIND] == at.SE3 else 0.0
        used += dim_of_variable(var, v)
        qx, qy, qz = lin[x] - x0, lin[x + 1] - y0, lin[x + 2] - z0
        mass += w
        px += w * qx
        py += w * qy
        pz += w * qz
        ux += w * gx
        uy += w * gy
        uz += w * gz
        xx += w * (qy * qy + qz * qz) + turn_weight
        yy += w * (qx * qx + qz * qz) + turn_weight
        zz += w * (qx * qx + qy * qy) + turn_weight
        xy -= w * qx * qy
        xz -= w * qx * qz
        yz -= w * qy * qz
        bx += w * (qy * gz - qz * gy) + turn_weight * hx
        by += w * (qz * gx - qx * gz) + turn_weight * hy
        bz += w * (qx * gy - qy * gx) + turn_weight * hz
    # About the centre.
    xx, yy, zz = xx - (py * py + pz * pz) / mass, yy - (px * px + pz * pz) / mass, zz - (px * px + py * py) / mass
    xy, xz, yz = xy + px * py / mass, xz + px * pz / mass, yz + py * pz / mass
    bx, by, bz = bx - (py * uz - pz * uy) / mass, by - (pz * ux - px * uz) / mass, bz - (px * uy - py * ux) / mass
    px, py, pz = px / mass + x0, py / mass + y0, pz / mass + z0
    ux, uy, uz = ux / mass, uy / mass, uz / mass
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    cyy, cyz, czz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    det = xx * cxx + xy * cxy + xz * cxz
    trace = xx + yy + zz
    if not det > SINGULAR * trace * trace * trace:
        return False
    ox, oy = (cxx * bx + cxy * by + cxz * bz) / det, (cxy * bx + cyy * by + cyz * bz) / det
    oz = (cxz * bx + cyz * by + czz * bz) / det
    motion[WHOLE], motion[WHOLE + 1] = ux - (oy * pz - oz * py), uy - (oz * px - ox * pz)
    motion[WHOLE + 2] = uz - (ox * py - oy * px)
    motion[WHOLE + 3], motion[WHOLE + 4], motion[WHOLE + 5] = ox, oy, oz
    return True


@inline_kernel
def displace(v: int, var: I64, lin: F64, turns: F64, given: F64, xi: int, motion: F64) -> None:
    """motion[LOCAL :] = J ξ of variable v, ξ at offset xi of `given`."""
    kind, x = var[v, at.V_KIND], var[v, at.V_AT]
    if kind == at.SE2 or kind == at.POINT2:
        turn = given[xi + 5]
        gx, gy = given[xi] - turn * lin[x + 1], given[xi + 1] + turn * lin[x]
        if kind == at.SE2:
            c, z = turns[v, tl.U_COS], turns[v, tl.U_SIN]
            gx, gy = c * gx + z * gy, c * gy - z * gx
        motion[LOCAL], motion[LOCAL + 1], motion[LOCAL + 2] = gx, gy, turn
        return
    ox, oy, oz = given[xi + 3], given[xi + 4], given[xi + 5]
    px, py, pz = lin[x], lin[x + 1], lin[x + 2]
    gx, gy = given[xi] + oy * pz - oz * py, given[xi + 1] + oz * px - ox * pz
    gz = given[xi + 2] + ox * py - oy * px
    if kind == at.SE3:
        a0, a1, a2, a3, a4, a5, a6, a7, a8 = rotation_matrix(lin, x + 3)
        gx, gy, gz = a0 * gx + a3 * gy + a6 * gz, a1 * gx + a4 * gy + a7 * gz, a2 * gx + a5 * gy + a8 * gz
        motion[LOCAL + 3] = a0 * ox + a3 * oy + a6 * oz
        motion[LOCAL + 4] = a1 * ox + a4 * oy + a7 * oz
        motion[LOCAL + 5] = a2 * ox + a5 * oy + a8 * oz
    motion[LOCAL], motion[LOCAL + 1], motion[LOCAL + 2] = gx, gy, gz


@part
def list_subtree(top: int, body: int, clique: I64, motions: F64, motion: F64, listed: I64, count: int, end: int) -> int:
    """All that was eliminated in clique `top` and below it moves by the new part of `motion`, as body number `body`.

    Its cliques remember that at once, and are listed from `count` on; `move_bodies` moves their variables.  What would
    be listed from `end` on stays behind.  Gives the new count.
    """
    for a in range(MOTION):
        motion[TABLE + body * MOTION + a] = motion[FRESH + a]
    c = top
    while True:
        row, since = clique[c], c * tl.M_WIDTH
        for a in range(MOTION):
            before = motions[since + a] if row[tl.C_MOVES] & tl.MOVED != 0 else 0.0
            motions[since + a] = before + motion[FRESH + a]
        row[tl.C_MOVES] |= tl.MOVED
        wx, wy, wz = motions[since + 3], motions[since + 4], motions[since + 5]
        motions[since + tl.M_BODY] = float(body)
        motions[since + tl.M_TURN] = math.sqrt(wx * wx + wy * wy + wz * wz)
        listed[count] = c
        count += 1
        if count >= end:
            leave_behind(c, clique)
            return count
        if row[tl.C_CHILD] >= 0:
            c = row[tl.C_CHILD]
            continue
        while c != top and clique[c, tl.C_NEXT] < 0:
            c = clique[c, tl.C_PARENT]
        if c == top:
            return count
        c = clique[c, tl.C_NEXT]


@inline_kernel
def leave_behind(c: int, clique: I64) -> None:
    """Something below clique c may have moved, and was not looked at: the next back-substitution comes by."""
    while c >= 0 and clique[c, tl.C_MOVES] & tl.BEHIND == 0:
        clique[c, tl.C_MOVES] |= tl.BEHIND
        c = clique[c, tl.C_PARENT]


@part
def move_bodies(graph: Graph, tree: Tree, listed: I64, quiet: float, delta: F64, before: F64, motion: F64) -> None:
    """The variables of the listed cliques move with their bodies, in the order in which they lie in memory.

    Where the error (9.21) of turns since it was solved is at most `quiet`, linearization errors stay what they were.
    """
    var = graph.var
    node, clique, lists, lin, turns = tree.node, tree.clique, tree.lists, tree.lin[0], tree.turns
    moved, motions, state = tree.moved, tree.motions, tree.state
    n = 0
    for k in range(listed.size):
        n += clique[listed[k], tl.C_FRONTALS]
    taken = scratch_used(tree.scratch)
    variables = take(n, tree.scratch)
    n = 0
    for k in range(listed.size):
        start = clique[listed[k], tl.C_LIST]
        for s in range(start, start + clique[listed[k], tl.C_FRONTALS]):
            variables[n] = lists[s]
            n += 1
    put_in_order(variables, state[tl.S_VARIABLES])
    for k in range(n):
        v = variables[k]
        since, kind, d = node[v, tl.N_CLIQUE] * tl.M_WIDTH, var[v, at.V_KIND], var[v, at.V_SCALAR]
        displace(v, var, lin, turns, motion, TABLE + int(motions[since + tl.M_BODY]) * MOTION, motion)
        for a in range(dim_of_variable(var, v)):
            delta[d + a] += motion[LOCAL + a]
        move_variable(graph, tree, v, delta, lin, before)
        lever_error = 2.0 * turns[v, tl.U_LEVER] * turn_of(kind, delta, d) * motions[since + tl.M_TURN]
        note_moved(MODEL if lever_error > quiet else PLACE, v, node, moved, state)
    free_since(taken, tree.scratch)
