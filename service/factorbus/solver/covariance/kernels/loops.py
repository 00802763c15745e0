"""What new factors between old variables tell of all variables, taken from their blocks of covariance.  MATH §10.6.

    Y = R⁻ᵀ Hᵀ L,   C Cᵀ = G = I − Yᵀ Y,   Z = R⁻¹ Y C⁻ᵀ,   Σ := Σ − Z Zᵀ                    (10.10)

Y is zero but for the paths of the factors' variables; of Z Zᵀ only what is within a variable is made.
"""

import math

import numpy as np
from numpy.typing import NDArray

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.covariance.kernels.paths import list_paths
from factorbus.solver.covariance.kernels.recursion import following, is_stirred
from factorbus.solver.covariance.kernels.squares import padded
from factorbus.solver.covariance.kernels.substitute import GROUP, backward, fetch, forward
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.simd import LANES, put, zero
from factorbus.solver.kernels.jit.simd import at as load

TOO_NEAR, DONE = 0, 1


@kernel(
    "int64(int64[::1], int64[:,::1], int64[::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64,"
    " float64, int64, int64[::1], int64[::1], int64[:,::1], int64[:,::1], int64[::1], float64[::1], int64[::1],"
    " float64[:,:,::1])"
)
def work_in(
    loops: I64, ends: I64, sizes: I64, A: F64, B: F64, W: F64, least: float, negligible: float, tick: int,
    stirred: I64, scalar: I64, node: I64, clique: I64, lists: I64, numbers: F64, dims: I64, blocks: F64,
) -> int:  # fmt: skip
    """Take from `blocks` what the factors `loops` tell; TOO_NEAR, and nothing done, if G may be too near to singular.

    in   least: for the eigenvalues of G
         of factors k: ends (k, 2), −1: none   sizes (k,): of r   A, B (k, 6, 6): Jacobians   W (k, 6, 6): Ω
         negligible: where no more than this share of a variance is taken from a separator, nothing is done below it
         tick: `stirred` of variables gets it where more is taken   scalar: where each variable starts, −1: fixed
    out  blocks (n, d, d): of the variables up to n
    """
    ranks, scalars = 0, 0
    for k in loops:
        ranks += sizes[k]
    for v in range(len(dims)):
        if scalar[v] >= 0:
            scalars = max(scalars, scalar[v] + dims[v])
    ld = padded(ranks)
    a, local = np.empty(2 * scalars * ld), scalars * ld
    path = list_paths(free_ends(loops, ends, scalar), node, clique)
    for c in path:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            zero(a, scalar[lists[s]] * ld, dims[lists[s]] * ld)
    put_factors(loops, ends, sizes, A, B, W, scalar, dims, a, ld)
    for c in path:
        for g in range(0, ld, GROUP * LANES):
            forward(clique[c], lists, numbers, dims, scalar, a, g, ld, min(GROUP, (ld - g) // LANES), local)
    if scale(path, ranks, least, clique, lists, dims, scalar, a, ld) == TOO_NEAR:
        return TOO_NEAR
    on_path = np.zeros(len(clique), np.bool_)
    on_path[path] = True
    for c in path:
        if clique[c, tl.C_PARENT] < 0:
            descend(c, on_path, negligible, tick, stirred, scalar, clique, lists, numbers, dims, a, ld, local, blocks)
    return DONE


@part
def descend(
    root: int, on_path: NDArray[np.bool_], negligible: float, tick: int, stirred: I64, scalar: I64, clique: I64,
    lists: I64, numbers: F64, dims: I64, a: F64, ld: int, local: int, blocks: F64,
) -> None:  # fmt: skip
    """Z and what it takes from the blocks, from a root down to where it is negligible."""
    c = root
    while c >= 0:
        row, child = clique[c], -1
        if on_path[c] or is_stirred(row, lists, stirred, tick):
            child = row[tl.C_CHILD]
            after = child if child >= 0 else row[tl.C_NEXT]
            if after >= 0:
                fetch(clique[after], numbers)
            for g in range(0, ld, GROUP * LANES):
                vectors = min(GROUP, (ld - g) // LANES)
                backward(row, lists, numbers, dims, scalar, a, g, ld, vectors, local, not on_path[c])
            for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
                v = lists[s]
                if v >= len(blocks):
                    stirred[v] = tick
                elif dims[v] == 3 and ld == 4:  # with constants the loops are unrolled
                    lessen(a, scalar[v] * 4, 4, 3, negligible, blocks[v], stirred, v, tick)
                else:
                    lessen(a, scalar[v] * ld, ld, dims[v], negligible, blocks[v], stirred, v, tick)
        c = following(c, child, clique)


@part
def free_ends(loops: I64, ends: I64, scalar: I64) -> I64:
    """The free variables that the factors are of; some may come twice."""
    found, count = np.empty(2 * loops.size, np.int64), 0
    for k in loops:
        for e in range(2):
            if ends[k, e] >= 0 and scalar[ends[k, e]] >= 0:
                found[count] = ends[k, e]
                count += 1
    return found[:count]


@part
def put_factors(
    loops: I64, ends: I64, sizes: I64, A: F64, B: F64, W: F64, scalar: I64, dims: I64, a: F64, ld: int
) -> None:
    """Hᵀ L, where Ω = L Lᵀ, into the rows of the factors' variables."""
    L, column = np.empty((6, 6)), 0
    for k in loops:
        d = sizes[k]
        for i in range(d):
            for j in range(i + 1):
                total = W[k, i, j]
                for q in range(j):
                    total -= L[i, q] * L[j, q]
                L[i, j] = math.sqrt(total) if i == j else total / L[j, j]
        for e in range(2):
            v = ends[k, e]
            if v < 0 or scalar[v] < 0:
                continue
            J = A[k] if e == 0 else B[k]
            for i in range(dims[v]):
                for j in range(d):
                    place, total = (scalar[v] + i) * ld + column + j, 0.0
                    for q in range(j, d):
                        total += J[q, i] * L[q, j]
                    put(a, place, load(a, place) + total)
        column += d


@part
def scale(path: I64, ranks: int, least: float, clique: I64, lists: I64, dims: I64, scalar: I64, a: F64, ld: int) -> int:
    """Y := Y C⁻ᵀ,  unless 1/tr G⁻¹, which no eigenvalue of G is below, is less than `least`."""
    C = np.zeros((ranks, ranks))
    for c in path:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            for line in range(scalar[lists[s]] * ld, (scalar[lists[s]] + dims[lists[s]]) * ld, ld):
                for i in range(ranks):
                    for j in range(i + 1):
                        C[i, j] -= load(a, line + i) * load(a, line + j)
    for i in range(ranks):
        C[i, i] += 1.0
        for j in range(i + 1):
            total = C[i, j]
            for q in range(j):
                total -= C[i, q] * C[j, q]
            if i == j and not total >= least:
                return TOO_NEAR
            C[i, j] = math.sqrt(total) if i == j else total / C[j, j]
    if trace_of_inverse(ranks, C) * least > 1.0:
        return TOO_NEAR
    for c in path:
        for s in range(clique[c, tl.C_LIST], clique[c, tl.C_LIST] + clique[c, tl.C_FRONTALS]):
            for line in range(scalar[lists[s]] * ld, (scalar[lists[s]] + dims[lists[s]]) * ld, ld):
                for i in range(ranks):
                    total = load(a, line + i)
                    for j in range(i):
                        total -= load(a, line + j) * C[i, j]
                    put(a, line + i, total / C[i, i])
    return DONE


@inline_kernel
def trace_of_inverse(n: int, C: F64) -> float:
    """Of (C Cᵀ)⁻¹: the sum of the squares of C⁻¹."""
    total, x = 0.0, np.empty(n)
    for column in range(n):
        for i in range(column, n):
            value = 1.0 if i == column else 0.0
            for q in range(column, i):
                value -= C[i, q] * x[q]
            x[i] = value / C[i, i]
            total += x[i] * x[i]
    return total


@inline_kernel
def lessen(a: F64, start: int, ld: int, d: int, negligible: float, block: F64, stirred: I64, v: int, tick: int) -> None:
    """block −= Z Zᵀ, and whether that was more than a negligible share of a variance."""
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            for q in range(ld):
                total += load(a, start + i * ld + q) * load(a, start + j * ld + q)
            if i == j and total > negligible * block[i, i]:
                stirred[v] = tick
            block[i, j] -= total
            if i != j:
                block[j, i] = block[i, j]
