"""Back-substitution from the new roots down, as far as anything changes.  MATH §9.7.

A clique that was there before is solved again only when its separator has moved by more than `ripple` standard
deviations since the clique was solved last; so what is left undone never adds up over the steps.
"""

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels._jit import F64, I64, inline_kernel, part
from factorbus.solver.kernels.points import move_point2, move_point3
from factorbus.solver.kernels.se2 import turn_se2
from factorbus.solver.kernels.se3 import move_se3
from factorbus.solver.kernels.sights import move_idp
from factorbus.solver.kernels.simd import at as load
from factorbus.solver.kernels.simd import put
from factorbus.solver.kernels.sizes import size_of
from factorbus.solver.kernels.tree_bend import (
    SEEN,
    axes_of,
    bend_of,
    may_slip,
    shift_between,
    slip_between,
    slip_of,
    turn_of,
)
from factorbus.solver.kernels.tree_exact import exact_bend
from factorbus.solver.kernels.tree_mark import dim_of_variable
from factorbus.solver.kernels.tree_relinearise import WAITS
from factorbus.solver.kernels.tree_take_in import next_incidence


@part
def substitute(
    ids: I64, ripple: float, var: I64, node: I64, clique: I64, lists: I64, numbers: F64, lin: F64, scalars: F64,
    turns: F64, values: F64, changed: I64, moved: I64, state: I64, account: F64,
) -> None:  # fmt: skip
    """Solve the new cliques and whatever moves with them.

    changed: gets the variables whose δ changed, each once in a step; S_CHANGED says how many.  lin[2]
    gets what they were.  moved: gets them too, where they are not there yet
    """
    far, delta, weight = ripple * ripple, scalars[0], scalars[1]
    for f in range(ids.size - 1, -1, -1):
        if clique[ids[f], tl.C_PARENT] >= 0:
            continue
        c = ids[f]
        while c >= 0:
            row = clique[c]
            gather_separator(row, var, lists, delta, numbers)
            solve_rows(row, numbers)
            row[tl.C_FIRST] = 0
            state[tl.S_SOLVED] += 1
            move_frontals(
                row, var, node, lists, numbers, scalars, lin[0], lin[2], turns, values, changed, moved, state, account
            )
            c = next_clique(row[tl.C_CHILD], c, far, var, clique, lists, numbers, delta, weight)


@inline_kernel
def next_clique(
    child: int, above: int, far: float, var: I64, clique: I64, lists: I64, numbers: F64, delta: F64, weight: F64
) -> int:
    """The next clique to solve, from `child` of clique `above` on, depth first; −1: none is left."""
    while True:
        while child >= 0:
            row = clique[child]
            if row[tl.C_FIRST] == -1 or has_moved(row, far, var, lists, numbers, delta, weight):
                return child
            child = row[tl.C_NEXT]
        if clique[above, tl.C_PARENT] < 0:
            return -1
        child, above = clique[above, tl.C_NEXT], clique[above, tl.C_PARENT]


@inline_kernel
def has_moved(row: I64, far: float, var: I64, lists: I64, numbers: F64, delta: F64, weight: F64) -> bool:
    """Whether a scalar of the separator is further than √far σ from where the frontals were solved with it."""
    start = row[tl.C_LIST] + row[tl.C_FRONTALS]
    used = row[tl.C_USED] + row[tl.C_PIVOTS]
    for s in range(start, start + row[tl.C_SEPARATORS]):
        v = lists[s]
        d = var[v, at.V_SCALAR]
        for a in range(dim_of_variable(var, v)):
            gap = load(delta, d + a) - load(numbers, used)
            if gap * gap * load(weight, d + a) > far:
                return True
            used += 1
    return False


@inline_kernel
def gather_separator(row: I64, var: I64, lists: I64, delta: F64, numbers: F64) -> None:
    """δ_S behind the place of δ_F."""
    start = row[tl.C_LIST] + row[tl.C_FRONTALS]
    x = row[tl.C_USED] + row[tl.C_PIVOTS]
    for s in range(start, start + row[tl.C_SEPARATORS]):
        v = lists[s]
        d = var[v, at.V_SCALAR]
        for a in range(dim_of_variable(var, v)):
            put(numbers, x, load(delta, d + a))
            x += 1


@inline_kernel
def solve_rows(row: I64, numbers: F64) -> None:
    """δ_F = R_F⁻¹ (d − R_S δ_S), the product first: its rows do not wait for each other.

    Of a pivot only the product with the one that was solved just before waits for that.
    """
    p, used, ld = row[tl.C_PIVOTS], row[tl.C_USED], row[tl.C_LD]
    width = p + row[tl.C_BORDER]
    for i in range(p):
        line, total = row[tl.C_ROWS] + i * ld, 0.0
        for k in range(p, width):
            total += load(numbers, line + k) * load(numbers, used + k)
        put(numbers, used + i, load(numbers, line + width) - total)
    before = 0.0
    for i in range(p - 1, -1, -1):
        line, total = row[tl.C_ROWS] + i * ld, load(numbers, used + i)
        share = 1.0 / load(numbers, line + i)
        for k in range(i + 2, p):
            total -= load(numbers, line + k) * load(numbers, used + k)
        # Behind the last column there is d, and `before` is zero.
        before = (total - load(numbers, line + i + 1) * before) * share
        put(numbers, used + i, before)


@inline_kernel
def move_frontals(
    row: I64, var: I64, node: I64, lists: I64, numbers: F64, scalars: F64, lin: F64, before: F64, turns: F64,
    values: F64, changed: I64, moved: I64, state: I64, account: F64,
) -> None:  # fmt: skip
    """The estimate of the frontals whose δ is another one."""
    start, solved, step = row[tl.C_LIST], row[tl.C_USED], state[tl.S_STEP]
    delta, weight = scalars[0], scalars[1]
    for s in range(start, start + row[tl.C_FRONTALS]):
        v = lists[s]
        kind, d, differs, far = var[v, at.V_KIND], var[v, at.V_SCALAR], False, 0.0
        shifts = 2 if kind == at.SE2 else 3
        for a in range(dim_of_variable(var, v)):
            gap = load(numbers, solved) - load(delta, d + a)
            differs |= gap != 0.0
            far += gap * gap * (load(weight, d + a) if a < shifts else turns[v, tl.U_LEVER] * turns[v, tl.U_LEVER])
            put(delta, d + a, load(numbers, solved))
            solved += 1
        if differs:
            x = var[v, at.V_AT]
            if node[v, tl.N_MOVED] != step:
                node[v, tl.N_MOVED] = step
                changed[state[tl.S_CHANGED]] = v
                state[tl.S_CHANGED] += 1
                for a in range(size_of(kind)):
                    put(before, x + a, load(values, x + a))
            if node[v, tl.N_LISTED] == 0:
                node[v, tl.N_LISTED] = 1
                moved[state[tl.S_MOVED]] = v
                state[tl.S_MOVED] += 1
            if kind == at.SE2:
                turn_se2(lin, x, turns[v, tl.U_COS], turns[v, tl.U_SIN], delta, d, values)
            else:
                move_to(kind, lin, x, delta, d, values)
            phi = turn_of(kind, delta, d)
            account[tl.A_ALARM] += phi * phi * far  # (9.15)


@part
def find_bent(
    settings: F64, var: I64, fac: I64, payload: F64, node: I64, link: I64, stiff: F64, lin: F64,
    scalars: F64, values: F64, turns: F64, pending: I64, moved: I64, state: I64,
) -> tuple[float, float]:  # fmt: skip
    """Add to `pending` what is bent of what `moved`, empty that, and see whether it is due; gives the largest bend of
    what moved, and Σ bend² of all that waits.
    """
    if state[tl.S_PENDING] == 0:
        state[tl.S_WAITING] = state[tl.S_STEP]
    bent = settings[tl.P_BENT]
    most = look(
        bent, var, fac, payload, node, link, stiff, lin, scalars, values, turns, pending, moved, state
    )  # fmt: skip
    for k in range(state[tl.S_MOVED]):
        node[moved[k], tl.N_LISTED] = 0
    state[tl.S_MOVED] = 0
    total, waited = 0.0, state[tl.S_STEP] - state[tl.S_WAITING]
    for k in range(state[tl.S_PENDING]):
        total += turns[pending[k], tl.U_STRAIN]
    if total > settings[tl.P_SOON] or most > settings[tl.P_MOST] or waited >= settings[tl.P_PATIENCE]:
        state[tl.S_DUE] = 1
    return most, total


@part
def look(
    bent: float, var: I64, fac: I64, payload: F64, node: I64, link: I64, stiff: F64, lin: F64,
    scalars: F64, values: F64, turns: F64, pending: I64, moved: I64, state: I64,
) -> float:  # fmt: skip
    """Add to `pending` what is to be relinearised of the `moved` variables: the poses with a factor that is bent by
    more than `bent`, (9.4), with what they see where that is what has moved, (9.5), (9.12) and (9.13), and both ends of
    one for which that is computed, (9.11).  turns: gets Σ bend² of each.  Gives the largest bend.
    """
    most, delta = 0.0, scalars[0]
    for k in range(state[tl.S_MOVED]):
        v = moved[k]
        pull, phi = 0.0, turn_of(var[v, at.V_KIND], delta, var[v, at.V_SCALAR])
        if phi == 0.0 and state[tl.S_EXACT] == 0:
            continue
        planar, x = var[v, at.V_KIND] == at.SE2, var[v, at.V_AT]
        axes, turned = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), False
        slot = node[v, tl.N_ADJ]
        while slot >= 0:
            f = slot // 2
            kind, y = link[f, tl.L_KIND], link[f, tl.L_FAR]
            if kind >= tl.EXACT:
                bend = exact_bend(f, var, fac, lin, values, payload, delta)
                most = max(most, bend)
                if bend > bent:
                    pull += 0.5 * bend * bend  # half of it for each end
                    await_ends(f, fac, var, node, pending, state)
            elif slot % 2 == 0 and phi > 0.0 and y >= 0:
                d, root, pulled = stiff[f, tl.B_LEVER], stiff[f, tl.B_ROOT], stiff[f, tl.B_PULL]
                shift = shift_between(planar, x, y, values, lin)
                bend = bend_of(kind, root, d, phi, shift)
                slip = slip_of(kind, root, d, shift, pulled)
                if may_slip(kind, root, d, phi, shift, pulled, stiff[f, tl.B_TURN], bent - bend):
                    if not turned:
                        axes, turned = axes_of(planar, x, values), True
                    slip = slip_between(planar, axes, x, y, shift, values, stiff, f)
                both = kind == at.BEARING_RANGE_SE2 or slip > bend
                bend += slip
                most = max(most, bend)
                if kind != at.BETWEEN_SE2 and kind != at.BETWEEN_SE3:
                    bend *= SEEN
                if bend > bent:
                    pull += bend * bend
                    await_move(v, node, pending, state)
                    if both and var[link[f, tl.L_SECOND], at.V_COLUMN] >= 0:
                        await_move(link[f, tl.L_SECOND], node, pending, state)
            slot = next_incidence(slot, link)
        turns[v, tl.U_STRAIN] = pull
    return most


@inline_kernel
def await_ends(f: int, fac: I64, var: I64, node: I64, pending: I64, state: I64) -> None:
    """The variables of factor f that are free are to be relinearised."""
    for end in range(2):
        v = fac[f, at.F_I + end]
        if v >= 0 and var[v, at.V_COLUMN] >= 0:
            await_move(v, node, pending, state)


@inline_kernel
def await_move(v: int, node: I64, pending: I64, state: I64) -> None:
    """Variable v is to be relinearised."""
    if node[v, tl.N_FLAGS] == 0:
        node[v, tl.N_FLAGS] = WAITS
        pending[state[tl.S_PENDING]] = v
        state[tl.S_PENDING] += 1


@inline_kernel
def move_to(kind: int, lin: F64, x: int, delta: F64, d: int, out: F64) -> None:
    """out = lin ⊞ δ, of what is no plane pose."""
    if kind == at.SE3:
        move_se3(lin, x, delta, d, out)
    elif kind == at.POINT2:
        move_point2(lin, x, delta, d, out)
    elif kind == at.IDP:
        move_idp(lin, x, delta, d, out)
    else:
        move_point3(lin, x, delta, d, out)
