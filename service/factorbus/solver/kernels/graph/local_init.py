"""Good first values for what is new: each new variable goes where its own factors want it, all else held.  MATH §8.6.

A variable composed from the first factor that reached it has none of the others in it.  Moving it alone costs what its
few factors cost, and what is left for the whole system to solve is much smaller.
"""

from typing import NamedTuple

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.small_cholesky import cholesky
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, is_member, is_one_of_many
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import add_normal_equations, linearize_many, square_of
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.model.retract import move_value
from factorbus.solver.kernels.model.sizes import MOST_SCALARS, dim_of, information_at, residual_dim, size_of

_ITERATIONS = 5
_MOST = max(MOST_SCALARS, 7)  # numbers of a value, and scalars
# Where in the scratch of a variable what begins: M at 0, z, the step, the value before it, and r, H, W of a factor.
_Z = _MOST * _MOST
_STEP, _BEFORE, _R = _Z + _MOST, _Z + 2 * _MOST, _Z + 3 * _MOST
_H = _R + at.R_SIZE
_W = _H + 72
_ROOM = _W + 36


class _Linear(NamedTuple):
    """A factor linearized: its residual r (7,), the Jacobians H (2, 6, 6) of its ends, its information W (6, 6)."""

    r: F64
    H: F64
    W: F64


@kernel("void(int64, int64, int64, int64, float64, int64[::1])")
def initialize_new(v0: int, v1: int, f0: int, f1: int, least: float, graph_table: I64) -> None:
    """Gauss-Newton on one free variable of v0 .. v1−1 after the other, with those of factors f0 .. f1−1 that are on it.

    Goes on while a step lowers the χ² of those factors, and by more than `least` and a thousandth of it.  graph_table:
    of the graph's arrays (`records`).
    """
    graph = graph_at(graph_table)
    for v in range(v0, v1):
        if graph.var[v, at.V_COLUMN] >= 0 and is_seen_twice(v, f0, f1, graph.fac):
            initialize_variable(v, f0, f1, least, graph, np.empty(_ROOM))


@part
def initialize_variable(v: int, f0: int, f1: int, least: float, graph: Graph, room: F64) -> None:
    """The same for one variable; room (_ROOM,) is scratch."""
    var, values = graph.var, graph.values
    M, z = room[:_Z].reshape((_MOST, _MOST)), room[_Z:_STEP]
    step, before = room[_STEP:_BEFORE], room[_BEFORE:_R]
    linear = _Linear(room[_R:_H], room[_H:_W].reshape((2, 6, 6)), room[_W:_ROOM].reshape((6, 6)))
    x, kind = var[v, at.V_AT], var[v, at.V_KIND]
    dim, size = dim_of(kind), size_of(kind)
    chi2 = gather_system(v, f0, f1, graph, linear, M, z)
    for _ in range(_ITERATIONS):
        if not chi2 > least or cholesky(dim, M, z) >= 0:
            break
        for i in range(dim - 1, -1, -1):
            step[i] = z[i]
            for j in range(i + 1, dim):
                step[i] -= M[i, j] * step[j]
            step[i] /= M[i, i]
        for c in range(size):
            before[c] = values[x + c]
        move_one(kind, values, x, step)
        reached = gather_system(v, f0, f1, graph, linear, M, z)
        if not reached <= chi2:
            for c in range(size):
                values[x + c] = before[c]
            break
        gained, chi2 = chi2 - reached, reached
        if gained <= least + 1e-3 * chi2:
            break


@inline_kernel
def is_seen_twice(v: int, f0: int, f1: int, fac: I64) -> bool:
    """Whether more than one of the factors f0 .. f1−1 is on variable v."""
    count = 0
    for f in range(f0, f1):
        if is_one_of_many(f, fac):
            for n in range(0 if is_member(f, fac) else count_ends(f, fac)):
                count += int(end_of(f, n, fac) == v)
        elif fac[f, at.F_I] == v or fac[f, at.F_J] == v:
            count += 1
        if count > 1:
            return True
    return False


@part
def gather_system(v: int, f0: int, f1: int, graph: Graph, linear: _Linear, M: F64, z: F64) -> float:
    """M = Σ Hᵀ Ω H and z = −Σ Hᵀ Ω r over the factors of variable v among f0 .. f1−1; gives their χ².

    M (d, d), z (d,), d the most scalars of a variable; `linear` is scratch
    """
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    r, H, W = linear
    width, chi2 = dim_of(var[v, at.V_KIND]), 0.0
    M[:, :], z[:] = 0.0, 0.0
    for f in range(f0, f1):
        if is_one_of_many(f, fac):
            if not is_member(f, fac):
                chi2 += gather_many(v, f, graph, M, z)
            continue
        end = 0 if fac[f, at.F_I] == v else 1
        if fac[f, at.F_I + end] != v:
            continue
        chi2 += evaluate_apart(f, var, fac, values, payload, r, H[0], H[1])
        dim, p = residual_dim(fac[f, at.F_KIND]), fac[f, at.F_AT] + information_at(fac[f, at.F_KIND])
        for a in range(dim):
            for b in range(a, dim):
                W[a, b] = W[b, a] = payload[p]
                p += 1
        A, g = H[end], H[1 - end, 0]  # of the other end nothing is needed any more
        for a in range(dim):
            e, g[:] = 0.0, 0.0
            for b in range(dim):
                e += W[a, b] * r[b]
                for j in range(width):
                    g[j] += W[a, b] * A[b, j]
            chi2 += r[a] * e
            for i in range(width):
                z[i] -= A[a, i] * e
                for j in range(i, width):
                    M[i, j] += A[a, i] * g[j]
    return chi2


@part
def gather_many(v: int, f: int, graph: Graph, M: F64, z: F64) -> float:
    """The same of one factor of more than two variables, which begins at row f, if variable v is among them."""
    for n in range(count_ends(f, graph.fac)):
        if end_of(f, n, graph.fac) == v:
            more, many = linearize_many(f, graph.var, graph.fac, graph.values, graph.payload)
            add_normal_equations(n, many, M, z)
            return more + square_of(many)
    return 0.0


@part
def move_one(kind: int, values: F64, x: int, step: F64) -> None:
    """The value at offset x := itself ⊞ step."""
    move_value(kind, values, x, step, 0, values)
