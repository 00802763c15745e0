"""Where the Hessian of a factor is, and behind it the Jacobian that it was made of.

Of a factor that `many` evaluates r and J at the linearization points are kept, whitened, while they are of a usual
size: its linearization error, (9.11), is computed at every step in which it moves, and needs both.  Behind them is, of
samples of an IMU, what these were integrated to last, and at which bias: where that has the same bits, at the
linearization points as at the estimate, in a step as in the next, they are not integrated again.
"""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expressions import BEHIND, evaluate_linear
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, is_one_of_many, residual_size, rows_of
from factorbus.solver.kernels.model.kinds import is_camera
from factorbus.solver.kernels.model.many import Many
from factorbus.solver.kernels.model.preintegration import ROOM
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import MOST_SCALARS, dim_of

# The most that the Hessian of a row takes, and for each row of a factor of its Jacobian.
HESSIAN = 3 * MOST_SCALARS * MOST_SCALARS + 2 * MOST_SCALARS + 1
JACOBIAN = 256
MOST_ROOM = HESSIAN + JACOBIAN


@inline_kernel
def hessian_size(di: int, dj: int) -> int:
    """Doubles that the Hessian of a factor takes; dj is 0 where there is no second variable."""
    return di * di + di * dj + dj * dj + di + dj + 1


@inline_kernel
def last_of_hessian(row: int, var: I64, fac: I64, link: I64) -> int:
    """Where the χ² of the Hessian of a row is, the last of its numbers."""
    i, j = fac[row, at.F_I], fac[row, at.F_J]
    size = hessian_size(dim_of_variable(var, i), dim_of_variable(var, j) if j >= 0 else 0)
    return link[row, tl.L_AT] + size - 1


@part
def jacobian_size(f: int, var: I64, fac: I64) -> int:
    """Doubles that are kept of r and J of the factor that begins at row f; 0: none are."""
    if not is_one_of_many(f, fac) or is_camera(fac[f, at.F_KIND]):  # what a camera has seen may come and go
        return 0
    columns = 0
    for n in range(count_ends(f, fac)):
        columns += dim_of(var[end_of(f, n, fac), at.V_KIND])
    size = residual_size(f, fac) * (columns + 1) + BEHIND + (ROOM if fac[f, at.F_KIND] == at.IMU else 0)
    return size if size <= JACOBIAN * rows_of(f, fac) else 0


@inline_kernel
def kept_samples(f: int, var: I64, fac: I64, tree: Tree) -> F64:
    """Room (ROOM,) for what the samples of factor f are integrated to; (0,) of all others."""
    if fac[f, at.F_KIND] != at.IMU:
        return tree.hessian[:0]
    k = jacobian_at(f, var, fac, tree.link) + jacobian_size(f, var, fac)
    return tree.hessian[k - ROOM : k]


@inline_kernel
def jacobian_at(f: int, var: I64, fac: I64, link: I64) -> int:
    """Where they are, r first."""
    return last_of_hessian(f + rows_of(f, fac) - 1, var, fac, link) + 1


@part
def keep_jacobian(f: int, graph: Graph, tree: Tree, many: Many) -> None:
    """Write them, of the factor that begins at row f and its `many`; of an own kind as its formula has them."""
    var, fac, size = graph.var, graph.fac, jacobian_size(f, graph.var, graph.fac)
    if size == 0:
        return
    k = jacobian_at(f, var, fac, tree.link)
    if fac[f, at.F_KIND] != at.OWN:
        copy_linear(many, tree.hessian[k : k + size])
        return
    evaluate_linear(f, var, fac, tree.lin[0], graph.payload, tree.hessian[k : k + size])


@part
def copy_linear(many: Many, out: F64) -> None:
    """r, and behind it J, row by row."""
    dim, columns = many.J.shape
    for a in range(dim):
        out[a] = many.r[a]
        for c in range(columns):
            out[dim + a * columns + c] = many.J[a, c]
