"""What is bent of what moved, and whether that is due to be relinearised.  MATH §9.6."""

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels._jit import F64, I64, inline_kernel, part
from factorbus.solver.kernels.ascending import put_in_order
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

LEAST_BURDEN = 0.02
IN_SPACE, WITH_LANDMARKS = 8.0, 24.0
LEAST_LOOK, MANY_LOOKS = 0.02, 1000
WITHOUT_LOOP, FEW = 4, 60
MUCH = 8  # where more than one variable in so many has moved, all factors are looked through


@part
def find_bent(
    settings: F64, var: I64, fac: I64, payload: F64, node: I64, link: I64, stiff: F64, lin: F64,
    scalars: F64, values: F64, turns: F64, pending: I64, moved: I64, state: I64,
) -> tuple[float, float]:  # fmt: skip
    """Add to `pending` what is bent of what `moved`, empty that, and see whether it is due; gives the largest bend of
    what moved, and Σ bend² of all that waits, as a multiple of (9.22).
    """
    state[tl.S_LOOKED] = state[tl.S_STEP]
    if state[tl.S_PENDING] == 0:
        state[tl.S_WAITING] = state[tl.S_STEP]
    bent = settings[tl.P_BENT]
    put_in_order(moved[: state[tl.S_MOVED]], state[tl.S_VARIABLES])
    most = look(
        bent, var, fac, payload, node, link, stiff, lin, scalars, values, turns, pending, moved, state
    )  # fmt: skip
    for k in range(state[tl.S_MOVED]):
        node[moved[k], tl.N_LISTED] = 0
    state[tl.S_MOVED] = 0
    total, scalars_waiting, dearest, waited = 0.0, 0, 1.0, state[tl.S_STEP] - state[tl.S_WAITING]
    for k in range(state[tl.S_PENDING]):
        v = pending[k]
        total += turns[v, tl.U_STRAIN]
        scalars_waiting += dim_of_variable(var, v)
        dearest = max(dearest, dearness(var[v, at.V_KIND]))
    total /= dearest * burden(scalars_waiting, settings)
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
    if state[tl.S_EXACT] == 0 and state[tl.S_MOVED] * MUCH > state[tl.S_VARIABLES]:
        return look_through(bent, var, fac, node, link, stiff, lin, scalars, values, turns, pending, moved, state)
    most, delta = 0.0, scalars[0]
    for k in range(state[tl.S_MOVED]):
        v = moved[k]
        pull, phi = 0.0, turn_of(var[v, at.V_KIND], delta, var[v, at.V_SCALAR])
        if phi == 0.0 and state[tl.S_EXACT] == 0:
            continue
        slot = node[v, tl.N_ADJ]
        while slot >= 0:
            f = slot // 2
            if link[f, tl.L_KIND] >= tl.EXACT:
                bend = exact_bend(f, var, fac, lin, values, payload, delta)
                most = max(most, bend)
                if bend > bent:
                    pull += 0.5 * bend * bend  # half of it for each end
                    await_ends(f, fac, var, node, pending, state)
            elif slot % 2 == 0 and phi > 0.0 and link[f, tl.L_FAR] >= 0:
                bend, counts = look_at(f, v, phi, bent, var, node, link, stiff, lin, values, pending, state)
                most = max(most, bend)
                pull += counts
            slot = next_incidence(slot, link)
        turns[v, tl.U_STRAIN] = pull
    return most


@part
def look_through(
    bent: float, var: I64, fac: I64, node: I64, link: I64, stiff: F64, lin: F64, scalars: F64, values: F64, turns: F64,
    pending: I64, moved: I64, state: I64,
) -> float:  # fmt: skip
    """`look` where much has moved and no bend is computed exactly: at all factors, in the order in which they lie in
    memory, for in that of the variables each waits for the one before.
    """
    most, delta = 0.0, scalars[0]
    for k in range(state[tl.S_MOVED]):
        v = moved[k]
        if turn_of(var[v, at.V_KIND], delta, var[v, at.V_SCALAR]) > 0.0:
            turns[v, tl.U_STRAIN] = 0.0
    for f in range(state[tl.S_FACTORS]):
        v = fac[f, at.F_I]
        if node[v, tl.N_LISTED] != 0 and link[f, tl.L_FAR] >= 0:
            phi = turn_of(var[v, at.V_KIND], delta, var[v, at.V_SCALAR])
            if phi > 0.0:
                bend, counts = look_at(f, v, phi, bent, var, node, link, stiff, lin, values, pending, state)
                most = max(most, bend)
                turns[v, tl.U_STRAIN] += counts
    return most


@inline_kernel
def look_at(
    f: int, v: int, phi: float, bent: float, var: I64, node: I64, link: I64, stiff: F64, lin: F64, values: F64,
    pending: I64, state: I64,
) -> tuple[float, float]:  # fmt: skip
    """How far factor f, seen from v, is bent, and what of its square counts: 0 where that is less than `bent`."""
    planar, x = var[v, at.V_KIND] == at.SE2, var[v, at.V_AT]
    kind, y = link[f, tl.L_KIND], link[f, tl.L_FAR]
    d, root, pulled = stiff[f, tl.B_LEVER], stiff[f, tl.B_ROOT], stiff[f, tl.B_PULL]
    shift = shift_between(planar, x, y, values, lin)
    bend = bend_of(kind, root, d, phi, shift)
    slip = slip_of(kind, root, d, shift, pulled)
    if may_slip(kind, root, d, phi, shift, pulled, stiff[f, tl.B_TURN], bent - bend):
        slip = slip_between(planar, axes_of(planar, x, values), x, y, shift, values, stiff, f)
    both = kind == at.BEARING_RANGE_SE2 or slip > bend
    bend += slip
    counts = bend if kind == at.BETWEEN_SE2 or kind == at.BETWEEN_SE3 else SEEN * bend
    if counts <= bent:
        return bend, 0.0
    await_move(v, node, pending, state)
    if both and var[link[f, tl.L_SECOND], at.V_COLUMN] >= 0:
        await_move(link[f, tl.L_SECOND], node, pending, state)
    return bend, counts * counts


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
def burden(count: int, settings: F64) -> float:
    """The share that so many scalars have to be worth of what `many` have to, to be relinearised.  (9.22)"""
    share = count / settings[tl.P_MANY]
    return min(max(share * share * share, LEAST_BURDEN), 1.0)


@inline_kernel
def dearness(kind: int) -> float:
    """How many times as much as planar poses a variable has to be worth, with all that wait beside it.  (9.22)"""
    if kind == at.SE2:
        return 1.0
    return IN_SPACE if kind == at.SE3 else WITH_LANDMARKS


@inline_kernel
def is_time_to_look(closes: bool, settings: F64, state: I64) -> bool:
    """Whether it is looked for what is bent, in a step that `closes` a loop or does not.  MATH §9.6"""
    since = state[tl.S_STEP] - state[tl.S_LOOKED]
    # What bends with its depth or its weight gives no sign of it that is as cheap as a turn.
    if state[tl.S_EXACT] > 0 or since >= WITHOUT_LOOP * settings[tl.P_EVERY]:
        return True
    return closes and (since >= settings[tl.P_EVERY] or state[tl.S_MOVED] < FEW)


@inline_kernel
def is_alarming(settings: F64, state: I64, account: F64) -> bool:
    """Whether what moved since it was looked last may have bent by so much that it is looked at once.  (9.15)"""
    share = min(max(state[tl.S_MOVED] / MANY_LOOKS, LEAST_LOOK), 1.0)
    return account[tl.A_ALARM] > settings[tl.P_LOOK] * share
