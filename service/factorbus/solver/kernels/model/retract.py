"""x ⊞ δ for all variables, which of them changed, and their values gathered per kind.  MATH §2."""

from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import move_idp
from factorbus.solver.kernels.model.dispatch import check_same, returning
from factorbus.solver.kernels.model.points import move_point2, move_point3, move_vector
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.se2 import move_se2
from factorbus.solver.kernels.model.se3 import move_se3
from factorbus.solver.kernels.model.similarity import move_sim3, move_so3
from factorbus.solver.kernels.model.sizes import dim_of, is_vector, size_of

# x ⊞ δ of every kind of variables of the wire, `factorbus.proto.kinds`, but of vectors, which have one.
MOVES = {
    "se2": move_se2,
    "se3": move_se3,
    "point2": move_point2,
    "idp": move_idp,
    "point3": move_point3,
    "so3": move_so3,
    "sim3": move_sim3,
}
_CODES = {name: code for name, code in at.VARIABLE_CODES.items() if not VARIABLE_KINDS[name].is_vector}
check_same("variable kind", _CODES, MOVES, __name__)


@inline_kernel
def _no_move(_values: F64, _x: int, _step: F64, _d: int, _out: F64) -> None:
    """Of no kind: there is none."""


_move_other = inline_kernel(returning("move_other", "values, x, step, d, out", _CODES, MOVES, _no_move))


@inline_kernel
def move_value(kind: int, values: F64, x: int, step: F64, d: int, out: F64) -> None:
    """The value at out[x] := that at values[x] ⊞ step[d]; each ⊞ has read what it needs before it writes."""
    if is_vector(kind):
        move_vector(dim_of(kind), values, x, step, d, out)
    else:
        _move_other(kind, values, x, step, d, out)


@kernel("void(int64, int64[:,::1], float64[::1], float64[::1], float64[::1])")
def move(count: int, var: I64, values: F64, step: F64, out: F64) -> None:
    """out = values ⊞ step, variable by variable; fixed ones are copied."""
    for v in range(count):
        kind, x, d = var[v, at.V_KIND], var[v, at.V_AT], var[v, at.V_SCALAR]
        if d < 0:
            for c in range(size_of(kind)):
                out[x + c] = values[x + c]
        else:
            move_value(kind, values, x, step, d, out)


@kernel("int64(int64, int64, int64[:,::1], int64[::1], int64[::1], int64[::1])")
def differing(old: int, count: int, var: I64, before: I64, values: I64, out: I64) -> int:
    """List in `out` the variables whose values differ from `before`, and all from `old` on; gives how many.

    The values are given as the integers that their bits are, so that −0.0 is not 0.0.
    """
    n = 0
    for v in range(count):
        x = var[v, at.V_AT]
        if v >= old or differs(x, size_of(var[v, at.V_KIND]), before, values):
            out[n] = v
            n += 1
    return n


@inline_kernel
def differs(x: int, size: int, a: I64, b: I64) -> bool:
    """Whether any of `size` numbers from offset x on differ."""
    for c in range(size):  # noqa: SIM110  (compiled)
        if a[x + c] != b[x + c]:
            return True
    return False


@kernel("int64(int64[::1], int64[::1])")
def common_label(picked: I64, graph_table: I64) -> int:
    """2 · kind of the picked variables, and 1 more where they are fixed; −1: they differ, or there are none."""
    graph = graph_at(graph_table)
    var, label = graph.var, -1
    for n in range(picked.size):
        own = 2 * var[picked[n], at.V_KIND] + int(var[picked[n], at.V_COLUMN] < 0)
        if n > 0 and own != label:
            return -1
        label = own
    return label


@inline_kernel
def run_from(n: int, picked: I64) -> int:
    """How many of the picked variables from the n-th on follow each other; in steps that double, then halve."""
    run, more = 1, 1
    while n + run + more <= picked.size and picked[n + run + more - 1] == picked[n] + run + more - 1:
        run += more
        more *= 2
    while more > 0:
        if n + run + more <= picked.size and picked[n + run + more - 1] == picked[n] + run + more - 1:
            run += more
        more //= 2
    return run


@kernel("void(int64[::1], int64[::1], int64[::1], float64[:,::1])")
def gather_values(picked: I64, graph_table: I64, out_keys: I64, out_values: F64) -> None:
    """Keys and values of the picked variables, ascending and of one kind: those that follow each other, together.

    graph_table: of its arrays (`records`).  Without room in out_keys only the values.
    """
    graph = graph_at(graph_table)
    var, keys, values = graph.var, graph.keys, graph.values
    size, out = out_values.shape[1], out_values.reshape(-1)
    n = 0
    while n < picked.size:
        v, run = picked[n], run_from(n, picked)
        x = var[v, at.V_AT]
        for k in range(run if out_keys.size > 0 else 0):
            out_keys[n + k] = keys[v + k]
        for c in range(run * size):
            out[n * size + c] = values[x + c]
        n += run


@kernel("float64(float64[::1], float64[::1])")
def inner(a: F64, b: F64) -> float:
    """aᵀ b, on one core: a threaded BLAS would wake the others for it."""
    total = 0.0
    for k in range(a.size):
        total += a[k] * b[k]
    return total
