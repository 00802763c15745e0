"""Residuals, Jacobians and information of factors as plain arrays: for questions about them.  MATH §3, §10.3."""

import math

from factorbus.solver.kernels.jit.compile import F64, I64, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import information_start, loss_code
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.losses import loss_of
from factorbus.solver.kernels.model.many import evaluate_plain
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.sizes import information_at, residual_dim


@kernel(
    "void(int64[::1], int64[::1], float64[::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1])"
)
def evaluate_factors(picked: I64, graph_table: I64, values: F64, r: F64, A: F64, B: F64, W: F64) -> None:
    """The factors with the ids `picked` (n,) at `values`, which are laid out as the graph's.

    graph_table: of the graph's arrays (`records`)
    out  r (n, R_SIZE), A, B, W (n, 6, 6): upper left corners
    """
    graph = graph_at(graph_table)
    var, fac, payload = graph.var, graph.fac, graph.payload
    for k in range(picked.size):
        f = picked[k]
        evaluate_apart(f, var, fac, values, payload, r[k], A[k], B[k])
        dim = residual_dim(fac[f, at.F_KIND])
        p = fac[f, at.F_AT] + information_at(fac[f, at.F_KIND])
        for a in range(dim):
            for b in range(a, dim):
                W[k, a, b] = W[k, b, a] = payload[p]
                p += 1


@kernel("void(int64, int64[::1], float64[::1], float64[::1], float64[:,::1], float64[:,::1])")
def evaluate_many(f: int, graph_table: I64, values: F64, r: F64, J: F64, W: F64) -> None:
    """The factor that begins at row f, one that `many` evaluates, at `values`; with a loss r and J are times √w.

    out  r (dim,), J (dim, Σ d): its Jacobians side by side, in the order of its variables, W (dim, dim)
    """
    graph = graph_at(graph_table)
    var, fac, payload = graph.var, graph.fac, graph.payload
    more, many = evaluate_plain(f, var, fac, values, payload, payload[:0])
    dim, p = len(W), information_start(f, var, fac, payload)
    own, k = 0.0, p
    for a in range(dim):
        for b in range(a, dim):
            W[a, b] = W[b, a] = payload[k]
            k += 1
    for a in range(dim):
        for b in range(dim):
            own += many.r[a] * W[a, b] * many.r[b]
    loss, root = loss_code(f, fac), 1.0
    if loss != at.NO_LOSS:
        _, w = loss_of(loss, own + more, payload[k])
        root = math.sqrt(w)
    for a in range(dim):
        r[a] = root * many.r[a]
        for c in range(J.shape[1]):
            J[a, c] = root * many.J[a, c]
