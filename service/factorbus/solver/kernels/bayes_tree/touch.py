"""What a step takes apart: the cliques that are touched, and what hangs from them.  MATH §9.3, §9.4."""

import math
from typing import NamedTuple

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence
from factorbus.solver.kernels.bayes_tree.affected import detach, touch
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.refactor_in_place import is_worth_ordering, mark_renewed, still_renewed
from factorbus.solver.kernels.bayes_tree.reroot import count_near, touch_near
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.scratch import take
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph


class NewRows(NamedTuple):
    """What is new in a graph: the variables v0 .. v1−1, and the factors that the tree does not have, up to f1−1."""

    v0: int
    v1: int
    f1: int


class Touched(NamedTuple):
    """What a step takes apart.

    cliques    those that it touches   orphans   the cliques that hang from these and stay as they are
    variables  those to be eliminated again, by their local numbers
    renewed    cliques below that only have relinearized factors: they are eliminated again as they are
    near       how many of the cliques were touched because they are around the robot
    """

    cliques: I64
    orphans: I64
    variables: I64
    renewed: I64
    near: int


@part
def find_touched(graph: Graph, tree: Tree, new: NewRows, moving: I64, settings: F64) -> Touched:
    """Touch the cliques that new and edited factors change, and those of the variables `moving`; detach them."""
    var, fac = graph.var, graph.fac
    node, link, clique = tree.node, tree.link, tree.clique
    moved, listed, state = tree.moved, tree.marked, tree.state
    state[tl.S_STAMP] += 1
    count = 0
    for k in range(state[tl.S_EDITED]):
        count = touch(moved[k], node, clique, state, listed, count)
    for f in range(state[tl.S_TAKEN], new.f1):
        count = touch_ends(f, fac, node, clique, state, listed, count)
    renewed = mark_renewed(moving, fac, node, link, clique, state, listed)
    reorders = is_worth_ordering(renewed, clique)
    if reorders:
        renewed = renewed[:0]
        count = touch_around(moving, fac, node, link, clique, state, listed, count)
    # A step with a budget relinearizes a part of the map, which need not come near the root for that.
    moves_root = reorders and not settings[tl.P_BUDGET] < math.inf
    near = count_near(listed[:count], moves_root, settings, clique, state)
    if near > 0:
        count = touch_near(graph, tree, near, new.f1, settings, listed, count)
        renewed = still_renewed(renewed, clique, state)
    cliques = listed[:count]
    room = new.v1 - new.v0
    hanging = 0
    for k in range(count):
        room += clique[cliques[k], tl.C_FRONTALS]
        hanging += 1
        child = clique[cliques[k], tl.C_CHILD]
        while child >= 0:
            hanging += 1
            child = clique[child, tl.C_NEXT]
    variables, orphans = take(room, tree.scratch), take(hanging, tree.scratch)
    n, hanging = detach(graph, tree, cliques, settings, variables, orphans)
    for v in range(new.v0, new.v1):
        if var[v, at.V_COLUMN] >= 0:
            node[v, tl.N_STAMP], node[v, tl.N_LOCAL] = state[tl.S_STAMP], n
            variables[n] = v
            n += 1
    return Touched(cliques, orphans[:hanging], variables[:n], renewed, near)


@part
def touch_around(moving: I64, fac: I64, node: I64, link: I64, clique: I64, state: I64, marked: I64, count: int) -> int:
    """Touch the variables of all factors of `moving`."""
    for k in range(moving.size):
        slot = node[moving[k], tl.N_ADJ]
        while slot >= 0:
            count = touch_ends(slot // 2, fac, node, clique, state, marked, count)
            slot = next_incidence(slot, link)
    return count


@inline_kernel
def touch_ends(f: int, fac: I64, node: I64, clique: I64, state: I64, marked: I64, count: int) -> int:
    """Touch both variables of factor f."""
    count = touch(fac[f, at.F_I], node, clique, state, marked, count)
    if fac[f, at.F_J] >= 0:
        count = touch(fac[f, at.F_J], node, clique, state, marked, count)
    return count
