"""The linearization error of a factor of a kind that a client wrote itself.  MATH (9.11), (9.31)

A step asks it of every such factor that moved.  So the code of its formula computes it where it computes the slopes
(`solver/formulas/error_code.py`); what is left here are the weights of a loss.
"""

import math

from factorbus.solver.kernels.bayes_tree.hessian_room import jacobian_at
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import I64, inline_kernel, part
from factorbus.solver.kernels.jit.scratch import free_since, scratch_used, take_floats
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import INACTIVE_CHI2
from factorbus.solver.kernels.model.expression_layout import X_BEFORE
from factorbus.solver.kernels.model.expressions import (
    CHI2,
    ERROR_SIZE,
    FORCE,
    MISSED,
    NO_NUMBER,
    ROOT,
    ROOT_WAS,
    error_of_own,
    information_square,
    square_of_own,
)
from factorbus.solver.kernels.model.factor_rows import loss_code, residual_size
from factorbus.solver.kernels.model.losses import loss_of
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import dim_of


@inline_kernel
def is_own_pose(f: int, var: I64, fac: I64) -> bool:
    """Whether factor f is an own kind, without a loss, that measures all of where one pose is from another.

    Where the map turns, the forces of such factors turn with it, as those of the solver's own kinds that do: they are
    not added up, (9.39).
    """
    flags, i, j = fac[f, at.F_FLAGS], fac[f, at.F_I], fac[f, at.F_J]
    if flags & at.RIGID == 0 or loss_code(f, fac) != at.NO_LOSS or var[i, at.V_KIND] != var[j, at.V_KIND]:
        return False
    kind = var[i, at.V_KIND]
    return (kind == at.SE2 or kind == at.SE3) and residual_size(f, fac) >= dim_of(kind)


@part
def exact_error_of_own(f: int, graph: Graph, tree: Tree) -> tuple[float, float, float]:
    """The error of the residual and of the force, and χ², of the factor that begins at row f."""
    fac, payload, dim, loss = graph.fac, graph.payload, residual_size(f, graph.fac), loss_code(f, graph.fac)
    before = scratch_used(tree.scratch)
    out, linear = take_floats(dim + ERROR_SIZE, tree.scratch), tree.hessian[jacobian_at(f, graph.var, fac, tree.link) :]
    out[dim + ROOT] = out[dim + ROOT_WAS] = 1.0
    weighted = 0.0
    if loss != at.NO_LOSS:
        p = fac[f, at.F_AT] + int(payload[fac[f, at.F_AT] + X_BEFORE])
        scale = payload[p + dim * (dim + 1) // 2]
        weighted, weight = loss_of(loss, square_of_own(f, graph.var, fac, graph.values, payload), scale)
        _, weight_was = loss_of(loss, information_square(dim, p, payload, linear), scale)
        out[dim + ROOT], out[dim + ROOT_WAS] = math.sqrt(weight), math.sqrt(weight_was)
    found = error_of_own(f, graph, linear, tree.scalars[0], out)
    chi2 = out[dim + CHI2] + (INACTIVE_CHI2 if found == NO_NUMBER else 0.0)
    free_since(before, tree.scratch)
    error, force = math.sqrt(max(out[dim + MISSED], 0.0)), math.sqrt(out[dim + FORCE])
    return error, force, chi2 if loss == at.NO_LOSS else weighted
