"""R in block rows that are cheap to change in structure and in numbers: their layout, growth, and solves with them.

Position k is the k-th block column of the elimination order.  Block row k of R holds the blocks (k, j) for the
positions j of its list, ascending, itself first; new positions are appended behind all others.
The arrays are those of `records.BlockRows`.

The first off-diagonal entry of a row is its parent in the elimination tree, and the rest of the row is in the parent's.
"""

import numpy as np

from factorbus.solver.kernels.inc_l.records import BlockList, BlockRows, rows_at
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.simd import zero
from factorbus.solver.kernels.jit.sorting import sort
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.sparse import fronts as fr

COLUMN = 0  # block column of Λ
DIM = 1
SCALAR = 2  # first scalar in elimination order
START = 3  # first scalar in insertion order
LIST = 4  # its positions are index[LIST : LIST + COUNT], with room for ROOM
COUNT = 5
ROOM = 6
ROW = 7  # numbers[ROW : ROW + DIM * LD]
WIDTH = 8
LD = 9
RECORD = 10

POSITIONS = 0
SCALARS = 1
INDEX = 2
NUMBERS = 3
COUNTS = 4

_NEW_ROOM = 4  # positions a new row has room for


@kernel("void(int64, int64, int64[::1], int64[::1])")
def append_rows(v0: int, v1: int, graph_table: I64, rows_table: I64) -> None:
    """Append zero rows, without information, for the free variables v0 .. v1−1.

    graph_table, rows_table: of the arrays of the graph and of R (`records`), here and below
    """
    graph, rows = graph_at(graph_table), rows_at(rows_table)
    var, dims, rec, index, numbers = graph.var, graph.dims, rows.rec, rows.index, rows.numbers
    place, d, counts = rows.place, rows.d, rows.counts
    for v in range(v0, v1):
        c = var[v, at.V_COLUMN]
        if c < 0:
            continue
        k, dim = counts[POSITIONS], dims[c]
        row = rec[k]
        row[COLUMN], row[DIM], row[SCALAR], row[START] = c, dim, counts[SCALARS], var[v, at.V_SCALAR]
        row[LIST], row[COUNT], row[ROOM] = counts[INDEX], 1, _NEW_ROOM
        row[ROW], row[WIDTH], row[LD] = counts[NUMBERS], dim, 3 * _NEW_ROOM
        index[row[LIST]], place[c] = k, k
        zero(numbers, row[ROW], dim * row[LD])
        zero(d, row[SCALAR], dim)
        counts[POSITIONS] += 1
        counts[SCALARS] += dim
        counts[INDEX] += row[ROOM]
        counts[NUMBERS] += dim * row[LD]


@kernel("void(int64[::1], int64[::1], int64[::1], int64[:,::1], int64[::1], float64[::1], int64[::1])")
def take_fronts(order: I64, dims: I64, starts: I64, fronts: I64, separator: I64, arena: F64, rows_table: I64) -> None:
    """Copy R from the fronts of a factorization, block by block.

    The zeros of joined fronts come along: the lists are those of the fronts.
    """
    rows = rows_at(rows_table)
    rec, index, numbers, place, counts = rows.rec, rows.index, rows.numbers, rows.place, rows.counts
    n = order.size
    position = np.empty(starts[n], np.int64)  # of each scalar in elimination order
    scalar = 0
    for k in range(n):
        row, dim = rec[k], dims[order[k]]
        row[COLUMN], row[DIM], row[SCALAR], row[START] = order[k], dim, scalar, starts[order[k]]
        place[order[k]] = k
        for _ in range(dim):
            position[scalar] = k
            scalar += 1
    put_list, put_row = 0, 0
    for f in range(fronts.shape[0]):
        front = fronts[f]
        p, m, ld, b = front[fr.PIVOTS], front[fr.SEPARATOR], front[fr.LD_ROWS], front[fr.SEPARATOR_AT]
        first = front[fr.VARIABLE]
        last = fronts[f + 1, fr.VARIABLE] if f + 1 < fronts.shape[0] else n
        for k in range(first, last):
            row = rec[k]
            dim, skip = row[DIM], row[SCALAR] - front[fr.COLUMN]
            row[LIST], row[ROW], row[WIDTH] = put_list, put_row, p - skip + m
            row[LD] = row[WIDTH]
            for j in range(k, last):
                index[put_list] = j
                put_list += 1
            j = 0
            while j < m:
                index[put_list] = position[separator[b + j]]
                j += rec[index[put_list], DIM]
                put_list += 1
            row[COUNT] = row[ROOM] = put_list - row[LIST]
            source = front[fr.ROWS] + skip * ld + skip
            for i in range(dim):
                zero(numbers, put_row, i)
                for j in range(i, row[WIDTH]):
                    numbers[put_row + j] = arena[source + i * ld + j]
                put_row += row[WIDTH]
    counts[POSITIONS], counts[SCALARS], counts[INDEX], counts[NUMBERS] = n, scalar, put_list, put_row


@kernel("int64(int64, int64, int64[::1], int64[::1], int64[::1], int64[::1], int64[::1])")
def reach_rows(f0: int, f1: int, graph_table: I64, rows_table: I64, mark: I64, out: I64, seen: I64) -> int:
    """The rows of R that factors f0 .. f1−1 change: their variables' and the ancestors of those.  MATH (8.5)

    in   mark: zero for every position; stays so
    out  out: the positions, ascending   seen (1,): their scalars
    Gives how many positions there are.
    """
    graph, rows = graph_at(graph_table), rows_at(rows_table)
    var, fac, rec, index, place = graph.var, graph.fac, rows.rec, rows.index, rows.place
    n = scalars = 0
    for f in range(f0, f1):
        for end in range(2):
            v = fac[f, at.F_I + end]
            k = place[var[v, at.V_COLUMN]] if v >= 0 and var[v, at.V_COLUMN] >= 0 else -1
            while k >= 0 and mark[k] == 0:
                mark[k] = 1
                out[n] = k
                n += 1
                scalars += rec[k, DIM]
                k = index[rec[k, LIST] + 1] if rec[k, COUNT] > 1 else -1
    sort(out[:n])
    for e in range(n):
        mark[out[e]] = 0
    seen[0] = scalars
    return n


@kernel("void(int64[::1], float64[::1], float64[::1], float64[::1])")
def solve_block_rows(rows_table: I64, d: F64, x: F64, delta: F64) -> None:
    """R x = d by blocks from the last row up; x in elimination order, δ = Pᵀ x in insertion order."""
    rows = rows_at(rows_table)
    rec, index, numbers, counts = rows.rec, rows.index, rows.numbers, rows.counts
    row_of_x = np.empty(counts[SCALARS])
    for k in range(counts[POSITIONS] - 1, -1, -1):
        row = rec[k]
        dim, width, base, ld = row[DIM], row[WIDTH], row[ROW], row[LD]
        gather_row(row, index, rec, x, row_of_x)
        for i in range(dim - 1, -1, -1):
            line, total = base + i * ld, 0.0
            for j in range(dim, width):
                total += numbers[line + j] * row_of_x[j]
            for j in range(i + 1, dim):
                total += numbers[line + j] * x[row[SCALAR] + j]
            x[row[SCALAR] + i] = (d[row[SCALAR] + i] - total) / numbers[line + i]
        for i in range(dim):
            delta[row[START] + i] = x[row[SCALAR] + i]


@inline_kernel
def gather_row(row: I64, index: I64, rec: I64, x: F64, out: F64) -> None:
    """out[dim:width] = x at the off-diagonal blocks of a row."""
    j = row[DIM]
    for e in range(row[LIST] + 1, row[LIST] + row[COUNT]):
        other = rec[index[e]]
        for c in range(other[DIM]):
            out[j] = x[other[SCALAR] + c]
            j += 1


@kernel("float64(int64[::1], float64[::1], float64[::1])")
def solve_block_rows_transposed(rows_table: I64, eta: F64, d: F64) -> float:
    """Rᵀ d = P η by blocks; η in insertion order, d in elimination order.  Gives dᵀ d."""
    rows = rows_at(rows_table)
    rec, index, numbers, counts = rows.rec, rows.index, rows.numbers, rows.counts
    taken = np.empty(counts[SCALARS])
    for k in range(counts[POSITIONS]):
        row = rec[k]
        for i in range(row[DIM]):
            d[row[SCALAR] + i] = eta[row[START] + i]
    total = 0.0
    for k in range(counts[POSITIONS]):
        row = rec[k]
        dim, width, base, ld, s = row[DIM], row[WIDTH], row[ROW], row[LD], row[SCALAR]
        for i in range(dim):
            y = d[s + i] / numbers[base + i * ld + i]
            d[s + i] = y
            total += y * y
            for j in range(i + 1, dim):
                d[s + j] -= numbers[base + i * ld + j] * y
            line = base + i * ld
            if i == 0:
                for j in range(dim, width):
                    taken[j] = numbers[line + j] * y
            else:
                for j in range(dim, width):
                    taken[j] += numbers[line + j] * y
        j = dim
        for e in range(row[LIST] + 1, row[LIST] + row[COUNT]):
            other = rec[index[e]]
            for c in range(other[DIM]):
                d[other[SCALAR] + c] -= taken[j]
                j += 1
    return float(total)


@kernel("void(int64[::1], int64[::1], float64[::1])")
def compact_rows(rows_table: I64, new_index: I64, new_numbers: F64) -> None:
    """Copy the rows to other arenas without the gaps that moved rows left behind."""
    rows = rows_at(rows_table)
    rec, index, numbers, counts = rows.rec, rows.index, rows.numbers, rows.counts
    put_list, put_row = 0, 0
    for k in range(counts[POSITIONS]):
        row = rec[k]
        for e in range(row[COUNT]):
            new_index[put_list + e] = index[row[LIST] + e]
        size = row[DIM] * row[LD]
        for j in range(size):
            new_numbers[put_row + j] = numbers[row[ROW] + j]
        row[LIST], row[ROW] = put_list, put_row
        put_list += row[ROOM]
        put_row += size
    counts[INDEX], counts[NUMBERS] = put_list, put_row


@part
def widen_row(k: int, wider: BlockList, rows: BlockRows) -> None:
    """Give row k the blocks of the list, which include those it has; new ones are zero.

    The row stays where it is if there is room, else it moves to the end of the arenas and gets room to grow.
    """
    index, counts = rows.index, rows.counts
    row, count, width = rows.rec[k], wider.count, wider.width
    if row[COUNT] == count:
        return
    old, old_ld, source = BlockList(index, row[LIST], row[COUNT], row[WIDTH]), row[LD], row[ROW]
    if row[LD] < width:
        row[LD] = width + width // 2 + 24
        row[ROW] = counts[NUMBERS]
        counts[NUMBERS] += row[DIM] * row[LD]
    for i in range(row[DIM]):
        move_blocks(wider, old, rows.rec, rows.numbers, source + i * old_ld, row[ROW] + i * row[LD])
    row[WIDTH] = width
    if row[ROOM] < count:
        row[LIST], row[ROOM] = counts[INDEX], count + count // 2 + 4
        counts[INDEX] += row[ROOM]
    for e in range(count):
        index[row[LIST] + e] = wider.positions[wider.first + e]
    row[COUNT] = count


@inline_kernel
def move_blocks(new: BlockList, old: BlockList, rec: I64, a: F64, source: int, target: int) -> None:
    """Move a scalar row with the blocks `old` at a[source] to the layout of `new` at a[target]; new blocks become zero.

    Goes from the end, so that source and target may be the same place.
    """
    e, m, x, y = old.count - 1, new.count - 1, old.width, new.width
    while m >= 0 and (m > e or source != target):
        position = new.positions[new.first + m]
        dim = rec[position, DIM]
        y -= dim
        if e >= 0 and old.positions[old.first + e] == position:
            x -= dim
            for c in range(dim - 1, -1, -1):
                a[target + y + c] = a[source + x + c]
            e -= 1
        else:
            zero(a, target + y, dim)
        m -= 1
