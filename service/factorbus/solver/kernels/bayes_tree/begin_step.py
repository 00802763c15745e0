"""Before a step of the tree: room, good first values, and whether everything new is determined.  MATH §9.2."""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.hessian_room import MOST_ROOM
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.graph.initialize import follow, reach
from factorbus.solver.kernels.graph.local_init import initialize_new
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.records import table_of
from factorbus.solver.kernels.jit.scratch import clear_scratch, take
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph


@part
def begin_step(graph: Graph, tree: Tree) -> int:
    """Gives DONE: the step can begin; NO_ROOM: the arenas by variable and factor are short; UNSURE: see `step`."""
    var, fac, values, payload, counts = graph.var, graph.fac, graph.values, graph.payload, graph.counts
    settings, node, link, hessian, lin = tree.settings, tree.node, tree.link, tree.hessian, tree.lin
    scalars, saved, state = tree.scalars, tree.saved, tree.state
    clear_scratch(tree.scratch)
    v0, v1, f0, f1 = state[tl.S_VARIABLES], counts[at.VARIABLES], state[tl.S_FACTORS], counts[at.FACTORS]
    if (
        v1 > len(node)
        or f1 > len(link)
        or counts[at.VALUES] > lin.shape[1]
        or counts[at.SCALARS] > scalars.shape[1]
        or state[tl.S_HESSIAN] + (f1 - f0) * MOST_ROOM > hessian.size
        or 2 * (f1 - f0) > len(saved)
    ):
        return tl.NO_ROOM
    if v1 - v0 <= settings[tl.P_INITIALIZE]:
        initialize_new(v0, v1, f0, f1, settings[tl.P_CHI2_EPSILON], table_of(graph))
    if state[tl.S_CHECKED] == 0 and v1 > v0:
        determined = take(v1 - v0, tree.scratch)
        for v in range(v0, v1):
            determined[v - v0] = 1 if var[v, at.V_COLUMN] < 0 else 0
        if (
            not are_determined_in_order(v0, f0, f1, var, fac, values, payload, determined)
            and reach(False, v0, f0, f1, table_of(graph), determined) >= 0
        ):
            return tl.UNSURE
    state[tl.S_CHANGED_BEFORE] = state[tl.S_CHANGED]
    state[tl.S_DIFFERING : tl.S_REPORT_END] = 0
    state[tl.S_FAILED], state[tl.S_CHORDS] = -1, 0
    state[tl.S_STEP] += 1
    state[tl.S_BEGUN] = 1
    return tl.DONE


@inline_kernel
def are_determined_in_order(
    v0: int, f0: int, f1: int, var: I64, fac: I64, values: F64, payload: F64, determined: I64
) -> bool:
    """Whether the factors f0 .. f1−1, in their order, determine all: as they do in an odometry step."""
    left = 0
    for k in range(determined.size):
        left += 1 - determined[k]
    for f in range(f0, f1):
        if left > 0 and follow(False, f, v0, var, fac, values, payload, determined) >= 0:
            left -= 1
    return left == 0
