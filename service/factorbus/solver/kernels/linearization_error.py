"""What a step moved is measured: χ² of its factors, and how far each is from its linear model.  MATH §9.6

Every factor with a variable that moved, in its value or in its linearization point, is evaluated.  So after every step
χ² is that of the estimate, and the sum of squared linearization errors is known of all factors: nothing waits for a
later look.  Variables with a factor whose error is above the threshold wait to be relinearized, together.
"""

import math

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels._jit import F64, I64, inline_kernel, part
from factorbus.solver.kernels.ascending import put_in_order
from factorbus.solver.kernels.factor_chi2 import any_chi2, factor_chi2, heading_of
from factorbus.solver.kernels.tree_bend import (
    LINKS,
    SEEN,
    bend_of,
    shift_between,
    slip_between,
    slip_of,
    turn_error,
    turn_of,
)
from factorbus.solver.kernels.tree_exact import exact_error
from factorbus.solver.kernels.tree_mark import dim_of_variable
from factorbus.solver.kernels.tree_move import MODEL, list_moved
from factorbus.solver.kernels.tree_relinearise import WAITS
from factorbus.solver.kernels.tree_take_in import next_incidence

LEAST_BURDEN = 0.02
IN_SPACE, WITH_LANDMARKS = 8.0, 24.0
MUCH = 8  # where more than one variable in so many has moved, all factors are gone through
FIRST_ONLY = 3  # in N_LISTED: it has not moved, but what one of its factors sees has
# The running sums are summed anew once what was added and taken away is so many times what is left.
CANCELLED = 1e5
NOTHING = 1e-6  # χ²
MOST_ERROR = 1e100  # of a factor: its square is still a number


@part
def measure(
    settings: F64, var: I64, fac: I64, payload: F64, node: I64, link: I64, stiff: F64, lin: F64, scalars: F64,
    values: F64, turns: F64, pending: I64, moved: I64, state: I64, account: F64,
) -> float:  # fmt: skip
    """Evaluate the factors of what `moved`, which empties that, and see whether what waits is due.

    Gives Σ error² of what waits, as a multiple of (9.22).
    """
    if state[tl.S_PENDING] == 0:
        state[tl.S_WAITING] = state[tl.S_STEP]
    most = 0.0
    if state[tl.S_MOVED] > 0:
        most = evaluate_moved(
            settings[tl.P_BENT], var, fac, payload, node, link, stiff, lin, scalars, values, turns, pending, moved,
            state, account,
        )  # fmt: skip
        if not account[tl.A_ADDED_UP] <= CANCELLED * (account[tl.A_CHI2] + NOTHING):
            sum_anew(stiff, turns, state, account)
    scaled = weighed(account[tl.A_COUNTED], settings, var, pending, state)
    waited = state[tl.S_STEP] - state[tl.S_WAITING]
    if scaled > settings[tl.P_SOON] or most > settings[tl.P_MOST] or waited >= settings[tl.P_PATIENCE]:
        state[tl.S_DUE] = 1
    return scaled


@part
def evaluate_moved(
    bent: float, var: I64, fac: I64, payload: F64, node: I64, link: I64, stiff: F64, lin: F64, scalars: F64,
    values: F64, turns: F64, pending: I64, moved: I64, state: I64, account: F64,
) -> float:  # fmt: skip
    """χ² and linearization error of every factor of what `moved`; gives the largest error.

    1. The first variables of factors whose second one moved are listed as well: a factor is evaluated from its first.
    2. What their factors counted is taken back.  3. All their factors are evaluated, in the order of their ids where
    many variables moved.  4. The list is empty.
    """
    delta = scalars[0]
    many = state[tl.S_MOVED] * MUCH > state[tl.S_VARIABLES]
    put_in_order(moved[: state[tl.S_MOVED]], state[tl.S_VARIABLES])
    list_first_ends(many, fac, node, link, moved, state)
    error, counted = account[tl.A_ERROR], account[tl.A_COUNTED]
    add_errors(-1.0, node, turns, moved, state, account)
    for k in range(state[tl.S_MOVED]):
        if node[moved[k], tl.N_LISTED] >= MODEL:
            turns[moved[k], tl.U_STRAIN] = turns[moved[k], tl.U_BOUND] = 0.0
    most = 0.0
    if many:
        for f in range(state[tl.S_FACTORS]):
            v = fac[f, at.F_I]
            if node[v, tl.N_LISTED] != 0:
                planar = var[v, at.V_KIND] == at.SE2
                c, s = heading_of(v, planar, var, delta, values, turns)
                error = evaluate_factor(
                    f, v, c, s, bent, var, fac, payload, node, link, stiff, lin, delta, values, turns, pending, state,
                    account,
                )  # fmt: skip
                most = max(most, error)
    else:
        for k in range(state[tl.S_MOVED]):
            v = moved[k]
            planar, slot = var[v, at.V_KIND] == at.SE2, node[v, tl.N_ADJ]
            c, s = heading_of(v, planar, var, delta, values, turns)
            while slot >= 0:
                if slot % 2 == 0:
                    error = evaluate_factor(
                        slot // 2, v, c, s, bent, var, fac, payload, node, link, stiff, lin, delta, values, turns,
                        pending, state, account,
                    )  # fmt: skip
                    most = max(most, error)
                slot = next_incidence(slot, link)
    add_errors(1.0, node, turns, moved, state, account)
    if not (error <= CANCELLED * account[tl.A_ERROR] and counted <= CANCELLED * account[tl.A_COUNTED]):
        account[tl.A_ADDED_UP] = math.inf
    for k in range(state[tl.S_MOVED]):
        node[moved[k], tl.N_LISTED] = 0
    state[tl.S_MOVED] = 0
    return most


@part
def list_first_ends(many: bool, fac: I64, node: I64, link: I64, moved: I64, state: I64) -> None:
    """List the first variable of every factor whose second one moved."""
    if many:
        for f in range(state[tl.S_FACTORS]):
            j = link[f, tl.L_SECOND]
            if j >= 0 and 0 < node[j, tl.N_LISTED] < FIRST_ONLY:
                list_moved(FIRST_ONLY, fac[f, at.F_I], node, moved, state)
        return
    for k in range(state[tl.S_MOVED]):
        slot = node[moved[k], tl.N_ADJ]
        while slot >= 0:
            if slot % 2 != 0:
                list_moved(FIRST_ONLY, fac[slot // 2, at.F_I], node, moved, state)
            slot = next_incidence(slot, link)


@inline_kernel
def add_errors(sign: float, node: I64, turns: F64, moved: I64, state: I64, account: F64) -> None:
    """± Σ error² of the factors of the listed variables."""
    full = counted = 0.0
    for k in range(state[tl.S_MOVED]):
        if node[moved[k], tl.N_LISTED] >= MODEL:
            full += turns[moved[k], tl.U_BOUND]
            counted += turns[moved[k], tl.U_STRAIN]
    account[tl.A_ERROR] = max(account[tl.A_ERROR] + sign * full, 0.0)
    account[tl.A_COUNTED] = max(account[tl.A_COUNTED] + sign * counted, 0.0)


@inline_kernel
def evaluate_factor(
    f: int, v: int, c: float, s: float, bent: float, var: I64, fac: I64, payload: F64, node: I64, link: I64, stiff: F64,
    lin: F64, delta: F64, values: F64, turns: F64, pending: I64, state: I64, account: F64,
) -> float:  # fmt: skip
    """χ² of factor f, whose first variable is v, and its linearization error, where more of v than its place moved."""
    error = 0.0
    if link[f, tl.L_KIND] >= tl.EXACT and node[v, tl.N_LISTED] < MODEL:
        chi2 = any_chi2(f, var, fac, values, payload)
    elif link[f, tl.L_KIND] >= tl.EXACT:
        error, chi2 = exact_error(f, var, fac, lin, values, payload, delta)
        error = min(error, MOST_ERROR)
        turns[v, tl.U_BOUND] += error * error
        if error > bent:
            turns[v, tl.U_STRAIN] += error * error
            await_ends(f, fac, var, node, pending, state)
    else:
        chi2, residual = factor_chi2(f, link[f, tl.L_KIND], c, s, var, fac, values, payload, stiff)
        if link[f, tl.L_FAR] >= 0 and node[v, tl.N_LISTED] >= MODEL:
            error = add_error(
                f, v, bent, residual, var, node, link, stiff, lin, delta, values, turns, pending, state
            )  # fmt: skip
    was = stiff[f, tl.B_CHI2]
    stiff[f, tl.B_CHI2] = chi2
    account[tl.A_CHI2] += chi2 - was
    account[tl.A_ADDED_UP] += chi2 + was
    return error


@inline_kernel
def add_error(
    f: int, v: int, bent: float, residual: float, var: I64, node: I64, link: I64, stiff: F64, lin: F64, delta: F64,
    values: F64, turns: F64, pending: I64, state: I64,
) -> float:  # fmt: skip
    """Add the square of how far factor f is from its linear model to what its first variable v has, and where that is
    more than `bent`, v waits; gives it.  (9.4), (9.5), (9.12), (9.13), (9.26)
    """
    kind, x, y = var[v, at.V_KIND], var[v, at.V_AT], link[f, tl.L_FAR]
    planar, free = kind == at.SE2, var[v, at.V_COLUMN] >= 0
    phi = turn_of(kind, delta, var[v, at.V_SCALAR]) if free else 0.0
    kind = link[f, tl.L_KIND]
    d, root, between = stiff[f, tl.B_LEVER], stiff[f, tl.B_ROOT], kind == at.BETWEEN_SE2 or kind == at.BETWEEN_SE3
    shift = shift_between(planar, x, y, values, lin)
    bend = bend_of(kind, root, d, phi, shift)
    if kind == at.BETWEEN_SE3 and phi > 0.0:
        bend += turn_error(phi, x, y, values, lin, stiff[f, tl.B_TURN])
    if between:
        slip = slip_between(root, d, shift, residual, stiff[f, tl.B_TURN])
        full, error = min(bend + slip, MOST_ERROR), min(bend + LINKS * slip, MOST_ERROR)
        both = LINKS * slip > bend
    else:
        slip = slip_of(kind, root, d, shift, stiff[f, tl.B_PULL])
        full = error = min(SEEN * (bend + slip), MOST_ERROR)
        both = kind == at.BEARING_RANGE_SE2 or slip > bend
    turns[v, tl.U_BOUND] += full * full
    if error > bent:
        turns[v, tl.U_STRAIN] += error * error
        if free:
            await_move(v, node, pending, state)
        if (both or not free) and var[link[f, tl.L_SECOND], at.V_COLUMN] >= 0:
            await_move(link[f, tl.L_SECOND], node, pending, state)
    return error


@part
def await_all(
    least: float, var: I64, fac: I64, node: I64, link: I64, turns: F64, pending: I64, state: I64
) -> None:  # fmt: skip
    """All variables whose factors have more than `least` of Σ error² in full wait, and what these factors join."""
    for v in range(state[tl.S_VARIABLES]):
        if turns[v, tl.U_BOUND] > least:
            slot = node[v, tl.N_ADJ]
            while slot >= 0:
                if slot % 2 == 0:
                    await_ends(slot // 2, fac, var, node, pending, state)
                slot = next_incidence(slot, link)


@inline_kernel
def await_ends(f: int, fac: I64, var: I64, node: I64, pending: I64, state: I64) -> None:
    """The variables of factor f that are free are to be relinearized."""
    for end in range(2):
        v = fac[f, at.F_I + end]
        if v >= 0 and var[v, at.V_COLUMN] >= 0:
            await_move(v, node, pending, state)


@inline_kernel
def await_move(v: int, node: I64, pending: I64, state: I64) -> None:
    """Variable v is to be relinearized."""
    if node[v, tl.N_FLAGS] == 0:
        node[v, tl.N_FLAGS] = WAITS
        pending[state[tl.S_PENDING]] = v
        state[tl.S_PENDING] += 1


@inline_kernel
def weighed(total: float, settings: F64, var: I64, pending: I64, state: I64) -> float:
    """Σ error² as a multiple of what it has to be worth, (9.22)."""
    if total <= LEAST_BURDEN * min(settings[tl.P_SOON], settings[tl.P_BENT_NOW]):
        return 0.0
    scalars, dearest = 0, 1.0
    for k in range(state[tl.S_PENDING]):
        scalars += dim_of_variable(var, pending[k])
        dearest = max(dearest, dearness(var[pending[k], at.V_KIND]))
    return total / (dearest * burden(scalars, settings))


@part
def sum_anew(stiff: F64, turns: F64, state: I64, account: F64) -> None:
    """χ² and Σ error² from what is kept of each factor and variable: running sums lose digits."""
    chi2 = full = counted = 0.0
    for f in range(state[tl.S_FACTORS]):
        chi2 += stiff[f, tl.B_CHI2]
    for v in range(state[tl.S_VARIABLES]):
        full += turns[v, tl.U_BOUND]
        counted += turns[v, tl.U_STRAIN]
    account[tl.A_CHI2], account[tl.A_ADDED_UP] = chi2, 0.0
    account[tl.A_ERROR], account[tl.A_COUNTED] = full, counted


@inline_kernel
def burden(count: int, settings: F64) -> float:
    """The share that so many scalars have to be worth of what `many` have to, to be relinearized.  (9.22)"""
    share = count / settings[tl.P_MANY]
    return min(max(share * share * share, LEAST_BURDEN), 1.0)


@inline_kernel
def dearness(kind: int) -> float:
    """How many times as much as planar poses a variable has to be worth, with all that wait beside it.  (9.22)"""
    if kind == at.SE2:
        return 1.0
    return IN_SPACE if kind == at.SE3 else WITH_LANDMARKS
