"""The block pattern of Λ, extended as variables and factors arrive.  MATH §4.

`pattern` (3, capacity): rows, columns and starts of the blocks, a block being stored once with row ≤ column (block
columns count free variables in insertion order).  `table` is a hash table of block index + 1 by (row, column), used as
in `key_table`.  `fill` (2,): blocks and numbers in use.  A factor remembers where its blocks start, so that adding it
again after the linearization point moved needs no search.
"""

from factorbus.solver.kernels.jit.compile import I64, inline_kernel, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at


@inline_kernel
def slot_of_pair(row: int, column: int, table: I64, pattern: I64) -> int:
    """Where the block (row, column) is in the table, or the free slot where it would go."""
    h = (int(row) * 0x45D9F3B + int(column) * 0x119DE1F3) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    h ^= h >> 16
    mask = table.size - 1
    slot = h & mask
    while table[slot] != 0:
        b = table[slot] - 1
        if pattern[0, b] == row and pattern[1, b] == column:
            break
        slot = (slot + 1) & mask
    return slot


@inline_kernel
def block_of(row: int, column: int, size: int, table: I64, pattern: I64, fill: I64) -> int:
    """Where the block (row, column) starts; it is appended where there is none yet."""
    slot = slot_of_pair(row, column, table, pattern)
    if table[slot] == 0:
        b = fill[0]
        pattern[0, b], pattern[1, b], pattern[2, b] = row, column, fill[1]
        table[slot] = b + 1
        fill[0] += 1
        fill[1] += size
    return int(pattern[2, table[slot] - 1])


@kernel("void(int64, int64, int64, int64, int64[::1], int64[::1], int64[:,::1], int64[::1])")
def connect_blocks(v0: int, v1: int, f0: int, f1: int, graph_table: I64, table: I64, pattern: I64, fill: I64) -> None:
    """Append the blocks of variables v0 .. v1−1 and of factors f0 .. f1−1; graph_table: of their arrays (`records`)."""
    graph = graph_at(graph_table)
    var, fac, dims = graph.var, graph.fac, graph.dims
    for v in range(v0, v1):
        c = var[v, at.V_COLUMN]
        if c >= 0:
            var[v, at.V_DIAGONAL] = block_of(c, c, dims[c] * dims[c], table, pattern, fill)
    for f in range(f0, f1):
        i, j = fac[f, at.F_I], fac[f, at.F_J]
        fac[f, at.F_II] = var[i, at.V_DIAGONAL]
        if j < 0:
            continue
        fac[f, at.F_JJ] = var[j, at.V_DIAGONAL]
        a, b = var[i, at.V_COLUMN], var[j, at.V_COLUMN]
        if a >= 0 and b >= 0:
            fac[f, at.F_IJ] = block_of(min(a, b), max(a, b), dims[a] * dims[b], table, pattern, fill)
            fac[f, at.F_FLAGS] = fac[f, at.F_FLAGS] & ~at.SWAPPED | (at.SWAPPED if a > b else 0)


@kernel("void(int64, int64[::1], int64[:,::1])")
def enter_blocks(count: int, table: I64, pattern: I64) -> None:
    """Fill an empty table with the first `count` blocks."""
    for b in range(count):
        table[slot_of_pair(pattern[0, b], pattern[1, b], table, pattern)] = b + 1


@kernel("void(int64, int64, int64[::1], int64[:,::1])")
def remove_blocks(first: int, last: int, table: I64, pattern: I64) -> None:
    """Remove the blocks first .. last−1, which are the last that were appended."""
    for b in range(last - 1, first - 1, -1):
        table[slot_of_pair(pattern[0, b], pattern[1, b], table, pattern)] = 0
