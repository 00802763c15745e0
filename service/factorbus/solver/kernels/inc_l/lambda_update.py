"""The Λ-update: R̃₂₂ᵀ R̃₂₂ = Λ₂₂ − R₁₂ᵀ R₁₂, d̃₂ with it.  MATH §8.3, (17) and (20) of the 2013 paper.

"2" are the rows that the new factors reach; with a row its ancestors are among them, so what the other rows hold of
them is the end of those rows.  The reached rows are made anew one after the other, each from its blocks of Λ less the
products of the rows before it (left-looking; a row waits in the list of the position whose turn it is next).
"""

import math

import numpy as np

from factorbus.solver.kernels.inc_l import block_rows as br
from factorbus.solver.kernels.inc_l.records import BlockList, BlockRows, rows_at
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.simd import zero
from factorbus.solver.kernels.jit.sorting import sort
from factorbus.solver.kernels.sparse.partial_cholesky import PIVOT_TOLERANCE

NONE = -1


@kernel("int64(int64[::1], int64, int64[:,::1], float64[::1], float64[::1], int64[::1])")
def lambda_update(reached: I64, blocks: int, pattern: I64, data: F64, eta: F64, rows_table: I64) -> int:
    """Make the rows at the positions `reached` (ascending) anew from η and the `blocks` blocks of Λ in `pattern`.

    Gives −1, or a position whose pivot failed.
    """
    rows = rows_at(rows_table)
    n = rows.counts[br.POSITIONS]
    is_reached = np.zeros(n, np.int64)
    for j in reached:
        is_reached[j] = 1
    begin, block_of = blocks_by_row(reached, is_reached, blocks, pattern, rows.place)
    renew_structure(reached, begin, block_of, pattern, rows)
    # the entry of each row that is next to be used, and its first scalar in the row
    entry, offset, head, after = np.empty(n, np.int64), np.empty(n, np.int64), np.full(n, NONE), np.empty(n, np.int64)
    for k in range(n):
        if is_reached[k] == 0:
            queue_row(k, is_reached, rows, entry, offset, head, after)
    where = np.empty(n, np.int64)  # of each position in the row that is being made
    for t in range(reached.size):
        j = reached[t]
        own = block_of[begin[t] : begin[t + 1]]
        fill_row(j, own, pattern, data, eta, rows, where)
        k = head[j]
        while k != NONE:
            following = after[k]
            take_product(j, k, entry[k], offset[k], rows, where)
            advance(k, rows, entry, offset, head, after)
            k = following
        row = rows.rec[j]
        if not factor_row(row, load_floor(row[br.DIM], pattern[2, own[0]], data), rows.numbers, rows.d):
            return j
        entry[j], offset[j] = 0, 0
        advance(j, rows, entry, offset, head, after)
    return -1


@part
def blocks_by_row(reached: I64, is_reached: I64, blocks: int, pattern: I64, place: I64) -> tuple[I64, I64]:
    """The blocks of Λ between reached positions, sorted by the lower position, the diagonal block first."""
    row_of = np.full(is_reached.size, NONE)
    for t in range(reached.size):
        row_of[reached[t]] = t
    begin = np.zeros(reached.size + 2, np.int64)
    for b in range(blocks):
        i, j = place[pattern[0, b]], place[pattern[1, b]]
        if is_reached[i] and is_reached[j]:
            begin[row_of[min(i, j)] + 2] += 1
    for t in range(reached.size):
        begin[t + 2] += begin[t + 1]
    start, out = begin.copy(), np.empty(begin[-1], np.int64)
    for b in range(blocks):
        i, j = place[pattern[0, b]], place[pattern[1, b]]
        if is_reached[i] and is_reached[j]:
            t = row_of[min(i, j)] + 1
            out[begin[t]] = b
            if i == j:  # to the front
                out[begin[t]], out[start[t]] = out[start[t]], b
            begin[t] += 1
    return begin, out


@part
def renew_structure(reached: I64, begin: I64, block_of: I64, pattern: I64, rows: BlockRows) -> None:
    """Rows get the positions of the new blocks of Λ and of their children in the tree."""
    rec, index, place, n = rows.rec, rows.index, rows.place, rows.counts[br.POSITIONS]
    seen, head, after = np.full(n, NONE), np.full(n, NONE), np.full(n, NONE)
    list_ = np.empty(n, np.int64)
    for t in range(reached.size):
        j = reached[t]
        count = 0
        for e in range(rec[j, br.LIST], rec[j, br.LIST] + rec[j, br.COUNT]):
            seen[index[e]] = j
            list_[count] = index[e]
            count += 1
        for e in range(begin[t], begin[t + 1]):
            b = block_of[e]
            i = max(place[pattern[0, b]], place[pattern[1, b]])
            if seen[i] != j:
                seen[i] = j
                list_[count] = i
                count += 1
        child = head[j]
        while child != NONE:
            for e in range(rec[child, br.LIST] + 1, rec[child, br.LIST] + rec[child, br.COUNT]):
                if seen[index[e]] != j:
                    seen[index[e]] = j
                    list_[count] = index[e]
                    count += 1
            child = after[child]
        if count != rec[j, br.COUNT]:
            sort(list_[:count])
            width = 0
            for e in range(count):
                width += rec[list_[e], br.DIM]
            br.widen_row(j, BlockList(list_, 0, count, width), rows)
        if count > 1:
            parent = index[rec[j, br.LIST] + 1]
            after[j], head[parent] = head[parent], j


@inline_kernel
def queue_row(k: int, is_reached: I64, rows: BlockRows, entry: I64, offset: I64, head: I64, after: I64) -> None:
    """A row that stays waits for the first reached position in its list, if there is one."""
    rec, index = rows.rec, rows.index
    first, e, x = rec[k, br.LIST], rec[k, br.COUNT], rec[k, br.WIDTH]
    while e > 1 and is_reached[index[first + e - 1]]:
        e -= 1
        x -= rec[index[first + e], br.DIM]
    if e < rec[k, br.COUNT]:
        j = index[first + e]
        entry[k], offset[k] = e, x
        after[k], head[j] = head[j], k


@inline_kernel
def advance(k: int, rows: BlockRows, entry: I64, offset: I64, head: I64, after: I64) -> None:
    """Row k waits for the next position in its list."""
    rec, index = rows.rec, rows.index
    first = rec[k, br.LIST]
    offset[k] += rec[index[first + entry[k]], br.DIM]
    entry[k] += 1
    if entry[k] < rec[k, br.COUNT]:
        j = index[first + entry[k]]
        after[k], head[j] = head[j], k


@part
def fill_row(j: int, own: I64, pattern: I64, data: F64, eta: F64, rows: BlockRows, where: I64) -> None:
    """Row j := row j of Λ and η, whose blocks are `own`; where: gets where its positions are in it."""
    rec, index, numbers, place, d = rows.rec, rows.index, rows.numbers, rows.place, rows.d
    row = rec[j]
    x = 0
    for e in range(row[br.LIST], row[br.LIST] + row[br.COUNT]):
        where[index[e]] = x
        x += rec[index[e], br.DIM]
    for i in range(row[br.DIM]):
        zero(numbers, row[br.ROW] + i * row[br.LD], row[br.WIDTH])
        d[row[br.SCALAR] + i] = eta[row[br.START] + i]
    for e in range(own.size):
        b = own[e]
        a, c, source = place[pattern[0, b]], place[pattern[1, b]], pattern[2, b]
        other = c if a == j else a
        height, width, target = row[br.DIM], rec[other, br.DIM], row[br.ROW] + where[other]
        for i in range(height):
            for q in range(width):
                turned = a != j
                value = data[source + (q * height + i if turned else i * width + q)]
                numbers[target + i * row[br.LD] + q] = value


@part
def take_product(j: int, k: int, entry: int, offset: int, rows: BlockRows, where: I64) -> None:
    """Row j −= R_kjᵀ (row k from j on), d_j −= R_kjᵀ d_k.  Neighbours that stay neighbours go together."""
    rec, index, numbers, d = rows.rec, rows.index, rows.numbers, rows.d
    row, other = rec[j], rec[k]
    height, base, ld = row[br.DIM], other[br.ROW], other[br.LD]
    for q in range(other[br.DIM]):
        y = d[other[br.SCALAR] + q]
        for i in range(height):
            scalar = row[br.SCALAR] + i
            d[scalar] -= numbers[base + q * ld + offset + i] * y
    e, last, x = entry, other[br.COUNT], offset
    while e < last:
        target = where[index[other[br.LIST] + e]]
        source, end = x, target
        while e < last and where[index[other[br.LIST] + e]] == end:
            dim = rec[index[other[br.LIST] + e], br.DIM]
            end += dim
            x += dim
            e += 1
        width = end - target
        for i in range(height):
            line = row[br.ROW] + i * row[br.LD] + target
            for q in range(other[br.DIM]):
                factor, from_ = numbers[base + q * ld + offset + i], base + q * ld + source
                for c in range(width):
                    numbers[line + c] -= factor * numbers[from_ + c]


@inline_kernel
def load_floor(dim: int, source: int, data: F64) -> float:
    """The least pivot allowed in a row of `dim` scalars whose diagonal block of Λ is at data[source]."""
    least = math.inf
    for i in range(dim):
        least = min(least, data[source + i * dim + i])
    return PIVOT_TOLERANCE * least


@part
def factor_row(row: I64, floor: float, numbers: F64, d: F64) -> bool:
    """Row := R_jj⁻ᵀ row and d_j := R_jj⁻ᵀ d_j, R_jj the factor of its diagonal block; False: a pivot failed."""
    dim, base, ld, width, scalar = row[br.DIM], row[br.ROW], row[br.LD], row[br.WIDTH], row[br.SCALAR]
    for i in range(dim):
        line = base + i * ld
        for q in range(i):
            factor = numbers[base + q * ld + i]
            for c in range(i, width):
                numbers[line + c] -= factor * numbers[base + q * ld + c]
            d[scalar + i] -= factor * d[scalar + q]
        pivot = numbers[line + i]
        if not (pivot > floor and pivot > 0.0 and pivot < math.inf):
            return False
        scale = 1.0 / math.sqrt(pivot)
        for c in range(i, width):
            numbers[line + c] = numbers[line + c] * scale
        for c in range(i):
            numbers[line + c] = 0.0
        d[scalar + i] = d[scalar + i] * scale
    return True
