"""Λ x and the gradient factor by factor, without the rounding of a Λ that is summed first.  MATH (6.4)

In J x what a stiff factor holds cancels before it is weighed, and the forces Jᵀ Ω J x on its variables are equal and
opposite to the last bit.  In Λ the rounding of its information acts on each of them by itself.
"""

from factorbus.solver.kernels.jit.compile import F64, I64, kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, is_member, is_one_of_many
from factorbus.solver.kernels.model.linearize import Scratch, evaluate_apart, make_scratch
from factorbus.solver.kernels.model.many import linearize_kept
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.model.sizes import dim_of, information_at, residual_dim


@kernel("void(int64[::1], float64[::1], float64[::1])")
def multiply_hessian(graph_table: I64, x: F64, out: F64) -> None:
    """out += Σ Jᵀ Ω J x of all factors, linearized at the values of the graph; x, out (scalars,)."""
    graph, scratch = graph_at(graph_table), make_scratch()
    add_products(graph.counts[at.FACTORS], graph, scratch, x, False, out)


@part
def add_products(factors: int, graph: Graph, scratch: Scratch, x: F64, gradient: bool, out: F64) -> None:
    """`add_product` of the first `factors` rows of factors."""
    for f in range(factors):
        if not is_one_of_many(f, graph.fac):
            add_product(f, graph, scratch, x, gradient, out)
        elif not is_member(f, graph.fac):
            add_product_of_many(f, graph, graph.payload[:0], x, gradient, out)


@part
def add_product(f: int, graph: Graph, scratch: Scratch, x: F64, gradient: bool, out: F64) -> None:
    """out += Jᵀ Ω J x of a factor of one or two variables, or Jᵀ Ω r."""
    var, fac, payload, r = graph.var, graph.fac, graph.payload, scratch.r
    kind, e, H = fac[f, at.F_KIND], scratch.W[0], scratch.H
    dim, p = residual_dim(kind), fac[f, at.F_AT] + information_at(kind)
    evaluate_apart(f, var, fac, graph.values, payload, r, H[0], H[1])
    for a in range(dim if not gradient else 0):
        r[a] = 0.0
        for n in range(count_ends(f, fac)):
            v = end_of(f, n, fac)
            s = var[v, at.V_SCALAR]
            for c in range(dim_of(var[v, at.V_KIND]) if s >= 0 else 0):
                r[a] += H[n, a, c] * x[s + c]
    for a in range(dim):
        e[a] = 0.0
    for a in range(dim):
        e[a] += payload[p] * r[a]
        p += 1
        for b in range(a + 1, dim):
            e[a] += payload[p] * r[b]
            e[b] += payload[p] * r[a]
            p += 1
    for n in range(count_ends(f, fac)):
        v = end_of(f, n, fac)
        s = var[v, at.V_SCALAR]
        for c in range(dim_of(var[v, at.V_KIND]) if s >= 0 else 0):
            for a in range(dim):
                out[s + c] += H[n, a, c] * e[a]


@part
def add_product_of_many(f: int, graph: Graph, kept: F64, x: F64, gradient: bool, out: F64) -> None:
    """The same of a factor that `many` evaluates; kept: as for `linearize_kept`."""
    var, fac = graph.var, graph.fac
    _, now = linearize_kept(f, var, fac, graph.values, graph.payload, kept)
    J, start, ends = now.J, now.start, count_ends(f, fac)
    for a in range(len(J)):
        e = now.r[a]
        if not gradient:
            e = 0.0
            for n in range(ends):
                s = var[end_of(f, n, fac), at.V_SCALAR]
                for c in range(start[n], start[n + 1] if s >= 0 else start[n]):
                    e += J[a, c] * x[s + c - start[n]]
        for n in range(ends):
            s = var[end_of(f, n, fac), at.V_SCALAR]
            for c in range(start[n], start[n + 1] if s >= 0 else start[n]):
                out[s + c - start[n]] += J[a, c] * e
