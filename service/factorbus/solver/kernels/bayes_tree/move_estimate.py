"""The estimate of variables of which δ is another one."""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import move_idp
from factorbus.solver.kernels.model.points import move_point2, move_point3, move_vector
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.se2 import turn_se2
from factorbus.solver.kernels.model.se3 import move_se3
from factorbus.solver.kernels.model.similarity import move_sim3, move_so3
from factorbus.solver.kernels.model.sizes import dim_of, is_vector, size_of

# In N_LISTED.
STAYED, PLACE, MODEL = 0, 1, 2


@inline_kernel
def move_variable(graph: Graph, tree: Tree, v: int, delta: F64, lin: F64, before: F64) -> None:
    """The estimate of variable v, of which δ is another one."""
    var, values = graph.var, graph.values
    node, turns, changed, state = tree.node, tree.turns, tree.changed, tree.state
    kind, x = var[v, at.V_KIND], var[v, at.V_AT]
    if node[v, tl.N_MOVED] != state[tl.S_STEP]:
        node[v, tl.N_MOVED] = state[tl.S_STEP]
        changed[state[tl.S_CHANGED]] = v
        state[tl.S_CHANGED] += 1
        for a in range(size_of(kind)):
            before[x + a] = values[x + a]
    if kind == at.SE2:
        turn_se2(lin, x, turns[v, tl.U_COS], turns[v, tl.U_SIN], delta, var[v, at.V_SCALAR], values)
    else:
        move_to(kind, lin, x, delta, var[v, at.V_SCALAR], values)


@inline_kernel
def note_moved(how: int, v: int, node: I64, moved: I64, state: I64) -> None:
    """The factors of variable v are to be evaluated: PLACE, their χ²; MODEL and more, how linear they are as well."""
    listed = node[v, tl.N_LISTED]
    if listed == STAYED:
        moved[state[tl.S_MOVED]] = v
        state[tl.S_MOVED] += 1
    if how > listed:
        node[v, tl.N_LISTED] = how


@inline_kernel
def move_to(kind: int, lin: F64, x: int, delta: F64, d: int, out: F64) -> None:
    """out = lin ⊞ δ, of what is no plane pose."""
    if kind == at.SE3:
        move_se3(lin, x, delta, d, out)
    elif kind == at.POINT2:
        move_point2(lin, x, delta, d, out)
    elif kind == at.IDP:
        move_idp(lin, x, delta, d, out)
    elif kind == at.SO3:
        move_so3(lin, x, delta, d, out)
    elif kind == at.SIM3:
        move_sim3(lin, x, delta, d, out)
    elif is_vector(kind):
        move_vector(dim_of(kind), lin, x, delta, d, out)
    else:
        move_point3(lin, x, delta, d, out)
