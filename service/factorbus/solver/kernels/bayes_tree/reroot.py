"""Bringing what surrounds the robot near the root.  MATH §9.4.

A step changes all cliques from those that its factors touch up to the root.  Where the root is what surrounds the robot
these are few and small, however large the map is.
"""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.add_to_tree import next_incidence
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable, touch
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.scratch import take
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph

INNERMOST = 30.0  # scalars of the smallest ring, at least
MOST_RINGS = 60  # each has a group of its own in the order
NEARBY = 0.25  # of a step's budget, what it may take with what is near
NO_RING = -1  # what is too far out of the way


@inline_kernel
def flops_of(cliques: I64, clique: I64) -> float:
    """What it takes to eliminate these again."""
    flops = 0.0
    for k in range(cliques.size):
        flops += flops_of_clique(clique[cliques[k]])
    return flops


@inline_kernel
def flops_of_clique(row: I64) -> float:
    """The same of one."""
    width = row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS] + 1
    return float(row[tl.C_PIVOTS] * width * width)


@inline_kernel
def count_near(marked: I64, relinearizes: bool, settings: F64, clique: I64, state: I64) -> int:
    """How many scalars are to come near the root with the elimination of the marked cliques; 0: it stays as it is."""
    flops = flops_of(marked, clique)
    if flops <= settings[tl.P_REROOT_MIN_FLOPS]:
        return 0
    if not relinearizes and state[tl.S_SPENT] + flops <= settings[tl.P_REROOT_PERIOD] * state[tl.S_MOVING_ROOT]:
        return 0
    side = flops ** (1.0 / 3.0)
    return int(max(settings[tl.P_REROOT_SIZE_LINEAR] * side, settings[tl.P_REROOT_SIZE_AREA] * side * side))


@part
def touch_near(graph: Graph, tree: Tree, room: int, f1: int, settings: F64, marked: I64, count: int) -> int:
    """Touch up to `room` scalars of the variables nearest to those of the newest factors, but for those that would take
    too much; gives the count of marked cliques.

    Near is what few factors lie between.  N_NEAR of what was looked at becomes the present elimination, N_RING its
    ring: 0 for the outermost, or NO_RING.
    """
    var, fac = graph.var, graph.fac
    node, link, clique, state = tree.node, tree.link, tree.clique, tree.state
    stamp, queue, put, taken = state[tl.S_STAMP], take(room, tree.scratch), 0, 0
    max_extra, wider = (
        settings[tl.P_REROOT_MAX_EXTRA] * flops_of(marked[:count], clique),
        settings[tl.P_REROOT_RING_RATIO],
    )
    ring, within, scalars = 0, float(room), 0
    max_extra = min(max_extra, NEARBY * settings[tl.P_BUDGET])
    while within >= wider * INNERMOST and ring < MOST_RINGS:
        ring, within = ring + 1, within / wider
    for f in range(min(state[tl.S_TAKEN], f1 - 1), f1):
        put = _queue(fac[f, at.F_I], queue, put, var, node, stamp)
        put = _queue(fac[f, at.F_J], queue, put, var, node, stamp)
    while taken < put and room > 0:
        v = queue[taken]
        taken += 1
        flops = flops_above(node[v, tl.N_CLIQUE], clique, stamp)
        if flops > max_extra:
            continue
        max_extra -= flops
        room -= dim_of_variable(var, v)
        scalars += dim_of_variable(var, v)
        while ring > 0 and scalars > within:
            ring, within = ring - 1, within * wider
        node[v, tl.N_RING] = ring
        count = touch(v, node, clique, state, marked, count)
        slot = node[v, tl.N_ADJ]
        while slot >= 0:
            put = _queue(fac[slot // 2, at.F_I + 1 - slot % 2], queue, put, var, node, stamp)
            slot = next_incidence(slot, link)
    return count


@inline_kernel
def flops_above(c: int, clique: I64, stamp: int) -> float:
    """What it takes to eliminate clique c and those above it again, up to a marked one."""
    flops = 0.0
    while c >= 0 and clique[c, tl.C_MARK] != stamp:
        flops += flops_of_clique(clique[c])
        c = clique[c, tl.C_PARENT]
    return flops


@inline_kernel
def _queue(v: int, queue: I64, put: int, var: I64, node: I64, stamp: int) -> int:
    """Variable v is next, unless it is fixed or queued or there is no room for it; gives how many there are."""
    if v >= 0 and put < queue.size and var[v, at.V_COLUMN] >= 0 and node[v, tl.N_NEAR] != stamp:
        node[v, tl.N_NEAR], node[v, tl.N_RING], queue[put] = stamp, NO_RING, v
        put += 1
    return put


@inline_kernel
def account_for(flops: int, moved_root: bool, state: I64) -> None:
    """What an elimination took counts: for the root's last move, or for what was spent since."""
    if moved_root:
        state[tl.S_MOVING_ROOT], state[tl.S_SPENT] = flops, 0
    else:
        state[tl.S_SPENT] += flops
