"""The Ω-update: R̃₂₂ᵀ R̃₂₂ = R₂₂ᵀ R₂₂ + Ω, d̃₂ with it.  MATH §8.2, (18) and (19) of the 2013 paper.

Rows of the whitened factors, W with WᵀW = Ω, are rotated into the rows of R that they reach, one block row after the
other (a Householder reflection per scalar), so that R₂₂ᵀ R₂₂ is never multiplied out:

    Q [ R₂₂  d₂ ]  =  [ R̃₂₂  d̃₂ ]
      [ W    w  ]     [ 0     ·  ]
"""

import math
from typing import NamedTuple

import numpy as np

from factorbus.solver.kernels.inc_l import block_rows as br
from factorbus.solver.kernels.inc_l.records import BlockList, BlockRows, rows_at
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.simd import zero
from factorbus.solver.kernels.jit.sorting import sort
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import (
    count_ends,
    end_of,
    is_member,
    is_one_of_many,
    residual_size,
)
from factorbus.solver.kernels.model.linearize import Scratch, evaluate_apart, make_scratch
from factorbus.solver.kernels.model.many import Many, linearize_many, upper_factor, width_of
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.model.sizes import MOST_SCALARS, information_at, residual_dim

# Of W at a time.  A step of this kind has at most 24 rows of `fac` (`inc_l.strategy`), so none of its factors has more
# than seven variables, and one row more than these have scalars.
MOST_ROWS = 64
_STRIP = 96  # columns that are worked on together: with MOST_ROWS rows they fit the first level cache


class WhitenedRows(NamedTuple):
    """Rows of [ W  w ]: row k has W at W[k·ld :], and w at rhs[k]."""

    W: F64
    ld: int
    rhs: F64


class Remaining(NamedTuple):
    """What is not yet rotated away: at the positions union[first : count], `width` scalars from column `skip` on."""

    first: int
    count: int
    skip: int
    width: int


class Reflections(NamedTuple):
    """One for each scalar of a block row, d at most: x (d, rows of W), v (d,), scale (d,); and s (_STRIP,), scratch."""

    x: F64
    v: F64
    scale: F64
    s: F64


@kernel("int64(int64, int64, int64[::1], int64[::1], int64, float64[::1])")
def omega_update(f0: int, f1: int, graph_table: I64, rows_table: I64, ld: int, W: F64) -> int:
    """Fold factors f0 .. f1−1, linearized at the graph's values, into R and d.

    ld: the scalars of the rows they reach   W: room for MOST_ROWS · ld
    Gives −1, or a position whose pivot is not a positive number.
    """
    graph, rows = graph_at(graph_table), rows_at(rows_table)
    fac, rec = graph.fac, rows.rec
    union, spare = np.empty(ld, np.int64), np.empty(ld, np.int64)
    scratch, whitened = make_scratch(), WhitenedRows(W, ld, np.empty(MOST_ROWS))
    r, H = scratch.r, scratch.H
    f = f0
    while f < f1:
        last, height = f, 0
        while last < f1 and height + residual_size(last, fac) <= MOST_ROWS:
            height += residual_size(last, fac)
            last += 1
        count = list_ends(f, last, graph, rows.place, union)
        width = 0
        for e in range(count):
            width += rec[union[e], br.DIM]
        for k in range(height):
            zero(W, k * ld, width)
        k = 0
        for g in range(f, last):
            if is_one_of_many(g, fac):
                if not is_member(g, fac):
                    _, many = linearize_many(g, graph.var, fac, graph.values, graph.payload)
                    k = write_rows(g, k, many, graph, rows, union, whitened)
                continue
            evaluate_apart(g, graph.var, fac, graph.values, graph.payload, r, H[0], H[1])
            k = whiten(g, k, graph, rows, union, scratch, whitened)
        failed = sweep(height, Remaining(0, count, 0, width), union, spare, whitened, rows)
        if failed >= 0:
            return failed
        f = last
    return -1


@part
def list_ends(f0: int, f1: int, graph: Graph, place: I64, out: I64) -> int:
    """The positions of the free variables of factors f0 .. f1−1, ascending, each once; gives how many."""
    var, fac = graph.var, graph.fac
    most, n = 0, 0
    for f in range(f0, f1):
        most += 0 if is_member(f, fac) else count_ends(f, fac)
    found = np.empty(most, np.int64)
    for f in range(f0, f1):
        for end in range(0 if is_member(f, fac) else count_ends(f, fac)):
            v = end_of(f, end, fac)
            if var[v, at.V_COLUMN] >= 0:
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
def whiten(f: int, k: int, graph: Graph, rows: BlockRows, union: I64, scratch: Scratch, whitened: WhitenedRows) -> int:
    """Write the rows C H and −C r of factor f, CᵀC its information, from row k of W on; gives the row behind.

    scratch: has r and H, and gets C
    """
    var, fac, payload, place, rec = graph.var, graph.fac, graph.payload, rows.place, rows.rec
    r, H, C, W, ld, rhs = scratch.r, scratch.H, scratch.W, whitened.W, whitened.ld, whitened.rhs
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
                W[(k + a) * ld + offset + c] = total
    return k + dim


@part
def write_rows(
    f: int, k: int, many: Many, graph: Graph, rows: BlockRows, union: I64, whitened: WhitenedRows
) -> int:  # fmt: skip
    """Write J and −r of the factor that begins at row f from row k of W on; gives the row of W behind them."""
    place, rec, ld, dim = rows.place, rows.rec, whitened.ld, len(many.J)
    for a in range(dim):
        whitened.rhs[k + a] = -many.r[a]
    for n in range(many.start.size - 1):
        column = graph.var[end_of(f, n, graph.fac), at.V_COLUMN]
        if column < 0:
            continue
        offset, e = 0, 0
        while union[e] != place[column]:
            offset += rec[union[e], br.DIM]
            e += 1
        for a in range(dim):
            to = (k + a) * ld + offset
            for c in range(width_of(n, many)):
                whitened.W[to + c] = many.J[a, many.start[n] + c]
    return k + dim


@part
def sweep(height: int, left: Remaining, union: I64, spare: I64, whitened: WhitenedRows, rows: BlockRows) -> int:
    """Rotate the first `height` rows of W into R, from the first row they touch to the last.

    Gives −1, or a position whose pivot is not a positive number.
    """
    most = MOST_SCALARS
    made = Reflections(np.empty((most, height)), np.empty(most), np.empty(most), np.empty(_STRIP))
    while left.first < left.count:
        i = union[left.first]
        left = join_lists(i, left, height, union, spare, whitened, rows)
        if rows.rec[i, br.COUNT] != left.count - left.first:
            br.widen_row(i, BlockList(union, left.first, left.count - left.first, left.width), rows)
        row = rows.rec[i]
        dim = row[br.DIM]
        if not reflect(row, height, left.skip, whitened, rows, made):
            return i
        for c in range(dim, left.width, _STRIP):
            apply(row, height, left.skip, c, min(_STRIP, left.width - c), whitened, rows.numbers, made)
        left = Remaining(left.first + 1, left.count, left.skip + dim, left.width - dim)
    return -1


@inline_kernel
def join_lists(
    i: int, left: Remaining, height: int, union: I64, spare: I64, whitened: WhitenedRows, rows: BlockRows
) -> Remaining:
    """The positions that remain become their union with the list of row i, and W gets zeros there."""
    rec, index, first, count = rows.rec, rows.index, left.first, left.count
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
        return left
    width = left.width
    e, g = 0, first
    while e < m:
        if g < count and union[g] == spare[e]:
            g += 1
        else:
            width += rec[spare[e], br.DIM]
        e += 1
    new, old = BlockList(spare, 0, m, width), BlockList(union, first, count - first, left.width)
    for k in range(height):
        start = k * whitened.ld + left.skip
        br.move_blocks(new, old, rec, whitened.W, start, start)
    for e in range(m):
        union[first + e] = spare[e]
    return Remaining(first, first + m, left.skip, width)


@part
def reflect(row: I64, height: int, skip: int, whitened: WhitenedRows, rows: BlockRows, made: Reflections) -> bool:
    """The reflections that clear W under the diagonal block of a row, applied to that block and to d and rhs.

    Reflection a is I − scale · (v, x)(v, x)ᵀ on (row a of the block, the rows of W); it leaves the pivot positive.
    """
    W, ld, rhs, numbers, d = whitened.W, whitened.ld, whitened.rhs, rows.numbers, rows.d
    x, v, scale = made.x, made.v, made.scale
    dim, base, step, scalar = row[br.DIM], row[br.ROW], row[br.LD], row[br.SCALAR]
    for a in range(dim):
        alpha, sigma = numbers[base + a * step + a], 0.0
        for k in range(height):
            x[a, k] = W[k * ld + skip + a]
            sigma += x[a, k] * x[a, k]
        pivot = math.sqrt(alpha * alpha + sigma)
        if not (pivot > 0.0 and pivot < math.inf):
            return False
        # α − |(α, x)| without cancellation
        v[a] = -sigma / (alpha + pivot)
        length = sigma + v[a] * v[a]
        scale[a] = 2.0 / length if length > 0.0 else 0.0
        numbers[base + a * step + a] = pivot
        for c in range(a + 1, dim):
            total = v[a] * numbers[base + a * step + c]
            for k in range(height):
                total += x[a, k] * W[k * ld + skip + c]
            total *= scale[a]
            numbers[base + a * step + c] -= v[a] * total
            for k in range(height):
                W[k * ld + skip + c] -= x[a, k] * total
        total = v[a] * d[scalar + a]
        for k in range(height):
            total += x[a, k] * rhs[k]
        total *= scale[a]
        d[scalar + a] -= v[a] * total
        for k in range(height):
            rhs[k] -= x[a, k] * total
    return True


@part
def apply(
    row: I64, height: int, skip: int, left: int, width: int, whitened: WhitenedRows, numbers: F64, made: Reflections
) -> None:
    """The reflections of a row on `width` of its columns from `left` on."""
    W, ld, x, v, scale, s = whitened.W, whitened.ld, made.x, made.v, made.scale, made.s
    for a in range(row[br.DIM]):
        line = row[br.ROW] + a * row[br.LD] + left
        va, sa, base = v[a], scale[a], skip + left
        for c in range(width):
            s[c] = va * numbers[line + c]
        k = 0
        while k + 3 <= height:
            x0, x1, x2 = x[a, k], x[a, k + 1], x[a, k + 2]
            w0, w1, w2 = k * ld + base, (k + 1) * ld + base, (k + 2) * ld + base
            for c in range(width):
                s[c] += x0 * W[w0 + c] + x1 * W[w1 + c] + x2 * W[w2 + c]
            k += 3
        while k < height:
            x0, w0 = x[a, k], k * ld + base
            for c in range(width):
                s[c] += x0 * W[w0 + c]
            k += 1
        for c in range(width):
            s[c] = s[c] * sa
        for c in range(width):
            numbers[line + c] -= va * s[c]
        for k in range(height):
            x0, w0 = x[a, k], k * ld + base
            for c in range(width):
                W[w0 + c] -= x0 * s[c]
