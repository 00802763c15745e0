"""Moving linearisation points of single variables to the estimate, and back.  MATH §9.6."""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence, note_turn
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.hessian import linearise_factor
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, list_moved
from factorbus.solver.kernels.jit.compile import F64, I64, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.sizes import size_of

WAITS, MOVES = 1, 2
SPARSE = 16  # where no more than one factor in so many is to be linearised, the others are not looked through


@part
def relinearise(
    pending: I64, var: I64, fac: I64, values: F64, payload: F64, node: I64, link: I64, hessian: F64, lin: F64,
    scalars: F64, stiff: F64, turns: F64, moved: I64, state: I64,
) -> None:  # fmt: skip
    """Move the pending variables to the estimate, and linearise their factors there."""
    for k in range(pending.size):
        v = pending[k]
        if node[v, tl.N_FLAGS] != WAITS:
            continue
        x, d = var[v, at.V_AT], var[v, at.V_SCALAR]
        for a in range(size_of(var[v, at.V_KIND])):
            lin[1, x + a], lin[0, x + a] = lin[0, x + a], values[x + a]
        for a in range(dim_of_variable(var, v)):
            scalars[2, d + a], scalars[0, d + a] = scalars[0, d + a], 0.0
        note_turn(v, var, lin, turns)
        node[v, tl.N_FLAGS] = MOVES
        list_moved(MODEL, v, node, moved, state)
        state[tl.S_RELINEARISED] += 1
    linearise_around(pending, var, fac, payload, node, link, hessian, lin, stiff, state)


@part
def go_back(
    pending: I64, var: I64, fac: I64, payload: F64, node: I64, link: I64, hessian: F64, lin: F64, scalars: F64,
    stiff: F64, turns: F64, state: I64,
) -> None:  # fmt: skip
    """Undo `relinearise`: its variables wait again."""
    for k in range(pending.size):
        v = pending[k]
        x, d = var[v, at.V_AT], var[v, at.V_SCALAR]
        for a in range(size_of(var[v, at.V_KIND])):
            lin[0, x + a] = lin[1, x + a]
        for a in range(dim_of_variable(var, v)):
            scalars[0, d + a] = scalars[2, d + a]
        note_turn(v, var, lin, turns)
        node[v, tl.N_FLAGS] = WAITS
        state[tl.S_RELINEARISED] -= 1
    linearise_around(pending, var, fac, payload, node, link, hessian, lin, stiff, state)


@part
def linearise_around(
    variables: I64, var: I64, fac: I64, payload: F64, node: I64, link: I64, hessian: F64, lin: F64, stiff: F64,
    state: I64,
) -> None:  # fmt: skip
    """Linearise the factors of some variables, each once, in the order of their ids: so they lie in memory.

    In that of the variables, which is the tree's, it takes twice as long.
    """
    r, H, W = np.zeros(at.R_SIZE), np.zeros((4, 6, 6)), np.zeros((6, 6))
    state[tl.S_SWEEP] += 1
    sweep, count, first, last = state[tl.S_SWEEP], 0, state[tl.S_FACTORS], -1
    for k in range(variables.size):
        slot = node[variables[k], tl.N_ADJ]
        while slot >= 0:
            f = slot // 2
            if link[f, tl.L_STAMP] != sweep:
                link[f, tl.L_STAMP] = sweep
                first, last, count = min(first, f), max(last, f), count + 1
            slot = next_incidence(slot, link)
    if last - first < SPARSE * count:
        for f in range(first, last + 1):
            if link[f, tl.L_STAMP] == sweep:
                linearise_factor(f, var, fac, lin[0], payload, link, hessian, stiff, r, H, W, state)
        return
    for k in range(variables.size):
        slot = node[variables[k], tl.N_ADJ]
        while slot >= 0:
            f = slot // 2
            if link[f, tl.L_STAMP] == sweep:
                link[f, tl.L_STAMP] = -1
                linearise_factor(f, var, fac, lin[0], payload, link, hessian, stiff, r, H, W, state)
            slot = next_incidence(slot, link)
