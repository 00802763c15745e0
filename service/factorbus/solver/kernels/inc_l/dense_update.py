"""Updates that reach few rows: dense, up to 5 × 5 blocks.  MATH §8.4, (18) and (19) of the 2013 paper.

M = R₂₂ᵀ R₂₂ + Ω,  z = R₂₂ᵀ d₂ + ω;  then R̃₂₂ = chol(M) and d̃₂ = R̃₂₂⁻ᵀ z.
"""

import numpy as np

from factorbus.solver.kernels.inc_l import block_rows as br
from factorbus.solver.kernels.inc_l.records import BlockList, BlockRows, rows_at
from factorbus.solver.kernels.jit.compile import F64, I64, kernel, part
from factorbus.solver.kernels.jit.small_cholesky import cholesky
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import end_of, is_member, is_one_of_many
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import linearize_many
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.model.sizes import MOST_SCALARS, dim_of, information_at, residual_dim

MOST_BLOCKS = 5
_MOST = MOST_SCALARS * MOST_BLOCKS


@kernel("int64(int64, int64, int64[::1], int64[::1], int64[::1])")
def dense_omega_update(f0: int, f1: int, reached: I64, graph_table: I64, rows_table: I64) -> int:
    """Apply factors f0 .. f1−1, linearized at the graph's values, into R and d by (18) and (19) as they stand.

    reached: the positions that the factors reach, at most MOST_BLOCKS.  Gives −1, or a position whose pivot failed.
    """
    graph, rows = graph_at(graph_table), rows_at(rows_table)
    rec = rows.rec
    start, size = np.empty(reached.size, np.int64), 0
    for t in range(reached.size):
        start[t] = size
        size += rec[reached[t], br.DIM]
    T, M, y, z = np.zeros((_MOST, _MOST)), np.empty((_MOST, _MOST)), np.empty(_MOST), np.empty(_MOST)
    read_trailing(reached, start, rows, T, y)
    for i in range(size):
        total = 0.0
        for k in range(i + 1):
            total += T[k, i] * y[k]
        z[i] = total
        for j in range(i, size):
            total = 0.0
            for k in range(i + 1):
                total += T[k, i] * T[k, j]
            M[i, j] = total
    add_omega(f0, f1, reached, start, graph, rows.place, M, z)
    failed = cholesky(size, M, z)
    if failed >= 0:
        t = 0
        while t + 1 < reached.size and start[t + 1] <= failed:
            t += 1
        return reached[t]
    write_trailing(reached, start, size, M, z, rows)
    return -1


@part
def read_trailing(reached: I64, start: I64, rows: BlockRows, T: F64, y: F64) -> None:
    """The reached rows as one dense matrix, and their part of d."""
    rec, index, numbers, d = rows.rec, rows.index, rows.numbers, rows.d
    for t in range(reached.size):
        row = rec[reached[t]]
        x, u = 0, t
        for e in range(row[br.LIST], row[br.LIST] + row[br.COUNT]):
            while reached[u] != index[e]:
                u += 1
            for c in range(rec[index[e], br.DIM]):
                for i in range(row[br.DIM]):
                    T[start[t] + i, start[u] + c] = numbers[row[br.ROW] + i * row[br.LD] + x]
                x += 1
        for i in range(row[br.DIM]):
            y[start[t] + i] = d[row[br.SCALAR] + i]


@part
def add_omega(f0: int, f1: int, reached: I64, start: I64, graph: Graph, place: I64, M: F64, z: F64) -> None:
    """M += Ω = Σ Hᵀ Ω_k H, z += ω = −Σ Hᵀ Ω_k r; on and above the diagonal."""
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    r, H, first = np.zeros(at.R_SIZE), np.zeros((2, 6, 6)), np.empty(2, np.int64)
    W, WH = np.zeros((6, 6)), np.zeros((6, 6))
    for f in range(f0, f1):
        if is_one_of_many(f, fac):
            if not is_member(f, fac):
                add_many_omega(f, reached, start, graph, place, M, z)
            continue
        evaluate_apart(f, var, fac, values, payload, r, H[0], H[1])
        kind = fac[f, at.F_KIND]
        dim, p = residual_dim(kind), fac[f, at.F_AT] + information_at(kind)
        for a in range(dim):
            for b in range(a, dim):
                W[a, b] = W[b, a] = payload[p]
                p += 1
        for end in range(2):
            v = fac[f, at.F_I + end]
            first[end] = -1
            if v >= 0 and var[v, at.V_COLUMN] >= 0:
                u = 0
                while reached[u] != place[var[v, at.V_COLUMN]]:
                    u += 1
                first[end] = start[u]
        for end in range(2):
            if first[end] < 0:
                continue
            width = dim_of(var[fac[f, at.F_I + end], at.V_KIND])
            for a in range(dim):
                for c in range(width):
                    total = 0.0
                    for b in range(dim):
                        total += W[a, b] * H[end, b, c]
                    WH[a, c] = total
            for c in range(width):
                total = 0.0
                for a in range(dim):
                    total += WH[a, c] * r[a]
                z[first[end] + c] -= total
            for other in range(2):
                if first[other] < 0 or first[other] > first[end]:
                    continue
                for q in range(dim_of(var[fac[f, at.F_I + other], at.V_KIND])):
                    for c in range(q if other == end else 0, width):
                        total = 0.0
                        for a in range(dim):
                            total += H[other, a, q] * WH[a, c]
                        M[first[other] + q, first[end] + c] += total


@part
def add_many_omega(f: int, reached: I64, start: I64, graph: Graph, place: I64, M: F64, z: F64) -> None:
    """The same of one factor that `many` evaluates, which begins at row f."""
    var, fac = graph.var, graph.fac
    _, many = linearize_many(f, var, fac, graph.values, graph.payload)
    r, J, columns = many
    dim, width = len(J), columns[columns.size - 1]
    into = np.full(width, -1)  # of each column of J
    for n in range(columns.size - 1):
        column = var[end_of(f, n, fac), at.V_COLUMN]
        if column >= 0:
            u = 0
            while reached[u] != place[column]:
                u += 1
            for c in range(columns[n], columns[n + 1]):
                into[c] = start[u] + c - columns[n]
    for c in range(width):
        if into[c] < 0:
            continue
        for a in range(dim):
            z[into[c]] -= J[a, c] * r[a]
            for e in range(width):
                if 0 <= into[e] <= into[c]:
                    M[into[e], into[c]] += J[a, e] * J[a, c]


@part
def write_trailing(reached: I64, start: I64, size: int, M: F64, z: F64, rows: BlockRows) -> None:
    """The rows get all reached positions from their own on, and the numbers of M and z."""
    rec, numbers, d = rows.rec, rows.numbers, rows.d
    for t in range(reached.size):
        k, width = reached[t], size - start[t]
        br.widen_row(k, BlockList(reached, t, reached.size - t, width), rows)
        row = rec[k]
        for i in range(row[br.DIM]):
            for c in range(width):
                value = M[start[t] + i, start[t] + c] if c >= i else 0.0
                numbers[row[br.ROW] + i * row[br.LD] + c] = value
            d[row[br.SCALAR] + i] = z[start[t] + i]
