"""The Ω-update: R̃₂₂ᵀ R̃₂₂ = R₂₂ᵀ R₂₂ + Ω, d̃₂ with it.  MATH §8.2, (18) and (19) of the 2013 paper.

Rows of the whitened factors, W with WᵀW = Ω, are rotated into the rows of R that they reach, one block row after the
other (a Householder reflection per scalar), so that R₂₂ᵀ R₂₂ is never multiplied out:

    Q [ R₂₂  d₂ ]  =  [ R̃₂₂  d̃₂ ]
      [ W    w  ]     [ 0     ·  ]
"""

import math

import numpy as np

from factorbus.solver.kernels.inc_l import block_rows as br
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.simd import at as load
from factorbus.solver.kernels.jit.simd import put, zero
from factorbus.solver.kernels.jit.sorting import sort
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.sizes import information_at, residual_dim

MOST_ROWS = 48  # of W at a time
_STRIP = 96  # columns that are worked on together: with MOST_ROWS rows they fit the first level cache


@kernel(
    "int64(int64, int64, int64[:,::1], int64[:,::1], float64[::1], float64[::1], int64[:,::1], int64[::1], "
    "float64[::1], int64[::1], float64[::1], int64[::1], int64, float64[::1])"
)
def omega_update(
    f0: int, f1: int, var: I64, fac: I64, values: F64, payload: F64, rec: I64, index: I64, numbers: F64, place: I64,
    d: F64, counts: I64, ld: int, W: F64,
) -> int:  # fmt: skip
    """Fold factors f0 .. f1−1, linearized at `values`, into R and d.

    ld: the scalars of the rows they reach   W: room for MOST_ROWS · ld
    Gives −1, or a position whose pivot is not a positive number.
    """
    union, spare, widths = np.empty(ld, np.int64), np.empty(ld, np.int64), np.zeros(1, np.int64)
    rhs, r, H, C = np.empty(MOST_ROWS), np.zeros(at.R_SIZE), np.zeros((2, 6, 6)), np.zeros((6, 6))
    f = f0
    while f < f1:
        last, rows = f, 0
        while last < f1 and rows + residual_dim(fac[last, at.F_KIND]) <= MOST_ROWS:
            rows += residual_dim(fac[last, at.F_KIND])
            last += 1
        count = ends_of(f, last, var, fac, place, union)
        offset = 0
        for e in range(count):
            offset += rec[union[e], br.DIM]
        widths[0] = offset
        for k in range(rows):
            zero(W, k * ld, offset)
        k = 0
        for g in range(f, last):
            evaluate_apart(g, var, fac, values, payload, r, H[0], H[1])
            k = whitened(g, k, var, fac, payload, place, rec, union, r, H, C, W, ld, rhs)
        failed = sweep(rows, count, union, spare, widths, W, ld, rhs, rec, index, numbers, d, counts)
        if failed >= 0:
            return failed
        f = last
    return -1


@part
def ends_of(f0: int, f1: int, var: I64, fac: I64, place: I64, out: I64) -> int:
    """The positions of the free variables of factors f0 .. f1−1, ascending, each once; gives how many."""
    found, n = np.empty(2 * (f1 - f0), np.int64), 0
    for f in range(f0, f1):
        for end in range(2):
            v = fac[f, at.F_I + end]
            if v >= 0 and var[v, at.V_COLUMN] >= 0:
                found[n] = place[var[v, at.V_COLUMN]]
                n += 1
    sort(found[:n])
    count = 0
    for e in range(n):
        if e == 0 or found[e] != found[e - 1]:
            out[count] = found[e]
            count += 1
    return count


@part
def whitened(
    f: int, k: int, var: I64, fac: I64, payload: F64, place: I64, rec: I64, union: I64, r: F64, H: F64, C: F64, W: F64,
    ld: int, rhs: F64,
) -> int:  # fmt: skip
    """Write the rows C H and −C r of factor f, CᵀC its information, from row k of W on; gives the row behind."""
    kind = fac[f, at.F_KIND]
    dim = residual_dim(kind)
    upper_factor(dim, fac[f, at.F_AT] + information_at(kind), payload, C)
    for a in range(dim):
        total = 0.0
        for b in range(a, dim):
            total += C[a, b] * r[b]
        rhs[k + a] = -total
    for end in range(2):
        v = fac[f, at.F_I + end]
        if v < 0 or var[v, at.V_COLUMN] < 0:
            continue
        position, offset, e = place[var[v, at.V_COLUMN]], 0, 0
        while union[e] != position:
            offset += rec[union[e], br.DIM]
            e += 1
        for a in range(dim):
            for c in range(rec[position, br.DIM]):
                total = 0.0
                for b in range(a, dim):
                    total += C[a, b] * H[end, b, c]
                put(W, (k + a) * ld + offset + c, total)
    return k + dim


@inline_kernel
def upper_factor(dim: int, p: int, payload: F64, C: F64) -> None:
    """C upper triangular with CᵀC the matrix whose upper triangle starts at payload[p]."""
    for a in range(dim):
        for b in range(a, dim):
            C[a, b] = payload[p]
            p += 1
    for a in range(dim):
        for q in range(a):
            for b in range(a, dim):
                C[a, b] -= C[q, a] * C[q, b]
        pivot = 1.0 / math.sqrt(C[a, a])
        for b in range(a, dim):
            C[a, b] *= pivot


@part
def sweep(
    rows: int, count: int, union: I64, spare: I64, widths: I64, W: F64, ld: int, rhs: F64, rec: I64, index: I64,
    numbers: F64, d: F64, counts: I64,
) -> int:  # fmt: skip
    """Rotate the rows of W over the positions union[:count] into R, from the first row they touch to the last."""
    x, v, scale, s = np.empty((6, rows)), np.empty(6), np.empty(6), np.empty(_STRIP)
    skip, first, width = 0, 0, widths[0]
    while first < count:
        i = union[first]
        count, width = join_lists(i, first, count, union, spare, width, skip, rows, W, ld, rec, index)
        widen_to(i, first, count, width, union, rec, index, numbers, counts)
        row = rec[i]
        dim = row[br.DIM]
        if not reflect(row, rows, skip, W, ld, rhs, numbers, d, x, v, scale):
            return i
        for left in range(dim, width, _STRIP):
            apply(row, rows, skip, left, min(_STRIP, width - left), W, ld, numbers, x, v, scale, s)
        skip += dim
        width -= dim
        first += 1
    return -1


@inline_kernel
def join_lists(
    i: int, first: int, count: int, union: I64, spare: I64, width: int, skip: int, rows: int, W: F64, ld: int, rec: I64,
    index: I64,
) -> tuple:  # fmt: skip
    """union[first:count] becomes its union with the list of row i, and W gets zeros there; gives (count, width)."""
    begin, n = rec[i, br.LIST], rec[i, br.COUNT]
    e, g, m = 0, first, 0
    while e < n or g < count:
        if g >= count or (e < n and index[begin + e] < union[g]):
            spare[m] = index[begin + e]
            e += 1
        else:
            if e < n and index[begin + e] == union[g]:
                e += 1
            spare[m] = union[g]
            g += 1
        m += 1
    if m == count - first:
        return count, width
    new_width = width
    e, g = 0, first
    while e < m:
        if g < count and union[g] == spare[e]:
            g += 1
        else:
            new_width += rec[spare[e], br.DIM]
        e += 1
    for k in range(rows):
        br.spread(spare, m, new_width, union, first, count - first, width, rec, W, k * ld + skip, k * ld + skip)
    for e in range(m):
        union[first + e] = spare[e]
    return first + m, new_width


@inline_kernel
def widen_to(
    i: int, first: int, count: int, width: int, union: I64, rec: I64, index: I64, numbers: F64, counts: I64
) -> None:
    """Row i gets the positions union[first:count]."""
    if rec[i, br.COUNT] != count - first:
        br.widen_row(i, union[first:count], count - first, width, rec, index, numbers, counts)


@part
def reflect(
    row: I64, rows: int, skip: int, W: F64, ld: int, rhs: F64, numbers: F64, d: F64, x: F64, v: F64, scale: F64
) -> bool:
    """The reflections that clear W under the diagonal block of a row, applied to that block and to d and rhs.

    Reflection a is I − scale · (v, x)(v, x)ᵀ on (row a of the block, the rows of W); it leaves the pivot positive.
    """
    dim, base, step, scalar = row[br.DIM], row[br.ROW], row[br.LD], row[br.SCALAR]
    for a in range(dim):
        alpha, sigma = load(numbers, base + a * step + a), 0.0
        for k in range(rows):
            x[a, k] = load(W, k * ld + skip + a)
            sigma += x[a, k] * x[a, k]
        pivot = math.sqrt(alpha * alpha + sigma)
        if not (pivot > 0.0 and pivot < math.inf):
            return False
        # α − |(α, x)| without cancellation
        v[a] = -sigma / (alpha + pivot)
        length = sigma + v[a] * v[a]
        scale[a] = 2.0 / length if length > 0.0 else 0.0
        put(numbers, base + a * step + a, pivot)
        for c in range(a + 1, dim):
            total = v[a] * load(numbers, base + a * step + c)
            for k in range(rows):
                total += x[a, k] * load(W, k * ld + skip + c)
            total *= scale[a]
            put(numbers, base + a * step + c, load(numbers, base + a * step + c) - v[a] * total)
            for k in range(rows):
                put(W, k * ld + skip + c, load(W, k * ld + skip + c) - x[a, k] * total)
        total = v[a] * load(d, scalar + a)
        for k in range(rows):
            total += x[a, k] * rhs[k]
        total *= scale[a]
        put(d, scalar + a, load(d, scalar + a) - v[a] * total)
        for k in range(rows):
            rhs[k] -= x[a, k] * total
    return True


@part
def apply(
    row: I64, rows: int, skip: int, left: int, width: int, W: F64, ld: int, numbers: F64, x: F64, v: F64, scale: F64,
    s: F64,
) -> None:  # fmt: skip
    """The reflections of a row on `width` of its columns from `left` on."""
    for a in range(row[br.DIM]):
        line = row[br.ROW] + a * row[br.LD] + left
        va, sa, base = v[a], scale[a], skip + left
        for c in range(width):
            put(s, c, va * load(numbers, line + c))
        k = 0
        while k + 3 <= rows:
            x0, x1, x2 = x[a, k], x[a, k + 1], x[a, k + 2]
            w0, w1, w2 = k * ld + base, (k + 1) * ld + base, (k + 2) * ld + base
            for c in range(width):
                put(s, c, load(s, c) + x0 * load(W, w0 + c) + x1 * load(W, w1 + c) + x2 * load(W, w2 + c))
            k += 3
        while k < rows:
            x0, w0 = x[a, k], k * ld + base
            for c in range(width):
                put(s, c, load(s, c) + x0 * load(W, w0 + c))
            k += 1
        for c in range(width):
            put(s, c, load(s, c) * sa)
        for c in range(width):
            put(numbers, line + c, load(numbers, line + c) - va * load(s, c))
        for k in range(rows):
            x0, w0 = x[a, k], k * ld + base
            for c in range(width):
                put(W, w0 + c, load(W, w0 + c) - x0 * load(s, c))
